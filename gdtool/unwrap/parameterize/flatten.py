"""Flatten one chart: start with a conformal map, then make it as isometric as possible; never fold or mirror it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import Edges, edges_of, handles
from gdtool.geometry.uv_raster import owned_texels, owner_count

_SLIM_ITERATIONS = (2, 2, 4, 6, 8)  # by round; the stretch is measured after each
_MIN_GAIN = 2e-4  # of stretch in a round, below which SLIM stops
_EXPECTED_GAIN = 1.0  # of a round, in units of what the round before it gained
_MIN_FACING_COSINE = 0.3  # between the mean normal and those of triangles that are seen along it


class FlattenResult(NamedTuple):
    """The coordinates uv (v, 2) of a flat chart, or None and the reason why the chart has to be cut.

    overlapped (v, 2): the coordinates of a chart that overlaps itself.
    """

    uv: np.ndarray | None
    reason: str = ""
    overlapped: np.ndarray | None = None


def flatten(mesh: TriMesh, good_stretch: float, max_stretch: float) -> FlattenResult:
    """Flatten one connected chart, a manifold with boundary, to uv (v, 2), v up, at the scale of the surface.

    It starts from the least-squares conformal map (Lévy et al. 2002), or from Tutte's embedding where that folds. SLIM
    (Rabinovich et al. 2017) then lowers the symmetric Dirichlet energy until good_stretch is reached. A chart beyond
    max_stretch has to be cut.
    """
    triangles = mesh.faces
    edges = edges_of(triangles)
    border = edges.count == 1
    if not border.any():
        return FlattenResult(None, "closed")
    surface, uv = StretchMeasure(mesh), _view_along_normal(mesh)
    disk = is_disk(mesh, edges)
    if uv is not None and surface.stretch(uv) < good_stretch and not overlaps_itself(uv, triangles, edges, disk):
        return FlattenResult(uv)
    if not disk and edges.count.max() == 2 and handles(triangles, 1, edges):  # no part of the plane has one
        return FlattenResult(None, "has a handle")
    uv = _conformal(mesh, edges.ends[border])
    if uv is None or not is_unfolded(uv, triangles):
        if not disk:
            return FlattenResult(None, "folds, and is no disk")
        uv = _tutte(mesh)
        if uv is None or not is_unfolded(uv, triangles):
            return FlattenResult(None, "folds")
    uv = _scaled(uv, triangles, surface.area)
    uv, reached = _isometric(mesh, uv, surface, good_stretch, max_stretch)
    if reached > max_stretch:
        return FlattenResult(None, "stretches")
    return (
        FlattenResult(None, "overlaps itself", uv) if overlaps_itself(uv, triangles, edges, disk) else FlattenResult(uv)
    )


def is_disk(mesh: TriMesh, edges: Edges) -> bool:
    """Return whether a connected mesh with these edges, which uses all its vertices, is a disk."""
    return len(mesh.vertices) - len(edges.ends) + len(mesh.faces) == 1 and edges.count.max() == 2


def _areas(uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Compute the signed areas (t,) of triangles in uv (v, 2)."""
    a, b, c = (uv[triangles[:, i]] for i in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def is_unfolded(uv: np.ndarray, triangles: np.ndarray) -> bool:
    """Return whether all triangles (t, 3) in uv (v, 2) are counter-clockwise and have an area."""
    area = _areas(uv, triangles)
    return bool(np.isfinite(area).all() and (area > 1e-10 * max(area.max(initial=0), 1e-300)).all())


def _scaled(uv: np.ndarray, triangles: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Centre uv (v, 2) and scale it so that the area of its triangles (t, 3) is the sum of area (t,)."""
    return (uv - uv.mean(0)) * (area.sum() / max(_areas(uv, triangles).sum(), 1e-300)) ** 0.5


def project_to_plane(mesh: TriMesh) -> np.ndarray | None:
    """Project a chart along its mean normal; this is exact for flat charts.

    Returns None where a triangle turns away from the mean normal or the projection overlaps itself.
    """
    triangles = mesh.faces
    uv = _view_along_normal(mesh)
    return None if uv is None or overlapping_triangles(uv, triangles).any() else uv


def _view_along_normal(mesh: TriMesh) -> np.ndarray | None:
    """Project a chart along its mean normal, at the scale of the surface; None where a triangle turns away."""
    vertices, triangles = mesh.vertices, mesh.faces
    normals, area = face_normals(mesh)
    mean = (normals * area[:, None]).sum(0)
    length = np.linalg.norm(mean)
    if length < 1e-12:
        return None
    mean /= length
    if (normals @ mean)[area > 0].min() < _MIN_FACING_COSINE:
        return None
    x = np.cross([0.0, 1.0, 0.0] if abs(mean[1]) < 0.9 else [1.0, 0.0, 0.0], mean)
    x /= np.linalg.norm(x)
    uv = np.stack([vertices @ x, vertices @ np.cross(mean, x)], -1)
    return _scaled(uv, triangles, area) if is_unfolded(uv, triangles) else None


def _conformal(mesh: TriMesh, border: np.ndarray) -> np.ndarray | None:
    """Compute the least-squares conformal map of a chart, None where that fails.

    Two far vertices of the boundary, border (b, 2) edges, are pinned.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    igl = imported("igl")
    rim = np.unique(border)
    first = rim[np.linalg.norm(vertices[rim] - vertices[rim].mean(0), axis=1).argmax()]
    second = rim[np.linalg.norm(vertices[rim] - vertices[first], axis=1).argmax()]
    if first == second:
        return None
    length = float(np.linalg.norm(vertices[second] - vertices[first]))
    try:
        uv = np.asarray(
            igl.lscm(
                np.ascontiguousarray(vertices),
                np.ascontiguousarray(triangles, np.int64),
                np.array([first, second], np.int64),
                np.array([[0.0, 0.0], [length, 0.0]]),
            )[0]
        )
    except RuntimeError:  # triangles without an area make its matrix singular
        return None
    if not np.isfinite(uv).all():
        return None
    return uv * [1.0, -1.0] if _areas(uv, triangles).sum() < 0 else uv


def extend_conformally(mesh: TriMesh, uv: np.ndarray) -> np.ndarray | None:
    """Fill the non-finite rows of uv (v, 2) by the least-squares conformal map that keeps the finite rows.

    Only vertices that triangles use are filled. Returns None where fewer than two rows are finite, or they have no
    area.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    igl = imported("igl")
    used, local = np.unique(triangles, return_inverse=True)
    is_given = np.isfinite(uv[used, 0])
    if is_given.sum() < 2:
        return None
    if not is_given.all():
        try:
            mapped = np.asarray(
                igl.lscm(
                    np.ascontiguousarray(vertices[used]),
                    np.ascontiguousarray(local.reshape(-1, 3), np.int64),
                    np.flatnonzero(is_given),
                    np.ascontiguousarray(uv[used[is_given]]),
                )[0]
            )
        except RuntimeError:  # as in _conformal()
            return None
        uv = uv.copy()
        uv[used[~is_given]] = mapped[~is_given]
    return uv


def _tutte(mesh: TriMesh) -> np.ndarray | None:
    """Compute the uniform-weight embedding onto a circle (Tutte 1963), which never folds.

    Returns None unless the chart has exactly one boundary.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import spsolve

    igl = imported("igl")
    loops = igl.boundary_loop_all(np.ascontiguousarray(triangles, np.int64))
    if len(loops) != 1:
        return None
    loop = np.array(loops[0])
    steps = np.linalg.norm(vertices[np.roll(loop, -1)] - vertices[loop], axis=1) + 1e-9
    angle = 2 * np.pi * np.concatenate([[0], np.cumsum(steps)[:-1]]) / steps.sum()
    ends = edges_of(triangles).ends
    n = len(vertices)
    rows, columns = np.concatenate([ends[:, 0], ends[:, 1]]), np.concatenate([ends[:, 1], ends[:, 0]])
    weights = coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)).tocsr()
    laplacian = (diags(np.asarray(weights.sum(1)).ravel()) - weights).tocsr()
    uv = np.zeros((n, 2))
    uv[loop] = np.stack([np.cos(angle), np.sin(angle)], -1)
    inner = np.setdiff1d(np.arange(n), loop)
    if len(inner):
        uv[inner] = spsolve(laplacian[inner][:, inner].tocsc(), -laplacian[inner][:, loop] @ uv[loop]).reshape(
            len(inner), 2
        )
    return uv * [1.0, -1.0] if _areas(uv, triangles).sum() < 0 else uv


def _isometric(
    mesh: TriMesh,
    uv: np.ndarray,
    surface: StretchMeasure,
    good_stretch: float,
    max_stretch: float,
) -> tuple[np.ndarray, float]:
    """Improve uv by SLIM; return the best uv and its stretch.

    Stops at good_stretch, when it gains little, or when it is clear that max_stretch will not be reached.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    igl = imported("igl")
    best, reached = uv, surface.stretch(uv)
    if reached < good_stretch:
        return best, reached
    state = igl.slim_precompute(
        np.asfortranarray(vertices, np.float64),
        np.asfortranarray(triangles, np.int32),
        np.asfortranarray(uv),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        np.zeros(0, np.int32),
        np.zeros((0, 2), order="F"),
        0.0,
    )
    for iterations in _SLIM_ITERATIONS:
        mapped = np.asarray(igl.slim_solve(state, iterations))[:, :2]
        if not np.isfinite(mapped).all() or not is_unfolded(mapped, triangles):
            break
        best, previous, reached = _scaled(mapped, triangles, surface.area), reached, surface.stretch(mapped)
        gained = previous - reached
        if reached < good_stretch or gained < _MIN_GAIN or reached - _EXPECTED_GAIN * gained > max_stretch:
            break
    return best, reached


def singular_values(mesh: TriMesh, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the singular values (t, 2), larger first, of the map from uv to the surface, and the areas (t,).

    The areas are those of the triangles on the surface.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    e1, e2 = (
        vertices[triangles[:, 1]] - vertices[triangles[:, 0]],
        vertices[triangles[:, 2]] - vertices[triangles[:, 0]],
    )
    u1, u2 = uv[triangles[:, 1]] - uv[triangles[:, 0]], uv[triangles[:, 2]] - uv[triangles[:, 0]]
    det = u1[:, 0] * u2[:, 1] - u1[:, 1] * u2[:, 0]
    safe = np.where(np.abs(det) > 0, det, 1e-300)[:, None]
    du = (e1 * u2[:, 1:] - e2 * u1[:, 1:]) / safe
    dv = (e2 * u1[:, :1] - e1 * u2[:, :1]) / safe
    a, b, c = (du * du).sum(1), (du * dv).sum(1), (dv * dv).sum(1)
    root = np.sqrt((a - c) ** 2 + 4 * b * b)
    values = np.sqrt(np.maximum(np.stack([(a + c + root) / 2, (a + c - root) / 2], -1), 0))
    return values, np.linalg.norm(np.cross(e1, e2), axis=1) / 2


def stretch(mesh: TriMesh, uv: np.ndarray) -> float:
    """Compute the L2 stretch (Sander et al. 2001), 1 for an isometry, at the scale where the areas agree."""
    return StretchMeasure(mesh).stretch(uv)


class StretchMeasure:
    """A measure of the stretch of maps from one mesh to the plane; the parts that all maps share are computed once."""

    def __init__(self, mesh: TriMesh):
        vertices = mesh.vertices
        self._abc = tuple(mesh.faces.T)
        a, b, c = self._abc
        side_ab, side_ac = (vertices[b] - vertices[a]).T, (vertices[c] - vertices[a]).T
        self._metric = (side_ab * side_ab).sum(0), (side_ab * side_ac).sum(0), (side_ac * side_ac).sum(0)
        normal = side_ab[[1, 2, 0]] * side_ac[[2, 0, 1]] - side_ab[[2, 0, 1]] * side_ac[[1, 2, 0]]
        self.area = np.sqrt((normal * normal).sum(0)) / 2

    def squared(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean square (t,) of the two singular values of the map from uv (v, 2) to each triangle.

        Also returns the triangles' areas (t,) in uv, not negative.
        """
        a, b, c = self._abc
        (u, v), (s, t), (e, f, g) = (uv[b] - uv[a]).T, (uv[c] - uv[a]).T, self._metric
        flat = np.abs(u * t - v * s)
        return (e * (s * s + t * t) - 2 * f * (u * s + v * t) + g * (u * u + v * v)) / (
            2 * np.maximum(flat, 1e-150) ** 2
        ), flat / 2

    def at_scale(self, uv: np.ndarray) -> float:
        """Compute the L2 stretch with one unit of uv as one of the surface: below 1 where uv is larger."""
        return float(np.sqrt((self.area * self.squared(uv)[0]).sum() / max(self.area.sum(), 1e-300)))

    def stretch(self, uv: np.ndarray) -> float:
        """Compute the L2 stretch at the scale where the areas agree; infinite where nothing has an area."""
        square, flat = self.squared(uv)
        area, total = self.area, self.area.sum()
        use = (area > 1e-12 * total) & (flat > 1e-14 * max(flat.sum(), 1e-300))
        if not use.any():
            return float("inf")
        return float(np.sqrt((area * square)[use].sum() * flat[use].sum()) / area[use].sum())


def overlaps_itself(uv: np.ndarray, triangles: np.ndarray, edges: Edges, disk: bool) -> bool:
    """Return whether some part of the chart lies on another; quicker than overlapping_triangles().

    A disk whose boundary neither crosses nor touches itself overlaps nothing: its boundary winds around everything
    once.
    """
    if not np.ptp(uv, 0).max() > 0:
        return True
    rim = np.flatnonzero(edges.count[edges.half_edge_idx] == 1)
    crossing, touches = rim_crossings(uv, edges.half_ends[rim])
    return len(crossing) > 0 or (touches or not disk) and bool((_rasterised(uv, triangles)[2] > 1).any())


def _rasterised(uv: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Rasterise a chart on a grid finer than its triangles.

    Returns uv (v, 2) scaled to the unit square, the grid's size, and (size, size) the number of triangles over each
    texel.
    """
    size = int(np.clip(10 * len(triangles) ** 0.5, 64, 512))
    at = (uv - uv.min(0)) / np.ptp(uv, 0).max()
    return at, size, owner_count(at, triangles, size)


def overlapping_triangles(uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Mark the triangles of an unfolded chart that lie on others of it, (t,) bool.

    The boundary of such a chart crosses itself, however little, or winds around some texels twice, which the grid
    finds.
    """
    overlaps = np.zeros(len(triangles), bool)
    if not np.ptp(uv, 0).max() > 0:
        return ~overlaps
    edges = edges_of(triangles)
    rim = np.flatnonzero(edges.count[edges.half_edge_idx] == 1)
    overlaps[edges.half_face[rim[rim_crossings(uv, edges.half_ends[rim])[0]]]] = True
    at, size, count = _rasterised(uv, triangles)
    twice = count > 1
    if twice.any():
        for face_idx, row, column in owned_texels(at, triangles, size):
            overlaps[face_idx[twice[row, column]]] = True
    return overlaps


def rim_crossings(uv: np.ndarray, ends: np.ndarray, at_once: int = 2_000_000) -> tuple[np.ndarray, bool]:
    """Find the boundary segments that cross another segment with which they share no end.

    ends (s, 2): segments between points uv (v, 2). A sweep over u, exact to rounding; at_once bounds the pairs compared
    at a time. Returns the crossing segments (n,), and whether any touch. Segments touch where ends of two lie in one
    place, as at a cut; whether they also cross there is not determined.
    """
    low, high = uv[ends].min(1), uv[ends].max(1)
    order = np.argsort(low[:, 0], kind="stable")
    ends, low, high = ends[order], low[order], high[order]
    # Each with those behind it in order that begin before it ends.
    number = np.searchsorted(low[:, 0], high[:, 0], "right") - np.arange(len(ends)) - 1
    total = np.cumsum(number)
    start, crossings, touches = 0, [], False
    while start < len(ends):
        base = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, base + at_once, "right")))
        first = np.repeat(np.arange(start, stop), number[start:stop])
        second = (
            first
            + 1
            + np.arange(len(first))
            - np.repeat(total[start:stop] - number[start:stop] - base, number[start:stop])
        )
        near = (low[first, 1] <= high[second, 1]) & (low[second, 1] <= high[first, 1])
        pair = np.stack([first[near], second[near]], -1)
        at = ends[pair]
        pair = pair[(at[:, 0, :, None] != at[:, 1, None, :]).all((1, 2))]
        (a, b), (c, d) = uv[ends[pair[:, 0]]].swapaxes(0, 1), uv[ends[pair[:, 1]]].swapaxes(0, 1)
        first, cd_side = _orientation(a, b, c) * _orientation(a, b, d), _orientation(c, d, a) * _orientation(c, d, b)
        crossings.append(pair[(first < 0) & (cd_side < 0)])
        touches = touches or bool(((first <= 0) & (cd_side <= 0) & (first * cd_side == 0)).any())
        start = stop
    return np.unique(order[np.concatenate(crossings).ravel()]) if crossings else np.zeros(0, np.int64), touches


def _orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute the side of the line from a to b that the point c lies on, each (n, 2): -1, 0 or 1."""
    return np.sign((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
