"""Rotate edges so that pairs of irregular vertices (one of three edges, one of five) meet and cancel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gdtool.geometry.mesh_quality import valences
from gdtool.geometry.meshes import QuadMesh

_MAX_STEPS = 3, 6, 10  # rotations in one direction, by round over all pairs: the nearest pairs meet first
_FLAT_COSINE = 0.8  # least cosine between the normals of two quads whose edge may rotate: creases stay


def cancel_pairs(mesh: QuadMesh) -> np.ndarray:
    """Cancel pairs of irregular vertices by rotating edges; return the new faces (q, 4).

    mesh: a manifold of quads. Rotating an edge moves such a pair by an edge and leaves regular quads behind (Peng et
    al. 2011, Connectivity editing for quadrilateral meshes). Each pair is moved in each direction until a rotation
    beside it leaves fewer irregular vertices; if none does, the pair is put back. Faces that are not consistently
    oriented are returned unchanged.
    """
    vertices, faces = mesh.vertices, mesh.faces
    valence, inner = valences(faces, len(vertices))
    rotatable = _RotatableMesh(vertices, faces, valence, inner)
    if not rotatable.is_oriented():
        return faces
    for steps in _MAX_STEPS:
        for vertex in np.flatnonzero(inner & (np.array(rotatable.valence) > 4)).tolist():
            rotatable.apply_gains(vertex)
            direction = 0
            while rotatable.valence[vertex] > 4 and rotatable.move_pair(vertex, direction, steps) is False:
                direction += 1
    return np.array(rotatable.faces, faces.dtype)


@dataclass(frozen=True)
class _Rotation:
    """A rotation of the edge between two faces within the hexagon that they form.

    The edge `old` is replaced by the edge `new` between two other corners of the hexagon. before, after: the corners of
    the two faces.
    """

    old: tuple[int, int]
    new: tuple[int, int]
    faces: tuple[int, int]
    before: tuple[tuple[int, ...], tuple[int, ...]]  # their corners
    after: tuple[tuple[int, ...], tuple[int, ...]]

    def inverse(self) -> _Rotation:
        """Return the rotation that undoes this one."""
        return _Rotation(self.new, self.old, self.faces, self.after, self.before)


class _RotatableMesh:
    """Quads whose edges can be rotated, as Python lists: single rotations are quicker on them than on arrays."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, valence: np.ndarray, inner: np.ndarray):
        self.faces, self.valence, self._inner = (
            [tuple(face) for face in faces.tolist()],
            valence.tolist(),
            inner.tolist(),
        )
        self._points = vertices.tolist()
        self._face_of: dict[tuple[int, int], int] = {}  # the face that traverses an edge in this direction
        self._face_at = [0] * len(valence)  # one of the faces around each vertex
        for k in range(len(self.faces)):
            self._register(k)

    def is_oriented(self) -> bool:
        """Return whether no two faces traverse an edge in the same direction."""
        return len(self._face_of) == 4 * len(self.faces)

    def apply_gains(self, *vertices: int) -> bool:
        """Apply rotations around `vertices` while any leaves fewer irregular vertices; return whether any did."""
        any_applied = False
        while rotation := next(
            (
                rotation_found
                for vertex in vertices
                for other in self._neighbours(vertex)
                for rotation_found in self._rotations(vertex, other)
            ),
            None,
        ):
            self._apply(rotation)
            any_applied = True
        return any_applied

    def move_pair(self, vertex: int, direction: int, steps: int) -> bool | None:
        """Move the irregular pair at a vertex in one of its directions until it cancels with others.

        direction: index among the possible first rotations. steps: the most rotations. Returns True where the pair
        cancelled, False where it was put back, and None where there is no such direction.
        """
        path: list[_Rotation] = []
        for _ in range(steps):
            rotations = [
                rotation
                for rotation in self._neutral_rotations(vertex)
                if not path or set(rotation.new) != set(path[-1].old)
            ]
            rotation = next(iter(rotations[0 if path else direction :]), None)
            if rotation is None:
                if not path:
                    return None
                break
            self._apply(rotation)
            path.append(rotation)
            if self.apply_gains(*rotation.old, *rotation.new):
                return True
            vertex = max(rotation.new, key=self.valence.__getitem__)
        for rotation in reversed(path):
            self._apply(rotation.inverse())
        return False

    def _neutral_rotations(self, vertex: int) -> Iterator[_Rotation]:
        """Yield rotations that add an edge to a vertex of three and leave the number of irregular vertices the same."""
        for other in self._neighbours(vertex):
            yield from self._rotations(vertex, other, neutral=True)

    def _rotations(self, p: int, q: int, neutral: bool = False) -> Iterator[_Rotation]:
        """Yield the rotations of the edge (p, q) that keep the quads a manifold without vertices of two edges.

        Only those that leave fewer irregular vertices; with `neutral`, those that leave as many and add an edge to a
        vertex of three.
        """
        valence, inner = self.valence, self._inner
        if valence[p] < 4 or valence[q] < 4 or not (inner[p] and inner[q]):
            return
        fewer = (valence[p] > 4) + (valence[q] > 4)  # ends whose valence comes nearer to four
        if not fewer and not neutral:
            return  # the other two corners gain no more than these lose
        first, second = self._face_of[p, q], self._face_of[q, p]
        r, s, t, u = *self._next_corners(first, q), *self._next_corners(second, p)
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
                or not self._flat(first, second)
            ):
                continue
            after = ((r, s, p, t), (t, u, q, r)) if x == r else ((s, p, t, u), (u, q, r, s))
            yield _Rotation((p, q), (x, y), (first, second), (self.faces[first], self.faces[second]), after)

    def _flat(self, first: int, second: int) -> bool:
        """Return whether two faces lie in about one plane, so that the edge between them is no crease."""
        (a, b, c), (x, y, z) = self._normal(first), self._normal(second)
        return a * x + b * y + c * z > _FLAT_COSINE

    def _normal(self, face: int) -> tuple[float, float, float]:
        """Return the unit normal of a face: the cross product of its diagonals."""
        a, b, c, d = (self._points[corner] for corner in self.faces[face])
        ux, uy, uz, wx, wy, wz = c[0] - a[0], c[1] - a[1], c[2] - a[2], d[0] - b[0], d[1] - b[1], d[2] - b[2]
        x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        length = (x * x + y * y + z * z) ** 0.5 or 1.0
        return x / length, y / length, z / length

    def _next_corners(self, face: int, vertex: int) -> tuple[int, int]:
        """Return the two corners that follow a vertex in a face."""
        corners = self.faces[face]
        i = corners.index(vertex)
        return corners[(i + 1) % 4], corners[(i + 2) % 4]

    def _neighbours(self, vertex: int) -> list[int]:
        """Return the vertices at the other ends of an inner vertex's edges, in order around it."""
        out: list[int] = []
        face = self._face_at[vertex]
        while not out or face != self._face_at[vertex]:
            corners = self.faces[face]
            out.append(corners[corners.index(vertex) - 1])
            face = self._face_of[vertex, out[-1]]
        return out

    def _apply(self, rotation: _Rotation) -> None:
        """Perform a rotation and update valences."""
        p, q = rotation.old
        del self._face_of[p, q], self._face_of[q, p]
        for face, quad in zip(rotation.faces, rotation.after, strict=True):
            self.faces[face] = quad
            self._register(face)
        for edge, change in ((rotation.old, -1), (rotation.new, 1)):
            for vertex in edge:
                self.valence[vertex] += change

    def _register(self, face: int) -> None:
        """Register the directed edges of a face."""
        corners = self.faces[face]
        for i in range(4):
            self._face_of[corners[i - 1], corners[i]] = face
            self._face_at[corners[i]] = face
