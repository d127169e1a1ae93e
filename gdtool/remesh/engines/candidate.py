"""One candidate: what an engine makes of a surface, mended and judged in a child, then drawn onto the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.geometry import repair, topology
from gdtool.geometry.distance import by_place
from gdtool.geometry.mesh_quality import scaled_jacobian, valences
from gdtool.remesh.connectivity.edge_rotation import cancel_pairs
from gdtool.remesh.connectivity.irregular_vertices import cancel_irregular
from gdtool.remesh.engines.adapters import ENGINES, on_few
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import (
    CUT_OFF,
    CUT_SUBDIVIDED,
    FAR_EDGES,
    FAR_SUBDIVIDED,
    LEAVES_OUT,
    STICKS_OUT,
    Outline,
    drawn,
    farthest,
    fault_of,
    left_out,
    outlined,
    sticks_out,
    surface_of,
)
from gdtool.remesh.fit.surface_projection import fill_holes, remove_doublets
from gdtool.remesh.task import Part

LOST, ADDED, PIECES = "handles are lost", "handles are added", "pieces are lost or joined"
_NEAR_EDGES, _LEAST_JACOBIAN = 0.75, 0.2  # nearer and squarer than this, a result is taken without a look at others
_NEAR_OUTLINE = 0.9  # edge lengths: shaping hardly brings what is farther within _NEAR_EDGES
_OUT_EDGES = 0.55  # what sticks out less is finer than a quad
# Surface so far from an engine's quads is no matter of tips, and how much of it is too much.
_BARE_EDGES, _BARE_SHARE = 2.0, 0.02
_MENDINGS = 4  # rounds of filling holes and parting what meets at a vertex


@dataclass(frozen=True)
class Way:
    """An engine, the subdivisions after it, factors on the count to try side by side, the crease angle that it is
    told."""

    engine: str
    subdivisions: int
    factors: tuple[float, ...]
    degrees: float

    @property
    def label(self) -> str:
        return (
            self.engine
            + (f", {self.subdivisions} subdivision" if self.subdivisions else "")
            + ("" if self.degrees else ", creases left out")
        )

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
    """What an engine made of `asked`, mended, what is wrong with it, and, once it was tried, drawn onto the surface."""

    way: Way
    asked: float
    fault: str | None
    vertices: np.ndarray
    quads: np.ndarray
    outline: Outline | None = None
    drawn: tuple[np.ndarray, np.ndarray, Constraints] | None = None
    far: float = np.inf  # of the surface from the quads drawn, in edge lengths
    least: float = -1.0  # their worst scaled Jacobian
    wrong: str | None = None  # what of them does not do on the surface
    passable: bool = False  # a subdivided one that is wrong: whether it would do without the subdivision
    _astray: float | None = None

    @property
    def count(self) -> int:
        """Of the quads that it will have when it is subdivided."""
        return len(self.quads) * self.way.children

    def off(self, wanted: float) -> float:
        return self.count / wanted - 1

    def rank(self, wanted: float, tolerance: float) -> tuple:
        """Smaller is better. tolerance: share of the quads wanted that there may be more or fewer."""
        return self.fault is not None, max(abs(self.off(wanted)), tolerance), self._irregular()

    @property
    def bridged(self) -> bool:
        """Whether it is closed and manifold, but a gap or tunnel was bridged or filled."""
        return self.fault in (LOST, ADDED)

    @property
    def good(self) -> bool:
        """Whether it is taken without a look at others."""
        return self.wrong is None and self.far < _NEAR_EDGES and self.least > _LEAST_JACOBIAN

    def usable(self, part: Part) -> bool:
        """Without a fault, or with one that is finer than its quads."""
        return (
            self.fault is None
            or self.fault == LOST
            and sticks_out(self.vertices, self.quads, part.surface) < 2 * _OUT_EDGES * part.edge
        )

    def leaves_out(self, part: Part) -> str | None:
        """What is wrong with it before it is drawn, where it does without parts of the surface that drawing does not
        bring back."""
        bare = left_out(surface_of(self.vertices, self.quads), part.surface, (_BARE_EDGES * part.edge,))[0]
        return f"{LEAVES_OUT} {bare:.1%} of the surface" if bare > _BARE_SHARE else None

    def astray(self, part: Part) -> float:
        """How far the surface is from it as the engine left it, in edge lengths."""
        if self._astray is None:
            self._astray = farthest(surface_of(self.vertices, self.quads), part.surface) / part.edge
        return self._astray

    def trace(self, part: Part) -> None:
        """Find its outline, once."""
        if self.outline is None:
            self.outline = outlined(
                self.vertices, self.quads, part.surface, part.features, self.way.subdivisions, part.request
            )

    def promising(self, part: Part) -> bool:
        """Whether its outline is so near to the surface that it can come out good."""
        self.trace(part)
        return self.outline.far < _NEAR_OUTLINE

    def draw(self, part: Part) -> None:
        """Drawn onto the surface, and judged there, once."""
        if self.drawn is not None:
            return
        subdivisions, surface = self.way.subdivisions, part.surface
        self.drawn = drawn(self.outline, surface, part.features, part.request)
        vertices, quads, _ = self.drawn
        self.least = float(scaled_jacobian(vertices, quads).min())
        limits = (FAR_SUBDIVIDED, CUT_SUBDIVIDED) if subdivisions else (FAR_EDGES, CUT_OFF)
        self.wrong, self.far = fault_of(vertices, quads, surface, part.edge, *limits)
        if self.fault and (over := sticks_out(vertices, quads, surface) / part.edge) > _OUT_EDGES:
            self.wrong = f"{STICKS_OUT} {over:.2g} edge lengths"  # else what is lost was finer than a quad
        if self.wrong is None and subdivisions and self.least < part.request.least_jacobian:
            self.wrong = f"has a quad of scaled Jacobian {self.least:.2g}"
        # Else it is not shaped to its end.
        if self.wrong and subdivisions and not self.fault and self.far <= FAR_SUBDIVIDED and not self.outline.hopeless:
            self.passable = fault_of(vertices, quads, surface, part.edge, FAR_EDGES, CUT_OFF)[0] is None

    def _irregular(self) -> int:
        valence, inner = valences(self.quads, int(self.quads.max(initial=0)) + 1)
        return int((valence[inner] != 4).sum())


def candidate(vertices: np.ndarray, faces: np.ndarray, way: Way, asked: float) -> Candidate:
    """What the child runs."""
    quads, wanted = max(int(asked / way.children), 16), topology.invariants(faces)
    mesh = vertices.astype(np.float32), faces.astype(np.int32)
    if way.engine == "instant-meshes" and way.subdivisions:
        mesh = on_few(*mesh, quads, wanted)
    fault, *found = judged(*ENGINES[way.engine](*mesh, quads, way.degrees), wanted)
    return Candidate(way, asked, fault, *_by_place(*found))


def _by_place(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh, its vertices and quads in an order in which those near to one another follow one another: what
    reads it finds them in the cache."""
    if not len(quads):
        return vertices, quads
    order = by_place(vertices)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    return vertices[order], number[quads[by_place(vertices[quads].mean(1))]]


def judged(
    quad_vertices: np.ndarray, quad_faces: np.ndarray, wanted: topology.Invariants
) -> tuple[str | None, np.ndarray, np.ndarray]:
    """What is wrong with an engine's result for a surface of these invariants, or None, and the result without its
    small defects."""
    closed, _, pieces, euler_number = wanted
    if quad_faces.ndim != 2 or quad_faces.shape[1] != 4 or not len(quad_faces):
        return "no quads", quad_vertices, quad_faces
    if quad_faces.min() < 0 or quad_faces.max() >= len(quad_vertices) or not np.isfinite(quad_vertices).all():
        return "indices or coordinates out of range", quad_vertices, quad_faces
    whole = (np.sort(quad_faces, 1)[:, 1:] != np.sort(quad_faces, 1)[:, :-1]).all(1)
    if not whole.any():
        return "no quads", quad_vertices, quad_faces
    quad_vertices, quad_faces = topology.compact(quad_vertices, quad_faces[whole])
    for turn in range(_MENDINGS):
        if turn and (not closed or topology.is_watertight(quad_faces)):
            break
        if closed:
            quad_vertices, quad_faces = fill_holes(quad_vertices, quad_faces)
        # What parts where fans met at a vertex, and what lay in a hole as a piece of its own, leave holes to fill.
        quad_vertices, quad_faces = remove_doublets(*repair.one_vertex_per_fan(quad_vertices, quad_faces))
        quad_vertices, quad_faces = cancel_irregular(quad_vertices, quad_faces)
        quad_vertices, quad_faces = repair.without_crumbs(quad_vertices, quad_faces, pieces)
        if not len(quad_faces):
            return "no quads", quad_vertices, quad_faces
    if closed and not topology.is_watertight(quad_faces):
        return "not watertight, though the input is", quad_vertices, quad_faces
    if not topology.is_manifold(quad_faces):
        return "not manifold", quad_vertices, quad_faces
    if topology.components(quad_faces)[0] != pieces:
        return PIECES, quad_vertices, quad_faces  # what of it is kept is judged again, piece by piece
    quad_faces = cancel_pairs(quad_vertices, quad_faces)
    if closed and (more := topology.euler_number(quad_faces) - euler_number):
        return LOST if more > 0 else ADDED, quad_vertices, quad_faces
    return None, quad_vertices, quad_faces
