"""Quads of a whole surface: count, topology, creases."""

import numpy as np
import pytest

from gdtool.geometry import simplify, topology
from gdtool.geometry.mesh_quality import distance_figures, shape_figures
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.remesh import pipeline
from gdtool.remesh.engines.adapters import ENGINES
from gdtool.remesh.task import Request
from tests.geometry.solids import assembly, bored_box, cube, lattice, plane, sphere, torus, volume
from tests.remesh.engines import in_this_process, is_watertight_manifold


@pytest.mark.slow
def test_large_pieces_are_not_decimated_further_because_of_small_ones():
    """An assembly with many pins of slivers, which the quick collapse does not reduce."""
    vertices, faces = assembly(60, 128)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=3000))
    out, quads_out = made.vertices, made.faces
    assert any("the quick collapse stopped" in line for line in record.failed)
    assert record.figures["simplified_to"] == 20000
    assert abs(len(quads_out) / 3000 - 1) < 0.1
    assert is_watertight_manifold(quads_out)
    assert topology.components(quads_out)[0] == 61
    assert (
        distance_figures(TriMesh(out, triangulated(quads_out)[0]), TriMesh(vertices, faces), 5000)["hausdorff"] < 0.015
    )


def test_a_bad_quick_collapse_is_repeated_with_the_topology_kept(monkeypatch):
    vertices, faces = sphere(120, 0.5)
    collapses, begin = [], simplify.begin

    def shrinking(function, mesh, call, *arguments, **limits):
        collapses.append(call.function)
        smaller = TriMesh(mesh.vertices * (0.5 if call.function is simplify.collapse else 1), mesh.faces)
        return begin(function, smaller, call, *arguments, **limits)

    monkeypatch.setattr(simplify, "begin", shrinking)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=2000))
    out = made.vertices
    assert collapses == [simplify.collapse, simplify.collapse_keeping_topology]
    assert abs(np.linalg.norm(out, axis=1) - 0.5).max() < 0.01
    assert any(line.startswith("simplify: strays") for line in record.failed)
    assert record.figures["simplify_error"] < 0.01


def test_sphere_keeps_its_radius():
    vertices, faces = sphere(48)
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=1000))
    out, quads_out = made.vertices, made.faces
    assert record.engine.startswith("instant-meshes")
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 1000 - 1) <= 0.03
    assert np.abs(np.linalg.norm(out, axis=1) - 0.4).max() < 2e-3
    assert shape_figures(QuadMesh(out, quads_out))["jacobian_min"] > 0.2


def test_torus_keeps_its_hole():
    vertices, faces = torus()
    made, _ = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=1500))
    out, quads_out = made.vertices, made.faces
    # Euler characteristic 0: E = 2F, V = F
    assert is_watertight_manifold(quads_out)
    assert len(out) == len(quads_out)
    assert volume(out, quads_out) == pytest.approx(2 * np.pi**2 * 0.65 * 0.28**2 / 8, rel=0.02)


@pytest.mark.parametrize("each, attempts", [(70, {"engines"}), (220, {"instant-meshes, 1 subdivision"})])
def test_a_lattice_keeps_all_handles_where_engines_would_lose_some(each, attempts):
    """With few quads for each handle, attempts that would lose handles are skipped: all, or those that subdivide."""
    vertices, faces = lattice()
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=28 * each))
    out, quads_out = made.vertices, made.faces
    assert is_watertight_manifold(quads_out)
    assert topology.handles(quads_out, 1) == 28
    assert abs(len(quads_out) / (28 * each) - 1) <= 0.03
    assert attempts == {line.split(":")[0] for line in record.failed if "not tried" in line and "28 handles" in line}
    assert record.engine == "pair and split" or each > 100
    assert shape_figures(QuadMesh(out, quads_out))["jacobian_mean"] > 0.75
    assert shape_figures(QuadMesh(out, quads_out))["folded_share"] < 1e-3


def test_a_requested_engine_is_tried_whatever_the_handles(monkeypatch):
    tried = in_this_process(monkeypatch, lambda *arguments: ENGINES["instant-meshes"](*arguments))
    pipeline.remesh(TriMesh(*lattice()), Request(quads=1000, engine="instant-meshes"))
    assert tried


def test_creases_lie_on_quad_edges():
    vertices, faces = bored_box()
    made, _ = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=2500))
    out, quads_out = made.vertices, made.faces
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 2500 - 1) <= 0.03
    triangles, _ = triangulated(quads_out)
    line = np.linspace(-0.37, 0.37, 50)
    from gdtool.geometry.distance import closest_points

    truth = np.concatenate(
        [np.stack([line, 0 * line + 0.3 * s, 0 * line + 0.25 * t], -1) for s in (-1, 1) for t in (-1, 1)]
    )
    assert (
        np.median(closest_points(truth, TriMesh(out, triangles))[0]) < 1e-3
    )  # marching cubes cuts these edges off by 8e-3


def test_coarse_cube_is_filled_with_quads():
    made, _ = pipeline.remesh(TriMesh(*cube()), Request(quads=600))
    out, quads_out = made.vertices, made.faces
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 600 - 1) <= 0.03
    assert volume(out, quads_out) == pytest.approx(1, rel=0.02)


def test_open_plane_stays_open_and_flat():
    made, _ = pipeline.remesh(TriMesh(*plane()), Request(quads=400))
    out, quads_out = made.vertices, made.faces
    assert topology.is_manifold(quads_out)
    assert np.abs(out[:, 2]).max() < 1e-9
    area = distance_figures(TriMesh(out, triangulated(quads_out)[0]), TriMesh(*plane()), 2000)
    assert area["hausdorff"] < 0.03  # less than an edge length: the boundary is where it was


def test_equal_input_gives_equal_quads():
    vertices, faces = sphere(24)
    first, second = (pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=500)) for _ in range(2))
    assert (first[0].vertices == second[0].vertices).all()
    assert (first[0].faces == second[0].faces).all()
