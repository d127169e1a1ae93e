"""From a point on the mesh that is baked to the place on the source surface that it stands for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.distance import barycentric_of, bisected
from gdtool.geometry.normals import face_normals
from gdtool.geometry.tangents import dot, weld

# A place on the source is on the right side when its face's normal agrees with the mesh's normal: dot product above
# this.
AGREEMENT = 0.1
_RETRIES = 4
# Faces with an edge of more than this share of the source are cut for the search of closest points, while there are no
# more than so many.
_LONG, _MOST_CUT = 1 / 16, 100_000


class Nearest:
    """Closest points on some faces of a mesh; the tree is kept (libigl builds one per call otherwise).

    vertices (v, 3), faces (f, 3), chosen (m,) indices of the faces to look among, all when None.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, chosen: np.ndarray | None = None):
        igl = imported("igl")
        some = faces if chosen is None else faces[chosen]
        cut_vertices, cut, whole = bisected(
            vertices, some, _LONG * float(np.ptp(vertices, axis=0).max(initial=0)), _MOST_CUT
        )
        self._vertices, self._faces = (
            np.ascontiguousarray(cut_vertices, np.float64),
            np.ascontiguousarray(cut, np.int64),
        )
        self._face_idx = (whole if chosen is None else chosen[whole]).astype(np.int32)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """face_idx (n,) into all faces and the closest point (n, 3) to each of points (n, 3)."""
        _, face, point = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points, np.float64)
        )
        return self._face_idx[face.reshape(-1)], np.asarray(point).reshape(-1, 3).copy()


class Source:
    """Triangles to bake from: vertices (v, 3), faces (f, 3), face_normals (f, 3) unit, and what finds places on
    them."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        from gdtool.geometry.quick_rays import QuickCaster

        self.vertices, self.faces = np.asarray(vertices, np.float64), faces
        self.face_normals = face_normals(vertices, faces)[0]
        self._normal_rows = np.ascontiguousarray(self.face_normals.T, np.float32)
        self.extent = float(np.ptp(self.vertices, axis=0).max())
        self.caster = QuickCaster(vertices, faces)
        self.nearest = Nearest(self.vertices, faces)
        self._facing: dict[tuple[int, float], Nearest | None] = {}
        self._lock = Lock()

    def normals_of(self, face_idx: np.ndarray) -> np.ndarray:
        """(n, 3) float32 unit normals of faces, component by component in memory."""
        return np.take(self._normal_rows, face_idx, axis=1).T

    @cached_property
    def twins(self) -> np.ndarray:
        """(f,) int32: the face that has the same corners and looks the other way, -1 where there is none."""
        corners = np.sort(weld(self.vertices)[self.faces], axis=1)
        order = np.lexsort(corners.T)
        one, two = order[:-1], order[1:]
        paired = (corners[one] == corners[two]).all(1) & (dot(self.face_normals[one], self.face_normals[two]) < 0)
        one, two = one[paired], two[paired]
        out = np.full(len(self.faces), -1, np.int32)
        out[one], out[two] = two, one
        return out

    def facing(self, axis: int, sign: float) -> Nearest | None:
        """Nearest among the faces within 75 degrees of a coordinate axis; None when there are none."""
        with self._lock:
            if (axis, sign) not in self._facing:
                chosen = np.flatnonzero(self.face_normals[:, axis] * sign > 0.25)
                self._facing[axis, sign] = Nearest(self.vertices, self.faces, chosen) if len(chosen) else None
            return self._facing[axis, sign]

    def turn_to(self, points: np.ndarray, normals: np.ndarray) -> bool:
        """Turn all faces round where the source is inside out: where nine in ten of those nearest to points (n, 3) look
        away from normals (n, 3). Returns whether it was."""
        face, _ = self.nearest.closest(points)
        if not len(face) or (dot(self.face_normals[face], normals) < 0).mean() < 0.9:
            return False
        self.face_normals, self._normal_rows = -self.face_normals, -self._normal_rows
        self._facing.clear()
        return True

    def at(self, face_idx: np.ndarray, barycentric: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Vertex values (v,) or (v, c), interpolated at places on faces: (n,) or (n, c)."""
        corners = values[self.faces[face_idx]]
        return np.einsum("nk,nk...->n...", barycentric.astype(corners.dtype, copy=False), corners)


@dataclass(frozen=True)
class Places:
    """Places on a source: face_idx (n,), barycentric (n, 3) float32, by_ray (n,) bool, False where by nearest point,
    and from_behind (n,) bool, where the back of the face is meant."""

    face_idx: np.ndarray
    barycentric: np.ndarray
    by_ray: np.ndarray
    from_behind: np.ndarray


def vertex_reach(vertices: np.ndarray, faces: np.ndarray, source: Source) -> np.ndarray:
    """How far from each triangle's points to look for the source, (t,): its cage.

    Twice the largest distance of its corners to the source, and a share of its size for the bulge between them. A
    corner that lies far out (a part that remeshing lost) does not count for more than the 99th percentile of all."""
    distance = np.linalg.norm(source.nearest.closest(vertices)[1] - vertices, axis=1)
    distance = np.minimum(distance, np.percentile(distance, 99) + 1e-12)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    extent = float(np.ptp(vertices, axis=0).max())
    return 2 * distance[faces].max(1) + 0.3 * np.minimum(longest, np.percentile(longest, 99)) + 1e-4 * extent


def _march(
    points: np.ndarray,
    directions: np.ndarray,
    normals: np.ndarray,
    reach: np.ndarray,
    source: Source,
    start: float,
    through: bool = True,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First face on the right side along each ray within reach: face_idx (n,), -1 for none, distance (n,), barycentric
    (n, 3).

    Faces on the wrong side are stepped through, unless a ray that may not go through meets the first of them from
    behind: these rays (k,) come last, with the place of that face and a distance of infinity."""
    face, t, barycentric = source.caster.quick_hits(points - directions * points.dtype.type(start), directions)
    t -= np.float32(start)
    near = (face >= 0) & (t <= reach)
    cosine = dot(source.normals_of(face), normals)
    good = near & (cosine > AGREEMENT)
    back = near & (cosine < -AGREEMENT) & (not through)
    # The other side of a wall: step through it and look on.
    active = np.flatnonzero(near & ~good & ~back)
    face[~(good | back)] = -1
    distance = np.where(good, np.abs(t), np.float32(np.inf))
    travelled = t[active] + start
    for _ in range(_RETRIES - 1):
        if not len(active):
            break
        hit_face, t, hit_at = source.caster.quick_hits(
            points[active] + directions[active] * travelled[:, None], directions[active]
        )
        t += travelled
        near = (hit_face >= 0) & (t <= reach[active])
        active, hit_face, hit_at, t = active[near], hit_face[near], hit_at[near], t[near]
        agrees = dot(source.normals_of(hit_face), normals[active]) > AGREEMENT
        found = active[agrees]
        face[found], distance[found], barycentric[found] = hit_face[agrees], np.abs(t[agrees]), hit_at[agrees]
        active, travelled = active[~agrees], t[~agrees] + start
    return face, distance, barycentric, np.flatnonzero(back)


def _nearest_agreeing(
    points: np.ndarray, normals: np.ndarray, reach: np.ndarray, source: Source
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest place whose face looks the same way as the normal: face_idx (n,), point (n, 3).

    Plain nearest if none does; and where that lies within reach (n,) but none that looks the same way: the back of a
    sheet that has but one side."""
    face, point = source.nearest.closest(points)
    wrong = np.flatnonzero(dot(source.face_normals[face], normals) <= AGREEMENT)
    if not len(wrong):
        return face, point
    # The normal's main component is at least 1/sqrt(3): the faces near that axis hold most of those that agree.
    axis = np.abs(normals[wrong]).argmax(1)
    sign = np.sign(normals[wrong, axis])
    for k in range(3):
        for s in (-1.0, 1.0):
            mine = wrong[(axis == k) & (sign == s)]
            among = source.facing(k, s) if len(mine) else None
            if among is None:
                continue
            other_face, other_point = among.closest(points[mine])
            apart, other_apart = (np.linalg.norm(at - points[mine], axis=1) for at in (point[mine], other_point))
            sheet = (apart <= reach[mine]) & (other_apart > reach[mine])
            better = (dot(source.face_normals[other_face], normals[mine]) > AGREEMENT) & ~sheet
            face[mine[better]], point[mine[better]] = other_face[better], other_point[better]
    return face, point


def _slide_off_edges(
    points: np.ndarray, normals: np.ndarray, source: Source, met: np.ndarray, face: np.ndarray, barycentric: np.ndarray
) -> None:
    """Where a ray met (n,) bool a slanted face from afar, take the nearest place instead if it agrees; changes face,
    barycentric.

    At a crease that remeshing cut off, the normal leads past the edge to a place well away from the nearest one.
    """
    cosine = dot(source.normals_of(face), normals)
    slanted = np.flatnonzero(met & (cosine > AGREEMENT) & (cosine < 0.99))
    away = source.at(face[slanted], barycentric[slanted], source.vertices) - points[slanted]
    # How far beside the nearest place the ray went, were the face a plane.
    beside = np.sqrt(dot(away, away) * np.maximum(1 - cosine[slanted] ** 2, 0))
    slanted = slanted[beside > 2e-5 * source.extent]
    if not len(slanted):
        return
    nearest_face, nearest = source.nearest.closest(points[slanted])
    agrees = dot(source.face_normals[nearest_face], normals[slanted]) > AGREEMENT
    slanted, nearest_face, nearest = slanted[agrees], nearest_face[agrees], nearest[agrees]
    face[slanted] = nearest_face
    barycentric[slanted] = barycentric_of(nearest, source.vertices[source.faces[nearest_face]])


def _turn_over(source: Source, places: np.ndarray, face: np.ndarray, barycentric: np.ndarray) -> None:
    """Move those of the places (k,) that lie on a face with a twin to the twin; changes face, barycentric."""
    if not len(places):
        return
    twin = source.twins[face[places]]
    places, twin = places[twin >= 0], twin[twin >= 0]
    at = source.at(face[places], barycentric[places], source.vertices)
    face[places], barycentric[places] = twin, barycentric_of(at, source.vertices[source.faces[twin]])


def reproject(points: np.ndarray, normals: np.ndarray, reach: np.ndarray, source: Source) -> Places:
    """Where points (n, 3) with unit normals (n, 3) of the baked mesh lie on the source.

    The nearest face along the normal, outward or inward within reach (n,), that looks the same way; the nearest such
    place in any direction where the normal meets none. So nothing is read from the other side of a thin wall. A sheet
    without another side is read from behind, and nothing through it."""
    start = 2e-5 * source.extent
    face, distance, barycentric, behind = _march(points, -normals, normals, reach, source, start, through=False)
    # Two sheets that look the same way have a third between them: outward cannot be nearer than what is this near.
    rest = np.flatnonzero(distance > 5e-4 * source.extent)
    out_face, out_distance, out_at, _ = _march(
        points[rest], normals[rest], normals[rest], np.minimum(reach, distance)[rest], source, start
    )
    outward = (out_face >= 0) & (out_distance < distance[rest])
    face[rest[outward]], distance[rest[outward]], barycentric[rest[outward]] = (
        out_face[outward],
        out_distance[outward],
        out_at[outward],
    )
    # Inside something whose front is not there: a sheet with one side, unless its other side lies on it.
    behind = behind[np.isinf(distance[behind])]
    _turn_over(source, behind, face, barycentric)
    lost = np.flatnonzero(face < 0)
    if len(lost):
        face[lost], nearest = _nearest_agreeing(points[lost], normals[lost], reach[lost], source)
        barycentric[lost] = barycentric_of(nearest, source.vertices[source.faces[face[lost]]])
    by_ray, from_behind = np.ones(len(points), bool), np.zeros(len(points), bool)
    by_ray[lost] = False
    _slide_off_edges(points, normals, source, by_ray, face, barycentric)
    for some in (behind, lost):
        from_behind[some] = dot(source.normals_of(face[some]), normals[some]) <= 0
    return Places(face, barycentric, by_ray, from_behind)
