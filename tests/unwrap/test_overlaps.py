"""Charts that overlap themselves lose the overlapping faces, which neighbouring charts get."""

import numpy as np
import pytest

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import edges_of, triangulated
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.parameterize import schedule
from gdtool.unwrap.parameterize.flatten import overlapping_triangles, overlaps_itself, stretch
from gdtool.unwrap.segment.charts import Adjacency, chart_mesh
from gdtool.unwrap.segment.overlaps import OverlapPiece, give_to_neighbours, remove_overlaps
from tests.unwrap.test_merge import GOOD, sheet


def spiral(turns, around=120, across=6):
    """Make a spiral band of quads: vertices (v, 3), faces (f, 4), and flat coordinates (v, 2).

    The flat coordinates overlap where there is more than one turn.
    """
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi * turns, around + 1), np.linspace(0.5, 0.6, across + 1))
    uv = np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()], -1)
    row, column = (x.ravel() for x in np.mgrid[:across, :around])
    i = row * (around + 1) + column
    faces = np.stack([i, i + around + 1, i + around + 2, i + 1], -1)
    return np.concatenate([uv, 0.01 * angle.ravel()[:, None]], 1), faces, uv


def test_only_the_overlapping_end_of_a_spiral_is_removed():
    vertices, faces, uv = spiral(1.05)
    triangles, face_idx = triangulated(faces)
    assert 0 < overlapping_triangles(uv, triangles).mean() < 0.2
    keep = remove_overlaps(Adjacency(QuadMesh(vertices, faces)), np.arange(len(faces)), triangles, face_idx, uv)
    # One of the two ends is removed, not both; nothing overlaps any more.
    assert 0.9 < keep.mean() < 0.97
    assert not overlapping_triangles(uv, triangles[keep[face_idx]]).any()


def test_a_disk_whose_rim_does_not_cross_itself_has_no_overlap():
    for turns in (0.9, 1.05, 1.6):
        _, faces, uv = spiral(turns)
        triangles = triangulated(faces)[0].astype(np.int64)
        assert (
            overlaps_itself(uv, triangles, edges_of(triangles), True)
            == overlapping_triangles(uv, triangles).any()
            == (turns > 1)
        )


@pytest.mark.parametrize("past", [0.0, 20.0])
def test_a_rim_may_cross_itself_where_two_of_its_corners_coincide(past):
    """A fan of triangles all around a corner, whose two ends meet in one place or run past each other."""
    degrees, length = np.array([-past, *range(0, 361, 30), 360 + past]), np.array([0.6, *[1.0] * 13, 0.6])
    uv = np.concatenate(
        [[[0, 0]], length[:, None] * np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], -1)]
    )
    uv[14] = uv[2]
    if not past:
        uv = np.delete(uv, [1, 15], 0)
    i = np.arange(1, len(uv) - 1)
    triangles = np.stack([np.zeros_like(i), i, i + 1], -1)
    assert overlaps_itself(uv, triangles, edges_of(triangles), True) == bool(past)


def test_overlaps_of_half_a_chart_are_not_removed():
    vertices, faces, uv = spiral(1.6)
    triangles, face_idx = triangulated(faces)
    assert remove_overlaps(Adjacency(QuadMesh(vertices, faces)), np.arange(len(faces)), triangles, face_idx, uv) is None


def test_an_overlapping_band_becomes_two_charts():
    vertices, faces, _ = spiral(1.05)
    charts, cut = schedule.flatten_all(
        QuadMesh(vertices, faces),
        np.zeros(len(faces), int),
        schedule.FlattenLimits(GOOD, 1.5),
        TriMesh(vertices, triangulated(faces)[0].astype(np.int64)),
    )
    assert len(charts) == 2
    assert cut == ["1 charts were cut: a chart overlaps itself"]
    assert sorted(np.concatenate([chart[0] for chart in charts])) == list(range(len(faces)))
    for _, _, uv, triangles in charts:
        assert not overlapping_triangles(uv, triangles).any()


def test_a_piece_is_added_to_the_neighbour_that_it_lies_flat_with(monkeypatch):
    """The piece has seams of equal length with a dome and with the sheet that it continues."""
    vertices, faces = sheet(12)
    column = np.arange(144) % 12
    bulge = np.clip(4 - (vertices[:, 0] * 12), 0, None)
    vertices = vertices + np.stack([0 * bulge, 0 * bulge, 0.08 * bulge * np.sin(np.pi * vertices[:, 1])], -1)
    piece, dome, flat = (np.flatnonzero(mask) for mask in ((column >= 4) & (column < 6), column < 4, column >= 6))

    def chart(faces_idx):
        return schedule.flatten_all(
            QuadMesh(vertices, faces[faces_idx]),
            np.zeros(len(faces_idx), int),
            schedule.FlattenLimits(GOOD, 1.5),
            TriMesh(vertices, triangulated(faces[faces_idx])[0].astype(np.int64)),
        )[0][0]

    def unplaced(home, beside=(dome, flat), good=GOOD):
        charts = [chart(faces_of_chart)._replace(faces_idx=faces_of_chart) for faces_of_chart in beside]
        return len(
            give_to_neighbours(
                Adjacency(QuadMesh(vertices, faces)),
                QuadMesh(vertices, faces),
                charts,
                [OverlapPiece(int(home[0]), piece)],
                good,
            )
        ), charts

    count, charts = unplaced(piece)
    assert not count
    assert len(charts[0][0]) == len(dome)
    assert sorted(charts[1][0]) == sorted(np.concatenate([flat, piece]))
    # The piece is not placed if its only flat neighbour is the chart it was removed from, if no neighbour lies flat
    # with it, or once the limit of work is reached.
    assert unplaced(flat, [flat])[0] == 1
    assert unplaced(dome, [flat])[0] == 0
    assert unplaced(piece, [dome], 1 + 1e-9)[0] == 1
    monkeypatch.setattr("gdtool.unwrap.segment.overlaps._MAX_WORK", -1)
    assert unplaced(piece)[0] == 1


@pytest.mark.parametrize(("columns", "stays"), [(1, True), (4, False)])
def test_a_chart_much_larger_than_a_piece_keeps_its_coordinates(columns, stays):
    vertices, faces = sheet(12, bend=1.0)
    column = np.arange(144) % 12
    piece, others = np.flatnonzero(column < columns), np.flatnonzero(column >= columns)
    made = chart_mesh(QuadMesh(vertices, faces[others]))
    points, corners = made.vertices, made.faces
    # Slanted coordinates, which flattening again would not reproduce.
    flat_uv = np.stack([np.arcsin(points[:, 0]), points[:, 1] + 0.01 * points[:, 0]], -1)
    charts = [Chart(others, corners, flat_uv, triangulated(corners)[0])]
    assert not give_to_neighbours(
        Adjacency(QuadMesh(vertices, faces)),
        QuadMesh(vertices, faces),
        charts,
        [OverlapPiece(int(piece[0]), piece)],
        1.01,
    )
    faces_idx, corners, uv, triangles = charts[0]
    assert sorted(faces_idx) == list(range(144))
    assert not overlapping_triangles(uv, triangles).any()
    assert (uv[: len(flat_uv)] == flat_uv).all() == stays
    assert stretch(TriMesh(chart_mesh(QuadMesh(vertices, faces[faces_idx])).vertices, triangles), uv) < 1.02
