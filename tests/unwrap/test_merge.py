"""Small charts merge with the neighbours that they lie flat with."""

import numpy as np
import trimesh

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.unwrap.parameterize import schedule
from gdtool.unwrap.segment.charts import Adjacency
from gdtool.unwrap.segment.merge import _transfer_labels, merge_small_charts

GOOD = 1.002


def sheet(n, height=0.0, bend=0.0, down=False):
    """Make n x n quads over the unit square, bent about y with curvature `bend`."""
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    turn = bend * (u - 0.5)
    x, z = (np.sin(turn) / bend, (1 - np.cos(turn)) / bend) if bend else (u, 0 * u)
    vertices = np.stack([x, v, z + height], -1).reshape(-1, 3)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.stack([i, i + 1, i + n + 2, i + n + 1], -1)
    return vertices, faces[:, ::-1] if down else faces


def proxy_of(vertices, faces):
    return TriMesh(vertices, triangulated(faces)[0].astype(np.int64))


def test_a_strip_beside_a_sheet_joins_it():
    vertices, faces = sheet(110, bend=1.0)
    label = (np.arange(110 * 110) % 110 >= 108).astype(int)
    assert (merge_small_charts(QuadMesh(vertices, faces), label, proxy_of(*sheet(55, bend=1.0)), GOOD) == 0).all()


def test_large_charts_stay_apart():
    vertices, faces = sheet(20)
    label = (np.arange(400) % 20 >= 10).astype(int)
    assert (merge_small_charts(QuadMesh(vertices, faces), label, proxy_of(vertices, faces), GOOD) == label).all()


def test_charts_that_would_close_or_stretch_stay_apart():
    ball = trimesh.creation.icosphere(4)
    faces = np.concatenate([ball.faces, np.full((len(ball.faces), 1), -1)], 1)
    height = ball.triangles_center[:, 2]
    for label in ((height > 0.98).astype(int), np.where(height > 0.98, 2, (height < 0).astype(int))):
        assert (
            len(
                np.unique(
                    merge_small_charts(QuadMesh(ball.vertices, faces), label, TriMesh(ball.vertices, ball.faces), GOOD)
                )
            )
            == label.max() + 1
        )


def test_the_sides_of_a_thin_wall_keep_their_labels():
    (front, up), (back, down) = sheet(30), sheet(30, height=0.002, down=True)
    vertices, faces = np.concatenate([front, back]), np.concatenate([up, down + len(front)])
    label = np.repeat([0, 1], 900)
    (front, up), (back, down) = sheet(7), sheet(7, height=0.002, down=True)
    proxy = proxy_of(np.concatenate([front, back]), np.concatenate([up, down + len(front)]))
    corners = np.concatenate([proxy.faces, np.full((len(proxy.faces), 1), -1)], 1)
    adjacency = Adjacency(QuadMesh(proxy.vertices, corners))
    labels = _transfer_labels(QuadMesh(vertices, faces), label, proxy, adjacency)
    assert (labels == np.repeat([0, 1], 98)).all()


def test_charts_that_are_flat_together_only_on_the_proxy_are_split_again(monkeypatch):
    """A hemisphere and its cap, merged into one chart: together they stretch too much, so each becomes a chart."""
    ball = trimesh.creation.icosphere(4)
    ball.update_faces(ball.triangles_center[:, 2] > 0)
    ball.remove_unreferenced_vertices()
    faces = np.concatenate([ball.faces, np.full((len(ball.faces), 1), -1)], 1)
    label = (ball.triangles_center[:, 2] > 0.985).astype(int)
    monkeypatch.setattr(schedule, "merge_small_charts", lambda *arguments: np.zeros(len(faces), int))
    monkeypatch.setattr(schedule, "_MAX_TOTAL_EXCESS", np.inf)
    charts, _ = schedule.flatten_all(
        QuadMesh(ball.vertices, faces), label, schedule.FlattenLimits(GOOD, 1.5), TriMesh(ball.vertices, ball.faces)
    )
    owner = np.full(len(faces), -1)
    for i, (faces_idx, _, uv, _) in enumerate(charts):
        owner[faces_idx] = i
        assert np.isfinite(uv).all()
    assert len(charts) == 2
    assert ((owner == owner[label.argmax()]) == (label == 1)).all()


def test_a_vertex_in_which_a_chart_touches_itself_is_doubled():
    from gdtool.unwrap.segment.charts import chart_mesh

    vertices, faces = sheet(2)
    for faces_idx, count in (([0, 1], 6), ([0, 3], 8), ([0, 1, 3], 8), ([0, 1, 2, 3], 9)):
        made = chart_mesh(QuadMesh(vertices, faces[faces_idx]))
        points, corners = made.vertices, made.faces
        assert len(points) == count
        np.testing.assert_array_equal(points[corners], vertices[faces[faces_idx]])
