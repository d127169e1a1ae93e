"""Distances to triangle meshes, inside and outside, and points on surfaces (libigl; fcpw for search trees of large
meshes)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.core.native import imported, imported_if_installed
from gdtool.geometry.vectors import cross, dot

_CELLS = 39  # along each axis: (39 + 1)^3 numbers fit 16 bits
_AT_ONCE = 50_000  # points in one call of libigl, which cannot be interrupted: a second of far points on two cores
_LARGE = 200_000  # triangles from which fcpw's tree is built in a quarter of the time


class SearchTree:
    """Closest points on one triangle mesh, asked again and again: vertices (v, 3), faces (f, 3), at least one of them.

    Of a large mesh fcpw (Sawhney 2021) finds the triangle, in single precision: one that is farther than the nearest by
    some 1e-7 of the mesh's size, or of the distance, can be taken for it. The point on that triangle is found in double
    precision."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.vertices, self.faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
        self._search = (_fcpw_search(self.vertices, self.faces) if len(faces) >= _LARGE else None) or _igl_search(
            self.vertices, self.faces
        )

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance (n,), face_idx (n,) and closest point (n, 3) for points (n, 3)."""
        if not len(points):
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        squared, face_idx, point = self._search(np.ascontiguousarray(points, np.float64))
        return np.sqrt(np.maximum(squared, 0)), face_idx, point


# Points (n, 3): squared distance (n,), face_idx (n,), point (n, 3).
_Search = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _igl_search(vertices: np.ndarray, faces: np.ndarray) -> _Search:
    igl = imported("igl")
    tree = igl.AABB()
    tree.init(vertices, faces)

    def search(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = [
            tree.squared_distance(vertices, faces, points[start : start + _AT_ONCE])
            for start in range(0, len(points), _AT_ONCE)
        ]
        return tuple(np.concatenate([np.asarray(part) for part in parts]) for parts in zip(*found, strict=True))

    return search


def _fcpw_search(vertices: np.ndarray, faces: np.ndarray) -> _Search | None:
    """None where there is no fcpw: it has no wheel for every machine."""
    fcpw = imported_if_installed("fcpw")
    if fcpw is None:
        return None
    low, high = vertices.min(0), vertices.max(0)
    middle, scale = (low + high) / 2, float((high - low).max()) or 1.0

    def single(points: np.ndarray) -> np.ndarray:
        return ((points - middle) / scale).astype(np.float32)

    scene = fcpw.scene_3D()
    scene.set_object_count(1)
    scene.set_object_vertices(single(vertices), 0)
    scene.set_object_triangles(faces.astype(np.int32), 0)
    # Searched as quickly as the others, built in half their time.
    scene.build(fcpw.aggregate_type.bvh_longest_axis_center, True, False, True)

    def search(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found, face_idx = fcpw.interaction_3D_list(), np.empty(len(points), np.int64)
        asked = single(points)
        order = by_place(asked)
        scene.find_closest_points(asked.take(order, 0), np.full(len(points), np.inf, np.float32), found)
        face_idx[order] = np.fromiter((one.primitive_index for one in found), np.int64, len(points))
        point = closest_on_triangles(points, vertices[faces[face_idx]])
        return ((points - point) ** 2).sum(1), face_idx, point

    return search


def by_place(points: np.ndarray) -> np.ndarray:
    """Return an order (n,) of points (n, 3) in which those near to one another follow one another: what is read for one
    is still in the cache for the next."""
    low, high = points.min(0), points.max(0)
    cell = ((points - low) * (_CELLS / (float((high - low).max()) or 1.0))).astype(np.uint16)
    # Of 16 bits: in linear time.
    return np.argsort((cell[:, 0] * (_CELLS + 1) + cell[:, 1]) * (_CELLS + 1) + cell[:, 2], kind="stable")


def closest_on_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3): the point of each of triangles (n, 3, 3) that is closest to the one of points (n, 3) in its place.

    As trimesh.triangles.closest_point, whose import takes .3 s.
    """
    weights = barycentric_of(points, triangles)
    out = np.einsum("nc,ncd->nd", weights, triangles)
    beside = np.flatnonzero((weights <= 0).any(1))  # zero-area ones, of weights (1, 0, 0), too
    if len(beside):
        points, triangles = points[beside], triangles[beside]
        start, along = triangles, np.roll(triangles, -1, 1) - triangles
        squared = np.einsum("nsd,nsd->ns", along, along)
        share = np.einsum("nsd,nsd->ns", points[:, None] - start, along) / np.where(squared > 0, squared, 1)
        on_sides = start + np.clip(share, 0, 1)[..., None] * along
        away = ((points[:, None] - on_sides) ** 2).sum(-1)
        out[beside] = on_sides[np.arange(len(beside)), away.argmin(1)]
    return out


def bisected(
    vertices: np.ndarray, faces: np.ndarray, longest: float, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (w, 3), faces (g, 3) and the face (g,) that each is of: the same surface, in faces without an edge of
    more than longest.

    Their longest edges are cut in the middle, again and again while there are no more than `most` faces; neighbours do
    not share the new vertices. A search tree finds closest points on them sooner: the boxes of long faces are mostly
    air. As trimesh.remesh.subdivide_to_size, but with a limit, which a mesh of many long faces needs, and without an
    import of .3 s."""
    whole, corners = np.arange(len(faces)), vertices[faces]
    done: list[tuple[np.ndarray, np.ndarray]] = []
    while len(whole):
        squared = ((np.roll(corners, -1, 1) - corners) ** 2).sum(-1)
        long = squared.max(1) > longest * longest
        if not long.any() or len(whole) + long.sum() + sum(len(some) for some, _ in done) > most:
            break
        done.append((whole[~long], corners[~long]))
        # Corners are turned round so that the edge to cut is that from the first to the second.
        turned = (squared[long].argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[long], turned[..., None], 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        whole, corners = np.repeat(whole[long], 2), np.stack([a, middle, c, middle, b, c], 1).reshape(-1, 3, 3)
    if not done:
        return vertices, faces, whole
    whole, corners = (np.concatenate(parts) for parts in zip(*done, (whole, corners), strict=True))
    return corners.reshape(-1, 3), np.arange(len(corners) * 3).reshape(-1, 3), whole


def closest_points(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For points (n, 3): distance (n,) to the surface, face_idx (n,) int32 and the closest point (n, 3).

    Vertices that no face uses are no surface. Zero-area faces count as the segment or point that they are. Raises
    ValueError for a mesh without faces.
    """
    if not len(faces):
        raise ValueError("a mesh without faces has no closest point")
    if not len(points):
        return np.zeros(0), np.zeros(0, np.int32), np.zeros((0, 3))
    points, vertices = _doubles(points, vertices)
    squared, face_idx, closest = _igl_search(vertices, np.ascontiguousarray(faces, np.int64))(points)
    return np.sqrt(np.maximum(squared, 0)), np.asarray(face_idx, np.int32), closest


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) generalised winding number: 1 inside a closed, outward-facing mesh, 0 outside (Barill et al. 2018).

    An approximation for far points: good to about 1e-2, so compare it with 0.5, not with 0 or 1.
    """
    igl = imported("igl")
    if not len(faces) or not len(points):
        return np.zeros(len(points))
    points, vertices = _doubles(points, vertices)
    return np.asarray(igl.fast_winding_number(vertices, np.ascontiguousarray(faces, np.int64), points))


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """count area-weighted uniform samples: points (n, 3), face_idx (n,) int32, barycentric (n, 3).

    Zero-area faces get none. Raises ValueError when the whole mesh has no area.
    """
    from gdtool.geometry.normals import face_normals

    below = np.cumsum(face_normals(vertices, faces)[1])
    if not len(below) or not below[-1] > 0:
        raise ValueError("a mesh without area cannot be sampled")
    # side="right": a face is drawn when below[i-1] <= r < below[i], never one of zero area.
    face_idx = np.searchsorted(below, rng.random(count) * below[-1], side="right")
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    barycentric = np.stack([1 - u - v, u, v], -1)
    return np.einsum("nc,ncd->nd", barycentric, vertices[faces[face_idx]]), face_idx.astype(np.int32), barycentric


def barycentric_of(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) barycentric coordinates of points (n, 3) in the planes of triangles (n, 3, 3); zero-area ones give (1, 0,
    0)."""
    a, b, c = np.ascontiguousarray(triangles.transpose(1, 2, 0))
    e0, e1, e2 = b - a, c - a, points.T - a
    normal = cross(e0, e1)
    squared = dot(normal, normal)
    good = squared > 0
    # Cross products instead of the Gram determinant, which cancels on slivers.
    over = np.where(good, 1 / np.where(good, squared, 1), 0)
    v, w = dot(cross(e2, e1), normal) * over, dot(cross(e0, e2), normal) * over
    return np.stack([1 - v - w, v, w], -1)


def _doubles(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(array, np.float64) for array in arrays)
