"""Values of remeshing: the request, the record of what was done, the patch to remesh, and its quads."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import sample_surface
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rays import RayCaster
from gdtool.geometry.vectors import dot
from gdtool.remesh.fit.feature_curves import Features, find_features
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from gdtool.remesh.limits import COUNT_TOLERANCE, QUADS_OF_A_PIECE

# Share of the time limit in which engines may start; the rest is for steps that need no engine.
_ENGINES_SHARE = 0.7
_MIN_FALLBACK_SECONDS = 20.0  # for steps without which there is no result, however late it is
_MIN_CHILD_SECONDS = 0.05

# Edge lengths: creases nearer to each other than this form a strip too narrow for a coarser mesh ...
_NARROW_EDGES = 1.5
_MAX_NARROW_SHARE = 0.05  # ... and this share of the creases' length may lie in strips.
_WALL_EDGES = 2.0  # edge lengths: walls thinner than this are too thin for a coarser mesh
_WALL_COSINE = 0.9  # least cosine between the normals of a wall's two sides; below it is a wedge
_MAX_WALL_SHARE = 7e-4  # of the surface may bound thin walls
_WALL_RAYS = 20_000  # cast into the surface to find walls
_RAY_OFFSET = 1e-4  # edge lengths: rays start this far under the surface
_MIN_FEATURE_EDGES = 3  # edge lengths: shorter features are noise

# Faces for each handle below which count_reason() names the handles: about as few as were found to keep one (40 of a
# torus of one handle, 21 a handle of a lattice of 28).
_FACES_OF_A_HANDLE = 40


@dataclass(frozen=True)
class Request:
    """The caller's request: about `quads` quads that follow creases sharper than `crease_degrees`.

    `seconds` limits the whole run, counted from when the request is made; `memory_mb` limits one child process.
    """

    quads: int = 20000
    crease_degrees: float = 30.0
    engine: str = "auto"
    smooth_iterations: int = 5
    restore_creases: bool = True
    seconds: float = 120.0
    memory_mb: int = 16000
    min_jacobian: float = 0.0  # a subdivided result whose worst quad has a smaller scaled Jacobian is rejected
    started: float = field(default_factory=time.monotonic)

    @property
    def engine_seconds_left(self) -> float:
        """Return the seconds in which engines may still start; 0 or less when the time for engines is over."""
        return self.started + _ENGINES_SHARE * self.seconds - time.monotonic()

    @property
    def child_seconds(self) -> float:
        """Return the time limit of one engine's child process, in seconds."""
        return max(self.engine_seconds_left, _MIN_CHILD_SECONDS)

    @property
    def fallback_seconds(self) -> float:
        """Return the seconds for the steps that a result needs: what is left, but at least _MIN_FALLBACK_SECONDS."""
        return max(self.started + self.seconds - time.monotonic(), _MIN_FALLBACK_SECONDS)


class QuadResult(NamedTuple):
    """Quads of a patch, and the manifest's name of the method that made them."""

    mesh: QuadMesh
    method: str


@dataclass
class Record:
    """The record of a run, for the manifest.

    engine: the one whose quads were taken. failed: what failed before, and why. figures: for the report. seconds: by
    step.
    """

    engine: str = ""
    failed: list[str] = field(default_factory=list)
    figures: dict[str, float | int | bool | str | None] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    source: ProjectionTarget | None = None  # the input with its search tree, built while a child worked

    def clock(self, name: str, start: float) -> None:
        """Add the seconds since `start` (time.perf_counter) to a step."""
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def count_reason(
    faces: np.ndarray, made: int, asked: int, tried: list[str], min_of_a_piece: int = QUADS_OF_A_PIECE
) -> str:
    """Explain in a sentence, as far as that is known, why a mesh has `made` faces instead of `asked`.

    faces (f, 3): the manifold that the faces were made from. tried: what failed before. min_of_a_piece: the fewest
    faces of a piece.
    """
    pieces = topology.components(faces)[0]
    if made < asked:
        reason = "no method that was tried came nearer to the count"
    elif asked < min_of_a_piece * pieces:
        reason = f"it has {pieces} separate pieces, and each takes at least {min_of_a_piece} faces or so"
    elif asked < _FACES_OF_A_HANDLE * (handles := topology.handles(faces, pieces)):
        reason = f"fewer would close some of its {handles} handles"
    else:
        reason = "fewer would change its shape, or its topology"
    return f"{reason} ({'; '.join(tried)})" if tried else reason


@dataclass
class RemeshPatch:
    """Triangles to remesh: the whole surface or some of its pieces.

    mesh: the triangles, in a unit box. `quads` is the wanted count and `edge` the wanted edge length. Properties are
    computed once.
    """

    mesh: TriMesh
    quads: int
    edge: float
    request: Request
    full_surface: Callable[[], ProjectionTarget]  # the whole input as it was before it was simplified
    skip_engines: bool = False
    tolerance: float = COUNT_TOLERANCE  # relative error of the count that is accepted
    input_quads: QuadMesh | None = None  # quads cut from its triangles beforehand

    def subset(
        self, chosen: np.ndarray, quads: int, skip_engines: bool = False, tolerance: float = COUNT_TOLERANCE
    ) -> RemeshPatch:
        """Make a patch of some of the triangles, chosen (f,) bool."""
        return RemeshPatch(
            topology.compact(TriMesh(self.mesh.vertices, self.mesh.faces[chosen])),
            quads,
            self.edge,
            self.request,
            self.full_surface,
            skip_engines,
            tolerance,
        )

    def has_count(self, count: int, wanted: float) -> bool:
        """Return whether a count is within the tolerance of the wanted one."""
        return abs(count / wanted - 1) <= self.tolerance

    @cached_property
    def pieces(self) -> tuple[int, np.ndarray]:
        """Return the number of connected pieces, and (f,) the piece of each triangle."""
        return topology.components(self.mesh.faces)

    @property
    def has_only_tiny_pieces(self) -> bool:
        """Return whether the pieces get fewer quads on average than a piece needs."""
        return self.quads < QUADS_OF_A_PIECE * self.pieces[0]

    @cached_property
    def handles(self) -> int:
        """Return the number of handles (the sum of the genus of all pieces)."""
        return topology.handles(self.mesh.faces, self.pieces[0])

    @cached_property
    def piece_areas(self) -> np.ndarray:
        """Return the area (pieces,) of each piece."""
        return np.bincount(self.pieces[1], face_normals(self.mesh)[1], self.pieces[0])

    @cached_property
    def surface(self) -> ProjectionTarget:
        """Return the triangles with their search tree."""
        return ProjectionTarget(self.mesh)

    @cached_property
    def has_narrow_strips(self) -> bool:
        """Return whether many creases lie in pairs closer than _NARROW_EDGES, as on thin plates and small bevels.

        Many: more than _MAX_NARROW_SHARE of their length. Always False for a mesh with more triangles than quads.
        """
        return (
            len(self.mesh.faces) < self.quads
            and self.features.share_in_strips(_NARROW_EDGES * self.edge) > _MAX_NARROW_SHARE
        )

    @cached_property
    def has_thin_walls(self) -> bool:
        """Return whether more than _MAX_WALL_SHARE of the surface bounds walls thinner than _WALL_EDGES.

        Walls are found by rays cast inward. Always False for a mesh with fewer triangles than quads, for which a
        coarser mesh may work all the same.
        """
        if len(self.mesh.faces) < self.quads:
            return False
        points, face_idx = sample_surface(self.mesh, _WALL_RAYS, np.random.default_rng(0))[:2]
        normals = face_normals(self.mesh)[0]
        inward = -normals[face_idx]
        hits = RayCaster(self.mesh, 1).first_hit(points + _RAY_OFFSET * self.edge * inward, inward)
        leaves = dot(normals[hits.face_idx].T, inward.T) > _WALL_COSINE
        return bool((hits.is_hit & leaves & (hits.distance < _WALL_EDGES * self.edge)).mean() > _MAX_WALL_SHARE)

    @cached_property
    def features(self) -> Features:
        """Find the creases and boundaries of the triangles."""
        return find_features(self.mesh, self.request.crease_degrees or 181.0, _MIN_FEATURE_EDGES * self.edge)
