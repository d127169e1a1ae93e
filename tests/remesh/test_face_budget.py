"""The coarsest mesh within a distance is found by the counts that are requested from remesh()."""

import numpy as np
import pytest

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh import face_budget
from gdtool.remesh.task import Record, Request


@pytest.fixture
def counted(monkeypatch):
    """Replace remesh() by one that records the requested counts; the distance of its quads is 2 / count."""
    counts = []

    def remesh(mesh, request):
        counts.append(request.quads)
        return QuadMesh(mesh.vertices, np.zeros((request.quads, 4), np.int64)), Record()

    monkeypatch.setattr(face_budget, "remesh", remesh)
    monkeypatch.setattr(face_budget, "deviation", lambda mesh, made: 2 / (len(made.faces) / 2))
    return counts


def test_fewest_quads_within_a_distance_are_found_in_a_few_runs(counted):
    made, _, reached = face_budget.coarsest_within(
        TriMesh(np.zeros((3, 3)), np.zeros((1, 3), int)), Request(quads=20000), 0.002
    )
    quads_out = made.faces
    assert reached <= 0.002
    assert 1000 <= len(quads_out) <= 1150
    assert len(counted) <= 6


def test_the_largest_count_is_returned_when_even_it_is_too_small(counted):
    made, _, reached = face_budget.coarsest_within(
        TriMesh(np.zeros((3, 3)), np.zeros((1, 3), int)), Request(quads=500), 0.002
    )
    quads_out = made.faces
    assert len(quads_out) == 500
    assert reached > 0.002
    assert counted == [500]
