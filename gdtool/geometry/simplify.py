"""Simplify triangle meshes by quadric edge collapse (Garland & Heckbert 1997) in a child process.

Two libraries do the work. fast-simplification is quick, and now and then tears a closed mesh. MeshLab takes ten times
as long and refuses collapses that change the topology. The quick one goes first, unless the caller asks otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, combinations_with_replacement
from typing import NamedTuple

import numpy as np

from gdtool.core.child import ChildFailed, begin
from gdtool.core.errors import InputError
from gdtool.core.native import imported
from gdtool.core.threads import cores
from gdtool.geometry import repair, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.nonmanifold_edges import separate_sheets
from gdtool.geometry.normals import CHUNK, face_normals
from gdtool.geometry.sharpen import marked_corner_counts, restore_creases
from gdtool.geometry.unique_rows import indices_of_distinct, unique_rows

CHILD_MODULES = ("scipy.sparse.csgraph", "scipy.spatial")  # that a child imports while it waits (core.child.prepare)
# Of fast-simplification: how steeply the bound on the error rises from round to round, tried in turn.
_AGGRESSIVENESS = (4.0, 3.0, 8.0)
_EVEN_UNIT = 0.5  # unit of length that leaves even triangles, as a share of the mesh's longest side
_FIRST_PASS_FACTOR = 6  # times the requested triangles, down to which the quick collapse is always good
_COPLANAR_JITTER_EDGES = 1e-3  # edge lengths by which coplanar vertices are moved
JITTER_EDGES = 0.03  # edge lengths by which all vertices are moved for triangles of one size
# Determinant of the mean outer product of a vertex's face normals below which they lie in a plane, but for rounding.
_COPLANAR_DETERMINANT = 1e-14
_MIN_COPLANAR_SHARE = 0.01  # of the vertices: fewer coplanar ones do not hinder the quick collapse
_SAMPLES = 20_000  # vertices or faces from which a property of the whole is estimated
# A quick collapse that leaves more triangles than this factor of the request, and so many more, did not finish.
_UNFINISHED_FACTOR, _UNFINISHED_FACES = 1.25, 32
_CHILD_MEMORY_MB = 16000

QUICK_METHOD, TOPOLOGY_METHOD = "quadric collapse", "quadric collapse, topology kept"  # as reports name them


@dataclass(frozen=True)
class SimplifyOptions:
    """Choose how to simplify a mesh.

    seconds: time limit of each child process. crease_degrees: before the collapse, restore creases of at least this
    angle from the bevels of marching cubes; 0 restores none. The creases are given up where the mesh then cannot be
    collapsed. topology_first: start with MeshLab's collapse. It is for meshes with more small parts than triangles to
    spare, of which the quick collapse destroys large parts. low_deviation: keep the quick collapse nearer to the
    surface, at a fifth of the error, with less even triangles. uniform: make triangles of one size, which may lie off
    the surface by some hundredths of the input's edge length (JITTER_EDGES). measure_error: compute the error; a quick
    result that is as far off as its edges are long is then compared with MeshLab's. is_closed: tells whether the input
    is watertight, where the caller can tell sooner than topology.is_watertight(). while_waiting: called once while each
    child works.
    """

    seconds: float = 120.0
    crease_degrees: float = 0.0
    topology_first: bool = False
    low_deviation: bool = False
    uniform: bool = False
    measure_error: bool = True
    is_closed: Callable[[], bool] | None = None
    while_waiting: Callable[[], object] | None = None


@dataclass(frozen=True)
class SimplifyReport:
    """Report what simplify() did.

    faces: number of triangles of the result. method: how it was made, "none" where the result is the input. creases:
    how many vertices moved to restored creases. error: the largest distance of either mesh's vertices to the other
    surface (at most about 20,000 vertices each), in the input's units; None where it was not measured. failed: the
    methods that failed before, with reasons; None where none did.
    """

    faces: int
    method: str
    creases: int | None = 0
    error: float | None = None
    failed: str | None = None


class Simplified(NamedTuple):
    """Hold a simplified mesh, attributes (v, ...) of its vertices (None where none were passed), and a report."""

    mesh: TriMesh
    attributes: np.ndarray | None
    report: SimplifyReport


class ChildResult(NamedTuple):
    """Hold what a child process returns: the collapsed mesh, and how many vertices it moved to creases before."""

    mesh: TriMesh
    creases: int


class CollapseCall(NamedTuple):
    """Hold a collapse function and its arguments, for the call function(mesh, *arguments)."""

    function: Callable[..., TriMesh]
    arguments: tuple


def jitter_vertices(mesh: TriMesh) -> np.ndarray:
    """Return the vertices (v, 3) moved by random noise, so that the collapse leaves triangles of one size.

    The standard deviation is JITTER_EDGES times the shortest edge of the faces around a vertex. The collapse removes
    the edges that add the least error first. Without noise an edge in a flat part adds none: flat parts end as a few
    large triangles with slivers around them. With noise it adds about as much as one in a slightly curved part.
    """
    vertices, faces = mesh.vertices, mesh.faces
    position = np.ascontiguousarray(vertices, np.float32)
    shortest_squared = np.full(len(vertices), median_edge(mesh) ** 2, np.float32)
    for i in range(0, len(faces), CHUNK):
        corners = np.ascontiguousarray(faces[i : i + CHUNK].T, np.intp)
        shortest = np.full(corners.shape[1], np.inf, np.float32)
        for start, end in combinations(corners, 2):
            side = position.take(start, 0) - position.take(end, 0)
            np.minimum(shortest, np.einsum("fi,fi->f", side, side), out=shortest)
        for corner in corners:
            np.minimum.at(shortest_squared, corner, shortest)
    return vertices + JITTER_EDGES * np.sqrt(shortest_squared)[:, None] * np.random.default_rng(0).standard_normal(
        vertices.shape, np.float32
    )


def break_coplanarity(mesh: TriMesh) -> np.ndarray:
    """Return the vertices (v, 3), with those moved whose faces are coplanar but for rounding.

    They move by up to _COPLANAR_JITTER_EDGES edge lengths. Where hardly any are coplanar, the array itself is returned.

    Why: in an exact plane the quadric of an edge has determinant zero, and the collapse merges its ends at one of them
    or in the middle. Rounding can make the determinant slightly more than zero. Then the optimal position is far away,
    and the edge has to be skipped. Flat parts keep their triangles, and curved parts are collapsed to nearly nothing
    instead.
    """
    vertices, faces = mesh.vertices, mesh.faces
    sampled = np.arange(len(vertices)) % max(len(vertices) // _SAMPLES, 1) == 0
    near_sample = faces[np.flatnonzero(marked_corner_counts(faces, sampled))]
    around_idx, sampled_faces = topology.renumbered(near_sample, len(vertices))
    sampled_coplanar = _nearly_coplanar(TriMesh(vertices[around_idx], sampled_faces))[sampled[around_idx]]
    if sampled_coplanar.sum() / sampled.sum() < _MIN_COPLANAR_SHARE:
        return vertices
    coplanar = np.flatnonzero(_nearly_coplanar(mesh))
    out = vertices.astype(np.float64)
    noise = np.random.default_rng(0).uniform(-1, 1, vertices.shape)[coplanar]
    out[coplanar] += _COPLANAR_JITTER_EDGES * median_edge(mesh) * noise
    return out


def _nearly_coplanar(mesh: TriMesh) -> np.ndarray:
    """Return (v,) bool: vertices all of whose faces lie in one plane, except for rounding errors."""
    vertices, faces = mesh.vertices, mesh.faces
    single = TriMesh(vertices.astype(np.float32).astype(np.float64), faces)
    normals, corners = face_normals(single)[0].T, np.ascontiguousarray(faces.T, np.intp)
    sums = np.zeros((6, len(vertices)))
    for total, (first, second) in zip(sums, combinations_with_replacement(normals, 2), strict=True):
        product = first * second
        for corner in corners:
            np.add.at(total, corner, product)
    sums /= np.maximum(np.bincount(corners.ravel(), minlength=len(vertices)), 1)
    xx, xy, xz, yy, yz, zz = sums
    determinant = abs(xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    return (determinant > 0) & (determinant < _COPLANAR_DETERMINANT)


def collapse(mesh: TriMesh, target_faces: int, aggressiveness: float, unit: float = 1.0) -> TriMesh:
    """Collapse edges with fast-simplification, which is quick but does not keep the topology.

    Each round takes all edges whose error is below a bound. The bound rises from round to round, from the same number
    for a mesh of any size. aggressiveness: how steeply it rises. unit: the length that counts as 1. With a large unit
    the first rounds take edges in any order, which leaves even triangles. With a small unit they take the flattest
    first, which leaves a fifth of the error.
    """
    fast_simplification = imported("fast_simplification")
    vertices, faces = fast_simplification.simplify(
        np.ascontiguousarray(mesh.vertices / unit, np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
        target_count=target_faces,
        agg=aggressiveness,
    )
    return TriMesh(np.asarray(vertices, np.float64) * unit, np.asarray(faces, np.int64))


def collapse_keeping_topology(mesh: TriMesh, target_faces: int) -> TriMesh:
    """Collapse edges with MeshLab, which refuses collapses that change the topology.

    Its cleaning afterwards is off, because that joins vertices at one position.
    """
    pymeshlab = imported("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=target_faces, preservetopology=True, preservenormal=True, planarquadric=True, autoclean=False
    )
    result = meshes.current_mesh()
    return TriMesh(np.asarray(result.vertex_matrix()), np.asarray(result.face_matrix(), np.int64))


def collapse_in_two_passes(mesh: TriMesh, target_faces: int) -> TriMesh:
    """Collapse quickly down to _FIRST_PASS_FACTOR times the requested triangles, and with MeshLab from there.

    Takes a third of the time of MeshLab alone. The result has no triangles where the quick pass does not finish.
    """
    mesh = collapse(mesh, _FIRST_PASS_FACTOR * target_faces, 5.0)
    if len(mesh.faces) > _UNFINISHED_FACTOR * _FIRST_PASS_FACTOR * target_faces:
        return TriMesh(mesh.vertices, mesh.faces[:0])
    return collapse_keeping_topology(mesh, target_faces)


def cluster(mesh: TriMesh, target_faces: int) -> TriMesh:
    """Merge the vertices in each cell of a grid into their mean (Rossignac & Borrel 1993).

    This is the fallback for open meshes: it always gives a result, but may join sheets.
    """
    vertices, faces = mesh.vertices, mesh.faces
    low, extent = vertices.min(0), float(np.ptp(vertices, 0).max())
    cells = int(np.clip((target_faces / 2) ** 0.5 / 2, 4, 2000))
    while True:
        grid = np.floor((vertices - low) / extent * cells)
        _, _, inverse = unique_rows(grid)
        out = np.stack([np.bincount(inverse, vertices[:, i]) for i in range(3)], -1) / np.bincount(inverse)[:, None]
        merged = inverse[faces]
        merged = merged[~topology.has_repeated_corner(merged)]
        merged = merged[indices_of_distinct(np.sort(merged, 1))]
        if len(merged) or cells > 4000:
            return topology.compact(TriMesh(out, merged))
        cells *= 2


def median_edge(mesh: TriMesh) -> float:
    """Return the median edge length, of a sample of the faces."""
    corners = mesh.vertices[_sample_faces(mesh.faces)]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1)))


def _expected_edge(mesh: TriMesh, count: int) -> float:
    """Return the edge length of `count` equilateral triangles that together have the mesh's area."""
    faces = mesh.faces
    mean_area = face_normals(TriMesh(mesh.vertices, _sample_faces(faces)))[1].mean()
    return float((4 / 3**0.5 * mean_area * len(faces) / count) ** 0.5)


def _sample_faces(faces: np.ndarray) -> np.ndarray:
    """Return every n-th face, about _SAMPLES (20,000) of them."""
    return faces[:: max(len(faces) // _SAMPLES, 1)]


def collapse_in_child(mesh: TriMesh, call: CollapseCall, uniform: bool, crease_degrees: float = 0.0) -> ChildResult:
    """Restore creases, jitter the vertices and collapse; this is the function that child processes run.

    uniform: jitter all vertices, not only coplanar ones. crease_degrees: as in SimplifyOptions.
    """
    creases = 0
    if crease_degrees:
        restored = restore_creases(mesh, crease_degrees)
        mesh, creases = restored.mesh, restored.moved
    vertices = (jitter_vertices if uniform else break_coplanarity)(mesh)
    collapsed = call.function(TriMesh(vertices, mesh.faces.astype(np.int32, copy=False)), *call.arguments)
    return ChildResult(collapsed, creases)


def simplify(
    mesh: TriMesh, target_faces: int, attributes: np.ndarray | None = None, options: SimplifyOptions | None = None
) -> Simplified:
    """Simplify a mesh to about target_faces triangles of the same shape and topology.

    attributes (v, ...): interpolated at the point of the input that is closest to each new vertex. A closed, manifold
    input stays closed and manifold; where nothing keeps it so, the input is returned. Raises InputError as
    repair.check() does.

    Example:
        simplify(mesh, 5000, options=SimplifyOptions(low_deviation=True)).mesh
    """
    options = options or SimplifyOptions()
    repair.check(mesh)
    target_faces = max(int(target_faces), 4)
    if len(mesh.faces) <= target_faces:
        creases = 0
        if options.crease_degrees:
            restored = restore_creases(mesh, options.crease_degrees)
            mesh, creases = restored.mesh, restored.moved
        return Simplified(mesh, attributes, SimplifyReport(len(mesh.faces), "none", creases, error=0.0))
    run = _Simplification(mesh, target_faces, options)
    collapsed = run.collapse()
    if collapsed is None:
        report = SimplifyReport(len(mesh.faces), "none", error=0.0, failed="; ".join(run.failed))
        return Simplified(mesh, attributes, report)
    result = run.finish(collapsed, attributes)
    report = result.report
    if (
        report.error is not None
        and not options.topology_first
        and report.method == QUICK_METHOD
        and report.error > run.edge * run.extent
    ):
        slow_options = replace(
            options, topology_first=True, crease_degrees=0.0, is_closed=lambda: run.is_closed, while_waiting=None
        )
        slow = simplify(mesh, target_faces, attributes, slow_options)
        return min(result, slow, key=_comparable_error)
    return result


def _comparable_error(simplified: Simplified) -> float:
    """Return the error; infinite where nothing was simplified, or measured."""
    report = simplified.report
    return np.inf if report.method == "none" or report.error is None else report.error


class _Collapsed(NamedTuple):
    """Hold a usable mesh and the method that made it.

    creases: how many vertices moved to restored creases; None where no child reported it.
    """

    mesh: TriMesh
    method: str
    creases: int | None


class _Simplification:
    """Run simplify() once, in a unit box around the mesh."""

    def __init__(self, mesh: TriMesh, target_faces: int, options: SimplifyOptions):
        self.target_faces, self.options = target_faces, options
        self.failed: list[str] = []
        rows = np.ascontiguousarray(mesh.vertices.T)  # several times faster to reduce than the columns
        low, high = rows.min(1), rows.max(1)
        self.centre, self.extent = (low + high) / 2, float((high - low).max())
        if not self.extent > 0:
            raise InputError("mesh", "all its faces lie in one point", repair.NO_AREA)
        self.mesh = TriMesh((mesh.vertices - self.centre) / self.extent, mesh.faces)
        self.edge = _expected_edge(self.mesh, target_faces)  # of the result, in the unit box

    @cached_property
    def is_closed(self) -> bool:
        """Whether the input is watertight."""
        return (self.options.is_closed or (lambda: topology.is_watertight(self.mesh.faces)))()

    @cached_property
    def pieces(self) -> int:
        """Number of the input's pieces."""
        return topology.components(self.mesh.faces)[0]

    def collapse(self) -> _Collapsed | None:
        """Collapse the mesh in the best way that works; None where none does."""
        collapsed, creases = self._collapse_in_children(self.options.crease_degrees)
        if collapsed is None and creases != 0:
            self.failed.append("creases restored: the result cannot be simplified")
            collapsed, creases = self._collapse_in_children(0.0)
        if collapsed is None and not self.is_closed:
            collapsed = _Collapsed(cluster(self.mesh, self.target_faces), "vertex clustering", creases)
        return collapsed if collapsed is not None and len(collapsed.mesh.faces) else None

    def finish(self, collapsed: _Collapsed, attributes: np.ndarray | None) -> Simplified:
        """Drop small pieces that came off, interpolate attributes, measure the error and scale back."""
        mesh = topology.compact(collapsed.mesh)
        if topology.components(mesh.faces)[0] > 1 and self.is_closed:
            mesh = repair.drop_small_pieces(mesh, self.pieces)
        report = SimplifyReport(
            len(mesh.faces),
            collapsed.method,
            collapsed.creases,
            deviation(self.mesh, mesh) * self.extent if self.options.measure_error else None,
            "; ".join(self.failed) or None,
        )
        made_attributes = None if attributes is None else self._interpolate(attributes, mesh.vertices)
        return Simplified(TriMesh(mesh.vertices * self.extent + self.centre, mesh.faces), made_attributes, report)

    def _interpolate(self, attributes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the input's attributes (v, ...) at its points closest to points (n, 3)."""
        from gdtool.geometry.distance import barycentric_of, closest_points

        _, face_idx, point = closest_points(points, self.mesh)
        corner_idx = self.mesh.faces[face_idx]
        weights = barycentric_of(point, self.mesh.vertices[corner_idx])
        return np.einsum("nc,nc...->n...", weights, attributes[corner_idx])

    def _calls(self) -> Iterator[CollapseCall]:
        """Yield the collapses to try, in order."""
        # The quick collapse tears a closed mesh now and then (a handful of edges with four faces), at one
        # aggressiveness and not at another. It collapses no parts made of slivers, at any. MeshLab's takes ten times
        # as long.
        unit = self.edge if self.options.low_deviation else _EVEN_UNIT
        quick = [CollapseCall(collapse, (self.target_faces, pace, unit)) for pace in _AGGRESSIVENESS]
        slow = [CollapseCall(collapse_keeping_topology, (self.target_faces,))]
        if len(self.mesh.faces) > 2 * _FIRST_PASS_FACTOR * self.target_faces:
            slow.insert(0, CollapseCall(collapse_in_two_passes, (self.target_faces,)))
        yield from slow + quick if self.options.topology_first else quick + slow

    def _collapse_in_children(self, crease_degrees: float) -> tuple[_Collapsed | None, int | None]:
        """Run collapses in children until one leaves the mesh as closed as it is; record what failed.

        Returns an unfinished quick result where nothing else works, None where nothing works. Also returns how many
        vertices the last child moved to restored creases, None where no child reported it.
        """
        topology_first = self.options.topology_first
        unfinished, creases = None, None if crease_degrees else 0
        for call in self._calls():
            is_quick = call.function is collapse
            if unfinished is not None and is_quick:
                continue
            if call.function is collapse_in_two_passes and unfinished is None and not topology_first:
                continue
            if creases != 0 and not is_quick and not topology_first:
                break  # folds hinder the collapse, of bevels that were moved where there is no crease
            try:
                mesh, creases = self._run_child(call, crease_degrees)
            except ChildFailed as failure:
                self.failed.append(str(failure))
                continue
            mesh, is_sound = self._separated_if_torn(mesh)
            if not is_sound and (self.is_closed or not _is_usable(mesh)):
                self.failed.append("the result is not as closed as the input")
            elif is_quick and not creases and len(mesh.faces) > self._most_finished_faces:
                unfinished = mesh
                self.failed.append(f"the quick collapse stopped at {len(mesh.faces)} triangles")
            else:
                return _Collapsed(mesh, QUICK_METHOD if is_quick else TOPOLOGY_METHOD, creases), creases
        return None if unfinished is None else _Collapsed(unfinished, QUICK_METHOD, creases), creases

    @property
    def _most_finished_faces(self) -> float:
        """Most triangles that a quick collapse leaves where it finishes."""
        return _UNFINISHED_FACTOR * self.target_faces + _UNFINISHED_FACES

    def _run_child(self, call: CollapseCall, crease_degrees: float) -> ChildResult:
        """Run one collapse in a child; do meanwhile what can be done without its result."""
        options = self.options
        running = begin(
            collapse_in_child,
            TriMesh(self.mesh.vertices, self.mesh.faces.astype(np.int32)),
            call,
            options.uniform,
            crease_degrees,
            seconds=options.seconds,
            memory_mb=_CHILD_MEMORY_MB,
        )
        if options.is_closed is not None and cores() > 1 and self.is_closed:
            _ = self.pieces  # needed where the result is in several pieces
        if options.while_waiting is not None:
            options.while_waiting()
        return running.result()

    def _separated_if_torn(self, mesh: TriMesh) -> tuple[TriMesh, bool]:
        """Separate sheets where a closed mesh was torn; return the mesh, and whether it is closed and manifold."""
        # A closed result does for any input, so whether the input is closed is asked only for other results.
        if _is_closed_manifold(mesh):
            return mesh, True
        if self.is_closed and _is_usable(mesh):
            mesh = separate_sheets(mesh)  # most tears are two sheets that meet in an edge
            return mesh, _is_closed_manifold(mesh)
        return mesh, False


def _is_usable(mesh: TriMesh) -> bool:
    """Tell whether a native library's result has faces, indices in range and finite vertices."""
    faces = mesh.faces
    return bool(
        len(faces) and faces.min() >= 0 and faces.max() < len(mesh.vertices) and np.isfinite(mesh.vertices).all()
    )


def _is_closed_manifold(mesh: TriMesh) -> bool:
    """Tell whether a native library's result is usable, watertight and manifold."""
    return _is_usable(mesh) and topology.is_watertight(mesh.faces) and topology.is_manifold(mesh.faces)


def deviation(mesh: TriMesh, other: TriMesh, limit: int = _SAMPLES) -> float:
    """Return the largest distance of either mesh's vertices to the other surface; about `limit` vertices of each."""
    from gdtool.geometry.distance import closest_points

    out = 0.0
    for measured, surface in ((mesh, other), (other, mesh)):
        used = np.unique(measured.faces)
        step = max(len(used) // limit, 1)
        out = max(out, float(closest_points(measured.vertices[used[::step]], surface)[0].max()))
    return out
