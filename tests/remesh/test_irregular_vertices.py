"""Irregular vertices cancel when a quad is collapsed; the mesh stays a manifold."""

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import valences
from gdtool.geometry.meshes import QuadMesh
from gdtool.remesh.connectivity.irregular_vertices import cancel_irregular
from tests.geometry.solids import quad_torus


def opened(points: np.ndarray, quads: np.ndarray, v: int) -> tuple[np.ndarray, np.ndarray]:
    """Split vertex v of four quads into two of three edges, with a new quad between: a diagonal collapse inverted."""
    around = np.flatnonzero((quads == v).any(1))
    after = {int(q[(q.tolist().index(v) + 1) % 4]): i for i, q in zip(around, quads[around], strict=True)}
    before = {i: int(q[(q.tolist().index(v) - 1) % 4]) for i, q in zip(around, quads[around], strict=True)}
    fan = [int(around[0])]
    while len(fan) < 4:
        fan.append(after[before[fan[-1]]])
    quads = quads.copy()
    for i in fan[:2]:
        quads[i][quads[i] == v] = len(points)
    start = quads[fan[0]][(quads[fan[0]].tolist().index(len(points)) + 1) % 4]
    end = before[fan[1]]
    return np.concatenate([points, points[v : v + 1] * 1.01]), np.concatenate([quads, [[v, start, len(points), end]]])


def test_a_split_vertex_is_merged_again():
    points, quads = quad_torus()
    more_points, more = opened(points, quads, 40)
    assert topology.is_watertight(more)
    assert (valences(more, len(more_points))[0] != 4).sum() == 4
    made = cancel_irregular(QuadMesh(more_points, more))
    out, quads_out = made.vertices, made.faces
    assert len(quads_out) == len(quads)
    assert topology.is_watertight(quads_out)
    assert topology.is_manifold(quads_out)
    assert (valences(quads_out, len(out))[0] == 4).all()


def test_a_regular_mesh_is_unchanged():
    points, quads = quad_torus()
    made = cancel_irregular(QuadMesh(points, quads))
    out, quads_out = made.vertices, made.faces
    assert (quads_out == quads).all()
    assert (out == points).all()
