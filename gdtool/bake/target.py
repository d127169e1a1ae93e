"""The mesh that maps are baked for: its triangles, its shading frames, and its texels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gdtool.core.threads import mapped
from gdtool.geometry.normals import face_normals
from gdtool.geometry.tangents import corner_tangents, edge_pairs, frames_of
from gdtool.geometry.uv_raster import Barycentrics, between_centres, centres_in, extend_owners, owners_of

CREASE_DEGREES = 45.0
# Texels at a time: few enough that what is computed of them stays near the cache, enough that libigl, which looks for
# nearest points while no other thread may run, does so on all cores: it begins at 10,000 points.
TEXELS_AT_ONCE = 65_536
# A texel this many times as wide as the source's detail has too much in it for one sample (docs/numerics.md).
COARSE_TEXEL = 3.0


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease_degrees: float = CREASE_DEGREES) -> np.ndarray:
    """Shading normals (t, 3, 3) float64 of triangles' corners: smooth, but split along edges sharper than
    crease_degrees.

    Faces weighted by their angle at the vertex (Thürmer & Wüthrich 1998).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    normals, area = face_normals(vertices, faces)
    count = len(faces)
    one, two = edge_pairs(faces)
    # A triangle without area has no direction of its own: it joins what it touches.
    smooth = (normals[one // 3] * normals[two // 3]).sum(1) > np.cos(np.radians(crease_degrees))
    smooth |= (area[one // 3] == 0) | (area[two // 3] == 0)
    one, two = one[smooth], two[smooth]
    following = np.arange(count * 3).reshape(count, 3)[:, [1, 2, 0]].ravel()
    a, b = np.concatenate([one, following[one]]), np.concatenate([following[two], two])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(count * 3, count * 3))
    group = connected_components(graph, directed=False)[1]
    corners = vertices[faces]
    before, after = np.roll(corners, 1, 1) - corners, np.roll(corners, -1, 1) - corners
    scale = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    angle = np.arccos(np.clip((before * after).sum(-1) / np.maximum(scale, 1e-300), -1, 1)) * (area > 0)[:, None]
    weighted = (normals[:, None] * angle[..., None]).reshape(-1, 3)
    total = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], 1)[group]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    own = np.repeat(normals, 3, 0)
    out = np.where(length > 1e-12, total / np.maximum(length, 1e-300), own)
    out[np.linalg.norm(out, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return out.reshape(count, 3, 3)


@dataclass(frozen=True)
class Target:
    """Triangles with texture coordinates and the frames that a normal map is encoded in.

    vertices (v, 3), faces (t, 3), uv (c, 2) with (0, 0) at the image's top left, face_uvs (t, 3), normals (t, 3, 3)
    unit and tangents (t, 3, 4) of the corners."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    face_uvs: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        uv: np.ndarray,
        face_uvs: np.ndarray,
        crease_degrees: float = CREASE_DEGREES,
    ) -> Target:
        """Target of a triangle mesh, with smooth normals split at creases and MikkTSpace tangents."""
        normals = corner_normals(vertices, faces, crease_degrees)
        own = np.arange(len(faces) * 3).reshape(-1, 3)
        tangents = corner_tangents(vertices, faces, normals.reshape(-1, 3), uv, face_uvs, own)
        return cls(vertices, faces, uv, face_uvs, normals, tangents)

    @cached_property
    def packed(self) -> np.ndarray:
        """(3, 10, t) float32 of the triangles' corners: position, normal, tangent and its handedness."""
        corners = np.concatenate([self.vertices[self.faces], self.normals, self.tangents], -1)
        return np.ascontiguousarray(corners.transpose(1, 2, 0), np.float32)


@dataclass(frozen=True)
class Texels:
    """The texels to bake: texel (n,) integers row-major, face_idx (n,) int32, barycentric (n, 3) float32.

    The first `inside` of them are owned by their triangle; the others lie just outside the charts, where the triangle
    would go on, for lookups between texel centres at a chart's border.
    """

    size: int
    texel: np.ndarray
    face_idx: np.ndarray
    barycentric: np.ndarray
    inside: int

    def __len__(self) -> int:
        return len(self.texel)

    def mask(self, inside_only: bool = False) -> np.ndarray:
        """(size, size) bool: which texels these are."""
        out = np.zeros(self.size * self.size, bool)
        out[self.texel[: self.inside] if inside_only else self.texel] = True
        return out.reshape(self.size, self.size)

    def image(self, values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        """(size, size, …) image of values (n, …) of these texels."""
        out = np.zeros((self.size * self.size, *values.shape[1:]), values.dtype)
        if fill:
            out[:] = fill
        out[self.texel] = values
        return out.reshape(self.size, self.size, *values.shape[1:])


def texels_of(target: Target, size: int, rings: int = 2, threads: int = 1) -> Texels:
    """Texels of a map of size x size that the target's charts cover, and `rings` of them around the charts.

    Where charts pass between texel centres, too far from any, the texels that they pass through are theirs; where none
    covers a centre there are no texels."""
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
    """Positions (n, 3), normals (n, 3), tangents (n, 3) and handedness (n,) at places on the target, float32, component
    by component in memory: sums over components then run over numbers that lie side by side.

    Normals and tangents as viewers interpolate them, not normalised (see tangents.frames_of)."""
    first, *others = target.packed
    face_idx, weights = np.asarray(face_idx, np.intp), np.ascontiguousarray(barycentric.T, np.float32)
    out, more = np.empty((9, len(face_idx)), np.float32), np.empty(len(face_idx), np.float32)
    for component, values in enumerate(out):
        # "clip": "raise" would read into a copy first.
        np.take(first[component], face_idx, out=values, mode="clip")
        values *= weights[0]
        for corner, weight in zip(others, weights[1:], strict=True):
            np.take(corner[component], face_idx, out=more, mode="clip")
            more *= weight
            values += more
    return out[:3].T, out[3:6].T, out[6:].T, np.take(first[9], face_idx)


def points_at(target: Target, face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and tangent frames (n, 3, 3), columns tangent, bitangent, normal, at places on the target."""
    points, normal, tangent, sign = surface_at(target, face_idx, barycentric)
    return points, frames_of(normal, tangent, sign)


def texel_width(target: Target, size: int) -> float:
    """What a texel of a size x size map spans on the target, in its units: the square root of surface over texels."""
    area = face_normals(target.vertices, target.faces)[1].sum()
    u, v = (target.uv[target.face_uvs[:, k]] - target.uv[target.face_uvs[:, 0]] for k in (1, 2))
    covered = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()
    return float(np.sqrt(area / max(covered, 1e-12)) / size)


def size_for(target: Target, detail: float, least: int = 256, most: int = 4096) -> int:
    """The power of two at which a texel of the map spans about detail, in the target's units: up to a tenth more."""
    wanted = texel_width(target, 1) / max(detail, 1e-9) / 1.1
    return int(np.clip(2 ** np.ceil(np.log2(max(wanted, 1))), least, most))


def samples_for(width: float, detail: float) -> int:
    """How many samples a texel that spans width needs where the source varies, whose detail is so wide (both in one
    unit)."""
    return 4 if width > COARSE_TEXEL * detail else 1
