"""Quads: count, topology, creases, and that a way through is found whatever the engine does."""

import time

import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.folders.mesh import triangulated
from gdtool.geometry import quad_fit, quad_pieces, quad_split, quad_ways, quads, repair, simplify
from gdtool.geometry.features import find_features
from gdtool.geometry.mesh_quality import distance_figures, polygon_normals, scaled_jacobian, shape_figures, topology_figures
from gdtool.geometry.quad_split import pair_and_split
from gdtool.geometry.quad_shape import Surface, fill_holes, remove_doublets, subdivide
from gdtool.geometry.quad_task import Part, Request
from gdtool.geometry.sharpen import restore_creases
from tests.geometry.solids import assembly, bored_box, cube, joined, marching, plane, quad_cube, rod, sphere, torus, volume


def whole(faces):
    return faces.min() >= 0 and repair.is_watertight(faces) and repair.is_manifold(faces)


def test_pieces_that_an_engine_loses_are_remeshed_one_by_one(monkeypatch):
    """Each has its share of the quads asked for, the small one enough for its shape, and none is lost."""
    vertices, faces = joined(sphere(48, 0.4, (0, -0.2, 0)), sphere(48, 0.12, (0, 0.5, 0)))
    both = Part(vertices, faces, 4000, 0.03, Request(), None)
    assert quad_pieces.well_made(both, None)[0] is None
    parts = quad_pieces.apart(both, np.zeros(2, bool), 4000)
    assert len(parts) == 2 and not any(part.given_up for part in parts)
    assert sum(part.quads for part in parts) == 4000 and min(part.quads for part in parts) >= 4000 * 0.02
    tried = []
    real = quad_ways.Trial.run

    def fails_together(trial):
        tried.append(trial.part.pieces[0])
        return None if tried[-1] > 1 else real(trial)

    monkeypatch.setattr(quad_ways.Trial, "run", fails_together)
    out, found, _ = quads.remesh(vertices, faces, Request(quads=4000))
    assert tried == [2, 1, 1] and repair.components(found)[0] == 2 and whole(found)
    assert abs(len(found) / 4000 - 1) <= 0.03


def test_quads_that_cut_edges_off_do_not_do_for_one_piece_of_several():
    vertices, faces = quad_cube(3)
    surface, edge = Surface(vertices, triangulated(faces)[0]), 0.125 * np.ptp(vertices[:, 0])
    assert quad_ways.fault_of(vertices, faces, surface, edge, 1.0, piece=True) is None
    cut = vertices.copy()
    on_two = np.isclose(np.abs(vertices), np.abs(vertices).max()).sum(1) >= 2  # the cube's twelve edges
    cut[on_two] *= 1 - 0.5 * edge / np.ptp(vertices[:, 0])
    assert quad_ways.fault_of(cut, faces, surface, edge, 1.0, piece=False) is None
    assert quad_ways.fault_of(cut, faces, surface, edge, 1.0, piece=True).startswith("cuts off")


def test_pieces_side_by_side_come_out_as_one_after_the_other(monkeypatch):
    vertices, faces = joined(*(sphere(32, 0.2, (0.5 * k, 0, 0)) for k in range(3)))
    real = quad_ways.judged
    monkeypatch.setattr(quad_ways, "judged", lambda *mesh: ("together", *mesh[:2]) if repair.components(mesh[3])[0] > 1 else real(*mesh))
    monkeypatch.setattr(quad_pieces, "quads_by_piece", lambda *given: [(np.zeros((0, 3)), np.zeros((0, 4), np.int64))] * 3)
    (one, one_faces, one_record), (two, two_faces, two_record) = (quads.remesh(vertices, faces, Request(quads=1500, threads=n)) for n in (1, 3))
    assert np.array_equal(one, two) and np.array_equal(one_faces, two_faces) and repair.components(two_faces)[0] == 3
    assert two_record.failed == one_record.failed and set(two_record.seconds) == set(one_record.seconds)


@pytest.mark.parametrize("hopeless", [False, True])
def test_of_many_pieces_those_that_came_out_well_are_kept(monkeypatch, hopeless):
    """Of more than go one by one; where one of them fails, too, whatever is tried, it alone is paired triangles."""
    ball, large = sphere(64, 0.09), sphere(48, 0.3)
    balls = [(ball[0] + (0.22 * i, 0.22 * j, 0), ball[1]) for i in range(5) for j in range(4)]
    vertices, faces = joined(*balls, (large[0] + (0.4, 0.3, 0.5), large[1]))
    real = quad_ways.judged

    def fails(quad_vertices, quad_faces, of_vertices, of_faces):
        fault, *mended = real(quad_vertices, quad_faces, of_vertices, of_faces)
        bad = repair.components(of_faces)[0] > 1 or hopeless and np.ptp(of_vertices, 0).max() > 0.5
        return "not watertight, though the input is" if bad else fault, *mended

    monkeypatch.setattr(quad_ways, "judged", fails)
    monkeypatch.setattr(quad_pieces, "judged", fails)
    out, found, record = quads.remesh(vertices, faces, Request(quads=4000))
    assert record.engine == ("instant-meshes; pair and split" if hopeless else "instant-meshes")
    assert repair.components(found)[0] == 21 and whole(found) and abs(len(found) / 4000 - 1) <= 0.03
    small = found[(out[found][..., 2] < 0.15).all(1)]
    assert topology_figures(*repair.compact(out, small))["irregular_share"] < 0.1  # eight of a ball's hundred; of paired triangles a fifth and more
    assert distance_figures(out, triangulated(found)[0], vertices, faces, 5000)["hausdorff"] < 0.02


def test_grid_figures():
    line = np.arange(5.0)
    x, y = np.meshgrid(line, line)
    i = (np.arange(4)[:, None] * 5 + np.arange(4)).ravel()
    faces = np.stack([i, i + 1, i + 6, i + 5], -1)
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1)
    figures = topology_figures(vertices, faces) | shape_figures(vertices, faces)
    assert figures["irregular_share"] == 0 and figures["boundary_edges"] == 16 and figures["jacobian_min"] == pytest.approx(1)
    vertices[6] += [1.5, 1.5, 0]  # past the opposite corner: folded
    assert scaled_jacobian(vertices, faces).min() < 0


def test_subdivision_of_a_cube_is_regular_but_for_eight_corners():
    vertices, faces = cube()
    quad = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    out, found, _ = subdivide(vertices, quad)
    assert len(found) == 24 and whole(found) and volume(out, found) == pytest.approx(1)
    assert topology_figures(out, found)["irregular_share"] == pytest.approx(8 / 26)
    mixed = np.concatenate([np.concatenate([faces, np.full((12, 1), -1)], 1)[[1, 2]], quad[2:]])
    assert len(subdivide(vertices, mixed)[1]) == 2 * 3 + 4 * 4


def test_doublet_is_removed():
    # A quad whose middle vertex 4 has two edges only: the pair around it is one quad.
    faces = np.array([[0, 1, 2, 4], [0, 4, 2, 3], [1, 0, 3, 2]])
    _, out = remove_doublets(np.arange(15.0).reshape(5, 3), faces)
    assert len(out) == 2


def test_pairing_gives_the_asked_count_exactly():
    vertices, faces = sphere(24)
    for count in (3 * len(faces) - 500, int(2.2 * len(faces))):
        out, found = pair_and_split(vertices, faces, count)
        assert abs(len(found) - count) <= 1 and whole(found) and volume(out, found) > 0


def test_the_fallback_takes_the_coarsest_collapse_that_keeps_all_pieces(monkeypatch):
    """One whose gentler steps keep the small piece: a third more quads than asked for, and not the whole mesh's."""
    small, large = sphere(8), sphere(24)
    vertices, faces = joined((small[0] * 0.1 + 3, small[1]), large)
    tried = []

    def losing(vertices, faces, target, **how):
        tried.append(target)
        own = simplify.simplify(*large, target - (len(small[1]) if target > 1000 else 0), measured=False)
        return (*(joined(small, own[:2]) if target > 1000 else own[:2]), None, {})

    monkeypatch.setattr(quad_split, "simplify", losing)
    asked = 1800  # 800 triangles, of which 1.15 times as many lose the piece and 1.3 times keep it
    out, found = quad_split._by_collapse(vertices, faces, asked, 60.0)
    assert tried[:3] == [800, 919, 1040] and repair.components(found)[0] == 2
    assert asked < len(found) < 1.5 * asked < 1.8 * len(faces)


def test_the_fallback_makes_up_for_pairs_that_it_does_not_find():
    """Pins with few triangles around: what bends too much stays single, and there are fewer triangles for it."""
    vertices, faces = joined(*((pin[0] + (0.3 * k, 0, 0), pin[1]) for k, pin in enumerate([rod(24)] * 8)))
    _, found = quad_split._by_collapse(vertices, faces, 400, 60.0)
    assert abs(len(found) / 400 - 1) < 0.1 and repair.components(found)[0] == 8 and repair.is_watertight(found)


def test_large_parts_are_not_torn_down_for_small_ones():
    """An assembly with more pins than the count has quads to spare, all of slivers, which the quick collapse does not touch."""
    vertices, faces = assembly(60, 128)
    out, found, record = quads.remesh(vertices, faces, Request(quads=3000))
    assert any("the quick collapse stopped" in line for line in record.failed) and record.figures["simplified_to"] == 20000
    assert abs(len(found) / 3000 - 1) < 0.1 and whole(found) and repair.components(found)[0] == 61
    assert distance_figures(out, triangulated(found)[0], vertices, faces, 5000)["hausdorff"] < 0.015


def test_what_the_quick_collapse_ruins_is_made_again_with_care(monkeypatch):
    vertices, faces = sphere(120, 0.5)
    begun, begin = [], simplify.begin

    def shrinking(function, vertices, faces, way, *given, **limits):
        begun.append(way)
        return begin(function, vertices * (0.5 if way == "collapse" else 1), faces, way, *given, **limits)

    monkeypatch.setattr(simplify, "begin", shrinking)
    out, _, record = quads.remesh(vertices, faces, Request(quads=2000))
    assert begun == ["collapse", "collapse_topology"] and abs(np.linalg.norm(out, axis=1) - 0.5).max() < 0.01
    assert any(line.startswith("simplify: strays") for line in record.failed) and record.figures["simplify_error"] < 0.01


@pytest.mark.parametrize("shape", ["slivers", "coincident"])
def test_splitting_makes_square_quads_of_any_triangles(shape):
    """What no engine manages is made even first: long slivers, and sheets that touch without being joined."""
    if shape == "slivers":
        vertices, faces = cube()
        vertices = vertices * (1, 0.4, 0.15)  # twelve triangles
    else:
        vertices, faces = joined(cube(), cube())
        vertices = vertices.copy()
        vertices[8:, 0] += np.ptp(vertices[:8, 0])  # shares a side with the first
    vertices = vertices / np.ptp(vertices, 0).max()
    out, found, record = quads.remesh(vertices, faces, Request(quads=3000, engine="split"))
    assert record.engine == "pair and split" and whole(found) and abs(len(found) / 3000 - 1) <= 0.03
    assert repair.components(found)[0] == repair.components(faces)[0]
    figures = shape_figures(out, found)
    assert figures["jacobian_mean"] > 0.85 and figures["folded_share"] == 0 and figures["angle_deviation_deg"] < 18
    assert distance_figures(out, triangulated(found)[0], vertices, faces, 5000)["hausdorff"] < 0.01


def test_quads_without_area_are_evened_out_where_their_neighbours_stay(monkeypatch):
    """A mesh of the fallback whose every vertex is to stay, but one quad was split without area."""
    vertices, faces = sphere(24, 0.5)
    split, quad_faces = pair_and_split(vertices, faces, 600)
    a, b, c, d = quad_faces[100]
    split[b], split[d] = split[a], split[c]
    assert polygon_normals(split, quad_faces)[1][100] < 1e-12
    monkeypatch.setattr(quad_fit, "_let_go", lambda *given: np.arange(len(quad_faces)))
    out, _ = quad_fit.fitted(split, quad_faces, vertices, faces, Request(quads=600), Surface(vertices, faces))
    edge = (polygon_normals(out, quad_faces)[1].sum() / len(quad_faces)) ** 0.5
    assert polygon_normals(out, quad_faces)[1].min() > 1e-4 * edge**2
    touched = np.isin(quad_faces, quad_faces[100]).any(1)
    kept = np.setdiff1d(quad_faces[~touched], quad_faces[touched])
    assert np.array_equal(out[kept], split[kept])


def test_surface_that_the_quads_do_without_is_measured():
    vertices, faces = cube()
    lid = faces[np.all(vertices[faces][:, :, 2] == vertices[:, 2].max(), 1)]
    rest = np.array([f for f in faces.tolist() if f not in lid.tolist()])
    surface = Surface(vertices, faces)
    closed, opened = (np.concatenate([f, np.full((len(f), 1), -1)], 1) for f in (faces, rest))
    assert quad_fit.left_out(vertices, closed, surface, 0.1) == 0
    assert quad_fit.left_out(vertices, opened, surface, 0.1) == pytest.approx(0.8**2 / 6, abs=0.02)  # the lid but its rim


def test_bevels_of_marching_cubes_become_creases():
    vertices, faces = bored_box()
    sharp, sharp_faces, report = restore_creases(vertices, faces)
    assert report["moved"] > 300 and repair.is_watertight(sharp_faces) and repair.is_manifold(sharp_faces)
    corner = np.array([0.8, 0.6, 0.5])
    before, after = (np.linalg.norm(v - corner, axis=1).min() for v in (vertices, sharp))
    assert after < 0.2 * before
    features = find_features(sharp, sharp_faces, 30.0, 0.15)
    length = np.linalg.norm(features.points[features.segments[:, 0]] - features.points[features.segments[:, 1]], axis=1).sum()
    assert length == pytest.approx(4 * (1.6 + 1.2 + 1.0) + 2 * 2 * np.pi * 0.3, rel=0.05)


def test_smooth_and_sharp_meshes_are_left_alone():
    for vertices, faces in (sphere(32), cube()):
        assert restore_creases(vertices, faces)[2]["moved"] == 0


def test_sphere():
    vertices, faces = sphere(48)
    out, found, record = quads.remesh(vertices / 2, faces, Request(quads=1000))
    assert record.engine.startswith("instant-meshes") and whole(found)
    assert abs(len(found) / 1000 - 1) <= 0.03
    assert np.abs(np.linalg.norm(out, axis=1) - 0.4).max() < 2e-3
    assert shape_figures(out, found)["jacobian_min"] > 0.2


def test_torus_keeps_its_hole():
    vertices, faces = torus()
    out, found, _ = quads.remesh(vertices / 2, faces, Request(quads=1500))
    assert whole(found) and len(out) == len(found)  # Euler characteristic 0: E = 2F, V = F
    assert volume(out, found) == pytest.approx(2 * np.pi**2 * 0.65 * 0.28**2 / 8, rel=0.02)


def test_creases_lie_on_quad_edges():
    vertices, faces = bored_box()
    out, found, _ = quads.remesh(vertices / 2, faces, Request(quads=2500))
    assert whole(found) and abs(len(found) / 2500 - 1) <= 0.03
    triangles, _ = triangulated(found)
    line = np.linspace(-0.37, 0.37, 50)
    from gdtool.geometry.distance import closest_points

    truth = np.concatenate([np.stack([line, 0 * line + 0.3 * s, 0 * line + 0.25 * t], -1) for s in (-1, 1) for t in (-1, 1)])
    assert np.median(closest_points(truth, out, triangles)[0]) < 1e-3  # marching cubes cuts these edges off by 8e-3


def test_coarse_cube_is_filled_with_quads():
    out, found, _ = quads.remesh(*cube(), Request(quads=600))
    assert whole(found) and abs(len(found) / 600 - 1) <= 0.03 and volume(out, found) == pytest.approx(1, rel=0.02)


def test_open_plane_stays_open_and_flat():
    out, found, _ = quads.remesh(*plane(), Request(quads=400))
    assert repair.is_manifold(found) and np.abs(out[:, 2]).max() < 1e-9
    area = distance_figures(out, triangulated(found)[0], *plane(), 2000)
    assert area["hausdorff"] < 0.03  # less than an edge length: the boundary is where it was


def test_small_piece_is_not_lost():
    vertices, faces = joined(sphere(40, 0.7), sphere(40, 0.05, (0.9, 0.9, 0.9)))
    out, found, record = quads.remesh(vertices / 2, faces, Request(quads=1000))
    assert repair.components(found)[0] == 2 and whole(found) and "pair and split" in record.engine
    assert np.linalg.norm(out - 0.45, axis=1).min() < 0.05


def test_the_count_holds_where_small_pieces_take_more_than_their_share():
    """A tray of ten triangles comes out of the fallback as two dozen quads however few are asked for."""
    corners = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3)[:100]
    vertices, faces = cube(0.01)
    trays = [(vertices + 0.05 * corner + 0.3, faces[:-2]) for corner in corners]
    vertices, faces = joined(sphere(60, 0.25), *trays)
    out, found, _ = quads.remesh(vertices, faces, Request(quads=4000, engine="split"))
    assert abs(len(found) / 4000 - 1) < 0.03 and repair.components(found)[0] == 101
    assert 1000 < (np.linalg.norm(out, axis=1)[found].max(1) < 0.27).sum() < 2700


class Ended:
    """A child that has ended, in the place of one that works."""

    def __init__(self, outcome):
        self.outcome = outcome

    def result(self):
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


@pytest.mark.parametrize("failure", ["died of SIGSEGV", "ended with exit code 0 and no result"])
def test_dead_engine_is_replaced(monkeypatch, failure):
    monkeypatch.setattr(quad_ways, "begin", lambda *_, **__: Ended(ChildFailed(failure)))
    vertices, faces = torus()
    _, found, record = quads.remesh(vertices / 2, faces, Request(quads=900))
    assert record.engine == "pair and split" and any(failure in text for text in record.failed)
    assert whole(found) and abs(len(found) / 900 - 1) <= 0.03


@pytest.mark.parametrize("outcome, runs", [("a smaller sphere", 1), ("a crash", 3)])
def test_an_engine_that_strays_is_asked_once_and_one_that_crashes_again(monkeypatch, outcome, runs):
    """Another density or no creases mend a seam that tore; a part that is too fine for the quads stays so."""
    asked = []
    vertices, faces = sphere(24)
    out, found, _ = quads.remesh(vertices / 2, faces, Request(quads=1000, engine="split"))
    small = out / 2, found

    def begin(*arguments, **_):
        asked.append(arguments)
        return Ended(ChildFailed("died of SIGSEGV") if outcome == "a crash" else small)

    monkeypatch.setattr(quad_ways, "begin", begin)
    # Fitting would draw the small sphere out to the large one.
    monkeypatch.setattr(quad_ways, "finished", lambda vertices, faces, *_: (vertices, faces))
    monkeypatch.setattr(quad_ways, "farthest", lambda *_: 0.3)
    _, found, record = quads.remesh(vertices / 2, faces, Request(quads=1000))
    assert len(asked) == runs and record.engine == "pair and split" and whole(found)
    assert outcome == "a crash" or "strays" in record.failed[0]


def with_tunnel(vertices, faces, length):
    """A ball with a tunnel, a triangle wide, from its top to a triangle about so far away."""
    centre = vertices[faces].mean(1)
    top = centre[:, 2].argmax()
    other = np.abs(np.linalg.norm(centre - centre[top], axis=1) - length).argmin()
    a, b = faces[top], faces[other][::-1]
    b = min((np.roll(b, k) for k in range(3)), key=lambda b: np.linalg.norm(vertices[a] - vertices[b], axis=1).sum())
    tube = [[a[k], a[(k + 1) % 3], b[k]] for k in range(3)] + [[a[(k + 1) % 3], b[(k + 1) % 3], b[k]] for k in range(3)]
    return vertices, np.concatenate([np.delete(faces, [top, other], 0), tube])


def bored_ball():
    return marching(lambda x, y, z: np.maximum(np.sqrt(x * x + y * y + z * z) - 0.4, 0.06 - np.hypot(x, y)), 64, 0.5)


@pytest.mark.parametrize("shape, given_up", [("a skin-deep tunnel", True), ("a bore", False)])
def test_a_handle_is_given_up_only_where_it_is_finer_than_a_quad(monkeypatch, shape, given_up):
    vertices, faces = sphere(96, 0.4)
    out, found, _ = quads.remesh(vertices, faces, Request(quads=1000, engine="split"))
    vertices, faces = with_tunnel(vertices, faces, 0.07) if given_up else bored_ball()
    assert repair.is_watertight(faces) and repair.is_manifold(faces) and repair.euler_number(faces) == 0
    monkeypatch.setattr(quad_ways, "begin", lambda *_, **__: Ended((out, found)))  # an engine that makes a ball of it
    _, found, record = quads.remesh(vertices, faces, Request(quads=1000))
    assert whole(found) and (record.engine == "instant-meshes, handles are lost") == given_up
    assert repair.euler_number(found) == (2 if given_up else 0)


def around(faces, middle):
    """The faces that touch face `middle` at one corner only, and those that share an edge with it."""
    shared = np.isin(faces, faces[middle]).sum(1)
    return np.flatnonzero(shared == 1), np.flatnonzero(shared == 2)


def inner_face(vertices, faces):
    """A face in the middle of a side of the cube."""
    centre = vertices[faces].mean(1)
    return int(np.linalg.norm(centre - [0.07, 0.07, centre[:, 2].max()], axis=1).argmin())


def test_two_holes_that_meet_at_a_vertex_are_closed_each_by_itself():
    vertices, faces = quad_cube(3)
    middle = inner_face(vertices, faces)
    open_faces = np.delete(faces, [middle, around(faces, middle)[0][0]], 0)
    out, found = fill_holes(vertices, open_faces)
    assert len(out) == len(vertices) and len(found) == len(faces) and whole(found)
    assert volume(out, triangulated(found)[0]) == pytest.approx(volume(vertices, triangulated(faces)[0]))


def test_a_hole_with_a_crumb_that_hangs_in_it_by_a_corner_is_closed():
    vertices, faces = quad_cube(3)
    middle = inner_face(vertices, faces)
    corners, sides = around(faces, middle)
    assert len(corners) == 4 and len(sides) == 4
    torn = np.delete(faces, [*corners[1:], *sides], 0)
    fault, out, found = quad_ways.judged(vertices, torn, vertices, triangulated(faces)[0])
    assert fault is None and whole(found) and repair.components(found)[0] == 1 and len(found) < len(faces)
    assert volume(out, triangulated(found)[0]) == pytest.approx(volume(vertices, triangulated(faces)[0]))


def test_output_without_area_is_no_quads():
    vertices, faces = quad_cube(1)
    assert quad_ways.judged(vertices, faces[:, [0, 1, 1, 0]], vertices, triangulated(faces)[0])[0] == "no quads"


def test_torn_output_is_not_believed(monkeypatch):
    # Three quads at one edge.
    book = np.array([[0, 1, 2, 3], [0, 1, 4, 5], [1, 0, 6, 7]])
    monkeypatch.setattr(quad_ways, "begin", lambda *_, **__: Ended((np.random.default_rng(0).random((8, 3)), book)))
    vertices, faces = sphere(24)
    _, found, record = quads.remesh(vertices / 2, faces, Request(quads=300))
    assert whole(found) and record.engine == "pair and split" and any("pieces are lost" in text for text in record.failed)


def test_equal_input_gives_equal_quads():
    vertices, faces = sphere(24)
    one, two = (quads.remesh(vertices / 2, faces, Request(quads=500)) for _ in range(2))
    assert (one[0] == two[0]).all() and (one[1] == two[1]).all()


def test_when_the_time_is_over_no_engine_is_begun():
    """What was asked for comes all the same, as paired triangles, and the record says why."""
    vertices, faces = sphere(96, 0.45)
    start = time.monotonic()
    out, found, record = quads.remesh(vertices, faces, Request(quads=4000, seconds=0.01))
    assert record.engine == "pair and split" and record.failed == ["instant-meshes, 1 subdivision: not tried, the time is over"]
    assert whole(found) and abs(len(found) / 4000 - 1) <= 0.03 and time.monotonic() - start < 30


def test_every_round_asks_for_two_densities():
    way = quad_ways._ways(20000, Request())[0]
    assert len(way.near(20000)) == 2 and np.mean(way.near(20000)) == pytest.approx(20000)
    assert way.near(20000)[1] / way.near(20000)[0] == pytest.approx(way.factors[1] / way.factors[0])
