"""What an engine is given in place of a finer mesh: as closed as that, also where the collapse tears it."""

import numpy as np

from gdtool.geometry import simplify, topology
from gdtool.remesh.engines import adapters
from tests.geometry.solids import sphere


def test_what_is_collapsed_is_given_where_its_tears_can_be_mended(monkeypatch):
    vertices, faces = sphere(40)
    wanted = topology.invariants(faces)
    few_vertices, few = simplify.collapse(vertices, faces, 1200, 5.0)

    def tearing(*_):
        """A flap of two triangles stands on an edge, which has four faces then."""
        a, b, _ = few[0]
        tip = len(few_vertices)
        return np.concatenate([few_vertices, [[0.0, 0.0, 2.0]]]), np.concatenate([few, [[a, b, tip], [b, a, tip]]])

    monkeypatch.setattr(simplify, "collapse", tearing)
    assert not topology.is_watertight(tearing()[1])
    _, collapsed = adapters.simplify_for_engine(vertices, faces, 300, wanted)
    assert len(few) <= len(collapsed) < len(few) + 12
    assert topology.invariants(collapsed) == wanted
    # What loses half of it is not: the engine has the mesh as it was.
    monkeypatch.setattr(simplify, "collapse", lambda *_: (few_vertices, few[: len(few) // 2]))
    assert adapters.simplify_for_engine(vertices, faces, 300, wanted)[1] is faces
