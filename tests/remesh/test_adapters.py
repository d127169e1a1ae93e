"""What an engine is given in place of a finer mesh: as closed as that, also where the collapse tears it."""

import numpy as np

from gdtool.geometry import simplify, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.remesh.engines import adapters
from tests.geometry.solids import sphere


def test_what_is_collapsed_is_given_where_its_tears_can_be_mended(monkeypatch):
    vertices, faces = sphere(40)
    wanted = topology.invariants(faces)
    made = simplify.collapse(TriMesh(vertices, faces), 1200, 5.0)
    few_vertices, few = made.vertices, made.faces

    def tearing(*_):
        """A flap of two triangles stands on an edge, which has four faces then."""
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
    # What loses half of it is not: the engine has the mesh as it was.
    monkeypatch.setattr(simplify, "collapse", lambda *_: TriMesh(few_vertices, few[: len(few) // 2]))
    assert adapters.simplify_for_engine(TriMesh(vertices, faces), 300, wanted).faces is faces
