"""Charts are cut where all of them together stretch too much."""

import numpy as np
import trimesh

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.unwrap.parameterize import schedule
from gdtool.unwrap.parameterize.flatten import overlapping_triangles, stretch
from gdtool.unwrap.pipeline import Request, figures, unwrap


def ball(level=4):
    mesh = trimesh.creation.icosphere(level)
    faces = np.concatenate([mesh.faces, np.full((len(mesh.faces), 1), -1)], 1).astype(np.int64)
    return np.asarray(mesh.vertices), faces, mesh.triangles_center


def whole_stretch(vertices, faces, charts):
    """Compute the L2 stretch of all charts together."""
    points, corners, uvs, offset = [], [], [], 0
    for faces_idx, chart_corners, uv, triangles in charts:
        place = np.zeros((len(uv), 3))
        place[chart_corners[chart_corners >= 0]] = vertices[faces[faces_idx][chart_corners >= 0]]
        points.append(place)
        corners.append(triangles + offset)
        uvs.append(uv)
        offset += len(uv)
    return stretch(TriMesh(np.concatenate(points), np.concatenate(corners).astype(np.int64)), np.concatenate(uvs))


def test_the_most_stretched_charts_are_cut_until_all_together_stretch_little(monkeypatch):
    vertices, faces, centre = ball()
    label = (centre[:, 2] > 0).astype(int)
    proxy = TriMesh(vertices, faces[:, :3])
    monkeypatch.setattr(schedule, "merge_small_charts", lambda *arguments: label)
    charts, why = schedule.flatten_all(QuadMesh(vertices, faces), label, schedule.FlattenLimits(1.01, 1.5), proxy)
    assert 1.002 < whole_stretch(vertices, faces, charts) < 1.014
    assert 3 <= len(charts) <= 8
    assert any("stretches more than most" in line for line in why)
    assert sorted(np.concatenate([chart[0] for chart in charts])) == list(range(len(faces)))
    assert not any(overlapping_triangles(uv, triangles.astype(np.int64)).any() for _, _, uv, triangles in charts)
    monkeypatch.setattr(schedule, "_MAX_TOTAL_EXCESS", np.inf)
    charts, _ = schedule.flatten_all(QuadMesh(vertices, faces), label, schedule.FlattenLimits(1.01, 1.5), proxy)
    assert len(charts) == 2
    assert whole_stretch(vertices, faces, charts) > 1.02


def test_charts_that_stretch_little_stay_whole():
    mesh = trimesh.creation.cylinder(0.4, 1.0, sections=64)
    mesh = mesh.subdivide().subdivide()
    faces = np.concatenate([mesh.faces, np.full((len(mesh.faces), 1), -1)], 1).astype(np.int64)
    result = unwrap(QuadMesh(np.asarray(mesh.vertices), faces), Request(size=512, padding=4))
    assert figures(QuadMesh(mesh.vertices, faces, result.uv, result.face_uvs))["stretch"] < 1.002
    assert not any("more than most" in line for line in result.failed)


def test_cutting_ends_where_stretch_cannot_be_reduced(monkeypatch):
    """Faces without area, and folds that stretch again after every cut: the number of cuts is bounded."""
    vertices, faces, centre = ball(3)
    crumpled = vertices * (1 + 0.5 * np.random.default_rng(0).random((len(vertices), 1)))
    label = (centre[:, 2] > 0).astype(int)
    monkeypatch.setattr(schedule, "merge_small_charts", lambda *arguments: label)
    charts, why = schedule.flatten_all(
        QuadMesh(crumpled, faces), label, schedule.FlattenLimits(1.0000001, 1.1), TriMesh(crumpled, faces[:, :3])
    )
    cuts = [int(line.split()[0]) for line in why if "more than most" in line]
    assert cuts
    assert cuts[0] >= 16
    assert sorted(np.concatenate([chart[0] for chart in charts])) == list(range(len(faces)))


def test_a_chart_is_cut_between_its_parts_or_else_through_the_middle():
    from gdtool.unwrap.segment.charts import Adjacency
    from tests.unwrap.test_merge import sheet

    vertices, faces = sheet(20)
    vertices = vertices * [2, 1, 1]
    adjacency, column = Adjacency(QuadMesh(vertices, faces)), np.arange(400) % 20
    for part, first in ((column >= 6, 6), (np.where(column < 12, 7, np.where(column < 15, 3, 5)), 12)):
        first_set, second_set = schedule._split_set(adjacency, part, np.arange(400))
        assert {len(first_set), len(second_set)} == {20 * first, 400 - 20 * first}
        assert (column[first_set] < first).all() != (column[second_set] < first).all()
    assert min(map(len, schedule._split_set(adjacency, np.zeros(400, int), np.arange(400)))) > 150
