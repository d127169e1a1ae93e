"""One candidate: what an engine makes of a surface, mended, judged and drawn onto it. Runs in a child, beside others."""

from __future__ import annotations

from dataclasses import dataclass

import igl  # noqa: F401 - read while a prepared child waits, as scipy's graphs are
import numpy as np
import scipy.sparse.csgraph  # noqa: F401

from gdtool.geometry import repair
from gdtool.geometry.features import Constraints
from gdtool.geometry.mesh_quality import scaled_jacobian, valences
from gdtool.geometry.quad_engines import ENGINES
from gdtool.geometry.quad_fit import drawn, farthest, sticks_out
from gdtool.geometry.quad_shape import fill_holes, remove_doublets
from gdtool.geometry.quad_task import Part
from gdtool.geometry.quad_topology import cancel_irregular

COUNT_TOLERANCE = 0.03
LOST, ADDED, PIECES = "handles are lost", "handles are added", "pieces are lost or joined"
CLOSE_EDGES = 0.55  # nearer than this, a result is taken without a look at others
_LEAST_JACOBIAN = 0.2  # and squarer than this
_MENDINGS = 4  # rounds of filling holes and parting what meets at a vertex


@dataclass(frozen=True)
class Way:
    """An engine, the subdivisions after it, factors on the count to try side by side, the crease angle that it is told."""

    engine: str
    subdivisions: int
    factors: tuple[float, ...]
    degrees: float

    @property
    def label(self) -> str:
        return self.engine + (f", {self.subdivisions} subdivision" if self.subdivisions else "") + ("" if self.degrees else ", creases left out")

    def near(self, count: float) -> list[float]:
        """Numbers to ask for side by side, as far from one another as the first, `count` in their middle."""
        middle = sum(self.factors) / len(self.factors)
        return [count * factor / middle for factor in self.factors]

    @property
    def children(self) -> int:
        """Quads of the engine's own for each in the end."""
        return 4**self.subdivisions


@dataclass
class Candidate:
    """What an engine made of `asked`, mended, what is wrong with it, and, where it is worth the while, drawn onto the surface."""

    asked: float
    fault: str | None
    vertices: np.ndarray
    quads: np.ndarray
    count: int  # of the quads that it will have when it is subdivided
    usable: bool = False  # without a fault, or with one finer than its quads
    drawn: tuple[np.ndarray, np.ndarray, Constraints] | None = None  # quad_fit.drawn
    far: float = np.inf  # of the surface from the quads drawn, in edge lengths
    least: float = -1.0  # their worst scaled Jacobian

    def off(self, wanted: float) -> float:
        return self.count / wanted - 1

    def counted(self, wanted: float) -> bool:
        """Whether there are about as many quads as wanted."""
        return abs(self.off(wanted)) <= COUNT_TOLERANCE

    def rank(self, wanted: float) -> tuple:
        """Smaller is better."""
        return self.fault is not None, max(abs(self.off(wanted)), COUNT_TOLERANCE), self._irregular()

    @property
    def bridged(self) -> bool:
        """Whether it is closed and manifold, but a gap or tunnel was bridged or filled."""
        return self.fault in (LOST, ADDED)

    @property
    def good(self) -> bool:
        return self.far < CLOSE_EDGES and self.least > _LEAST_JACOBIAN

    def _irregular(self) -> int:
        valence, inner = valences(self.quads, int(self.quads.max(initial=0)) + 1)
        return int((valence[inner] != 4).sum())


def candidate(part: Part, way: Way, asked: float, wanted: float) -> Candidate:
    """What the child runs. Drawn onto the surface is what comes near to the number wanted, if it can be used or is the last resort."""
    engine = ENGINES["on few" if way.engine == "instant-meshes" and way.subdivisions else way.engine]
    found = engine(part.vertices.astype(np.float32), part.faces.astype(np.int32), max(int(asked / way.children), 16), way.degrees)
    fault, vertices, quads = judged(*found, part.vertices, part.faces)
    out = Candidate(asked, fault, vertices, quads, len(quads) * way.children)
    out.usable = fault is None or fault == LOST and sticks_out(vertices, quads, part.surface) < 2 * CLOSE_EDGES * part.edge
    if out.counted(wanted) and (out.usable or out.bridged and not way.subdivisions):
        out.drawn = drawn(vertices, quads, part.surface, part.features, way.subdivisions, part.request)
        out.far, out.least = farthest(*out.drawn[:2], part.surface) / part.edge, float(scaled_jacobian(*out.drawn[:2]).min())
    return out


def judged(quad_vertices: np.ndarray, quad_faces: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[str | None, np.ndarray, np.ndarray]:
    """What is wrong with an engine's result, or None, and the result without its small defects."""
    if quad_faces.ndim != 2 or quad_faces.shape[1] != 4 or not len(quad_faces):
        return "no quads", quad_vertices, quad_faces
    if quad_faces.min() < 0 or quad_faces.max() >= len(quad_vertices) or not np.isfinite(quad_vertices).all():
        return "indices or coordinates out of range", quad_vertices, quad_faces
    whole = (np.sort(quad_faces, 1)[:, 1:] != np.sort(quad_faces, 1)[:, :-1]).all(1)
    if not whole.any():
        return "no quads", quad_vertices, quad_faces
    quad_vertices, quad_faces = repair.compact(quad_vertices, quad_faces[whole])
    closed = repair.is_watertight(faces)
    pieces = repair.components(faces)[0]
    for turn in range(_MENDINGS):
        if turn and (not closed or repair.is_watertight(quad_faces)):
            break
        if closed:
            quad_vertices, quad_faces = fill_holes(quad_vertices, quad_faces)
        # What parts where fans met at a vertex, and what lay in a hole as a piece of its own, leave holes to fill.
        quad_vertices, quad_faces = remove_doublets(*repair.one_vertex_per_fan(quad_vertices, quad_faces))
        quad_vertices, quad_faces = cancel_irregular(quad_vertices, quad_faces)
        quad_vertices, quad_faces = repair.without_crumbs(quad_vertices, quad_faces, pieces)
        if not len(quad_faces):
            return "no quads", quad_vertices, quad_faces
    if closed and not repair.is_watertight(quad_faces):
        return "not watertight, though the input is", quad_vertices, quad_faces
    if not repair.is_manifold(quad_faces):
        return "not manifold", quad_vertices, quad_faces
    if repair.components(quad_faces)[0] != pieces:
        return PIECES, quad_vertices, quad_faces
    if closed and (more := repair.euler_number(quad_faces) - repair.euler_number(faces)):
        return LOST if more > 0 else ADDED, quad_vertices, quad_faces
    return None, quad_vertices, quad_faces
