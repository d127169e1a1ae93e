"""Find the point of the source surface that corresponds to each point of the baked mesh."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import NamedTuple

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.distance import barycentric_of, split_long_faces
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.tangents import dot, number_distinct_rows

# The least dot product of a source face's normal and the mesh's normal at which the two agree.
AGREEMENT = 0.1
# Faces that a ray meets before it gives up.
_RETRIES = 4
# For the search of closest points, faces with an edge longer than this share of the source's extent are cut; long faces
# make its tree slow.
_LONG_EDGE = 1 / 16
# The most faces that cutting may lead to.
_MOST_CUT = 100_000


class Nearest:
    """Find closest points on faces of a mesh.

    Keeps the search tree, which libigl otherwise builds on each call. chosen (m,): indices of the faces to search; None
    searches all.
    """

    def __init__(self, mesh: TriMesh, chosen: np.ndarray | None = None):
        igl = imported("igl")
        searched = mesh if chosen is None else TriMesh(mesh.vertices, mesh.faces[chosen])
        longest = _LONG_EDGE * float(np.ptp(mesh.vertices, axis=0).max(initial=0))
        cut, face_idx = split_long_faces(searched, longest, _MOST_CUT)
        self._vertices, self._faces = (
            np.ascontiguousarray(cut.vertices, np.float64),
            np.ascontiguousarray(cut.faces, np.int64),
        )
        self._face_idx = (face_idx if chosen is None else chosen[face_idx]).astype(np.int32)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the closest point (n, 3) to each of points (n, 3), and its face_idx (n,) among all faces."""
        _, face, point = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points, np.float64)
        )
        return self._face_idx[face.reshape(-1)], np.asarray(point).reshape(-1, 3).copy()


class Source:
    """The triangles to bake from, with their ray caster and search trees.

    mesh: vertices (v, 3), faces (f, 3). face_normals (f, 3) unit; extent: longest side of the bounding box.
    """

    def __init__(self, mesh: TriMesh):
        from gdtool.geometry.single_precision_rays import SinglePrecisionCaster

        self.mesh = TriMesh(np.asarray(mesh.vertices, np.float64), mesh.faces)
        self.face_normals = face_normals(mesh)[0]
        self._normal_rows = np.ascontiguousarray(self.face_normals.T, np.float32)
        self.extent = self.mesh.extent
        self.caster = SinglePrecisionCaster(mesh)
        self.nearest = Nearest(self.mesh)
        self._facing: dict[tuple[int, float], Nearest | None] = {}
        self._lock = Lock()

    def normals_of(self, face_idx: np.ndarray) -> np.ndarray:
        """Gather unit normals (n, 3) float32 of faces; each component is contiguous in memory."""
        return np.take(self._normal_rows, face_idx, axis=1).T

    @cached_property
    def twins(self) -> np.ndarray:
        """Find for each face the one with the same corners that faces the other way: (f,) int32, -1 without one."""
        corners = np.sort(number_distinct_rows(self.mesh.vertices)[self.mesh.faces], axis=1)
        order = np.lexsort(corners.T)
        first, second = order[:-1], order[1:]
        same = (corners[first] == corners[second]).all(1)
        paired = same & (dot(self.face_normals[first], self.face_normals[second]) < 0)
        first, second = first[paired], second[paired]
        out = np.full(len(self.mesh.faces), -1, np.int32)
        out[first], out[second] = second, first
        return out

    def facing(self, axis: int, sign: float) -> Nearest | None:
        """Return the search tree of the faces within 75 degrees of a signed coordinate axis; None without faces."""
        with self._lock:
            if (axis, sign) not in self._facing:
                chosen = np.flatnonzero(self.face_normals[:, axis] * sign > 0.25)
                self._facing[axis, sign] = Nearest(self.mesh, chosen) if len(chosen) else None
            return self._facing[axis, sign]

    def flip_if_inside_out(self, points: np.ndarray, normals: np.ndarray) -> bool:
        """Flip all face normals if the source is inside out, and return whether it was.

        It counts as inside out when nine in ten of the faces nearest to points (n, 3) face away from normals (n, 3).
        """
        face, _ = self.nearest.closest(points)
        if not len(face) or (dot(self.face_normals[face], normals) < 0).mean() < 0.9:
            return False
        self.face_normals, self._normal_rows = -self.face_normals, -self._normal_rows
        self._facing.clear()
        return True

    def at(self, face_idx: np.ndarray, barycentric: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Interpolate vertex values (v,) or (v, c) at places on faces: (n,) or (n, c)."""
        corners = values[self.mesh.faces[face_idx]]
        return np.einsum("nk,nk...->n...", barycentric.astype(corners.dtype, copy=False), corners)


@dataclass(frozen=True)
class Places:
    """Points on a source's surface.

    face_idx (n,), barycentric (n, 3) float32. by_ray (n,) bool: found by a ray along the normal; False where the
    nearest point was taken. from_behind (n,) bool: whether the back of the face is seen.
    """

    face_idx: np.ndarray
    barycentric: np.ndarray
    by_ray: np.ndarray
    from_behind: np.ndarray


def cage_offsets(mesh: TriMesh, source: Source) -> np.ndarray:
    """Compute how far from each triangle to look for the source: (t,), the offset of its baking cage.

    This is twice the largest distance of the triangle's corners to the source, plus a share of its size for the bulge
    between them. Distances are capped at the 99th percentile, since a corner may lie far out where remeshing lost a
    part.
    """
    vertices, faces = mesh.vertices, mesh.faces
    distance = np.linalg.norm(source.nearest.closest(vertices)[1] - vertices, axis=1)
    distance = np.minimum(distance, np.percentile(distance, 99) + 1e-12)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    extent = float(np.ptp(vertices, axis=0).max())
    return 2 * distance[faces].max(1) + 0.3 * np.minimum(longest, np.percentile(longest, 99)) + 1e-4 * extent


class _Hits(NamedTuple):
    """Hits of n rays on the source: face_idx (n,), -1 without a hit, distance (n,), barycentric (n, 3).

    behind (k,): indices of the rays that stopped at the back of a face.
    """

    face_idx: np.ndarray
    distance: np.ndarray
    barycentric: np.ndarray
    behind: np.ndarray


def _march(
    points: np.ndarray,
    directions: np.ndarray,
    normals: np.ndarray,
    reach: np.ndarray,
    source: Source,
    start: float,
    through: bool = True,
) -> _Hits:
    """Find the first face along each ray, within reach (n,), whose normal agrees with normals (n, 3).

    Rays begin `start` before their points, and pass through faces that do not agree. If not `through`, a ray whose
    first face is seen from behind stops there. It gets that face and the distance infinity, and is listed in `behind`.
    """
    face, t, barycentric = source.caster.first_hit_single(points - directions * points.dtype.type(start), directions)
    t -= np.float32(start)
    near = (face >= 0) & (t <= reach)
    cosine = dot(source.normals_of(face), normals)
    good = near & (cosine > AGREEMENT)
    back = near & (cosine < -AGREEMENT) & (not through)
    # Hits on the other side of a wall: pass through it and continue.
    active = np.flatnonzero(near & ~good & ~back)
    face[~(good | back)] = -1
    distance = np.where(good, np.abs(t), np.float32(np.inf))
    travelled = t[active] + start
    for _ in range(_RETRIES - 1):
        if not len(active):
            break
        hit_face, t, hit_at = source.caster.first_hit_single(
            points[active] + directions[active] * travelled[:, None], directions[active]
        )
        t += travelled
        near = (hit_face >= 0) & (t <= reach[active])
        active, hit_face, hit_at, t = active[near], hit_face[near], hit_at[near], t[near]
        agrees = dot(source.normals_of(hit_face), normals[active]) > AGREEMENT
        done = active[agrees]
        face[done], distance[done], barycentric[done] = hit_face[agrees], np.abs(t[agrees]), hit_at[agrees]
        active, travelled = active[~agrees], t[~agrees] + start
    return _Hits(face, distance, barycentric, np.flatnonzero(back))


def _nearest_agreeing(
    points: np.ndarray, normals: np.ndarray, reach: np.ndarray, source: Source
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest point of the source whose face agrees with the normal: face_idx (n,), point (n, 3).

    Where no face agrees, the nearest point of all is taken. It is also taken where it lies within reach (n,) and the
    nearest agreeing point does not: the surface there is the back of a one-sided sheet.
    """
    face, point = source.nearest.closest(points)
    wrong = np.flatnonzero(dot(source.face_normals[face], normals) <= AGREEMENT)
    if not len(wrong):
        return face, point
    # A normal's largest component is at least 1/√3: the faces near that axis include most of those that agree.
    axis = np.abs(normals[wrong]).argmax(1)
    sign = np.sign(normals[wrong, axis])
    for k in range(3):
        for s in (-1.0, 1.0):
            rows = wrong[(axis == k) & (sign == s)]
            among = source.facing(k, s) if len(rows) else None
            if among is None:
                continue
            other_face, other_point = among.closest(points[rows])
            apart, other_apart = (np.linalg.norm(at - points[rows], axis=1) for at in (point[rows], other_point))
            sheet = (apart <= reach[rows]) & (other_apart > reach[rows])
            better = (dot(source.face_normals[other_face], normals[rows]) > AGREEMENT) & ~sheet
            face[rows[better]], point[rows[better]] = other_face[better], other_point[better]
    return face, point


def _prefer_nearest_points(
    points: np.ndarray, normals: np.ndarray, source: Source, met: np.ndarray, face: np.ndarray, barycentric: np.ndarray
) -> None:
    """Replace a ray's hit by the nearest point, where the hit face is slanted and the two are far apart.

    At a crease that remeshing cut off, the normal leads past the edge, to a point well away from the nearest one. The
    nearest point has to agree with the normal. met (n,) bool: the points whose places come from rays. Changes face (n,)
    and barycentric (n, 3).
    """
    cosine = dot(source.normals_of(face), normals)
    slanted = np.flatnonzero(met & (cosine > AGREEMENT) & (cosine < 0.99))
    away = source.at(face[slanted], barycentric[slanted], source.mesh.vertices) - points[slanted]
    # Distance from the hit to the nearest point, if the face were an infinite plane.
    beside = np.sqrt(dot(away, away) * np.maximum(1 - cosine[slanted] ** 2, 0))
    slanted = slanted[beside > 2e-5 * source.extent]
    if not len(slanted):
        return
    nearest_face, nearest = source.nearest.closest(points[slanted])
    agrees = dot(source.face_normals[nearest_face], normals[slanted]) > AGREEMENT
    slanted, nearest_face, nearest = slanted[agrees], nearest_face[agrees], nearest[agrees]
    face[slanted] = nearest_face
    barycentric[slanted] = barycentric_of(nearest, source.mesh.vertices[source.mesh.faces[nearest_face]])


def _move_to_twins(source: Source, places: np.ndarray, face: np.ndarray, barycentric: np.ndarray) -> None:
    """Move places from faces with a twin (Source.twins) to the twin; changes face (n,) and barycentric (n, 3).

    places (k,): the rows of face and barycentric to move.
    """
    if not len(places):
        return
    twin = source.twins[face[places]]
    places, twin = places[twin >= 0], twin[twin >= 0]
    at = source.at(face[places], barycentric[places], source.mesh.vertices)
    face[places], barycentric[places] = twin, barycentric_of(at, source.mesh.vertices[source.mesh.faces[twin]])


def reproject(points: np.ndarray, normals: np.ndarray, reach: np.ndarray, source: Source) -> Places:
    """Find the places on the source of points (n, 3) with unit normals (n, 3) of the baked mesh.

    Rays go along the normal, outward and inward, within reach (n,). The nearest face that faces the same way is taken.
    Where neither ray meets one, the nearest such point in any direction is taken. So nothing is read from the other
    side of a thin wall. A one-sided sheet is read from behind, and nothing is read through it.
    """
    start = 2e-5 * source.extent
    face, distance, barycentric, behind = _march(points, -normals, normals, reach, source, start, through=False)
    # Where the inward hit is very near, no agreeing face is nearer outward: between two sheets that face the same way
    # lies one that faces the other way.
    far = np.flatnonzero(distance > 5e-4 * source.extent)
    out_face, out_distance, out_at, _ = _march(
        points[far], normals[far], normals[far], np.minimum(reach, distance)[far], source, start
    )
    outward = (out_face >= 0) & (out_distance < distance[far])
    face[far[outward]], distance[far[outward]], barycentric[far[outward]] = (
        out_face[outward],
        out_distance[outward],
        out_at[outward],
    )
    # Points behind a one-sided sheet, unless its other side coincides with it.
    behind = behind[np.isinf(distance[behind])]
    _move_to_twins(source, behind, face, barycentric)
    missed = np.flatnonzero(face < 0)
    if len(missed):
        face[missed], nearest = _nearest_agreeing(points[missed], normals[missed], reach[missed], source)
        barycentric[missed] = barycentric_of(nearest, source.mesh.vertices[source.mesh.faces[face[missed]]])
    by_ray, from_behind = np.ones(len(points), bool), np.zeros(len(points), bool)
    by_ray[missed] = False
    _prefer_nearest_points(points, normals, source, by_ray, face, barycentric)
    for rows in (behind, missed):
        from_behind[rows] = dot(source.normals_of(face[rows]), normals[rows]) <= 0
    return Places(face, barycentric, by_ray, from_behind)
