"""Fitting quads: constraints and tips stay those of their vertices after quads were collapsed."""

import numpy as np

from gdtool.geometry.meshes import QuadMesh
from gdtool.remesh.fit import shaping
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import SnappedQuads
from gdtool.remesh.task import Request
from tests.geometry.solids import quad_cube


def test_tips_are_found_again_after_folded_quads_were_collapsed(monkeypatch):
    vertices, quads = quad_cube(2)
    fixed, tips, gone = np.array([3, 11, 20, 40]), np.array([11, 40]), 7
    constraints = Constraints.none(len(vertices))
    constraints.fixed[fixed] = True
    released = []

    def without_one(mesh, surface, constraints):
        """Merge a vertex into another, and remove a quad."""
        number = np.arange(len(vertices)) - (np.arange(len(vertices)) > gone)
        remaining = np.delete(np.arange(len(vertices)), gone)
        return (
            QuadMesh(mesh.vertices[remaining], number[np.where(mesh.faces == gone, 0, mesh.faces)][1:]),
            Constraints(constraints.curve[remaining], constraints.fixed[remaining], *held[2:]),
        )

    held = constraints.curve, constraints.fixed, constraints.path, constraints.path_curve
    monkeypatch.setattr(
        shaping,
        "_square_twice",
        lambda mesh, surface, features, constraints, request: (mesh.vertices, constraints),
    )
    monkeypatch.setattr(
        shaping,
        "_untangle_and_release",
        lambda mesh, surface, features, constraints, tips: (mesh.vertices, constraints),
    )
    monkeypatch.setattr(shaping, "collapse_folded_quads", without_one)
    monkeypatch.setattr(shaping, "untangle", lambda mesh, *_: mesh.vertices)
    monkeypatch.setattr(
        shaping,
        "release_and_smooth",
        lambda mesh, *arguments, tips, **_: released.append(mesh.vertices[tips]) or (mesh.vertices, arguments[2]),
    )
    for jacobian in (0.1, -0.1):
        monkeypatch.setattr(
            shaping, "scaled_jacobian", lambda mesh, jacobian=jacobian: np.full(len(mesh.faces), jacobian)
        )
        shaping.fit_to_surface(
            SnappedQuads(QuadMesh(vertices, quads), constraints, tips, 0.1, 0.0, 1.0, False), None, None, Request()
        )
    # only for the quads that are folded
    assert len(released) == 1
    assert np.array_equal(released[0], vertices[tips])
