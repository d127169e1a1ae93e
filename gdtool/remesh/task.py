"""What remeshing is asked for, what it works on, and the record of what it did."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import sample_surface
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rays import RayCaster
from gdtool.geometry.vectors import dot
from gdtool.remesh.fit.feature_curves import Features, find_features
from gdtool.remesh.fit.surface_projection import Surface

COUNT_TOLERANCE = 0.03
QUADS_OF_A_PIECE = 12  # at least
_ENGINES_SHARE, _LEAST_SECONDS = 0.7, 20.0
_SHORTEST_RUN = 0.05  # seconds
_NARROW_EDGES, _FEW_NARROW = 1.5, 0.05  # share of the creases' length
_WALL_EDGES, _PARALLEL, _FEW_THIN = 2.0, 0.9, 7e-4  # cosine between the two sides of a wall; share of the surface
_RAYS, _OFF = 20_000, 1e-4  # edge lengths under the surface that they start
_FEATURE_EDGES = 3  # quads long: shorter creases are noise
# About as few as were found to keep one: 40 of a torus of one handle, 21 a handle of a lattice of 28.
_FACES_OF_A_HANDLE = 40


@dataclass(frozen=True)
class Request:
    """What is asked for: about `quads` faces; creases sharper than crease_degrees followed; time limit of the whole,
    memory limit of a child."""

    quads: int = 20000
    crease_degrees: float = 30.0
    engine: str = "auto"
    smooth_iterations: int = 5
    restore_creases: bool = True
    # From when the request is made; engines have a share of them, the rest is for what needs none.
    seconds: float = 120.0
    memory_mb: int = 16000
    least_jacobian: float = 0.0  # a coarser mesh subdivided is passed over where its worst quad is worse
    begun: float = field(default_factory=time.monotonic)

    @property
    def for_engines(self) -> float:
        """Seconds in which engines may still be tried; below zero when what is not done by then goes without one."""
        return self.begun + _ENGINES_SHARE * self.seconds - time.monotonic()

    @property
    def for_a_run(self) -> float:
        """Seconds that a child has, which works for an engine."""
        return max(self.for_engines, _SHORTEST_RUN)

    @property
    def for_the_rest(self) -> float:
        """Seconds for what a result cannot do without: those left, and some however late it is."""
        return max(self.begun + self.seconds - time.monotonic(), _LEAST_SECONDS)


@dataclass
class Record:
    """What was done: the engine whose result was taken, what was tried before and why not, figures, seconds by step."""

    engine: str = ""
    failed: list[str] = field(default_factory=list)
    figures: dict[str, float | int | bool | str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    source: Surface | None = None  # the input with its search tree, built while a child worked

    def clock(self, name: str, start: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def add(self, other: Record) -> None:
        """What was tried, and the seconds, of a part."""
        self.failed += other.failed
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def count_reason(faces: np.ndarray, made: int, asked: int, tried: list[str], of_a_piece: int = QUADS_OF_A_PIECE) -> str:
    """Why a mesh got `made` faces and not those asked for, as far as that is known.

    faces (f, 3): the manifold that they were made from; tried: what failed on the way; of_a_piece: the fewest faces of
    a piece."""
    pieces = topology.components(faces)[0]
    if made < asked:
        reason = "no way that was tried came nearer to the count"
    elif asked < of_a_piece * pieces:
        reason = f"it has {pieces} separate pieces, and each takes at least {of_a_piece} faces or so"
    elif asked < _FACES_OF_A_HANDLE * (handles := topology.handles(faces, pieces)):
        reason = f"fewer would close some of its {handles} handles"
    else:
        reason = "fewer would change its shape, or its topology"
    return f"{reason} ({'; '.join(tried)})" if tried else reason


@dataclass
class Part:
    """Triangles that are to be made into `quads` quads, `edge` long each; what is known of them is found out once."""

    vertices: np.ndarray  # (v, 3)
    faces: np.ndarray  # (f, 3)
    quads: int
    edge: float
    request: Request
    fine: Callable[[], Surface]  # the whole input as it was before it was simplified
    given_up: bool = False  # no engine is tried
    tolerance: float = COUNT_TOLERANCE  # share of the quads that there may be more or fewer
    cut: tuple[np.ndarray, np.ndarray] | None = None  # quads of its own triangles, where these were made before

    def of(self, faces: np.ndarray, quads: int, given_up: bool = False, tolerance: float = COUNT_TOLERANCE) -> Part:
        """Some of the triangles: faces (f,) bool."""
        return Part(
            *topology.compact(self.vertices, self.faces[faces]),
            quads,
            self.edge,
            self.request,
            self.fine,
            given_up,
            tolerance,
        )

    def counted(self, count: int, wanted: float) -> bool:
        """Whether so many quads are about as many as wanted."""
        return abs(count / wanted - 1) <= self.tolerance

    @cached_property
    def pieces(self) -> tuple[int, np.ndarray]:
        """How many, and which each triangle belongs to."""
        return topology.components(self.faces)

    @property
    def crumbs(self) -> bool:
        """Whether it is pieces of fewer quads each than the least that one is made of."""
        return self.quads < QUADS_OF_A_PIECE * self.pieces[0]

    @cached_property
    def handles(self) -> int:
        return topology.handles(self.faces, self.pieces[0])

    @cached_property
    def piece_areas(self) -> np.ndarray:
        """Area of each piece."""
        return np.bincount(self.pieces[1], face_normals(self.vertices, self.faces)[1], self.pieces[0])

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.vertices, self.faces)

    @cached_property
    def narrow(self) -> bool:
        """Whether more than a few creases lie in pairs closer together than _NARROW_EDGES, as on thin plates and small
        bevels; not asked of what has more triangles than quads."""
        return len(self.faces) < self.quads and self.features.in_strips(_NARROW_EDGES * self.edge) > _FEW_NARROW

    @cached_property
    def thin(self) -> bool:
        """Whether more than a little of the surface bounds walls thinner than two quads are wide, as rays into it tell.
        Wedges are none; not asked of what has fewer triangles than quads, as a coarser mesh may do there all the
        same."""
        if len(self.faces) < self.quads:
            return False
        points, face_idx = sample_surface(self.vertices, self.faces, _RAYS, np.random.default_rng(0))[:2]
        normals = face_normals(self.vertices, self.faces)[0]
        inward = -normals[face_idx]
        hits = RayCaster(self.vertices, self.faces, 1).first_hit(points + _OFF * self.edge * inward, inward)
        out_again = dot(normals[hits.face_idx].T, inward.T) > _PARALLEL
        return bool((hits.found & out_again & (hits.distance < _WALL_EDGES * self.edge)).mean() > _FEW_THIN)

    @cached_property
    def features(self) -> Features:
        return find_features(
            self.vertices, self.faces, self.request.crease_degrees or 181.0, _FEATURE_EDGES * self.edge
        )
