"""Fewer irregular vertices in a quad mesh: pairs of a vertex of three and one of five edges led to one another, where
they cancel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gdtool.geometry.mesh_quality import valences

_STEPS = 3, 6, 10  # rotations along one way, round by round of all pairs: the nearest come together first
_FLAT_COSINE = 0.8  # between the normals of two quads whose edge may go: creases stay


def cancel_pairs(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Quads (q, 4) of a manifold with as many faces and vertices, fewer of those of other than four edges.

    Such a pair moves on by the rotation of an edge, one way or the other, and leaves regular quads behind (Peng et al.
    2011, Connectivity editing for quadrilateral meshes). Each is led both ways until a rotation beside it leaves less
    that is irregular, or put back. Faces that do not all look the same way out are left as they are."""
    valence, inner = valences(faces, len(vertices))
    net = _Net(vertices, faces, valence, inner)
    if not net.oriented():
        return faces
    for steps in _STEPS:
        for vertex in np.flatnonzero(inner & (np.array(net.valence) > 4)).tolist():
            net.gain_beside(vertex)
            way = 0
            while net.valence[vertex] > 4 and net.lead(vertex, way, steps) is False:
                way += 1
    return np.array(net.faces, faces.dtype)


@dataclass(frozen=True)
class _Turn:
    """The edge `old` between two faces gives way to the edge `new` between two other corners of the hexagon around
    it."""

    old: tuple[int, int]
    new: tuple[int, int]
    faces: tuple[int, int]
    before: tuple[tuple[int, ...], tuple[int, ...]]  # their corners
    after: tuple[tuple[int, ...], tuple[int, ...]]

    def back(self) -> _Turn:
        return _Turn(self.new, self.old, self.faces, self.after, self.before)


class _Net:
    """Quads whose edges can be rotated."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, valence: np.ndarray, inner: np.ndarray):
        self.faces, self.valence, self._inner = (
            [tuple(face) for face in faces.tolist()],
            valence.tolist(),
            inner.tolist(),
        )
        self._points = vertices.tolist()
        self._face_of: dict[tuple[int, int], int] = {}  # which face walks an edge in this direction
        self._face_at = [0] * len(valence)  # one of those around each vertex
        for k in range(len(self.faces)):
            self._enter(k)

    def oriented(self) -> bool:
        """Whether no two faces walk an edge in the same direction."""
        return len(self._face_of) == 4 * len(self.faces)

    def gain_beside(self, *vertices: int) -> bool:
        """Whether there were rotations of edges at vertices that leave less that is irregular; they are done."""
        found = False
        while better := next(
            (one for vertex in vertices for other in self._neighbours(vertex) for one in self._turns(vertex, other)),
            None,
        ):
            self._apply(better)
            found = True
        return found

    def lead(self, vertex: int, way: int, steps: int) -> bool | None:
        """Whether its pair was led that way until it gained; otherwise it is where it was. None where there is no such
        way."""
        path: list[_Turn] = []
        for _ in range(steps):
            ways = [turn for turn in self._neutral(vertex) if not path or set(turn.new) != set(path[-1].old)]
            turn = next(iter(ways[0 if path else way :]), None)
            if turn is None:
                if not path:
                    return None
                break
            self._apply(turn)
            path.append(turn)
            if self.gain_beside(*turn.old, *turn.new):
                return True
            vertex = max(turn.new, key=self.valence.__getitem__)
        for turn in reversed(path):
            self._apply(turn.back())
        return False

    def _neutral(self, vertex: int) -> Iterator[_Turn]:
        """Rotations of its edges that take one from it and give one to a vertex of three, and leave as much that is
        irregular."""
        for other in self._neighbours(vertex):
            yield from self._turns(vertex, other, neutral=True)

    def _turns(self, p: int, q: int, neutral: bool = False) -> Iterator[_Turn]:
        """The two rotations of an edge, those of them that leave quads of a manifold, no vertex of two edges, and less
        that is irregular; or if neutral as much, and one edge more at a vertex of three."""
        valence, inner = self.valence, self._inner
        if valence[p] < 4 or valence[q] < 4 or not (inner[p] and inner[q]):
            return
        fewer = (valence[p] > 4) + (valence[q] > 4)  # ends that will be less off four, and not more
        if not fewer and not neutral:
            return  # the others gain no more than these lose
        one, two = self._face_of[p, q], self._face_of[q, p]
        r, s, t, u = *self._after(one, q), *self._after(two, p)
        for x, y in ((r, t), (s, u)):
            threes = (valence[x] < 4) + (valence[y] < 4)
            if not (
                (fewer + threes == 2 and 3 in (valence[x], valence[y]) if neutral else fewer + threes > 2)
                and inner[x]
                and inner[y]
            ):
                continue
            if (
                (x, y) in self._face_of
                or (y, x) in self._face_of
                or len({p, q, r, s, t, u}) < 6
                or not self._flat(one, two)
            ):
                continue
            after = ((r, s, p, t), (t, u, q, r)) if x == r else ((s, p, t, u), (u, q, r, s))
            yield _Turn((p, q), (x, y), (one, two), (self.faces[one], self.faces[two]), after)

    def _flat(self, one: int, two: int) -> bool:
        """Whether two faces do not turn at the edge between them."""
        (a, b, c), (x, y, z) = self._normal(one), self._normal(two)
        return a * x + b * y + c * z > _FLAT_COSINE

    def _normal(self, face: int) -> tuple[float, float, float]:
        """Unit normal: the diagonals' cross product."""
        a, b, c, d = (self._points[corner] for corner in self.faces[face])
        ux, uy, uz, wx, wy, wz = c[0] - a[0], c[1] - a[1], c[2] - a[2], d[0] - b[0], d[1] - b[1], d[2] - b[2]
        x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        length = (x * x + y * y + z * z) ** 0.5 or 1.0
        return x / length, y / length, z / length

    def _after(self, face: int, vertex: int) -> tuple[int, int]:
        """The two corners that follow this one."""
        corners = self.faces[face]
        i = corners.index(vertex)
        return corners[(i + 1) % 4], corners[(i + 2) % 4]

    def _neighbours(self, vertex: int) -> list[int]:
        """The other ends of the edges of an inner vertex."""
        out, face = [], self._face_at[vertex]
        while not out or face != self._face_at[vertex]:
            corners = self.faces[face]
            out.append(corners[corners.index(vertex) - 1])
            face = self._face_of[vertex, out[-1]]
        return out

    def _apply(self, turn: _Turn) -> None:
        p, q = turn.old
        del self._face_of[p, q], self._face_of[q, p]
        for face, quad in zip(turn.faces, turn.after, strict=True):
            self.faces[face] = quad
            self._enter(face)
        for edge, change in ((turn.old, -1), (turn.new, 1)):
            for vertex in edge:
                self.valence[vertex] += change

    def _enter(self, face: int) -> None:
        corners = self.faces[face]
        for i in range(4):
            self._face_of[corners[i - 1], corners[i]] = face
            self._face_at[corners[i]] = face
