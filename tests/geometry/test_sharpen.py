"""Bevels: what is found where the surface turns, and what their collapse may change."""

import numpy as np
import pytest

from gdtool.geometry import sharpen, topology
from gdtool.remesh.fit.feature_curves import find_features
from tests.geometry.solids import bored_box, cube, sphere, torus, volume


@pytest.mark.parametrize("solid", [sphere, torus, bored_box])
def test_no_bent_edge_is_left_out(solid):
    vertices, faces = solid(40)
    maybe, used = sharpen._maybe_bent(np.concatenate([vertices, vertices[:3]]), faces, 15.0)
    assert used == len(vertices)
    ends, _, angle = sharpen.dihedral_degrees(vertices, faces)
    assert maybe[ends[angle > 15]].all()


@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_creases_restored_keep_the_mesh_closed_and_their_input(kind):
    vertices, faces = bored_box(48)
    before, faces = vertices.copy(), faces.astype(kind)
    before_faces = faces.copy()
    out, found, report = sharpen.restore_creases(vertices, faces)
    assert (vertices == before).all() and (faces == before_faces).all()
    assert report["moved"] > 300 and 0 < report["largest_move"] < 0.1 and 0 < report["bevel_share"] < 0.25
    assert len(found) < len(faces) - 200 and topology.invariants(found) == topology.invariants(faces)
    assert len(np.unique(found)) == len(out) and np.linalg.norm(out - [0.8, 0.6, 0.5], axis=1).min() < 0.02
    true = 1.6 * 1.2 * 1.0 - np.pi * 0.3**2
    assert abs(volume(out, found) - true) < 0.3 * abs(volume(vertices, faces) - true)


def test_bevels_collapse_onto_vertices_they_had():
    vertices, faces = bored_box(32)
    longest = 0.6 * np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).max()
    out, found = sharpen.collapse_bevels(vertices, faces, np.ones(len(vertices), bool), longest)
    assert len(found) < 0.9 * len(faces) and topology.invariants(found) == topology.invariants(faces)
    assert {tuple(place) for place in out.tolist()} < {tuple(place) for place in vertices.tolist()}
    for moved, most in ((np.zeros(len(vertices), bool), longest), (np.ones(len(vertices), bool), 0.0)):
        same, same_faces = sharpen.collapse_bevels(vertices, faces, moved, most)
        assert (same == vertices).all() and (same_faces == faces).all()


def test_edges_collapsed_at_once_are_those_collapsed_one_by_one():
    vertices, faces = bored_box(24)
    edges = topology.edges_of(faces).ends
    edges = edges[np.random.default_rng(0).permutation(len(edges))]
    longest = 0.9 * np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    together, alone = (sharpen._Rims(vertices, faces.astype(np.int64), longest) for _ in range(2))
    together.collapse(edges)
    for edge in edges:
        alone.collapse(alone.became[edge][None])
    assert (
        (together.became == alone.became).all()
        and (together.stays == alone.stays).all()
        and together.stays.mean() < 0.8
    )


def test_bevels_of_marching_cubes_become_creases():
    vertices, faces = bored_box()
    sharp, sharp_faces, report = sharpen.restore_creases(vertices, faces)
    assert report["moved"] > 300 and topology.is_watertight(sharp_faces) and topology.is_manifold(sharp_faces)
    corner = np.array([0.8, 0.6, 0.5])
    before, after = (np.linalg.norm(v - corner, axis=1).min() for v in (vertices, sharp))
    assert after < 0.2 * before
    features = find_features(sharp, sharp_faces, 30.0, 0.15)
    length = np.linalg.norm(
        features.points[features.segments[:, 0]] - features.points[features.segments[:, 1]], axis=1
    ).sum()
    assert length == pytest.approx(4 * (1.6 + 1.2 + 1.0) + 2 * 2 * np.pi * 0.3, rel=0.05)


def test_smooth_and_sharp_meshes_are_left_alone():
    for vertices, faces in (sphere(32), cube()):
        assert sharpen.restore_creases(vertices, faces)[2]["moved"] == 0
