"""Find closest points on triangle meshes, winding numbers, and samples of surfaces.

libigl does most of this; fcpw builds the search trees of large meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gdtool.core.native import imported, imported_if_installed
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.vectors import cross, dot

_CELLS = 39  # of spatial_order's grid along each axis: (39 + 1)^3 numbers fit 16 bits
# Points in one call of libigl, which cannot be interrupted: a second for far points on two cores.
_POINTS_PER_CALL = 50_000
_MIN_FCPW_FACES = 200_000  # triangles from which fcpw's tree is built in a quarter of the time of libigl's


class SearchTree:
    """Find closest points on one triangle mesh, which has at least one face; keeps its search tree.

    mesh: the triangles, as float64 and int64. With a large mesh fcpw (Sawhney 2021) finds the triangle in single
    precision: it may be one that is farther than the nearest by some 1e-7 of the mesh's size, or of the distance. The
    point on that triangle is found in double precision.
    """

    def __init__(self, mesh: TriMesh):
        self.mesh = TriMesh(np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64))
        is_large = len(mesh.faces) >= _MIN_FCPW_FACES
        self._search = (_fcpw_search(self.mesh) if is_large else None) or _igl_search(self.mesh)

    @property
    def vertices(self) -> np.ndarray:
        """Vertices (v, 3) float64 of the mesh."""
        return self.mesh.vertices

    @property
    def faces(self) -> np.ndarray:
        """Faces (f, 3) int64 of the mesh."""
        return self.mesh.faces

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance (n,), face_idx (n,) and closest point (n, 3) for points (n, 3)."""
        if not len(points):
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        squared, face_idx, point = self._search(np.ascontiguousarray(points, np.float64))
        return np.sqrt(np.maximum(squared, 0)), face_idx, point


# Takes points (n, 3); returns squared distance (n,), face_idx (n,) and closest point (n, 3).
_Search = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _igl_search(mesh: TriMesh) -> _Search:
    """Build libigl's search tree; the mesh has contiguous float64 vertices and int64 faces."""
    vertices, faces = mesh.vertices, mesh.faces
    igl = imported("igl")
    tree = igl.AABB()
    tree.init(vertices, faces)

    def search(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        answers = [
            tree.squared_distance(vertices, faces, points[start : start + _POINTS_PER_CALL])
            for start in range(0, len(points), _POINTS_PER_CALL)
        ]
        return tuple(np.concatenate([np.asarray(part) for part in parts]) for parts in zip(*answers, strict=True))

    return search


def _fcpw_search(mesh: TriMesh) -> _Search | None:
    """Build fcpw's search tree; None where fcpw is not installed, which has no wheel for every machine."""
    vertices, faces = mesh.vertices, mesh.faces
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
    # This kind of tree is searched as quickly as the others and built in half their time.
    scene.build(fcpw.aggregate_type.bvh_longest_axis_center, True, False, True)

    def search(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        interactions, face_idx = fcpw.interaction_3D_list(), np.empty(len(points), np.int64)
        queries = single(points)
        order = spatial_order(queries)
        scene.find_closest_points(queries.take(order, 0), np.full(len(points), np.inf, np.float32), interactions)
        face_idx[order] = np.fromiter((hit.primitive_index for hit in interactions), np.int64, len(points))
        point = closest_on_triangles(points, vertices[faces[face_idx]])
        return ((points - point) ** 2).sum(1), face_idx, point

    return search


def spatial_order(points: np.ndarray) -> np.ndarray:
    """Return an order (n,) of points (n, 3) in which points near each other follow each other.

    What is read for one is then still in the cache for the next.
    """
    low, high = points.min(0), points.max(0)
    cell = ((points - low) * (_CELLS / (float((high - low).max()) or 1.0))).astype(np.uint16)
    # numpy sorts keys of 16 bits in linear time.
    return np.argsort((cell[:, 0] * (_CELLS + 1) + cell[:, 1]) * (_CELLS + 1) + cell[:, 2], kind="stable")


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the closest point (n, 3) to each of points (n, 3) on one triangle each, with corners (n, 3, 3).

    Does what trimesh.triangles.closest_point does, whose import takes 0.3 s.
    """
    weights = barycentric_of(points, corners)
    out = np.einsum("nc,ncd->nd", weights, corners)
    # Outside the triangle, or on its outline; triangles without area, whose weights are (1, 0, 0), belong here too.
    beside = np.flatnonzero((weights <= 0).any(1))
    if len(beside):
        points, corners = points[beside], corners[beside]
        start, along = corners, np.roll(corners, -1, 1) - corners
        squared = np.einsum("nsd,nsd->ns", along, along)
        share = np.einsum("nsd,nsd->ns", points[:, None] - start, along) / np.where(squared > 0, squared, 1)
        on_sides = start + np.clip(share, 0, 1)[..., None] * along
        away = ((points[:, None] - on_sides) ** 2).sum(-1)
        out[beside] = on_sides[np.arange(len(beside)), away.argmin(1)]
    return out


class SplitFaces(NamedTuple):
    """Hold a mesh whose long faces were split, and face_idx (g,): the original face that each face is part of."""

    mesh: TriMesh
    face_idx: np.ndarray


def split_long_faces(mesh: TriMesh, longest: float, max_faces: int) -> SplitFaces:
    """Split faces until no edge is longer than `longest`, or until one more round would exceed max_faces.

    Each round cuts the longest edges in the middle. Neighbours do not share the new vertices, so the result is not
    watertight. A search tree finds closest points on the result sooner, because the boxes of long faces are mostly
    empty.

    Does what trimesh.remesh.subdivide_to_size does, without an import of 0.3 s. The limit keeps a mesh of many long
    faces from filling the memory.
    """
    whole, corners = np.arange(len(mesh.faces)), mesh.vertices[mesh.faces]
    done: list[tuple[np.ndarray, np.ndarray]] = []
    while len(whole):
        squared = ((np.roll(corners, -1, 1) - corners) ** 2).sum(-1)
        long = squared.max(1) > longest * longest
        if not long.any() or len(whole) + long.sum() + sum(len(idx) for idx, _ in done) > max_faces:
            break
        done.append((whole[~long], corners[~long]))
        # The corners are rotated so that the edge to cut runs from the first to the second.
        rotation = (squared[long].argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[long], rotation[..., None], 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        whole, corners = np.repeat(whole[long], 2), np.stack([a, middle, c, middle, b, c], 1).reshape(-1, 3, 3)
    if not done:
        return SplitFaces(mesh, whole)
    whole, corners = (np.concatenate(parts) for parts in zip(*done, (whole, corners), strict=True))
    return SplitFaces(TriMesh(corners.reshape(-1, 3), np.arange(len(corners) * 3).reshape(-1, 3)), whole)


def closest_points(points: np.ndarray, mesh: TriMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for points (n, 3) the distance (n,) to the surface, face_idx (n,) int32 and the closest point (n, 3).

    Vertices that no face uses are ignored. Faces without area count as the segment or point that they are. Raises
    ValueError for a mesh without faces.
    """
    if not len(mesh.faces):
        raise ValueError("a mesh without faces has no closest point")
    if not len(points):
        return np.zeros(0), np.zeros(0, np.int32), np.zeros((0, 3))
    points, vertices = _doubles(points, mesh.vertices)
    squared, face_idx, closest = _igl_search(TriMesh(vertices, np.ascontiguousarray(mesh.faces, np.int64)))(points)
    return np.sqrt(np.maximum(squared, 0)), np.asarray(face_idx, np.int32), closest


def winding_number(points: np.ndarray, mesh: TriMesh) -> np.ndarray:
    """Return the generalised winding number (n,) of points (n, 3) (Barill et al. 2018).

    It is 1 inside a closed mesh whose faces look outward, and 0 outside. Far points are approximated, to about 1e-2:
    compare it with 0.5, not with 0 or 1.
    """
    igl = imported("igl")
    if not len(mesh.faces) or not len(points):
        return np.zeros(len(points))
    points, vertices = _doubles(points, mesh.vertices)
    return np.asarray(igl.fast_winding_number(vertices, np.ascontiguousarray(mesh.faces, np.int64), points))


def sample_surface(mesh: TriMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw `count` points uniformly by area: points (n, 3), face_idx (n,) int32, barycentric (n, 3).

    Faces without area get none. Raises ValueError where the whole mesh has no area.
    """
    from gdtool.geometry.normals import face_normals

    below = np.cumsum(face_normals(mesh)[1])
    if not len(below) or not below[-1] > 0:
        raise ValueError("a mesh without area cannot be sampled")
    # side="right": face i is chosen where below[i-1] <= r < below[i], so never one without area.
    face_idx = np.searchsorted(below, rng.random(count) * below[-1], side="right")
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    barycentric = np.stack([1 - u - v, u, v], -1)
    points = np.einsum("nc,ncd->nd", barycentric, mesh.vertices[mesh.faces[face_idx]])
    return points, face_idx.astype(np.int32), barycentric


def barycentric_of(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates (n, 3) of points (n, 3) in the planes of triangles with corners (n, 3, 3).

    Triangles without area give (1, 0, 0).
    """
    a, b, c = np.ascontiguousarray(corners.transpose(1, 2, 0))
    e0, e1, e2 = b - a, c - a, points.T - a
    normal = cross(e0, e1)
    squared = dot(normal, normal)
    good = squared > 0
    # Cross products, because the Gram determinant cancels on slivers.
    over = np.where(good, 1 / np.where(good, squared, 1), 0)
    v, w = dot(cross(e2, e1), normal) * over, dot(cross(e0, e2), normal) * over
    return np.stack([1 - v - w, v, w], -1)


def _doubles(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the arrays as contiguous float64."""
    return tuple(np.ascontiguousarray(array, np.float64) for array in arrays)
