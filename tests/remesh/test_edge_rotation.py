"""Edge rotations cancel pairs of irregular vertices; creases stay, and the mesh stays a manifold."""

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import valences
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.sharpen import dihedral_degrees
from gdtool.remesh.connectivity.edge_rotation import cancel_pairs
from gdtool.remesh.engines import candidate as candidates
from gdtool.remesh.engines.candidate import EngineAttempt, make_candidate
from tests.geometry.solids import marching, plane, quad_cube, quad_torus


def rotated(quads: np.ndarray, p: int, q: int) -> np.ndarray:
    """Rotate the edge from p to q within the hexagon of its two faces.

    It then ends at the corner before p in the first face.
    """
    first = next(f for f in quads.tolist() if p in f and f[(f.index(p) + 1) % 4] == q)
    second = next(f for f in quads.tolist() if q in f and f[(f.index(q) + 1) % 4] == p)
    r, s = (first[(first.index(q) + i) % 4] for i in (1, 2))
    t, u = (second[(second.index(p) + i) % 4] for i in (1, 2))
    others = [f for f in quads.tolist() if f not in (first, second)]
    return np.array([*others, [s, p, t, u], [u, q, r, s]])


def sheared(quads: np.ndarray, columns: list[tuple[int, int]]) -> np.ndarray:
    """Rotate the edges between a row of quads one after the other.

    This makes a pair of irregular vertices at each end of the row.
    """
    for rung in columns:
        quads = rotated(quads, *rung)
    return quads


def irregular(points, quads) -> int:
    valence, inner = valences(quads, len(points))
    return int((inner & (valence != 4)).sum())


@pytest.mark.parametrize("apart", [1, 2, 5, 9])
def test_separated_pairs_of_irregular_vertices_cancel(apart):
    n = 24
    points, quads = quad_torus(n)
    torn = sheared(quads, [(i * n + 3, i * n + 4) for i in range(2, 2 + apart)])
    assert irregular(points, torn) == 4
    quads_out = cancel_pairs(QuadMesh(points, torn))
    assert irregular(points, quads_out) == 0
    assert topology.is_watertight(quads_out)
    assert topology.is_manifold(quads_out)
    assert len(quads_out) == len(quads)


def test_pairs_too_far_apart_are_put_back():
    n = 40
    points, quads = quad_torus(n)
    torn = sheared(quads, [(i * n + 3, i * n + 4) for i in range(2, 22)])
    quads_out = cancel_pairs(QuadMesh(points, torn))
    assert {frozenset(f) for f in quads_out.tolist()} == {frozenset(f) for f in torn.tolist()}


def test_regular_and_open_meshes_are_unchanged():
    for points, quads in (quad_torus(), quad_cube(3)):
        assert (np.sort(cancel_pairs(QuadMesh(points, quads)), 1) == np.sort(quads, 1)).all()
    n = 8
    points, _ = plane(n)
    at = np.arange(n * n).reshape(n, n)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    assert (cancel_pairs(QuadMesh(points, quads)) == quads).all()


def test_a_moebius_band_is_unchanged():
    """A Moebius band is not orientable: edges that two faces traverse in the same direction cannot be rotated."""
    n = 20
    at = np.arange(n * 5).reshape(n, 5)
    following = np.concatenate([at[1:], at[:1, ::-1]])
    quads = np.stack([at[:, :-1], following[:, :-1], following[:, 1:], at[:, 1:]], -1).reshape(-1, 4)
    points = np.random.default_rng(0).standard_normal((n * 5, 3))
    assert (cancel_pairs(QuadMesh(points, quads)) == quads).all()


def test_edges_at_creases_are_not_rotated():
    """A cube's edges are not rotated, whatever pairs would cancel across them."""
    points, quads = quad_cube(3)
    ends, _, degrees = dihedral_degrees(TriMesh(points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))
    crease = {tuple(sorted(edge)) for edge in ends[degrees > 45].tolist()}
    flat = [tuple(sorted(edge)) for edge in topology.edges_of(quads).ends.tolist() if tuple(sorted(edge)) not in crease]
    rng, torn = np.random.default_rng(0), quads
    for edge in rng.permutation(flat)[:40].tolist():
        try:
            turned = rotated(torn, *edge)
        except StopIteration:  # no longer an edge
            continue
        valence = valences(turned, len(points))[0]
        if valence.min() > 2 and topology.is_manifold(turned):
            torn = turned
    quads_out = cancel_pairs(QuadMesh(points, torn))
    edges_out = {tuple(sorted(edge)) for edge in topology.edges_of(quads_out).ends.tolist()}
    assert crease <= edges_out
    assert topology.is_watertight(quads_out)
    assert topology.is_manifold(quads_out)
    assert irregular(points, quads_out) < irregular(points, torn) / 2


def test_rotations_leave_fewer_irregular_vertices_in_an_engines_quads(monkeypatch):
    vertices, faces = marching(lambda x, y, z: (np.hypot(x, y) - 0.6) ** 2 + z**2 - 0.06 - 0.02 * np.sin(7 * x), 48)
    attempt = EngineAttempt("instant-meshes", 1, (1.0,), 30.0)
    quads_out = make_candidate(TriMesh(vertices / 2, faces), attempt, 8000)
    monkeypatch.setattr(candidates, "cancel_pairs", lambda mesh: mesh.faces)
    before = make_candidate(TriMesh(vertices / 2, faces), attempt, 8000)
    assert quads_out.fault is None
    assert quads_out.count == before.count
    assert topology.is_watertight(quads_out.mesh.faces)
    after = irregular(quads_out.mesh.vertices, quads_out.mesh.faces)
    assert after < 0.9 * irregular(before.mesh.vertices, before.mesh.faces)
