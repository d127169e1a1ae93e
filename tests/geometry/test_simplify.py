"""Simplify meshes: the count of triangles, the reported error, and what happens where a child process fails."""

import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.core.errors import InputError
from gdtool.geometry import simplify, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.simplify import ChildResult, SimplifyOptions, SimplifyReport
from tests.geometry.solids import assembly, bored_box, cube, joined, plane, quad_cube, sphere, volume


def fine_cube(rounds: int = 6) -> TriMesh:
    """Make a cube whose sides are cut into many triangles."""
    vertices, quads = quad_cube(rounds)
    return TriMesh(vertices, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))


def test_a_sphere_keeps_its_shape_and_topology():
    made, _, report = simplify.simplify(TriMesh(*sphere(40)), 800)
    assert 0.9 * 800 <= len(made.faces) <= 800
    assert topology.is_watertight(made.faces)
    assert topology.is_manifold(made.faces)
    assert report.method == "quadric collapse"
    assert 0 < report.error < 0.02
    # The error bounds the distance of all vertices: there are fewer of them than are sampled.
    radius = np.linalg.norm(made.vertices, axis=1)
    assert abs(radius - 0.8).max() < report.error + 2e-3
    assert volume(made.vertices, made.faces) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)


def test_attributes_are_interpolated():
    vertices, faces = sphere(32)
    made, attributes, _ = simplify.simplify(TriMesh(vertices, faces), 500, attributes=vertices * 2 + 1)
    assert np.abs(attributes - (made.vertices * 2 + 1)).max() < 0.02


def test_a_mesh_with_few_faces_is_returned_as_it_is():
    mesh = TriMesh(*cube())
    made, _, report = simplify.simplify(mesh, 100)
    assert made is mesh
    assert report == SimplifyReport(12, "none", creases=0, error=0.0)


def test_a_target_of_one_face_leaves_a_closed_mesh():
    made = simplify.simplify(TriMesh(*sphere(16)), 1).mesh
    assert len(made.faces) >= 4
    assert topology.is_watertight(made.faces)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_unit_of_length_does_not_matter(scale):
    vertices, faces = sphere(24)
    made, _, report = simplify.simplify(TriMesh(vertices * scale, faces), 300)
    assert np.abs(np.linalg.norm(made.vertices / scale, axis=1) - 0.8).max() < 0.05
    assert report.error / scale < 0.05


def test_dead_children_leave_clusters_of_an_open_mesh_and_a_closed_one_as_it_is(monkeypatch):
    def dead(*_, **__):
        raise ChildFailed("died of SIGSEGV")

    monkeypatch.setattr(simplify, "begin", dead)
    mesh = TriMesh(*plane(40))
    made, _, report = simplify.simplify(mesh, 400)
    assert report.method == "vertex clustering"
    assert "SIGSEGV" in report.failed
    assert 0 < len(made.faces) < len(mesh.faces)
    closed = TriMesh(*sphere(24))
    assert simplify.simplify(closed, 100).mesh is closed


def test_an_index_out_of_range_never_reaches_a_native_library():
    with pytest.raises(InputError):
        simplify.simplify(TriMesh(np.eye(3), np.array([[0, 1, 7]])), 1)


def test_two_pieces_stay_two():
    mesh = TriMesh(*joined(sphere(24, 0.4, (-0.5, 0, 0)), sphere(24, 0.4, (0.5, 0, 0))))
    assert topology.components(simplify.simplify(mesh, 400).mesh.faces)[0] == 2


def test_meshlab_takes_over_where_the_quick_collapse_does_not_touch_slivers():
    """Pins of slivers stand around a disk: the quick collapse leaves them as they are and tears down the disk."""
    mesh = TriMesh(*assembly(60, 48))
    made, _, report = simplify.simplify(mesh, 900)
    assert report.method.endswith("topology kept")
    assert "the quick collapse stopped" in report.failed
    assert len(made.faces) <= 900
    assert report.error < 0.02
    assert topology.invariants(made.faces) == topology.invariants(mesh.faces)


def test_flat_sides_in_any_direction_collapse_once_their_coplanarity_is_broken():
    """The sides of a cube are finely cut, and the cube is rotated so that rounding bends them."""
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    axis_aligned = fine_cube()
    mesh = TriMesh(axis_aligned.vertices @ (rotation * np.linalg.det(rotation)), axis_aligned.faces)
    moved = simplify.break_coplanarity(mesh)
    made = topology.compact(simplify.collapse(TriMesh(moved, mesh.faces), 200, 5.0))
    assert len(made.faces) == 200
    assert topology.is_watertight(made.faces)
    assert topology.is_manifold(made.faces)
    assert simplify.deviation(mesh, made) < 1e-3
    assert volume(made.vertices, made.faces) == pytest.approx(1, abs=1e-4)
    assert len(simplify.collapse(mesh, 200, 5.0).faces) > 5000
    # Only vertices inside a side move, though at the cube's edges the mean outer product has determinant zero too.
    edge = np.linalg.norm(mesh.vertices[mesh.faces[0, 0]] - mesh.vertices[mesh.faces[0, 1]])
    shift = np.linalg.norm(moved - mesh.vertices, axis=1) / edge
    assert 0.5 < (shift > 0).mean() <= 1
    assert shift.max() < 3 * simplify._COPLANAR_JITTER_EDGES


@pytest.mark.parametrize("solid", [sphere, bored_box])
def test_curved_and_axis_aligned_surfaces_are_not_moved(solid):
    """Rounding does not bend a plane along an axis."""
    mesh = TriMesh(*solid(40))
    assert simplify.break_coplanarity(mesh) is mesh.vertices


def nearest_to_corner(vertices: np.ndarray) -> float:
    """Measure the distance of the nearest vertex to a corner of the bored box."""
    return np.linalg.norm(vertices - [0.8, 0.6, 0.5], axis=1).min()


def restores_creases(arguments: tuple) -> bool:
    """Tell whether arguments of begin() ask the child to restore creases."""
    return arguments[-1] > 0


RESTORING = SimplifyOptions(crease_degrees=30.0)


def test_creases_are_restored_before_the_collapse():
    mesh = TriMesh(*bored_box(64))
    made, _, report = simplify.simplify(mesh, 2000, options=RESTORING)
    assert report.creases > 300
    assert len(made.faces) <= 2000
    assert topology.is_watertight(made.faces)
    assert nearest_to_corner(made.vertices) < 0.2 * nearest_to_corner(mesh.vertices)


def test_creases_are_not_restored_where_that_kills_the_child(monkeypatch):
    begin = simplify.begin

    def dying(*arguments, **limits):
        if restores_creases(arguments):
            raise ChildFailed("died of SIGSEGV")
        return begin(*arguments, **limits)

    monkeypatch.setattr(simplify, "begin", dying)
    report = simplify.simplify(TriMesh(*bored_box(64)), 2000, options=RESTORING).report
    assert report.faces <= 2000
    assert report.creases == 0


def test_creases_are_not_restored_where_that_tears_the_result(monkeypatch):
    begin = simplify.begin

    class Torn:
        def __init__(self, running):
            self.running = running

        def result(self):
            mesh, creases = self.running.result()
            return ChildResult(TriMesh(mesh.vertices, mesh.faces[:-1]), creases)

    def tearing(*arguments, **limits):
        running = begin(*arguments, **limits)
        return Torn(running) if restores_creases(arguments) else running

    monkeypatch.setattr(simplify, "begin", tearing)
    mesh = TriMesh(*bored_box(64))
    made, _, report = simplify.simplify(mesh, 2000, options=RESTORING)
    assert report.creases == 0
    assert "creases restored" in report.failed
    assert topology.is_watertight(made.faces)
    assert nearest_to_corner(made.vertices) > 0.5 * nearest_to_corner(mesh.vertices)


def test_uniform_leaves_triangles_of_one_size():
    mesh = TriMesh(*bored_box(64))

    def spread(uniform: bool) -> float:
        """Ratio of the ninth decile of edge lengths to the first."""
        made = simplify.simplify(mesh, 1500, options=SimplifyOptions(uniform=uniform, measure_error=False)).mesh
        edges = topology.edges_of(made.faces)
        assert topology.is_watertight(made.faces)
        assert abs(len(made.faces) / 1500 - 1) < 0.02
        start, end = (made.vertices[edges.ends[:, i]] for i in (0, 1))
        first, ninth = np.quantile(np.linalg.norm(start - end, axis=1), (0.1, 0.9))
        return ninth / first

    assert spread(uniform=True) < 4
    assert spread(uniform=False) > 10


def test_jitter_is_as_fine_as_the_detail():
    """A ball a thousandth of the size of the cube beside it keeps its shape."""
    large = fine_cube()
    ball_vertices, ball_faces = sphere(24)
    ball = ball_vertices * 1e-3 + (2.0, 0.0, 0.0), ball_faces
    mesh = TriMesh(*joined((large.vertices, large.faces), ball))
    moved = simplify.jitter_vertices(mesh)
    count = len(large.vertices)
    edge = np.linalg.norm(large.vertices[large.faces[0, 0]] - large.vertices[large.faces[0, 1]])
    assert np.abs(moved - mesh.vertices)[:count].max() > 0.01 * edge
    radius = np.linalg.norm(moved[count:] - (2.0, 0.0, 0.0), axis=1)
    assert 1e-6 < np.abs(radius - 0.8e-3).max() < 1e-5


def test_low_deviation_stays_nearer_with_as_many_triangles():
    mesh = TriMesh(*bored_box(64))
    even, near = (
        simplify.simplify(mesh, 1000, options=SimplifyOptions(low_deviation=low)).report for low in (False, True)
    )
    assert even.faces == 1000
    assert near.faces == 1000
    assert near.error < 0.5 * even.error


def test_a_quick_result_that_is_far_off_is_replaced_by_meshlabs(monkeypatch):
    begin = simplify.begin

    def shrinking(function, mesh, call, *arguments, **limits):
        factor = 0.5 if call.function is simplify.collapse else 1
        return begin(function, TriMesh(mesh.vertices * factor, mesh.faces), call, *arguments, **limits)

    monkeypatch.setattr(simplify, "begin", shrinking)
    made, _, report = simplify.simplify(TriMesh(*sphere(40)), 800)
    assert report.method.endswith("topology kept")
    assert report.error < 0.02
    assert abs(np.linalg.norm(made.vertices, axis=1) - 0.8).max() < 0.02


def test_the_collapse_that_keeps_the_topology_does_not_join_coincident_vertices():
    """Two balls touch in a vertex each: they are not joined, and no part of them is left out."""
    vertices, faces = sphere(24)
    top = vertices[vertices[:, 0].argmax()]
    mirrored = vertices * (-1, 1, 1) + (2 * top[0], 0, 0), faces[:, ::-1]
    mesh = TriMesh(*joined((vertices, faces), mirrored))
    made = simplify.collapse_keeping_topology(mesh, 600)
    assert topology.invariants(made.faces) == topology.invariants(mesh.faces)
    assert len(made.faces) <= 600


def test_the_collapse_in_two_passes_is_about_as_accurate_as_meshlab_alone():
    mesh = TriMesh(*sphere(64))
    assert len(mesh.faces) > 20_000
    alone = simplify.collapse_keeping_topology(mesh, 1000)
    two_passes = simplify.collapse_in_two_passes(mesh, 1000)
    assert len(two_passes.faces) == 1000
    assert topology.is_watertight(two_passes.faces)
    assert simplify.deviation(mesh, two_passes) < 1.5 * simplify.deviation(mesh, alone)


def test_topology_first_starts_with_two_passes_on_a_fine_mesh(monkeypatch):
    called, begin = [], simplify.begin

    def recording(function, mesh, call, *arguments, **limits):
        called.append(call.function)
        return begin(function, mesh, call, *arguments, **limits)

    monkeypatch.setattr(simplify, "begin", recording)
    report = simplify.simplify(TriMesh(*sphere(64)), 1000, options=SimplifyOptions(topology_first=True)).report
    assert called == [simplify.collapse_in_two_passes]
    assert report.faces == 1000


def test_two_passes_give_nothing_where_the_quick_one_does_not_finish(monkeypatch):
    monkeypatch.setattr(simplify, "collapse", lambda mesh, target_faces, aggressiveness: mesh)
    assert not len(simplify.collapse_in_two_passes(TriMesh(*sphere(64)), 1000).faces)
