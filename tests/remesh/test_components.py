"""Meshes of several pieces: none is lost, and each has its share of the quads."""

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import distance_figures, topology_figures
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.remesh import components, pipeline
from gdtool.remesh.engines import candidate, search
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import FittedQuads
from gdtool.remesh.task import RemeshPatch, Request
from tests.geometry.solids import cube, joined, sphere
from tests.remesh.engines import in_this_process, is_watertight_manifold


def test_pieces_that_an_engine_loses_are_remeshed_one_by_one(monkeypatch):
    """Each gets its share of the quads requested, and the small one enough for its shape."""
    vertices, faces = joined(sphere(48, 0.4, (0, -0.2, 0)), sphere(48, 0.12, (0, 0.5, 0)))
    both = RemeshPatch(TriMesh(vertices, faces), 4000, 0.03, Request(), None)
    assert components.accept_good_pieces(both, None)[0] is None
    patches = components.remaining_patches(both, np.zeros(2, bool), 4000)
    assert len(patches) == 2
    assert not any(patch.skip_engines for patch in patches)
    assert sum(patch.quads for patch in patches) == 4000
    assert min(patch.quads for patch in patches) >= 4000 * 0.02
    assert sum(patch.tolerance * patch.quads for patch in patches) == pytest.approx(0.03 * 4000)
    few = components.remaining_patches(both, np.array([True, False]), 1000)[0]
    assert few.tolerance * few.quads == pytest.approx(0.03 * 4000)
    assert few.has_count(1000 + 119, 1000)
    assert not few.has_count(1000 - 121, 1000)
    assert components.remaining_patches(both, np.array([True, False]), 400)[0].tolerance == 0.15
    tried = []
    real = search.EngineSearch.run

    def fails_together(search_run):
        tried.append(search_run.patch.pieces[0])
        return None if tried[-1] > 1 else real(search_run)

    monkeypatch.setattr(search.EngineSearch, "run", fails_together)
    made, _ = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))
    quads_out = made.faces
    assert tried == [2, 1, 1]
    assert topology.components(quads_out)[0] == 2
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 4000 - 1) <= 0.03


@pytest.mark.parametrize("hopeless", [False, True])
def test_good_pieces_of_an_engines_result_are_kept(monkeypatch, hopeless):
    """There are too many pieces to remesh them one by one. If engines fail on one, it alone is paired triangles."""
    ball, large = sphere(64, 0.09), sphere(48, 0.3)
    balls = [(ball[0] + (0.22 * i, 0.22 * j, 0), ball[1]) for i in range(5) for j in range(4)]
    vertices, faces = joined(*balls, (large[0] + (0.4, 0.3, 0.5), large[1]))
    real = candidate.repair_and_judge

    def fails(mesh, wanted):
        judged = real(mesh, wanted)
        bad = wanted.pieces > 1 or hopeless and np.ptp(mesh.vertices, 0).max() > 0.5
        return judged._replace(fault="not watertight, though the input is") if bad else judged

    in_this_process(monkeypatch)
    monkeypatch.setattr(candidate, "repair_and_judge", fails)
    monkeypatch.setattr(components, "repair_and_judge", fails)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))
    out, quads_out = made.vertices, made.faces
    assert record.engine == ("instant-meshes; pair and split" if hopeless else "instant-meshes")
    assert topology.components(quads_out)[0] == 21
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 4000 - 1) <= 0.03
    small = quads_out[(out[quads_out][..., 2] < 0.15).all(1)]
    # An engine's ball of a hundred quads has eight irregular vertices; paired triangles have a fifth or more.
    assert topology_figures(topology.compact(QuadMesh(out, small)))["irregular_share"] < 0.1
    assert (
        distance_figures(TriMesh(out, triangulated(quads_out)[0]), TriMesh(vertices, faces), 5000)["hausdorff"] < 0.02
    )


@pytest.mark.parametrize("wanted, accepted", [(1.0, True), (1.2, False)])
def test_fitted_pieces_are_accepted_if_the_others_can_make_up_for_their_count(monkeypatch, wanted, accepted):
    """Two balls with good quads are both accepted, or neither if there are a sixth too few; neither is fitted again."""
    meshes = [sphere(24, 0.3, (x, 0, 0)) for x in (-0.4, 0.4)]
    made = components.concatenate_meshes(
        [pipeline.remesh(TriMesh(*mesh), Request(quads=500, engine="split"))[0] for mesh in meshes]
    )
    quads_out = made.faces
    patch = RemeshPatch(TriMesh(*joined(*meshes)), round(wanted * len(quads_out)), 0.05, Request(), None)
    patch.full_surface = lambda: patch.surface
    whole = candidate.Candidate(search.EngineAttempt("instant-meshes", 0, (1.0,), 30.0), len(quads_out), None, made)
    whole.fitted = FittedQuads(made, Constraints.none(len(made.vertices)))
    monkeypatch.setattr(components, "snap_to_features", None)
    accepted_quads, good = components.accept_good_pieces(patch, whole)
    assert good.all() == good.any() == accepted
    assert (accepted_quads is None) != accepted
    if accepted:
        assert len(accepted_quads.mesh.faces) == len(quads_out)
        assert accepted_quads.method == "instant-meshes"


def test_small_piece_is_not_lost():
    vertices, faces = joined(sphere(40, 0.7), sphere(40, 0.05, (0.9, 0.9, 0.9)))
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=1000))
    out, quads_out = made.vertices, made.faces
    assert topology.components(quads_out)[0] == 2
    assert is_watertight_manifold(quads_out)
    assert "pair and split" in record.engine
    assert np.linalg.norm(out - 0.45, axis=1).min() < 0.05


def test_tiny_pieces_skip_engines(monkeypatch):
    """Twenty boxes of about eight quads each beside a ball: the engine gets the ball alone."""
    vertices, faces = cube(0.02)
    vertices, faces = joined(sphere(48, 0.4), *((vertices + (0.45, 0.05 * k - 0.5, 0), faces) for k in range(20)))
    tried, run = [], search.EngineSearch.run
    monkeypatch.setattr(
        search.EngineSearch, "run", lambda search_run: tried.append(search_run.patch.pieces[0]) or run(search_run)
    )
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))
    quads_out = made.faces
    assert tried == [1]
    assert "engines: not tried, 20 pieces of so few quads" in record.failed
    assert topology.components(quads_out)[0] == 21
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 4000 - 1) <= 0.03


def test_the_count_holds_where_small_pieces_take_more_than_their_share():
    """A tray of ten triangles becomes two dozen quads in the fallback, however few are requested."""
    corners = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3)[:100]
    vertices, faces = cube(0.01)
    trays = [(vertices + 0.05 * corner + 0.3, faces[:-2]) for corner in corners]
    vertices, faces = joined(sphere(60, 0.25), *trays)
    made, _ = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000, engine="split"))
    out, quads_out = made.vertices, made.faces
    assert abs(len(quads_out) / 4000 - 1) < 0.03
    assert topology.components(quads_out)[0] == 101
    assert 1000 < (np.linalg.norm(out, axis=1)[quads_out].max(1) < 0.27).sum() < 2700
