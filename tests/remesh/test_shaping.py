"""Quads drawn onto a surface: what is known of their vertices is known of them still when some are gone."""

import numpy as np

from gdtool.remesh.fit import shaping
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import SnappedQuads
from gdtool.remesh.task import Request
from tests.geometry.solids import quad_cube


def test_tips_stay_where_folded_quads_before_them_are_taken_out(monkeypatch):
    vertices, quads = quad_cube(2)
    fixed, tips, gone = np.array([3, 11, 20, 40]), np.array([11, 40]), 7
    constraints = Constraints.none(len(vertices))
    constraints.fixed[fixed] = True
    eased = []

    def without_one(vertices, faces, surface, constraints):
        """A vertex becomes another, a quad is gone."""
        number = np.arange(len(vertices)) - (np.arange(len(vertices)) > gone)
        kept = np.delete(np.arange(len(vertices)), gone)
        return (
            vertices[kept],
            number[np.where(faces == gone, 0, faces)][1:],
            Constraints(constraints.curve[kept], constraints.fixed[kept], *held[2:]),
        )

    held = constraints.curve, constraints.fixed, constraints.path, constraints.path_curve
    monkeypatch.setattr(
        shaping,
        "_square_twice",
        lambda vertices, faces, surface, features, constraints, request: (vertices, constraints),
    )
    monkeypatch.setattr(
        shaping,
        "_untangle_and_release",
        lambda vertices, faces, surface, features, constraints, tips: (vertices, constraints),
    )
    monkeypatch.setattr(shaping, "collapse_folded_quads", without_one)
    monkeypatch.setattr(shaping, "untangle", lambda vertices, *_: vertices)
    monkeypatch.setattr(
        shaping,
        "release_and_smooth",
        lambda vertices, *given, tips, **_: eased.append(vertices[tips]) or (vertices, given[3]),
    )
    for jacobian in (0.1, -0.1):
        monkeypatch.setattr(
            shaping, "scaled_jacobian", lambda vertices, faces, jacobian=jacobian: np.full(len(faces), jacobian)
        )
        shaping.fit_to_surface(
            SnappedQuads(vertices, quads, constraints, tips, 0.1, 0.0, 1.0, False), None, None, Request()
        )
    # of the folded ones alone
    assert len(eased) == 1
    assert np.array_equal(eased[0], vertices[tips])
