"""Find edges, pieces and handles from indices, and whether a mesh is closed and manifold."""

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.meshes import QuadMesh
from tests.geometry.solids import joined, lattice, plane, sphere, torus


def test_a_plane_is_manifold_and_not_watertight():
    _, faces = plane(3)
    edges = topology.edges_of(faces)
    assert (edges.count == 1).sum() == 12
    assert topology.is_manifold(faces)
    assert not topology.is_watertight(faces)


def test_a_torus_has_euler_number_zero():
    vertices, faces = torus()
    assert len(vertices) - len(topology.edges_of(faces).ends) + len(faces) == 0
    assert topology.euler_number(faces) == 0


def test_triangulation_cuts_between_first_and_third_corner_and_keeps_volume():
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) - 0.5
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    triangles, face_idx = topology.triangulated(quads)
    assert len(triangles) == 12
    assert np.array_equal(face_idx, np.repeat(np.arange(6), 2))
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    assert np.isclose((a * np.cross(b, c)).sum() / 6, 1)  # outward: positive volume


@pytest.mark.parametrize(
    "mesh, cut, handles",
    [
        (sphere(12), 0, 0),
        (torus(20), 0, 1),
        (torus(20), 40, 1),
        (plane(4), 0, 0),
        (lattice(), 0, 28),
        (joined(torus(20), sphere(12), plane(4)), 0, 1),
    ],
    ids=["ball", "torus", "open torus", "sheet", "lattice", "several"],
)
def test_handles_are_counted_however_many_boundary_loops_there_are(mesh, cut, handles):
    vertices, faces = mesh
    faces = faces[cut:]
    pieces = topology.components(faces)[0]
    assert topology.handles(faces, pieces) == handles
    assert topology.handles(faces, pieces, topology.edges_of(faces)) == handles


def test_quads_and_triangles_share_edges():
    faces = np.array([[0, 1, 2, 3], [1, 4, 2, -1]])
    edges = topology.edges_of(faces)
    assert len(edges.ends) == 6
    assert edges.count.max() == 2
    assert not edges.turned.any()
    assert edges.face_pairs()[1].tolist() == [[0, 1]]


def test_edges_agree_with_sorting():
    rng = np.random.default_rng(0)
    faces = rng.integers(0, 40, (300, 4))
    faces[::3, 3] = -1
    edges = topology.edges_of(faces)
    half = np.sort(edges.half_ends, 1)
    ends, inverse, count = np.unique(half, axis=0, return_inverse=True, return_counts=True)
    assert (edges.ends == ends).all()
    assert (edges.count == count).all()
    assert (edges.half_edge_idx == inverse.ravel()).all()
    assert (edges.order == np.argsort(inverse.ravel(), kind="stable")).all()


@pytest.mark.parametrize("change", ["none", "turned", "opened", "doubled", "wedge"])
def test_is_watertight_agrees_with_the_edges(change):
    _, faces = torus(20)
    faces = {
        "none": faces,
        "turned": np.concatenate([faces[:1, ::-1], faces[1:]]),
        "opened": faces[1:],
        "doubled": np.concatenate([faces, faces[:1]]),
        "wedge": np.concatenate([faces, faces[:1], faces[:1, ::-1]]),
    }[change]
    edges = topology.edges_of(faces)
    assert (
        topology.is_watertight(faces) == bool((edges.count == 2).all() and not edges.turned.any()) == (change == "none")
    )


def test_compact_drops_unused_vertices_and_keeps_triangles_among_quads():
    vertices = np.arange(21.0).reshape(7, 3)
    used = topology.compact(QuadMesh(vertices, np.array([[1, 2, 4, 5], [1, 5, 6, -1]], np.int32)))
    assert (used.vertices == vertices[[1, 2, 4, 5, 6]]).all()
    assert (used.faces == [[0, 1, 2, 3], [0, 3, 4, -1]]).all()
    assert used.faces.dtype == np.int64
    assert topology.compact(used).vertices is used.vertices
