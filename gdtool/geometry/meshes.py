"""Hold a mesh as one value: triangles, or quads with texture coordinates.

Both classes keep the arrays they are given, without a copy or a cast. What is derived from them is computed when it is
first asked for and kept; a pickle, as it goes to a child process, holds the arrays alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from gdtool.geometry.topology import Edges


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Hold a triangle mesh: vertices (v, 3) floating point, faces (f, 3) integers.

    Faces are counter-clockwise seen from outside.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __reduce__(self) -> tuple:
        """Pickle the arrays, not what was derived from them."""
        return TriMesh, (self.vertices, self.faces)

    @cached_property
    def edges(self) -> Edges:
        """Undirected edges and the faces at each."""
        from gdtool.geometry.topology import edges_of

        return edges_of(self.faces)

    @cached_property
    def area(self) -> float:
        """Sum of the areas of all faces."""
        from gdtool.geometry.normals import face_normals

        return face_normals(self)[1].sum()

    @cached_property
    def extent(self) -> float:
        """Longest side of the bounding box of all vertices."""
        return float(np.ptp(self.vertices, axis=0).max())


class Triangulation(NamedTuple):
    """Hold the triangles that faces are cut into: faces (t, 3) int32, and face_idx (t,) int32, the face each comes
    from.
    """

    faces: np.ndarray
    face_idx: np.ndarray


@dataclass(frozen=True, eq=False)
class QuadMesh:
    """Hold a mesh of quads, and triangles where faces[:, 3] is -1; counter-clockwise seen from outside.

    vertices (v, 3) floating point, faces (f, 4) integers. uv (c, 2) in [0, 1], (0, 0) at the image's top left, and
    face_uvs (f, 4) indices into uv, -1 for a triangle's fourth corner; both None without texture coordinates. Files
    store float64 and int32, in the normalised frame.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    face_uvs: np.ndarray | None = None

    def __reduce__(self) -> tuple:
        """Pickle the arrays, not what was derived from them."""
        return QuadMesh, (self.vertices, self.faces, self.uv, self.face_uvs)

    @property
    def is_quad(self) -> np.ndarray:
        """(f,) bool: False for triangles."""
        return self.faces[:, 3] >= 0

    @cached_property
    def edges(self) -> Edges:
        """Undirected edges and the faces at each."""
        from gdtool.geometry.topology import edges_of

        return edges_of(self.faces)

    def texture_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return uv and face_uvs; raise ValueError for a mesh without texture coordinates."""
        if self.uv is None or self.face_uvs is None:
            raise ValueError("the mesh has no texture coordinates")
        return self.uv, self.face_uvs

    @cached_property
    def triangulation(self) -> Triangulation:
        """Triangles of the faces, quads cut along corners 0 and 2."""
        from gdtool.geometry.topology import triangulated

        return Triangulation(*triangulated(self.faces))

    @property
    def triangles(self) -> TriMesh:
        """The triangulation as a mesh with the same vertices."""
        return TriMesh(self.vertices, self.triangulation.faces)


Mesh = TypeVar("Mesh", TriMesh, QuadMesh)  # for functions that return the kind of mesh that they are given
