"""Tips: quads are extruded over parts of the surface that stick out, and nothing else changes."""

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import distance_figures, scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import triangulated
from gdtool.remesh import pipeline
from gdtool.remesh.fit import shaping
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import max_distance, target_of_quads
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from gdtool.remesh.fit.tip_extrusion import ExtrudedQuads, extrude_tips
from gdtool.remesh.task import Request
from tests.geometry.solids import quad_cube, sphere
from tests.remesh.engines import in_this_process


def horned(length, width=0.05, bend=0.0):
    """Make a sphere of radius 0.4 with a horn at +x that bends toward +y."""
    vertices, faces = sphere(160, 0.4)
    away = np.linalg.norm(vertices[:, 1:], axis=1)
    horn = (vertices[:, 0] > 0) & (away < width)
    share = 1 - away[horn] / width
    vertices[horn, 0] += length * share
    vertices[horn, 1] += bend * share**2
    return vertices, faces


def ball(rounds=4):
    """Make quads on the sphere of radius 0.4; also return their edge length."""
    vertices, faces = quad_cube(rounds)
    vertices = vertices - vertices.mean(0)
    vertices *= 0.4 / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces, (4 * np.pi * 0.4**2 / len(faces)) ** 0.5


@pytest.mark.parametrize("length, bend", [(0.08, 0.0), (0.25, 0.0), (0.25, 0.15)])
def test_quads_are_extruded_over_a_horn(length, bend):
    vertices, faces, edge = ball()
    surface = ProjectionTarget(TriMesh(*horned(length, bend=bend)))
    assert max_distance(target_of_quads(QuadMesh(vertices, faces)), surface) > 1.4 * edge
    made, constraints, tips, _, _ = extrude_tips(
        QuadMesh(vertices, faces), Constraints.none(len(vertices)), surface, edge, max_added=0.3
    )
    out, quads_out = made.vertices, made.faces
    assert max_distance(target_of_quads(QuadMesh(out, quads_out)), surface) < 0.8 * edge
    assert topology.is_watertight(quads_out)
    assert topology.is_manifold(quads_out)
    assert topology.euler_number(quads_out) == 2
    assert len(faces) < len(quads_out) < 1.2 * len(faces)
    assert len(tips)
    assert constraints.fixed[tips].all()
    assert len(constraints.curve) == len(out)
    apex = surface.vertices[surface.vertices[:, 0].argmax()]
    assert np.linalg.norm(out[tips] - apex, axis=1).min() < 0.9 * edge
    # Quads away from the horn are unchanged.
    same = (vertices == out[: len(vertices)]).all(1)
    assert same.sum() > 0.97 * len(vertices)
    assert (vertices[~same, 0] > 0.3).all()


def test_no_more_quads_than_allowed_are_added():
    vertices, faces, edge = ball()
    quads_out = extrude_tips(
        QuadMesh(vertices, faces),
        Constraints.none(len(vertices)),
        ProjectionTarget(TriMesh(*horned(0.25))),
        edge,
        max_added=0.01,
    ).mesh.faces
    assert 0 < len(quads_out) - len(faces) < 0.01 * len(faces) + 40  # 40: quads of the last step


def test_surface_near_the_quads_is_not_extruded():
    vertices, faces, edge = ball()
    surface = ProjectionTarget(TriMesh(*horned(0.4 * edge)))
    made, _, tips, far, _ = extrude_tips(QuadMesh(vertices, faces), Constraints.none(len(vertices)), surface, edge)
    out, quads_out = made.vertices, made.faces
    assert out is vertices
    assert quads_out is faces
    assert not len(tips)
    assert far == pytest.approx(0.4 * edge, rel=0.2)


def test_uncovered_surface_is_measured_by_area_and_not_by_vertices():
    """Most vertices of a simplified mesh lie at creases, though little of its area is cut off there."""
    vertices, faces, edge = ball()
    fine, triangles = sphere(160, 0.4)
    narrow = fine[:, 0] > 0.39
    fine = np.where(narrow[:, None], fine * (1 + 0.4 * edge / 0.4), fine)  # lifted by less than the height of a tip
    many = ProjectionTarget(TriMesh(*_cut_in_four(fine, triangles, narrow[triangles].all(1), 3)))
    assert (many.vertices[:, 0] > 0.39).mean() > 0.5
    far, away = extrude_tips(QuadMesh(vertices, faces), Constraints.none(len(vertices)), many, edge)[3:]
    share = face_normals(TriMesh(many.vertices, many.faces))[1] * (many.vertices[many.faces].mean(1)[:, 0] > 0.39)
    assert far == pytest.approx(0.4 * edge, rel=0.2)
    assert (away > 0.25 * edge).mean() == pytest.approx(
        share.sum() / face_normals(TriMesh(many.vertices, many.faces))[1].sum(), abs=0.01
    )


def _cut_in_four(vertices, faces, which, rounds):
    """Cut some faces, which (f,) bool, in four at the middles of their edges, but not the faces beside them."""
    cut, others = faces[which], faces[~which]
    for _ in range(rounds):
        a, b, c = (vertices[cut[:, i]] for i in range(3))
        n, k = len(vertices), np.arange(len(cut))
        ab, bc, ca = n + k, n + len(cut) + k, n + 2 * len(cut) + k
        vertices = np.concatenate([vertices, (a + b) / 2, (b + c) / 2, (c + a) / 2])
        cut = np.concatenate(
            [np.stack(x, -1) for x in ((cut[:, 0], ab, ca), (ab, cut[:, 1], bc), (ca, bc, cut[:, 2]), (ab, bc, ca))]
        )
    return vertices, np.concatenate([cut, others])


def test_one_vertex_reaches_a_tip_that_is_less_than_an_edge_away():
    vertices, faces, edge = ball()
    surface = ProjectionTarget(TriMesh(*horned(0.9 * edge)))
    assert 0.6 * edge < max_distance(target_of_quads(QuadMesh(vertices, faces)), surface) < edge
    made, constraints, tips, _, _ = extrude_tips(
        QuadMesh(vertices, faces), Constraints.none(len(vertices)), surface, edge
    )
    out, quads_out = made.vertices, made.faces
    assert quads_out is faces
    assert max_distance(target_of_quads(QuadMesh(out, faces)), surface) < 0.4 * edge
    assert len(tips) == 1
    assert constraints.fixed[tips].all()
    assert (out == vertices).all(1).sum() == len(vertices) - 1


def test_paths_along_creases_end_where_a_tip_is_extruded():
    """A path over the tip no longer consists of edges; the rest of the path is kept."""
    vertices, faces, edge = ball()
    around = np.flatnonzero(np.abs(vertices[:, 2]) < 1e-9)
    around = around[np.argsort(np.arctan2(vertices[around, 1], vertices[around, 0]))]
    path = np.stack([around, np.roll(around, -1)], -1)
    curve = np.full(len(vertices), -1)
    curve[around] = 0
    path_constraints = Constraints(curve, np.zeros(len(vertices), bool), path, np.zeros(len(path), int))
    made, constraints, tips, _, _ = extrude_tips(
        QuadMesh(vertices, faces), path_constraints, ProjectionTarget(TriMesh(*horned(0.2))), edge
    )
    quads_out = made.faces
    edges = set(map(tuple, topology.edges_of(quads_out).ends.tolist()))
    assert 0.8 * len(path) < len(constraints.path) < len(path)
    assert all(tuple(sorted(ends)) in edges for ends in constraints.path.tolist())
    assert (constraints.curve[tips] < 0).all()


def test_an_engine_that_cuts_a_horn_short_is_still_accepted(monkeypatch):
    vertices, faces = horned(0.35, 0.04)
    request = Request(quads=2000)
    edge = (4 * np.pi * 0.4**2 / 2000) ** 0.5
    made, record = pipeline.remesh(TriMesh(vertices, faces), request)
    out, quads_out = made.vertices, made.faces
    figures = distance_figures(TriMesh(out, triangulated(quads_out)[0]), TriMesh(vertices, faces), 20000)
    assert "instant-meshes" in record.engine
    assert abs(len(quads_out) / 2000 - 1) <= 0.03
    assert topology.is_watertight(quads_out)
    assert figures["hausdorff"] < 2 * edge
    assert (scaled_jacobian(QuadMesh(out, quads_out)) <= 0).mean() < 0.003
    in_this_process(monkeypatch)
    monkeypatch.setattr(
        shaping, "extrude_tips", lambda mesh, constraints, *_: ExtrudedQuads(mesh, constraints, None, 0.0, np.zeros(1))
    )
    assert pipeline.remesh(TriMesh(vertices, faces), request)[1].engine == "pair and split"


def test_fixed_vertices_on_a_blunt_tip_leave_room_for_quads():
    """Vertices fixed as near to each other as their target points would leave quads without area between them."""
    vertices, faces, edge = ball()
    fine, triangles = sphere(160, 0.4)
    # A ridge some edges wide and a tenth of that thick: all vertices of its cap move about equally far.
    blunt = (fine[:, 0] > 0) & (abs(fine[:, 1]) < 2.2 * edge) & (abs(fine[:, 2]) < 0.4 * edge)
    fine[blunt, 0] += 1.4 * edge
    made, _, tips, _, _ = extrude_tips(
        QuadMesh(vertices, faces),
        Constraints.none(len(vertices)),
        ProjectionTarget(TriMesh(fine, triangles)),
        edge,
        max_added=0.3,
    )
    out = made.vertices
    apart = np.linalg.norm(out[tips][:, None] - out[tips], axis=-1)[np.triu_indices(len(tips), 1)]
    assert len(tips) > 2
    assert apart.min() > 0.7 * edge
