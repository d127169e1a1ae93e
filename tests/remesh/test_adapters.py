"""Engines' input: simplified with the topology of the mesh, even where the collapse tears it."""

import numpy as np

from gdtool.geometry import simplify, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.remesh.engines import adapters
from tests.geometry.solids import sphere


def test_engine_input_is_simplified_where_tears_of_the_collapse_can_be_repaired(monkeypatch):
    vertices, faces = sphere(40)
    wanted = topology.invariants(faces)
    made = simplify.collapse(TriMesh(vertices, faces), 1200, 5.0)
    few_vertices, few = made.vertices, made.faces

    def tearing(*_):
        """Return the collapsed mesh with two triangles more on one of its edges, which then has four faces."""
        a, b, _ = few[0]
        tip = len(few_vertices)
        vertices = np.concatenate([few_vertices, [[0.0, 0.0, 2.0]]])
        return TriMesh(vertices, np.concatenate([few, [[a, b, tip], [b, a, tip]]]))

    monkeypatch.setattr(simplify, "collapse", tearing)
    assert not topology.is_watertight(tearing().faces)
    made = adapters.simplify_for_engine(TriMesh(vertices, faces), 300, wanted)
    collapsed = made.faces
    assert len(few) <= len(collapsed) < len(few) + 12
    assert topology.invariants(collapsed) == wanted
    # A result that lost half of the mesh cannot be repaired: the input is returned.
    monkeypatch.setattr(simplify, "collapse", lambda *_: TriMesh(few_vertices, few[: len(few) // 2]))
    assert adapters.simplify_for_engine(TriMesh(vertices, faces), 300, wanted).faces is faces
