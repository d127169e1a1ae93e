"""Cut polygons into triangles."""

from __future__ import annotations

import numpy as np


def triangulate(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles (t, 3), as positions in `corners`, and tell the polygon (t,) of each.

    vertices (v, 3). corners (c,): the vertex of each polygon corner, polygon after polygon. sizes (p,): corners of each
    polygon, at least 3. A quad is cut from corner 0 to 2, or from 1 to 3 where it is concave; larger polygons are cut
    by ear clipping.
    """
    first = np.cumsum(sizes) - sizes
    if (sizes == 3).all():
        return np.arange(3 * len(sizes)).reshape(-1, 3), np.arange(len(sizes))
    triangles, owners = [], []
    triangle_polygons = np.flatnonzero(sizes == 3)
    triangles.append(first[triangle_polygons, None] + np.arange(3))
    owners.append(triangle_polygons)
    quad_polygons = np.flatnonzero(sizes == 4)
    if len(quad_polygons):
        ring = first[quad_polygons, None] + np.arange(4)
        p = vertices[corners[ring]]
        cuts = [np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 0])]
        concave = (cuts[0] * cuts[1]).sum(1) < 0
        order = np.where(concave[:, None], (1, 2, 3, 1, 3, 0), (0, 1, 2, 0, 2, 3))
        triangles.append(np.take_along_axis(ring, order, 1).reshape(-1, 3))
        owners.append(np.repeat(quad_polygons, 2))
    for polygon in np.flatnonzero(sizes > 4):
        ring = first[polygon] + np.arange(sizes[polygon])
        cut = _cut_ears(vertices[corners[ring]])
        triangles.append(ring[cut])
        owners.append(np.full(len(cut), polygon))
    triangle_idx, owner = np.concatenate(triangles), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return triangle_idx[order], owner[order]


def _cut_ears(points: np.ndarray) -> np.ndarray:
    """Cut a polygon (n, 3) into n - 2 triangles: a fan where it is convex, else by ear clipping.

    Both work in the coordinate plane that the polygon faces most.
    """
    n = len(points)
    normal = np.cross(points, np.roll(points, -1, 0)).sum(0)  # Newell's method
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, 1)
    if normal[axis] * (-1 if axis == 1 else 1) < 0:
        flat = flat * (-1, 1)

    def turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return twice the signed area of the triangles a, b, c: positive for a left turn."""
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    left = list(range(n))
    if (turn(np.roll(flat, 1, 0), flat, np.roll(flat, -1, 0)) >= 0).all():
        return np.array([(0, i, i + 1) for i in range(1, n - 1)])
    triangles = []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            if turn(flat[a], flat[b], flat[c]) <= 0:
                continue
            others = flat[[i for i in left if i not in (a, b, c)]]
            inside = (
                (turn(flat[a], flat[b], others) >= 0)
                & (turn(flat[b], flat[c], others) >= 0)
                & (turn(flat[c], flat[a], others) >= 0)
            )
            if not inside.any():
                break
        else:
            k = 0  # no ear: the polygon crosses itself, and any cut is as good as another
            a, b, c = left[-1], left[0], left[1]
        triangles.append((a, b, c))
        del left[k]
    return np.array([*triangles, tuple(left)])
