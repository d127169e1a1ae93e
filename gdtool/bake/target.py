"""Describe the mesh that maps are baked for: its triangles, shading frames and texels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from gdtool.core.threads import mapped
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.tangents import corner_tangents, edge_pairs, tangent_frames
from gdtool.geometry.uv_raster import Barycentrics, between_centres, centres_in, extend_owners, owners_of

CREASE_DEGREES = 45.0  # smooth normals are split along edges that bend more
# Texels in one batch: few enough for the cache, and enough for libigl to use all cores, as it does from 10,000 points
# on. It holds Python's lock while it searches for nearest points.
TEXELS_AT_ONCE = 65_536
# A texel wider than this many times the source's detail needs more than one sample (docs/numerics.md).
COARSE_TEXEL = 3.0


def corner_normals(mesh: TriMesh, crease_degrees: float = CREASE_DEGREES) -> np.ndarray:
    """Compute shading normals (t, 3, 3) float64 of triangles' corners, split along edges that bend by crease_degrees.

    A vertex's faces are weighted by their angles there (Thürmer & Wüthrich 1998).
    """
    vertices, faces = mesh.vertices, mesh.faces
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    normals, area = face_normals(mesh)
    count = len(faces)
    first, second = edge_pairs(faces)
    # A triangle without area has no normal: it joins its neighbours.
    smooth = (normals[first // 3] * normals[second // 3]).sum(1) > np.cos(np.radians(crease_degrees))
    smooth |= (area[first // 3] == 0) | (area[second // 3] == 0)
    first, second = first[smooth], second[smooth]
    following = np.arange(count * 3).reshape(count, 3)[:, [1, 2, 0]].ravel()
    a, b = np.concatenate([first, following[first]]), np.concatenate([following[second], second])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(count * 3, count * 3))
    group = connected_components(graph, directed=False)[1]
    corners = vertices[faces]
    before, after = np.roll(corners, 1, 1) - corners, np.roll(corners, -1, 1) - corners
    scale = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    angle = np.arccos(np.clip((before * after).sum(-1) / np.maximum(scale, 1e-300), -1, 1)) * (area > 0)[:, None]
    weighted = (normals[:, None] * angle[..., None]).reshape(-1, 3)
    total = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], 1)[group]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    flat = np.repeat(normals, 3, 0)
    out = np.where(length > 1e-12, total / np.maximum(length, 1e-300), flat)
    out[np.linalg.norm(out, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return out.reshape(count, 3, 3)


class SurfaceModes(Protocol):
    """The glTF material settings alpha mode, alpha cutoff and double-sided; bake.origin.Origin has them."""

    @property
    def alpha_mode(self) -> str:
        """OPAQUE, MASK or BLEND."""

    @property
    def alpha_cutoff(self) -> float:
        """Alpha at or above which MASK shows a texel, 0 to 1."""

    @property
    def double_sided(self) -> bool:
        """Whether faces are seen from both sides."""


class CornerNormals(NamedTuple):
    """Shading normals of a quad mesh: idx (f, 4) into normals (n, 3); -1 for a triangle's fourth corner."""

    idx: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class Target:
    """Triangles with texture coordinates and the frames that a normal map is encoded in.

    mesh: vertices (v, 3), faces (t, 3). uv (c, 2), with (0, 0) at the image's top left; face_uvs (t, 3) into uv.
    normals (t, 3, 3) unit and tangents (t, 3, 4) of the triangles' corners.
    """

    mesh: TriMesh
    uv: np.ndarray
    face_uvs: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray

    @classmethod
    def of(
        cls,
        mesh: TriMesh,
        uv: np.ndarray,
        face_uvs: np.ndarray,
        crease_degrees: float = CREASE_DEGREES,
    ) -> Target:
        """Make the target of a triangle mesh: smooth normals split at creases, and MikkTSpace tangents."""
        normals = corner_normals(mesh, crease_degrees)
        normal_idx = np.arange(len(mesh.faces) * 3).reshape(-1, 3)
        tangents = corner_tangents(mesh, normals.reshape(-1, 3), uv, face_uvs, normal_idx)
        return cls(mesh, uv, face_uvs, normals, tangents)

    @cached_property
    def packed(self) -> np.ndarray:
        """Gather the corners of the triangles as (3, 10, t) float32: position, normal, tangent and its handedness."""
        corners = np.concatenate([self.mesh.vertices[self.mesh.faces], self.normals, self.tangents], -1)
        return np.ascontiguousarray(corners.transpose(1, 2, 0), np.float32)


@dataclass(frozen=True)
class Texels:
    """The texels to bake: texel (n,) row-major indices, face_idx (n,) int32, barycentric (n, 3) float32.

    Triangles cover the first `inside` of them. The others lie just outside the charts, where a triangle is extended:
    bilinear lookups at a chart's border read them.
    """

    size: int
    texel: np.ndarray
    face_idx: np.ndarray
    barycentric: np.ndarray
    inside: int

    def __len__(self) -> int:
        return len(self.texel)

    def mask(self, inside_only: bool = False) -> np.ndarray:
        """Make an image (size, size) bool that is True at these texels."""
        out = np.zeros(self.size * self.size, bool)
        out[self.texel[: self.inside] if inside_only else self.texel] = True
        return out.reshape(self.size, self.size)

    def image(self, values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        """Make an image (size, size, …) of values (n, …) of these texels; other texels are `fill`."""
        out = np.zeros((self.size * self.size, *values.shape[1:]), values.dtype)
        if fill:
            out[:] = fill
        out[self.texel] = values
        return out.reshape(self.size, self.size, *values.shape[1:])


def texels_of(target: Target, size: int, rings: int = 2, threads: int = 1) -> Texels:
    """Rasterise the target's charts into a map of size x size, and `rings` of texels around them.

    A chart that is too thin to cover texel centres gets the texels that it passes through. Where no chart covers any
    centre at all, there are no texels.
    """
    barycentrics = Barycentrics(target.uv, target.face_uvs)
    owner = owners_of(target.uv, target.face_uvs, size)
    if owner.max() >= 0:
        texel, face = between_centres(target.uv, target.face_uvs, owner.reshape(size, size))
        owner[texel] = face
    inside = np.flatnonzero(owner >= 0).astype(np.int32 if size <= 32768 else np.int64)
    ring, ring_owner, ring_at = extend_owners(barycentrics, owner.reshape(size, size), rings)
    face_idx = np.concatenate([owner[inside], ring_owner])
    at = np.empty((len(face_idx), 3), np.float32)

    def place(part: slice) -> None:
        at[part] = centres_in(barycentrics, face_idx[part], inside[part], size)

    for _ in mapped(
        place,
        [slice(s, min(s + 2 * TEXELS_AT_ONCE, len(inside))) for s in range(0, len(inside), 2 * TEXELS_AT_ONCE)],
        threads,
    ):
        pass
    at[len(inside) :] = ring_at
    return Texels(size, np.concatenate([inside, ring.astype(inside.dtype)]), face_idx, at, len(inside))


def surface_at(
    target: Target, face_idx: np.ndarray, barycentric: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate positions, normals, tangents (n, 3) and handedness (n,) at points of the target, float32.

    Normals and tangents are not made unit, as viewers interpolate them (see tangents.tangent_frames). Each component is
    contiguous in memory, so that sums over components are fast.
    """
    first, *others = target.packed
    face_idx, weights = np.asarray(face_idx, np.intp), np.ascontiguousarray(barycentric.T, np.float32)
    out, more = np.empty((9, len(face_idx)), np.float32), np.empty(len(face_idx), np.float32)
    for component, values in enumerate(out):
        # With mode "raise", numpy would buffer the output.
        np.take(first[component], face_idx, out=values, mode="clip")
        values *= weights[0]
        for corner, weight in zip(others, weights[1:], strict=True):
            np.take(corner[component], face_idx, out=more, mode="clip")
            more *= weight
            values += more
    return out[:3].T, out[3:6].T, out[6:].T, np.take(first[9], face_idx)


def points_at(target: Target, face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate positions (n, 3) and tangent frames (n, 3, 3) at points of the target.

    The columns of a frame are tangent, bitangent and normal.
    """
    points, normal, tangent, sign = surface_at(target, face_idx, barycentric)
    return points, tangent_frames(normal, tangent, sign)


def texel_width(target: Target, size: int) -> float:
    """Compute the mean width of a texel of a size x size map on the target, in its units: √(area / texels)."""
    area = target.mesh.area
    u, v = (target.uv[target.face_uvs[:, k]] - target.uv[target.face_uvs[:, 0]] for k in (1, 2))
    covered = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()
    return float(np.sqrt(area / max(covered, 1e-12)) / size)


def size_for(target: Target, detail: float, least: int = 256, most: int = 4096) -> int:
    """Choose the side of the maps: the least power of two whose texels span at most 1.1 `detail`, within bounds.

    detail: width of the source's finest detail, in the target's units.
    """
    wanted = texel_width(target, 1) / max(detail, 1e-9) / 1.1
    return int(np.clip(2 ** np.ceil(np.log2(max(wanted, 1))), least, most))


def size_and_samples(target: Target, detail: float, size: int | None, samples: int | None) -> tuple[int, int]:
    """Choose the side of the maps in texels, and the samples per texel where the source varies.

    detail: width of the source's finest detail, in the target's units. A size or number of samples that is not None is
    kept; samples are rounded to a square number.
    """
    size = size or size_for(target, detail)
    if samples is None:
        return size, samples_for(texel_width(target, size), detail)
    return size, round(samples**0.5) ** 2


def samples_for(width: float, detail: float) -> int:
    """Choose the samples per texel: 4 where a texel is more than COARSE_TEXEL times as wide as the detail, else 1.

    width, detail: both in the same unit.
    """
    return 4 if width > COARSE_TEXEL * detail else 1
