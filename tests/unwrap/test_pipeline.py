"""Unwrapping: quads stay whole, nothing overlaps, nothing is mirrored, and a dead child is survived."""

import time

import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.geometry.uv_raster import owner_count
from gdtool.unwrap import pipeline
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.pack import search
from gdtool.unwrap.pack.bitmasks import orient_upright
from gdtool.unwrap.pack.search import pack
from gdtool.unwrap.parameterize.flatten import FlattenResult, flatten, stretch
from gdtool.unwrap.parameterize.schedule import FlattenLimits, flatten_all
from gdtool.unwrap.segment import charts as unwrap_charts
from tests.bake.shapes import torus
from tests.geometry.solids import cube
from tests.unwrap.test_merge import sheet

CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
SMALL = pipeline.Request(size=512, padding=4)


def box(n: int = 6):
    """Make a cube of side 1 with at least n x n quads a side."""
    from gdtool.remesh.fit.surface_projection import subdivide

    vertices, quads = cube()[0], CUBE_QUADS
    while len(quads) < 6 * n * n:
        made, _ = subdivide(QuadMesh(vertices, quads))
        vertices, quads = made.vertices, made.faces
    return vertices, quads


def checked(vertices, faces, result, size=512):
    """Check what must hold for all results, and return the figures."""
    assert np.isfinite(result.uv).all()
    assert result.uv.min() >= 0
    assert result.uv.max() <= 1
    assert ((result.face_uvs >= 0) == (faces >= 0)).all()
    assert result.face_uvs.max() == len(result.uv) - 1
    figures = pipeline.figures(QuadMesh(vertices, faces, result.uv, result.face_uvs), size)
    assert figures["overlap"] == 0
    assert figures["mirrored"] == 0
    return figures


def test_box_unfolds_without_stretch():
    vertices, faces = box()
    result = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    figures = checked(vertices, faces, result)
    assert figures["charts"] <= 6
    assert figures["stretch"] == pytest.approx(1, abs=2e-3)
    assert figures["coverage"] > 0.4
    # Seams run along creases: the twelve edges and no more, sqrt(3) is the diagonal.
    assert figures["seam_length"] <= 12 / 3**0.5 + 1e-6


def test_torus_has_uniform_density_and_gaps():
    vertices, faces, _ = torus(48, 24)
    result = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    figures = checked(vertices, faces, result)
    assert figures["stretch"] < 1.1
    assert figures["area_distortion"] < 1.3
    assert figures["charts"] <= 16
    # Charts stay 4 texels of 512 apart, so they do not meet when each is grown by a texel.
    from scipy.ndimage import binary_dilation

    from gdtool.geometry.topology import triangulated

    _, face_idx = triangulated(faces)
    corners = pipeline.corner_triangles(result.face_uvs, face_idx)
    grown = np.zeros((512, 512), int)
    for chart in range(result.chart.max() + 1):
        mask = owner_count(result.uv, corners[result.chart[face_idx] == chart], 512) > 0
        grown += binary_dilation(mask, np.ones((3, 3)), 1)
    assert grown.max() == 1


def test_two_pieces_and_triangles_mixed():
    large, quads = box(2)
    small, triangles = cube(0.3)
    vertices = np.concatenate([large, small + 2])
    faces = np.concatenate([quads, np.concatenate([triangles + len(large), np.full((12, 1), -1)], 1)])
    checked(vertices, faces, pipeline.unwrap(QuadMesh(vertices, faces), SMALL))


def test_open_square_fills_the_texture():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    result = pipeline.unwrap(QuadMesh(vertices, np.array([[0, 1, 2, 3]])), SMALL)
    assert checked(vertices, np.array([[0, 1, 2, 3]]), result)["coverage"] > 0.95


def test_degenerate_and_turned_faces_survive():
    vertices, faces = box(2)
    faces = faces.copy()
    faces[3] = faces[3][::-1]
    vertices = vertices.copy()
    vertices[faces[7, 1]] = vertices[faces[7, 0]]
    result = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    assert np.isfinite(result.uv).all()
    assert pipeline.figures(QuadMesh(vertices, faces, result.uv, result.face_uvs))["overlap"] == 0


def test_dead_xatlas_leaves_box_projection(monkeypatch):
    def dead(*_, **__):
        raise ChildFailed("took longer than 1 s")

    monkeypatch.setattr(unwrap_charts, "call", dead)
    monkeypatch.setattr(pipeline, "begin", dead)
    vertices, faces, _ = torus(24, 12)
    result = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    checked(vertices, faces, result)
    assert len(result.failed) >= 2
    assert "took longer" in result.failed[0]


@pytest.mark.parametrize("seconds", [1e-3, 0.3])
def test_with_hardly_any_time_the_atlas_is_simple_and_valid(seconds):
    vertices, faces, _ = torus(96, 48)
    start = time.monotonic()
    result = pipeline.unwrap(QuadMesh(vertices, faces), pipeline.Request(size=512, padding=4, seconds=seconds))
    assert time.monotonic() - start < 20
    assert result.failed
    checked(vertices, faces, result)


def test_remaining_faces_become_charts_when_the_time_is_over():
    vertices, faces, _ = torus(24, 12)
    charts, why = flatten_all(QuadMesh(vertices, faces), np.zeros(len(faces), int), FlattenLimits(1.002, 1.1, 0.0, 0.0))
    assert len(charts) == len(faces)
    assert why == ["1 charts were cut: a chart was left when the time was over"]
    result = pipeline.unwrap(QuadMesh(vertices, faces), pipeline.Request(size=512, padding=4, seconds=1e-9))
    assert checked(vertices, faces, result)["charts"] == len(faces)


def test_a_failed_conformal_map_is_replaced_by_tuttes_embedding(monkeypatch):
    def refuses(*_):
        raise RuntimeError("igl::lscm failed")

    monkeypatch.setattr("igl.lscm", refuses)
    points = np.random.default_rng(0).random((30, 2))
    import scipy.spatial

    triangles = scipy.spatial.Delaunay(points).simplices.astype(np.int64)
    bowl = np.concatenate([points, ((points - 0.5) ** 2).sum(1, keepdims=True) * 2], 1)
    flat = flatten(TriMesh(bowl, triangles), 1.0001, 1.5)
    assert flat.uv is not None
    assert stretch(TriMesh(bowl, triangles), flat.uv) < 1.2


def test_charts_stay_whole_where_they_fill_the_square(monkeypatch):
    """Cutting is skipped, and little is lost: with every cut tried, coverage is less than a tenth better."""
    side = np.arange(9)
    x, y = np.meshgrid(side, side)
    plate = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1) / 8.0
    i = (side[:-1, None] * 9 + side[:-1]).ravel()
    quads = np.stack([i, i + 1, i + 10, i + 9], -1)
    ell = quads[(plate[quads].mean(1)[:, :2] < 0.25).any(1)]
    meshes = [(plate, quads)] * 8 + [(plate, ell)]
    vertices = np.concatenate([points + [0, 0, height] for height, (points, _) in enumerate(meshes)])
    faces = np.concatenate([quads_of_plate + 81 * k for k, (_, quads_of_plate) in enumerate(meshes)])
    uncut = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    assert [what for what, _, _ in uncut.skipped] == ["cutting further for packing"]
    assert uncut.skipped[0][2] > 0
    monkeypatch.setattr(pipeline, "WELL_PACKED", 1.0)
    monkeypatch.setattr(search, "WELL_PACKED", 1.0)
    monkeypatch.setattr(search, "_MAX_STEP_GAIN", 1.0)
    cut = pipeline.unwrap(QuadMesh(vertices, faces), SMALL)
    few, many = checked(vertices, faces, uncut), checked(vertices, faces, cut)
    assert not cut.skipped
    assert many["coverage"] < 1.1 * few["coverage"]
    assert many["stretch"] == pytest.approx(few["stretch"], abs=1e-3)


def test_cylinder_side_is_developable():
    angle = np.linspace(0, 1.6 * np.pi, 25)
    x, z = np.meshgrid(angle, np.linspace(0, 1, 5))
    vertices = np.stack([np.sin(x.ravel()), z.ravel(), np.cos(x.ravel())], -1)
    i = (np.arange(4)[:, None] * 25 + np.arange(24)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + 26], -1), np.stack([i, i + 26, i + 25], -1)])
    flat = flatten(TriMesh(vertices, triangles), 1.001, 1.05)
    assert flat.reason == ""
    assert stretch(TriMesh(vertices, triangles), flat.uv) < 1.001


def test_stretch_of_known_maps():
    vertices, triangles = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    assert stretch(TriMesh(vertices, triangles), 7 * vertices[:, :2]) == pytest.approx(1)
    # Stretched by two in one direction: sqrt((a + 1/a) / 2) with a = 2.
    assert stretch(TriMesh(vertices, triangles), vertices[:, :2] * [2, 1]) == pytest.approx((2.5 / 2) ** 0.5)


def test_closed_mesh_cannot_lie_flat():
    vertices, triangles = cube()
    assert flatten(TriMesh(vertices, triangles), 1.001, 1.1) == FlattenResult(None, "closed")


@pytest.mark.parametrize("holes", [1, 2, 5])
def test_a_torus_with_holes_has_a_handle_and_a_bent_sheet_with_holes_lies_flat(holes):
    vertices, faces, _ = torus(24, 12)
    assert flatten(
        TriMesh(vertices, np.delete(triangulated(faces)[0], 40 * np.arange(holes), 0)), 1.001, 1.1
    ) == FlattenResult(None, "has a handle")
    vertices, faces = sheet(20, bend=1.0)
    triangles = triangulated(np.delete(faces, 42 + 42 * np.arange(holes), 0))[0]
    flat = flatten(TriMesh(vertices, triangles), 1.001, 1.1)
    assert flat.reason == ""
    assert stretch(TriMesh(vertices, triangles), flat.uv) < 1.001


def test_four_rotated_squares_are_set_upright_and_packed_tight():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    assert np.ptp(orient_upright(square @ turn), 0) == pytest.approx([1, 1], abs=1e-3)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    places, scale = pack([(square @ turn * s, triangles) for s in (1, 1, 1, 1)], 0.01)
    for uv in places:
        assert uv.min() >= 0
        assert uv.max() <= 1
        assert np.linalg.det([uv[1] - uv[0], uv[3] - uv[0]]) > 0  # rotated, never mirrored
        assert np.linalg.norm(uv[1] - uv[0]) == pytest.approx(scale)
    assert 4 * scale**2 > 0.8
    assert (owner_count(np.concatenate(places), np.concatenate([triangles + 4 * i for i in range(4)]), 512) <= 1).all()


def test_slivers_do_not_overlap_other_charts():
    """Triangles narrower than the packer's cells still get their place."""
    shapes = [np.array([[0, 0], [1, 0], [1, height]]) for height in (1.0, 0.055, 0.012)] + [
        np.array([[0, 0], [2.2, 0], [2.2, 0.055]])
    ]
    charts = [(shape, np.array([[0, 1, 2]])) for shape in shapes for _ in range(12)]
    places, _ = pack(charts, 1 / 256)
    assert (owner_count(np.concatenate(places), np.arange(3 * len(charts)).reshape(-1, 3), 4096) <= 1).all()


def test_thousands_of_charts_are_placed_in_rows():
    triangle, faces = np.array([[0, 0], [1, 0], [0, 1.0]]), np.array([[0, 1, 2]])
    places, _ = pack([(triangle, faces)] * 2000, 0.002)
    assert min(uv.min() for uv in places) >= 0
    assert max(uv.max() for uv in places) <= 1


def test_hundreds_of_charts_fill_the_square_better_than_rows_do():
    """Triangles of all sizes, whose bounding rectangles are half empty."""
    from gdtool.unwrap.pack.search import _shelf_pack

    rng = np.random.default_rng(0)
    charts = [
        (corners * rng.uniform(0.2, 1), np.array([[0, 1, 2]])) for corners in rng.uniform(0, 1, (200, 1, 3, 2))[:, 0]
    ]
    charts = [(uv if np.linalg.det([uv[1] - uv[0], uv[2] - uv[0]]) > 0 else uv[::-1], t) for uv, t in charts]
    places, scale = pack(charts, 1 / 512)
    assert min(uv.min() for uv in places) >= 0
    assert max(uv.max() for uv in places) <= 1
    assert (owner_count(np.concatenate(places), np.arange(3 * len(charts)).reshape(-1, 3), 2048) <= 1).all()
    assert scale**2 > 1.2 * _shelf_pack([orient_upright(uv) for uv, _ in charts], 1 / 512)[1] ** 2


def test_a_rim_that_hardly_crosses_itself_is_found():
    from gdtool.unwrap.parameterize.flatten import overlapping_triangles, rim_crossings

    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    ends = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    assert not len(rim_crossings(square, ends)[0])
    assert rim_crossings(square[[0, 2, 1, 3]], ends)[0].tolist() == [0, 2]
    # A strip of triangles bent into a ring, whose ends miss or pass each other by a millionth.
    for turn, crosses in ((2 * np.pi - 1e-6, False), (2 * np.pi + 1e-6, True)):
        angle = np.repeat(np.linspace(0, turn, 65), 2)
        radius = np.tile([1.0, 2.0], 65)
        uv = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
        i = np.arange(64)[:, None] * 2
        strip = np.concatenate([i + [0, 1, 3], i + [0, 3, 2]])
        assert overlapping_triangles(uv, strip).any() == crosses


def ring_of_quads(around=96, across=10):
    """Make a flat ring, inner radius half the outer: vertices, quads, and the uv of its chart."""
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0.25, 0.5, across + 1))
    uv = np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()], -1)
    row, column = (x.ravel() for x in np.mgrid[:across, :around])
    after = (column + 1) % around
    quads = np.stack(
        [row * around + column, (row + 1) * around + column, (row + 1) * around + after, row * around + after], -1
    )
    return np.concatenate([uv, np.zeros((len(uv), 1))], 1), quads, uv


def test_a_ring_is_cut_into_arcs_that_keep_their_coordinates():
    from gdtool.geometry.topology import triangulated
    from gdtool.unwrap.segment.charts import Adjacency
    from gdtool.unwrap.segment.straight_cuts import cut_to_pack

    vertices, quads, uv = ring_of_quads()
    chart = Chart(np.arange(len(quads)), quads, uv, triangulated(quads)[0])
    adjacency = Adjacency(QuadMesh(vertices, quads))
    assert not list(cut_to_pack(adjacency, [chart], [1]))
    few, parts = cut_to_pack(adjacency, [chart], [2, 40])
    assert 2 <= len(few) <= 3 < len(parts)
    assert sorted(np.concatenate([part[0] for part in parts])) == list(range(len(quads)))
    for faces_idx, corners, part_uv, _ in parts:
        np.testing.assert_array_equal(part_uv[corners], uv[quads[faces_idx]])
    # A filled square is not cut.
    square = np.stack(np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 1, 11)), -1).reshape(-1, 2)
    i = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.stack([i, i + 1, i + 12, i + 11], -1)
    flat = np.concatenate([square, np.zeros((121, 1))], 1)
    assert not list(
        cut_to_pack(
            Adjacency(QuadMesh(flat, faces)), [Chart(np.arange(100), faces, square, triangulated(faces)[0])], [40]
        )
    )


def test_two_rings_fill_the_square_better_once_cut():
    vertices, quads, _ = ring_of_quads()
    both = np.concatenate([vertices, vertices + (2, 0, 0)])
    faces = np.concatenate([quads, quads + len(vertices)])
    figures = checked(both, faces, pipeline.unwrap(QuadMesh(both, faces), SMALL))
    # Two whole rings cannot cover more than 2 * 0.75 pi / 4 of the square around the two of them, which is 1.707 of
    # their width.
    assert figures["coverage"] > 0.45 > 2 * 0.75 * np.pi / 4 / 1.707**2


def test_sets_of_more_charts_are_not_tried_where_few_fill_the_square():
    from gdtool.unwrap.pack.search import WELL_PACKED, choose_cut

    def grid(n, sides):
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * sides
        return [(corners, np.array([[0, 1, 2], [0, 2, 3]]))] * n

    few, many, narrow = grid(4, (1, 1)), grid(16, (0.5, 0.5)), grid(2, (3.0, 0.1))
    chosen, share, *_ = choose_cut([few, many], 1 / 512)
    assert chosen == 0
    assert share > WELL_PACKED
    # Where the first set fills it badly, a later one that fills it is taken.
    assert choose_cut([narrow, many], 1 / 512)[0] == 1
    # Where a set fills much less, the next ones are skipped, but never the last.
    strips = grid(2, (3.0, 0.3))
    assert choose_cut([strips, few, many], 1 / 512)[::3] == (2, 1)
    assert choose_cut([strips, many], 1 / 512)[::3] == (
        1,
        0,
    )


@pytest.mark.parametrize(("around", "across", "minor"), [(96, 20, 0.08), (80, 28, 0.12), (96, 12, 0.035)])
def test_skipped_sets_of_charts_cost_little_coverage_and_few_seams(monkeypatch, around, across, minor):
    """Against packing every set of charts, skipping some costs at most 0.02 of the square and eight charts."""
    vertices, faces, _ = torus(around, across, 0.35, minor)
    measured = []
    for gains in (search._MAX_STEP_GAIN, np.inf):
        monkeypatch.setattr(search, "_MAX_STEP_GAIN", gains)
        result = pipeline.unwrap(QuadMesh(vertices, faces), pipeline.Request(size=1024, padding=4))
        reasons = [why for what, why, _ in result.skipped if what.startswith("packing")]
        assert len(reasons) == (gains < np.inf)
        assert not result.failed
        measured.append(pipeline.figures(QuadMesh(vertices, faces, result.uv, result.face_uvs)))
    quick, whole = measured
    assert quick["coverage"] > whole["coverage"] - 0.02
    assert quick["charts"] <= whole["charts"] + 8
    assert quick["overlap"] == 0
