"""Quadric edge collapse in a killable child, with the error it made."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import combinations, combinations_with_replacement

import numpy as np

from gdtool.core.child import ChildFailed, begin
from gdtool.core.errors import InputError
from gdtool.core.native import imported
from gdtool.core.threads import cores
from gdtool.geometry import repair, topology
from gdtool.geometry.normals import CHUNK, face_normals
from gdtool.geometry.rows import first_rows, unique_rows
from gdtool.geometry.sharpen import corners_in, restore_creases
from gdtool.geometry.unpinch import unpinched

CHILD_MODULES = ("scipy.sparse.csgraph", "scipy.spatial")  # that a child imports while it waits (core.child.prepare)
# How steeply the collapse's bound rises, tried in turn; the unit of lengths, in sizes of the mesh.
_PACES, _UNIT = (4.0, 3.0, 8.0), 0.5
_BY_WAY = 6  # times the triangles asked for, to which the quicker collapse still goes well
# Edge lengths that what is flat is moved by; determinant of the mean of its normals' squares.
_UNEVEN, _FLAT = 1e-3, 1e-14
SHAKEN = 0.03  # edge lengths that all is moved by where the triangles are to be even
_FEW_FLAT, _SAMPLE = 0.01, 20000  # of the vertices: so few stop no collapse; how many of them tell
_STUCK, _FEW = 1.25, 32  # triangles in units of those asked for, and so many more, that a collapse may leave


def shaken(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices (v, 3) moved by noise of SHAKEN times the shortest edge of their faces (f, 3), for a collapse that
    leaves triangles of one size.

    With it every vertex that is taken in adds about the same to an edge's error, where the surface is flat as where it
    is curved less than the noise; without it what is flat comes out in a few large triangles, and slivers around it.
    """
    position = np.ascontiguousarray(vertices, np.float32)
    far = np.full(len(vertices), median_edge(vertices, faces) ** 2, np.float32)
    for i in range(0, len(faces), CHUNK):
        corners = np.ascontiguousarray(faces[i : i + CHUNK].T, np.intp)
        shortest = np.full(corners.shape[1], np.inf, np.float32)
        for one, other in combinations(corners, 2):
            side = position.take(one, 0) - position.take(other, 0)
            np.minimum(shortest, np.einsum("fi,fi->f", side, side), out=shortest)
        for corner in corners:
            np.minimum.at(far, corner, shortest)
    return vertices + SHAKEN * np.sqrt(far)[:, None] * np.random.default_rng(0).standard_normal(
        vertices.shape, np.float32
    )


def uneven(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices (v, 3), those that lie in a plane but for rounding, where there are more than a few, moved by up to
    _UNEVEN edge lengths.

    The quadric of an edge in a plane has its least value all over. Where its determinant is exactly zero the collapse
    takes an end or the middle; where rounding makes it a little more it takes a point somewhere far, has to pass the
    edge over, and what is curved is taken down to its last triangles instead."""
    some = np.arange(len(vertices)) % max(len(vertices) // _SAMPLE, 1) == 0
    around, few = topology.renumbered(faces[np.flatnonzero(corners_in(faces, some))], len(vertices))
    if _flat(vertices[around], few)[some[around]].sum() / some.sum() < _FEW_FLAT:
        return vertices
    flat = np.flatnonzero(_flat(vertices, faces))
    out = vertices.astype(np.float64)
    out[flat] += _UNEVEN * median_edge(vertices, faces) * np.random.default_rng(0).uniform(-1, 1, vertices.shape)[flat]
    return out


def _flat(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(v,) bool: vertices all of whose faces lie in a plane that rounding bends."""
    normals, corners = (
        face_normals(vertices.astype(np.float32).astype(np.float64), faces)[0].T,
        np.ascontiguousarray(faces.T, np.intp),
    )
    sums = np.zeros((6, len(vertices)))
    for total, (one, other) in zip(sums, combinations_with_replacement(normals, 2), strict=True):
        product = one * other
        for corner in corners:
            np.add.at(total, corner, product)
    sums /= np.maximum(np.bincount(corners.ravel(), minlength=len(vertices)), 1)
    xx, xy, xz, yy, yz, zz = sums
    determinant = abs(xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    return (determinant > 0) & (determinant < _FLAT)


def collapse(
    vertices: np.ndarray, faces: np.ndarray, target_faces: int, aggressiveness: float, unit: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the child runs: fast-simplification's quadric collapse (Garland & Heckbert 1997), with lengths in
    units of `unit`.

    It takes all edges whose error is below a bound that rises from round to round, from the same number whatever the
    size of the mesh: in a large unit the first rounds take what they meet, which leaves even triangles; in a small one
    it takes the flattest first, which leaves a fifth of the error."""
    fast_simplification = imported("fast_simplification")
    out_vertices, out_faces = fast_simplification.simplify(
        np.ascontiguousarray(vertices / unit, np.float32),
        np.ascontiguousarray(faces, np.int32),
        target_count=target_faces,
        agg=aggressiveness,
    )
    return np.asarray(out_vertices, np.float64) * unit, np.asarray(out_faces, np.int64)


def _edge(vertices: np.ndarray, faces: np.ndarray, count: int) -> float:
    """About how long the edges are of so many even triangles in its place."""
    return float((4 / 3**0.5 * face_normals(vertices, _few(faces))[1].mean() * len(faces) / count) ** 0.5)


def median_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the median length of the edges, of some of them."""
    corners = vertices[_few(faces)]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1)))


def _few(faces: np.ndarray) -> np.ndarray:
    """Return some 20,000 of the faces, enough to tell their size."""
    return faces[:: max(len(faces) // 20000, 1)]


def collapse_topology(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what the child runs where the quicker collapse tears the mesh: MeshLab's, which refuses what changes the
    topology.

    Without its cleaning afterwards, which joins what coincides.
    """
    pymeshlab = imported("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=target_faces, preservetopology=True, preservenormal=True, planarquadric=True, autoclean=False
    )
    mesh = meshes.current_mesh()
    return np.asarray(mesh.vertex_matrix()), np.asarray(mesh.face_matrix(), np.int64)


def collapse_by_way(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what the child runs where the quicker collapse does not come to its end: that one as far as it goes well,
    MeshLab's from there.

    A third of the time of MeshLab's alone. No triangles at all where the quicker one does not come so far either.
    """
    vertices, faces = collapse(vertices, faces, _BY_WAY * target_faces, 5.0)
    if len(faces) > _STUCK * _BY_WAY * target_faces:
        return vertices, faces[:0]
    return collapse_topology(vertices, faces, target_faces)


def cluster(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Fallback that cannot fail: vertices of one grid cell become their mean (Rossignac & Borrel 1993). May join
    sheets."""
    low, extent = vertices.min(0), float(np.ptp(vertices, 0).max())
    cells = int(np.clip((target_faces / 2) ** 0.5 / 2, 4, 2000))
    while True:
        grid = np.floor((vertices - low) / extent * cells)
        _, _, inverse = unique_rows(grid)
        out = np.stack([np.bincount(inverse, vertices[:, i]) for i in range(3)], -1) / np.bincount(inverse)[:, None]
        merged = inverse[faces]
        merged = merged[~topology.repeats(merged)]
        merged = merged[first_rows(np.sort(merged, 1))]
        if len(merged) or cells > 4000:
            return topology.compact(out, merged)
        cells *= 2


def reduced(
    vertices: np.ndarray, faces: np.ndarray, way: str, arguments: tuple, even: bool, crease_degrees: float = 0.0
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return what the child runs: one of the collapses above of what is shaken, or uneven, first, and before that drawn
    out to creases that turn by more than crease_degrees, if any; and how many vertices were."""
    moved = 0
    if crease_degrees:
        vertices, faces, creases = restore_creases(vertices, faces, crease_degrees)
        moved = int(creases["moved"])
    vertices = (shaken if even else uneven)(vertices, faces)
    return *globals()[way](vertices, faces.astype(np.int32, copy=False), *arguments), moved


def simplify(
    vertices: np.ndarray,
    faces: np.ndarray,
    target_faces: int,
    attributes: np.ndarray | None = None,
    *,
    seconds: float = 120.0,
    closed: Callable[[], bool] | None = None,
    crease_degrees: float = 0.0,
    careful: bool = False,
    near: bool = False,
    even: bool = False,
    measured: bool = True,
    meanwhile: Callable[[], object] = lambda: None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, dict[str, float | int | str]]:
    """Return a mesh of about target_faces triangles of the same shape and topology.

    vertices (v, 3), faces (f, 3), attributes (v, a) or None. Returns vertices, faces, attributes (read at the closest
    point of the input) and a report: faces, method, and error, the largest distance of the result's vertices and of the
    input's vertices (at most 20,000 of them) to the other surface, in units of the input. A closed, manifold input
    stays so (closed says whether it is, soon). With crease_degrees, bevels are drawn out first to creases that turn by
    more, unless what comes of it cannot be collapsed; the report says how many vertices moved (creases). `careful`
    takes the slow way first, for meshes with more small parts than triangles to spare: the quick one reaches any
    number, even by tearing down what is large. With `near` the quick one keeps nearer to the surface, its triangles
    less even; with `even` the triangles are of one size, and off the surface by some hundredths of the input's edges
    (SHAKEN). Without `measured` the error is left out; with it, a quick result that is as far off as its edges are long
    is compared with the slow one's. `meanwhile` is called while each child works.
    Raises InputError as repair.check does.
    """
    repair.check(vertices, faces)
    target_faces = max(int(target_faces), 4)
    if len(faces) <= target_faces:
        report = {"faces": len(faces), "method": "none", "error": 0.0, "creases": 0}
        if crease_degrees:
            vertices, faces, drawn = restore_creases(vertices, faces, crease_degrees)
            report |= {"faces": len(faces), "creases": drawn["moved"]}
        return vertices, faces, attributes, report
    rows = np.ascontiguousarray(vertices.T)  # several times faster than along the columns
    low, high = rows.min(1), rows.max(1)
    centre, extent = (low + high) / 2, float((high - low).max())
    if not extent > 0:
        raise InputError("mesh", "all its faces lie in one point", repair.NO_AREA)
    unit = (vertices - centre) / extent
    edge = _edge(unit, faces, target_faces)
    is_closed, pieces = (
        cache(closed or (lambda: topology.is_watertight(faces))),
        cache(lambda: topology.components(faces)[0]),
    )

    def beside() -> None:
        if closed is not None and cores() > 1 and is_closed():
            pieces()  # asked for where what comes out is in several
        meanwhile()

    def collapsed(crease_degrees: float) -> tuple[tuple[np.ndarray, np.ndarray] | None, str, list[str], int | None]:
        return _collapsed(
            unit,
            faces,
            target_faces,
            edge if near else _UNIT,
            even,
            crease_degrees,
            careful,
            seconds,
            is_closed,
            beside,
        )

    found, method, reasons, moved = collapsed(crease_degrees)
    if found is None and moved != 0:
        reasons.append("creases restored: the result cannot be simplified")
        found, method, more, moved = collapsed(0.0)
        reasons += more
    if found is None and not is_closed():
        found, method = cluster(unit, faces, target_faces), "vertex clustering"
        if not len(found[1]):
            found = None
    if found is None:
        return (
            vertices,
            faces,
            attributes,
            {"faces": len(faces), "method": "none", "error": 0.0, "creases": 0, "failed": "; ".join(reasons)},
        )
    out_vertices, out_faces = topology.compact(*found)
    if topology.components(out_faces)[0] > 1 and is_closed():
        out_vertices, out_faces = repair.without_crumbs(out_vertices, out_faces, pieces())
    out_attributes = None
    if attributes is not None:
        from gdtool.geometry.distance import barycentric_of, closest_points

        _, face_idx, point = closest_points(out_vertices, unit, faces)
        weights = barycentric_of(point, unit[faces[face_idx]])
        out_attributes = np.einsum("nc,nc...->n...", weights, attributes[faces[face_idx]])
    report = {"faces": len(out_faces), "method": method, "creases": moved}
    if measured:
        report["error"] = deviation(unit, faces, out_vertices, out_faces) * extent
    if reasons:
        report["failed"] = "; ".join(reasons)
    out = out_vertices * extent + centre, out_faces, out_attributes, report
    if measured and not careful and method == "quadric collapse" and report["error"] > edge * extent:
        other = simplify(
            vertices,
            faces,
            target_faces,
            attributes,
            seconds=seconds,
            closed=is_closed,
            careful=True,
            near=near,
            even=even,
        )
        return min(out, other, key=lambda one: one[3]["error"] if one[3]["method"] != "none" else np.inf)
    return out


def _collapsed(
    vertices: np.ndarray,
    faces: np.ndarray,
    target_faces: int,
    unit: float,
    even: bool,
    crease_degrees: float,
    careful: bool,
    seconds: float,
    is_closed: Callable[[], bool],
    meanwhile: Callable[[], object],
) -> tuple[tuple[np.ndarray, np.ndarray] | None, str, list[str], int | None]:
    """Return what the first way leaves that keeps the mesh as closed as it is, or None; its name, what failed, and how
    many vertices were drawn out to creases, None where no child came to tell."""
    # The quick collapse tears a closed mesh now and then (a handful of edges with four faces), at one pace and not at
    # another, and of parts made of slivers it collapses nothing, at any; MeshLab's takes ten times as long.
    quick = [("collapse", (target_faces, pace, unit)) for pace in _PACES]
    slow = [("collapse_topology", (target_faces,))]
    if len(faces) > 2 * _BY_WAY * target_faces:
        slow.insert(0, ("collapse_by_way", (target_faces,)))
    reasons, stuck, moved = [], None, None if crease_degrees else 0
    for way, arguments in slow + quick if careful else quick + slow:
        if stuck is not None and way == "collapse" or way == "collapse_by_way" and stuck is None and not careful:
            continue
        if moved != 0 and way != "collapse" and not careful:
            break  # what cannot be collapsed are folds, of bevels that were drawn out where there is no crease
        try:
            running = begin(
                reduced,
                vertices,
                faces.astype(np.int32),
                way,
                arguments,
                even,
                crease_degrees,
                seconds=seconds,
                memory_mb=16000,
            )
            meanwhile()
            *out, moved = running.result()
        except ChildFailed as failure:
            reasons.append(str(failure))
            continue
        # What comes out closed does for any input: whether that is closed is asked of no other.
        sound = _sound(*out, True, target_faces)
        if not sound and is_closed() and _sound(*out, False, target_faces):
            out = unpinched(*out)  # what the quick collapse tears are mostly two sheets that meet in an edge
            sound = _sound(*out, True, target_faces)
        if not sound and (is_closed() or not _sound(*out, False, target_faces)):
            reasons.append("the result is not as closed as the input")
        elif way == "collapse" and not moved and len(out[1]) > _STUCK * target_faces + _FEW:
            stuck = out
            reasons.append(f"the quick collapse stopped at {len(out[1])} triangles")
        else:
            return out, "quadric collapse" if way == "collapse" else "quadric collapse, topology kept", reasons, moved
    return stuck, "quadric collapse", reasons, moved


def _sound(vertices: np.ndarray, faces: np.ndarray, closed: bool, target_faces: int) -> bool:
    """Whether a native result can be used: finite, in range, not empty, closed when the input was."""
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        return False
    return not closed or (topology.is_watertight(faces) and topology.is_manifold(faces))


def deviation(
    vertices_a: np.ndarray, faces_a: np.ndarray, vertices_b: np.ndarray, faces_b: np.ndarray, limit: int = 20000
) -> float:
    """Largest distance of the vertices of one mesh to the surface of the other, both ways, at most `limit` vertices
    each."""
    from gdtool.geometry.distance import closest_points

    out = 0.0
    for (points, faces), surface in (
        ((vertices_a, faces_a), (vertices_b, faces_b)),
        ((vertices_b, faces_b), (vertices_a, faces_a)),
    ):
        used = np.unique(faces)
        step = max(len(used) // limit, 1)
        out = max(out, float(closest_points(points[used[::step]], *surface)[0].max()))
    return out
