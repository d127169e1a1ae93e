"""Build closed triangle parts from grids of points (lathes, extrusions, boxes, balls, tubes) and transform them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Part:
    """Hold one closed surface: vertices (v, 3), outward unit normals (v, 3), faces (f, 3) of outward winding.

    Vertices are doubled along creases and texture seams. Welded by position, every edge has exactly two faces.
    uv (v, 2) runs along the grid in [0, 1] where `extent` is given, the lengths that one unit of u and of v stands for.
    Without extent it is a box projection in the part's own unit of length.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    extent: tuple[float, float] | None = None

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Part:
        """Translate the part by (x, y, z)."""
        return replace(self, vertices=self.vertices + np.array([x, y, z], float))

    def scaled(self, x: float, y: float | None = None, z: float | None = None) -> Part:
        """Scale the part about the origin; x alone scales all axes, a negative factor mirrors."""
        factors = np.array([x, x if y is None else y, x if z is None else z], float)
        faces = self.faces if np.prod(factors) > 0 else self.faces[:, ::-1]
        mean = float(np.abs(factors).mean())
        extent = None if self.extent is None else (self.extent[0] * mean, self.extent[1] * mean)
        uv = self.uv * mean if self.extent is None else self.uv
        return replace(
            self,
            vertices=self.vertices * factors,
            normals=unit(self.normals / factors),
            faces=np.ascontiguousarray(faces),
            uv=uv,
            extent=extent,
        )

    def turned(self, axis: str, degrees: float) -> Part:
        """Rotate the part about the origin, right-handed about axis "x", "y" or "z"."""
        matrix = rotation(axis, degrees)
        return replace(self, vertices=product(self.vertices, matrix), normals=product(self.normals, matrix))

    def mirrored(self) -> Part:
        """Mirror the part in x."""
        return self.scaled(-1.0, 1.0, 1.0)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-30)


def product(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Multiply points (n, 3) by a transposed matrix (k, 3), giving (n, k), or by a vector (3,), giving (n,).

    einsum instead of BLAS: the last bits of BLAS depend on the number of threads, and a seed's object must not.
    """
    return np.einsum("ij,kj->ik" if matrix.ndim == 2 else "ij,j->i", points, matrix)


def rotation(axis: str, degrees: float) -> np.ndarray:
    """Compute the right-handed rotation matrix (3, 3) about a coordinate axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.eye(3)
    matrix[j, j], matrix[j, k], matrix[k, j], matrix[k, k] = c, -s, s, c
    return matrix


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Compute the volume inside closed faces, positive where they wind counter-clockwise seen from outside."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _crease_flags(quads: np.ndarray, axis: int, wraps: bool, cosine: float) -> np.ndarray:
    """Find the sharp grid lines across an axis: where the median angle between the quads of both sides is large.

    quads: area vectors (rows, columns, 3). wraps: the grid closes along the axis; open ends count as sharp.
    cosine: of the angle from which a line is sharp.
    """
    normals = unit(quads)
    cosines = np.einsum("...i,...i->...", normals, np.roll(normals, 1, axis))
    area = np.linalg.norm(quads, axis=-1)
    area = np.minimum(area, np.roll(area, 1, axis))
    cosines = np.where(area > 1e-12, cosines, np.nan)
    has_area = np.isfinite(cosines).any(axis=1 - axis)
    flags = np.zeros(quads.shape[axis] + 1, bool)
    median = np.ones(len(has_area))
    median[has_area] = np.nanmedian(np.compress(has_area, cosines, axis=axis), axis=1 - axis)
    flags[:-1] = median < cosine
    flags[-1] = flags[0]
    if not wraps:
        flags[0] = flags[-1] = True
    return flags


def grid_part(points: np.ndarray, closed: bool = False, crease_degrees: float = 38.0, boxed: bool = False) -> Part:
    """Make the closed surface through a grid of points (rows, columns, 3).

    Columns wrap around, and rows do where `closed`. An open grid must begin and end in a row of coincident points, a
    pole. Grid lines that bend by more than `crease_degrees` get separate normals. boxed: use box-projected texture
    coordinates instead of the grid's own.
    """
    row_count, columns = points.shape[:2]
    strips = row_count if closed else row_count - 1
    following = (np.arange(columns) + 1) % columns
    low, high = points[:strips], points[(np.arange(strips) + 1) % row_count]
    quads = 0.5 * np.cross(high[:, following] - low, high - low[:, following])
    cosine = np.cos(np.radians(crease_degrees))
    sharp_row = _crease_flags(quads, 0, closed, cosine)
    sharp_column = _crease_flags(quads, 1, True, cosine)

    keep_low, keep_high = ~sharp_row[:-1, None, None], ~sharp_row[1:, None, None]
    by_row = [quads + keep_low * np.roll(quads, 1, 0), quads + keep_high * np.roll(quads, -1, 0)]
    pole = np.ptp(points, axis=1).max(axis=1) < 1e-9
    for side, row in ((0, 0), (1, row_count - 1)):
        if not closed and pole[row]:
            strip = by_row[side][0 if row == 0 else -1]
            total = strip.sum(axis=0)
            if (
                np.linalg.norm(total) > 0.7 * np.linalg.norm(strip, axis=1).sum()
            ):  # a pointed tip keeps separate normals
                strip[:] = total
    keep_left, keep_right = ~sharp_column[:-1, None], ~sharp_column[1:, None]

    # A vertex of the part for each grid point and side of a crease (key); corners of a quad in the order of `corners`.
    corners = ((0, 0), (0, 1), (1, 1), (1, 0))
    rows, cols = np.meshgrid(np.arange(strips), np.arange(columns), indexing="ij")
    corner_keys, corner_normals, corner_points, corner_welded = [], [], [], []
    for up, right in corners:
        strip = by_row[up]
        keep, shift = (keep_right, -1) if right else (keep_left, 1)
        corner_normals.append(strip + keep * np.roll(strip, shift, 1))
        r, c = rows + up, cols + right
        row_key = 2 * r + (sharp_row[r] & (up == 0))
        column_key = 2 * c + (sharp_column[c] & (right == 0))
        corner_keys.append(row_key * (2 * columns + 3) + column_key)
        corner_points.append(np.stack([r, c], -1))
        wrapped = r % row_count
        corner_welded.append(np.where(pole[wrapped], wrapped * columns, wrapped * columns + c % columns))
    _, first, inverse = np.unique(np.stack(corner_keys).reshape(-1), return_index=True, return_inverse=True)
    corner = inverse.reshape(4, strips, columns)
    grid_idx = np.stack(corner_points).reshape(-1, 2)[first]
    vertices = points[grid_idx[:, 0] % row_count, grid_idx[:, 1] % columns]
    normals = unit(np.stack(corner_normals).reshape(-1, 3)[first])

    triangles = []
    for triangle in ((0, 1, 2), (0, 2, 3)):
        a, b, c = (corner_welded[i] for i in triangle)
        has_area = (a != b) & (b != c) & (c != a)  # at a pole, one triangle of a quad has none
        triangles.append(np.stack([corner[i][has_area] for i in triangle], -1))
    faces = np.concatenate(triangles).astype(np.int32)

    length_u = np.linalg.norm(np.diff(points[:, np.r_[0:columns, 0]], axis=1), axis=-1)
    widest = length_u[length_u.sum(axis=1).argmax()]
    ring = points if not closed else points[np.r_[0:row_count, 0]]
    length_v = np.linalg.norm(np.diff(ring, axis=0), axis=-1).max(axis=1)
    u = np.r_[0.0, np.cumsum(widest)] / max(widest.sum(), 1e-12)
    v = np.r_[0.0, np.cumsum(length_v)] / max(length_v.sum(), 1e-12)
    uv = np.stack([u[grid_idx[:, 1]], 1.0 - v[grid_idx[:, 0]]], -1)
    if signed_volume(vertices, faces) < 0:
        faces, normals = np.ascontiguousarray(faces[:, ::-1]), -normals
        uv[:, 0] = 1.0 - uv[:, 0]
    part = Part(vertices, normals, faces, uv, (float(widest.sum()), float(length_v.sum())))
    return box_projected(part) if boxed else part


def box_projected(part: Part) -> Part:
    """Project texture coordinates along each face's dominant axis, with vertices doubled at the seams."""
    corners = part.vertices[part.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    label = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)
    keys, inverse = np.unique(part.faces * 6 + label[:, None], return_inverse=True)
    source, side = keys // 6, keys % 6
    x, y, z = part.vertices[source].T
    u = np.choose(side, [-z, z, x, x, x, -x])
    v = np.choose(side, [-y, -y, z, -z, -y, -y])
    return Part(
        part.vertices[source],
        part.normals[source],
        inverse.reshape(part.faces.shape).astype(np.int32),
        np.stack([u, v], -1),
    )


def circle(count: int = 40) -> np.ndarray:
    """Make a unit circle (count, 2) as an outline for `loft`."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def rectangle(width: float, depth: float, subdivisions: int = 6) -> np.ndarray:
    """Make the outline (n, 2) of a rectangle about the origin, with each side cut into `subdivisions` pieces.

    Finishes of solid fields look their pattern up at vertices, so a side needs several.
    """
    corners = 0.5 * np.array([[width, -depth], [width, depth], [-width, depth], [-width, -depth]])
    return subdivided(corners, subdivisions)


def subdivided(corners: np.ndarray, subdivisions: int) -> np.ndarray:
    """Cut each side of a polygon (n, 2) into equal pieces, giving (n * subdivisions, 2)."""
    t = np.arange(subdivisions)[None, :, None] / subdivisions
    return (corners[:, None] * (1 - t) + np.roll(corners, -1, 0)[:, None] * t).reshape(-1, 2)


def _miter(outline: np.ndarray) -> np.ndarray:
    """Compute for each point of an outline (n, 2) the vector that moves its two sides outward by one unit.

    Points inside a straight side interpolate the vectors of both its ends, so that no point overtakes a corner.
    """
    step = np.roll(outline, -1, 0) - outline
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
    normal = np.stack([step[:, 1], -step[:, 0]], -1) / length[:, None]
    total = normal + np.roll(normal, 1, 0)
    miter = 2 * total / np.maximum((total**2).sum(-1, keepdims=True), 0.4)
    corner = np.flatnonzero((normal * np.roll(normal, 1, 0)).sum(-1) < np.cos(np.radians(0.5)))
    if len(corner) < 3:
        return miter
    along = np.r_[0.0, np.cumsum(length)]
    knots = np.r_[along[corner[-1]] - along[-1], along[corner], along[-1] + along[corner[0]]]
    values = miter[np.r_[corner[-1], corner, corner[0]]]
    return np.stack([np.interp(along[:-1], knots, values[:, k]) for k in range(2)], -1)


def loft(
    profile: np.ndarray,
    outline: np.ndarray,
    crease_degrees: float = 38.0,
    boxed: bool = False,
    twist_degrees: float = 0.0,
) -> Part:
    """Sweep an outline (n, 2), in x and z, up a profile of rows (scale, height) or (scale, height, inset).

    The first and the last row must have scale 0. inset moves the outline's sides inward by a length, for bevels. boxed,
    crease_degrees: as in `grid_part`. twist_degrees: rotation about y from the first height to the last.
    """
    profile = np.asarray(profile, float)
    profile = profile[np.r_[True, np.abs(np.diff(profile, axis=0)).max(axis=1) > 1e-9]]  # a doubled row has no faces
    inset = profile[:, 2] if profile.shape[1] > 2 else np.zeros(len(profile))
    flat = profile[:, 0, None, None] * outline - inset[:, None, None] * _miter(outline)
    if twist_degrees:
        angle = np.radians(twist_degrees) * (profile[:, 1] - profile[0, 1]) / max(np.ptp(profile[:, 1]), 1e-9)
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        flat = np.stack([c * flat[..., 0] - s * flat[..., 1], s * flat[..., 0] + c * flat[..., 1]], -1)
    height = np.broadcast_to(profile[:, 1, None], flat.shape[:2])
    return grid_part(np.stack([flat[..., 0], height, flat[..., 1]], -1), crease_degrees=crease_degrees, boxed=boxed)


def refined(profile: ArrayLike, step: float) -> np.ndarray:
    """Add rows to a polyline (k, c) until no piece is longer than `step` in its first two columns."""
    points = np.asarray(profile, float)
    rows = [points[:1]]
    for a, b in itertools.pairwise(points):
        pieces = max(1, int(np.ceil(np.hypot(*(b - a)[:2]) / step)))
        rows.append(a + (b - a) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(rows)


def smooth_curve(knots: ArrayLike, count: int) -> np.ndarray:
    """Sample `count` points (count, c) of the shape-preserving cubic (PCHIP, by chord length) through knots (k, c)."""
    from scipy.interpolate import PchipInterpolator

    points = np.asarray(knots, float)
    chord = np.r_[0.0, np.cumsum(np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-6))]
    return PchipInterpolator(chord, points)(np.linspace(0, chord[-1], count))


def extrusion(outline: np.ndarray, height: float, bevel: float = 0.02, rows: int = 6) -> Part:
    """Extrude an outline about the origin from y = 0 to `height`, with bevelled rims and box-projected UVs."""
    bevel = min(bevel, 0.45 * height, 0.4 * float(np.linalg.norm(outline, axis=1).min()))
    wall = [(1.0, y, 0.0) for y in np.linspace(bevel, height - bevel, rows)]
    caps = np.array([0.0, 0.3, 0.6])
    profile = [(s, 0.0, s * bevel) for s in caps] + [(1.0, 0.0, bevel)] + wall + [(1.0, height, bevel)]
    profile += [(s, height, s * bevel) for s in caps[::-1]]
    return loft(np.array(profile), outline, boxed=True)


def box(width: float, height: float, depth: float, bevel: float = 0.02, subdivisions: int = 6) -> Part:
    """Make a bevelled box about the origin."""
    part = extrusion(rectangle(width, depth, subdivisions), height, min(bevel, 0.2 * min(width, height, depth)))
    return part.moved(y=-height / 2)


def cylinder(
    radius: float, height: float, bevel: float = 0.02, count: int = 36, top_radius: float | None = None
) -> Part:
    """Make a bevelled cylinder or truncated cone about the origin, along y."""
    top = radius if top_radius is None else top_radius
    bevel = min(bevel, 0.3 * min(radius, max(top, 1e-3)), 0.3 * height)
    h = height / 2
    profile = refined(
        [(0, -h), (radius - bevel, -h), (radius, -h + bevel), (top, h - bevel), (max(top - bevel, 0), h), (0, h)],
        max(height, radius) / 8,
    )
    return loft(profile, circle(count))


def ball(rx: float, ry: float | None = None, rz: float | None = None, count: int = 32) -> Part:
    """Make an ellipsoid about the origin; radii that are not given equal rx."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 1)
    profile = np.stack([np.cos(angle), np.sin(angle)], -1)
    profile[[0, -1], 0] = 0
    return loft(profile, circle(count)).scaled(rx, rx if ry is None else ry, rx if rz is None else rz)


def cone(radius: float, height: float, count: int = 32) -> Part:
    """Make a cone from y = 0 to `height`, its foot slightly rounded."""
    profile = refined([(0, 0), (0.97 * radius, 0), (radius, 0.03 * height), (0, height)], height / 8)
    return loft(profile, circle(count))


def tube(path: np.ndarray, radius: float | np.ndarray, closed: bool = False, outline: np.ndarray | None = None) -> Part:
    """Sweep an outline, a circle by default, along a path (k, 3), scaled by a radius or radii (k,).

    The frame is parallel-transported. Open ends are rounded off; a closed path must not repeat its first point.
    """
    path = np.asarray(path, float)
    outline = circle(16) if outline is None else outline
    radii = np.broadcast_to(np.asarray(radius, float), len(path)).copy()
    ahead = np.roll(path, -1, 0) if closed else np.vstack([path[1:], 2 * path[-1] - path[-2]])
    behind = np.roll(path, 1, 0) if closed else np.vstack([2 * path[0] - path[1], path[:-1]])
    tangents = unit(ahead - behind)
    side = unit(np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()]))
    transported = []
    for tangent in tangents:
        side = unit(side - tangent * (side @ tangent))
        transported.append(side)
    sides = np.array(transported)
    if closed:  # the frame returns rotated to the start; spread that angle over the loop so that the ends meet
        last = unit(sides[-1] - tangents[0] * (sides[-1] @ tangents[0]))
        angle = np.arctan2(np.cross(sides[0], last) @ tangents[0], sides[0] @ last)
        share = -angle * np.arange(len(path)) / len(path)
        sides = np.cos(share)[:, None] * sides + np.sin(share)[:, None] * np.cross(tangents, sides)
    ups = np.cross(tangents, sides)
    if not closed:
        bend = np.radians([0, 30, 60])
        head = path[0] - tangents[0] * radii[0] * np.cos(bend)[:, None] * 0.8
        tail = path[-1] + tangents[-1] * radii[-1] * np.cos(bend[::-1])[:, None] * 0.8
        radii = np.r_[radii[0] * np.sin(bend), radii, radii[-1] * np.sin(bend[::-1])]
        path = np.vstack([head, path, tail])
        sides = np.vstack([np.repeat(sides[:1], 3, 0), sides, np.repeat(sides[-1:], 3, 0)])
        ups = np.vstack([np.repeat(ups[:1], 3, 0), ups, np.repeat(ups[-1:], 3, 0)])
    spread = outline[None, :, 0, None] * sides[:, None] + outline[None, :, 1, None] * ups[:, None]
    return grid_part(path[:, None] + radii[:, None, None] * spread, closed=closed)
