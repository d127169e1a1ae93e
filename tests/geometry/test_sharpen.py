"""Measure dihedral angles, and turn the bevels of marching cubes into creases."""

import numpy as np
import pytest

from gdtool.geometry import sharpen, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.remesh.fit.feature_curves import find_features
from tests.geometry.solids import bored_box, cube, sphere, torus, volume


@pytest.mark.parametrize("solid", [sphere, torus, bored_box])
def test_the_quick_test_for_bent_vertices_misses_none(solid):
    vertices, faces = solid(40)
    maybe, used = sharpen._may_be_bent(TriMesh(np.concatenate([vertices, vertices[:3]]), faces), 15.0)
    assert used == len(vertices)
    ends, _, angle = sharpen.dihedral_degrees(TriMesh(vertices, faces))
    assert maybe[ends[angle > 15]].all()


@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_restoring_creases_keeps_the_topology_and_the_input(kind):
    vertices, faces = bored_box(48)
    before, faces = vertices.copy(), faces.astype(kind)
    before_faces = faces.copy()
    restored = sharpen.restore_creases(TriMesh(vertices, faces))
    out, out_faces = restored.mesh.vertices, restored.mesh.faces
    assert (vertices == before).all()
    assert (faces == before_faces).all()
    assert restored.moved > 300
    assert 0 < restored.largest_move < 0.1
    assert 0 < restored.bevel_share < 0.25
    assert len(out_faces) < len(faces) - 200
    assert topology.invariants(out_faces) == topology.invariants(faces)
    assert len(np.unique(out_faces)) == len(out)
    assert np.linalg.norm(out - [0.8, 0.6, 0.5], axis=1).min() < 0.02
    true = 1.6 * 1.2 * 1.0 - np.pi * 0.3**2
    assert abs(volume(out, out_faces) - true) < 0.3 * abs(volume(vertices, faces) - true)


def test_collapsed_bevels_keep_some_of_their_vertices():
    vertices, faces = bored_box(32)
    longest = 0.6 * np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).max()
    mesh = TriMesh(vertices, faces)
    collapsed = sharpen.collapse_bevels(mesh, np.ones(len(vertices), bool), longest)
    assert len(collapsed.faces) < 0.9 * len(faces)
    assert topology.invariants(collapsed.faces) == topology.invariants(faces)
    assert set(map(tuple, collapsed.vertices.tolist())) < set(map(tuple, vertices.tolist()))
    for moved, most in ((np.zeros(len(vertices), bool), longest), (np.ones(len(vertices), bool), 0.0)):
        same = sharpen.collapse_bevels(mesh, moved, most)
        assert (same.vertices == vertices).all()
        assert (same.faces == faces).all()


def test_collapsing_edges_together_equals_one_by_one():
    vertices, faces = bored_box(24)
    edges = topology.edges_of(faces).ends
    edges = edges[np.random.default_rng(0).permutation(len(edges))]
    longest = 0.9 * np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    together, alone = (sharpen._Rims(TriMesh(vertices, faces.astype(np.int64)), longest) for _ in range(2))
    together.collapse(edges)
    for edge in edges:
        alone.collapse(alone.became[edge][None])
    assert (together.became == alone.became).all()
    assert (together.stays == alone.stays).all()
    assert together.stays.mean() < 0.8


def test_bevels_of_marching_cubes_become_creases():
    vertices, faces = bored_box()
    restored = sharpen.restore_creases(TriMesh(vertices, faces))
    sharp, sharp_faces = restored.mesh.vertices, restored.mesh.faces
    assert restored.moved > 300
    assert topology.is_watertight(sharp_faces)
    assert topology.is_manifold(sharp_faces)
    corner = np.array([0.8, 0.6, 0.5])
    before, after = (np.linalg.norm(v - corner, axis=1).min() for v in (vertices, sharp))
    assert after < 0.2 * before
    features = find_features(TriMesh(sharp, sharp_faces), 30.0, 0.15)
    length = np.linalg.norm(
        features.points[features.segments[:, 0]] - features.points[features.segments[:, 1]], axis=1
    ).sum()
    assert length == pytest.approx(4 * (1.6 + 1.2 + 1.0) + 2 * 2 * np.pi * 0.3, rel=0.05)


def test_smooth_and_sharp_meshes_stay_as_they_are():
    for vertices, faces in (sphere(32), cube()):
        assert sharpen.restore_creases(TriMesh(vertices, faces)).moved == 0
