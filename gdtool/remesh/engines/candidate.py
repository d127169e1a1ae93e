"""Make one candidate: run an engine in a child, repair and judge its quads, then fit them to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gdtool.geometry import repair, topology
from gdtool.geometry.distance import spatial_order
from gdtool.geometry.mesh_quality import scaled_jacobian, valences
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh.connectivity.edge_rotation import cancel_pairs
from gdtool.remesh.connectivity.irregular_vertices import cancel_irregular
from gdtool.remesh.engines.adapters import ENGINES, simplify_for_engine
from gdtool.remesh.fit.shaping import (
    CUT_OFF,
    CUT_SUBDIVIDED,
    FAR_EDGES,
    FAR_SUBDIVIDED,
    LEAVES_OUT,
    STICKS_OUT,
    FittedQuads,
    SnappedQuads,
    fit_to_surface,
    max_distance,
    max_overshoot,
    rejection_reason,
    snap_to_features,
    target_of_quads,
    uncovered_shares,
)
from gdtool.remesh.fit.surface_projection import fill_holes, remove_doublets
from gdtool.remesh.task import RemeshPatch

# Verdicts of repair_and_judge() that later code tells apart; they stand in the manifest.
LOST, ADDED, PIECES = "handles are lost", "handles are added", "pieces are lost or joined"

# A fitted result this near (edge lengths) and this square (worst scaled Jacobian) is taken without a look at others.
_GOOD_DISTANCE_EDGES, _GOOD_JACOBIAN = 0.75, 0.2
# Edge lengths: fitting hardly ever brings snapped quads that are farther than this within _GOOD_DISTANCE_EDGES.
_PROMISING_EDGES = 0.9
# Edge lengths: geometry that sticks out by less is finer than a quad, and may be lost.
_OVERSHOOT_EDGES = 0.55
# Edge lengths: surface farther than this from an engine's quads is too far for tip extrusion to bring back ...
_UNCOVERED_EDGES = 2.0
_MAX_UNCOVERED_SHARE = 0.02  # ... and this share of the area may lie that far away.
_REPAIR_ROUNDS = 4  # of filling holes and splitting pinched vertices; each can cause the other
_MIN_ENGINE_QUADS = 16  # fewer than these make the engines fail


@dataclass(frozen=True)
class EngineAttempt:
    """An engine and the settings to call it with.

    `factors` scale the quad count; one child process runs for each. `degrees` is the crease angle passed to the engine,
    0 for none. `subdivisions`: the number of regular subdivisions after the engine. The engine is asked for a quarter
    as many quads for each.
    """

    engine: str
    subdivisions: int
    factors: tuple[float, ...]
    degrees: float

    @property
    def label(self) -> str:
        """Return the attempt's name in the manifest."""
        return (
            self.engine
            + (f", {self.subdivisions} subdivision" if self.subdivisions else "")
            + ("" if self.degrees else ", creases left out")
        )

    def counts_around(self, count: float) -> list[float]:
        """Return the quad counts to request side by side: one per factor, with `count` as their mean."""
        middle = sum(self.factors) / len(self.factors)
        return [count * factor / middle for factor in self.factors]

    @property
    def quads_per_engine_quad(self) -> int:
        """Return the number of final quads for each quad of the engine."""
        return 4**self.subdivisions


@dataclass
class Candidate:
    """An engine's repaired quads for one requested count, and the figures that judge them.

    `fault`: why the engine's quads differ from the surface in topology, None where they do not. snap() and fit() fill
    the fields from `snapped` on.
    """

    attempt: EngineAttempt
    requested: float
    fault: str | None
    mesh: QuadMesh
    snapped: SnappedQuads | None = None
    fitted: FittedQuads | None = None
    distance_edges: float = np.inf  # largest distance from the surface to the fitted quads, in edge lengths
    min_jacobian: float = -1.0  # worst scaled Jacobian of the fitted quads
    rejection: str | None = None  # why the fitted quads are not acceptable
    acceptable_as_finer: bool = False  # rejected, but only by the stricter limits of subdivided results
    _raw_distance_edges: float | None = None

    @property
    def count(self) -> int:
        """Return the number of quads after subdivision."""
        return len(self.mesh.faces) * self.attempt.quads_per_engine_quad

    @property
    def snapped_count(self) -> int:
        """Return the number of snapped quads, subdivided and with tips; call snap() before."""
        assert self.snapped is not None
        return len(self.snapped.mesh.faces)

    @property
    def fitted_count(self) -> int:
        """Return the number of fitted quads; call fit() before."""
        assert self.fitted is not None
        return len(self.fitted.mesh.faces)

    def count_error(self, wanted: float) -> float:
        """Return the signed relative error of the count: -0.1 is a tenth too few."""
        return self.count / wanted - 1

    def rank(self, wanted: float, tolerance: float) -> tuple:
        """Return a sort key, smaller is better: without a fault, then near the count, then few irregular vertices.

        tolerance: relative errors of the count below this count as equal.
        """
        return self.fault is not None, max(abs(self.count_error(wanted)), tolerance), self._irregular_count()

    @property
    def is_bridged(self) -> bool:
        """Return whether the quads are closed and manifold, but bridge or fill a gap or tunnel."""
        return self.fault in (LOST, ADDED)

    @property
    def is_good(self) -> bool:
        """Return whether the fitted quads are so good that no other candidate is fitted."""
        return (
            self.rejection is None and self.distance_edges < _GOOD_DISTANCE_EDGES and self.min_jacobian > _GOOD_JACOBIAN
        )

    def is_usable(self, patch: RemeshPatch) -> bool:
        """Return whether the quads have no fault, or lost only handles that are finer than a quad."""
        return (
            self.fault is None
            or self.fault == LOST
            and max_overshoot(self.mesh, patch.surface) < 2 * _OVERSHOOT_EDGES * patch.edge
        )

    def missing_surface(self, patch: RemeshPatch) -> str | None:
        """Return a rejection reason where the quads leave out surface that tip extrusion cannot cover, else None."""
        uncovered = uncovered_shares(target_of_quads(self.mesh), patch.surface, (_UNCOVERED_EDGES * patch.edge,))[0]
        return f"{LEAVES_OUT} {uncovered:.1%} of the surface" if uncovered > _MAX_UNCOVERED_SHARE else None

    def raw_distance(self, patch: RemeshPatch) -> float:
        """Return the largest distance from the surface to the engine's quads, in edge lengths; computed once."""
        if self._raw_distance_edges is None:
            self._raw_distance_edges = max_distance(target_of_quads(self.mesh), patch.surface) / patch.edge
        return self._raw_distance_edges

    def snap(self, patch: RemeshPatch) -> None:
        """Snap the quads to the features and extrude tips; done once."""
        if self.snapped is None:
            self.snapped = snap_to_features(
                self.mesh,
                patch.surface,
                patch.features,
                self.attempt.subdivisions,
                patch.request,
            )

    def is_promising(self, patch: RemeshPatch) -> bool:
        """Return whether the snapped quads are so near to the surface that fitting can make them good."""
        self.snap(patch)
        return self.snapped.distance_edges < _PROMISING_EDGES

    def fit(self, patch: RemeshPatch) -> None:
        """Fit the snapped quads to the surface and judge the result; done once."""
        if self.fitted is not None:
            return
        subdivisions, surface = self.attempt.subdivisions, patch.surface
        self.fitted = fit_to_surface(self.snapped, surface, patch.features, patch.request)
        mesh = self.fitted.mesh
        self.min_jacobian = float(scaled_jacobian(mesh).min())
        limits = (FAR_SUBDIVIDED, CUT_SUBDIVIDED) if subdivisions else (FAR_EDGES, CUT_OFF)
        self.rejection, self.distance_edges = rejection_reason(mesh, surface, patch.edge, *limits)
        # A lost handle whose bridge sticks out by less was finer than a quad.
        if self.fault and (overshoot := max_overshoot(mesh, surface) / patch.edge) > _OVERSHOOT_EDGES:
            self.rejection = f"{STICKS_OUT} {overshoot:.2g} edge lengths"
        if self.rejection is None and subdivisions and self.min_jacobian < patch.request.min_jacobian:
            self.rejection = f"has a quad of scaled Jacobian {self.min_jacobian:.2g}"
        # Fitting stops early beyond these limits, so such a result would not do as a finer one either.
        if (
            self.rejection
            and subdivisions
            and not self.fault
            and self.distance_edges <= FAR_SUBDIVIDED
            and not self.snapped.hopeless
        ):
            self.acceptable_as_finer = rejection_reason(mesh, surface, patch.edge, FAR_EDGES, CUT_OFF)[0] is None

    def _irregular_count(self) -> int:
        """Count the inner vertices without exactly four edges."""
        valence, inner = valences(self.mesh.faces, int(self.mesh.faces.max(initial=0)) + 1)
        return int((valence[inner] != 4).sum())


def make_candidate(mesh: TriMesh, attempt: EngineAttempt, requested: float) -> Candidate:
    """Run an engine on triangles, repair its quads and judge them; child processes run this function.

    mesh: in a unit box. requested: final quads, after subdivision.
    """
    quads = max(int(requested / attempt.quads_per_engine_quad), _MIN_ENGINE_QUADS)
    wanted = topology.invariants(mesh.faces)
    engine_input = TriMesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    if attempt.engine == "instant-meshes" and attempt.subdivisions:
        engine_input = simplify_for_engine(engine_input, quads, wanted)
    judged = repair_and_judge(ENGINES[attempt.engine](engine_input, quads, attempt.degrees), wanted)
    return Candidate(attempt, requested, judged.fault, _sort_spatially(judged.mesh))


def _sort_spatially(mesh: QuadMesh) -> QuadMesh:
    """Reorder vertices and quads so that neighbours in space are neighbours in memory, for the cache's sake."""
    vertices, quads = mesh.vertices, mesh.faces
    if not len(quads):
        return mesh
    order = spatial_order(vertices)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    return QuadMesh(vertices[order], number[quads[spatial_order(vertices[quads].mean(1))]])


class JudgedQuads(NamedTuple):
    """Repaired quads, and why their topology differs from the surface's (None where it does not)."""

    fault: str | None
    mesh: QuadMesh


def repair_and_judge(mesh: QuadMesh, wanted: topology.Invariants) -> JudgedQuads:
    """Repair small defects of an engine's quads and compare their topology with the surface's.

    mesh: faces should be (q, 4); any shape and any indices are handled. wanted: invariants of the triangles that the
    engine was given.
    """
    closed, _, pieces, euler_number = wanted
    faces = mesh.faces
    if faces.ndim != 2 or faces.shape[1] != 4 or not len(faces):
        return JudgedQuads("no quads", mesh)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices) or not np.isfinite(mesh.vertices).all():
        return JudgedQuads("indices or coordinates out of range", mesh)
    whole = (np.sort(faces, 1)[:, 1:] != np.sort(faces, 1)[:, :-1]).all(1)
    if not whole.any():
        return JudgedQuads("no quads", mesh)
    mesh = topology.compact(QuadMesh(mesh.vertices, faces[whole]))
    for turn in range(_REPAIR_ROUNDS):
        if turn and (not closed or topology.is_watertight(mesh.faces)):
            break
        if closed:
            mesh = fill_holes(mesh)
        # Splitting pinched vertices and dropping small pieces open new holes, which the next round fills.
        mesh = remove_doublets(repair.one_vertex_per_fan(mesh))
        mesh = repair.drop_small_pieces(cancel_irregular(mesh), pieces)
        if not len(mesh.faces):
            return JudgedQuads("no quads", mesh)
    if closed and not topology.is_watertight(mesh.faces):
        return JudgedQuads("not watertight, though the input is", mesh)
    if not topology.is_manifold(mesh.faces):
        return JudgedQuads("not manifold", mesh)
    if topology.components(mesh.faces)[0] != pieces:
        # Irregular vertices stay for now: the pieces that are kept are judged again one by one.
        return JudgedQuads(PIECES, mesh)
    mesh = QuadMesh(mesh.vertices, cancel_pairs(mesh))
    if closed and (difference := topology.euler_number(mesh.faces) - euler_number):
        return JudgedQuads(LOST if difference > 0 else ADDED, mesh)
    return JudgedQuads(None, mesh)
