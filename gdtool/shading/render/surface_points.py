"""Look up a scene's material at points of its triangles (glTF 2.0 metallic-roughness).

Inside this module the vectors of n points are arrays (3, n), so that each component is contiguous in memory. They are
float32, except where texture coordinates need float64. Results are transposed views (n, 3).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from gdtool.assets.scene import Material, Scene, Texture
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.vectors import dot
from gdtool.shading.render.textures import TextureReader, same_layout

ATTRIBUTES = ("albedo", "roughness", "metallic", "normal", "geometric_normal", "alpha", "emissive")


def _interpolated(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate values (c, v) at corners (3, n) by barycentric weights (3, n): (c, n)."""
    out = np.take(values, corners[0], axis=1)
    out *= weights[0]
    for i in (1, 2):
        more = np.take(values, corners[i], axis=1)
        more *= weights[i]
        out += more
    return out


def _columns(values: np.ndarray, dtype=np.float32) -> np.ndarray:
    """Transpose (n, c) to contiguous (c, n)."""
    return np.ascontiguousarray(np.asarray(values).T, dtype)


@dataclass
class _SurfacePoints:
    """Hold n points on the surface.

    face_idx (n,). corners (3, n): vertex indices. exact, weights (3, n): barycentric coordinates in float64 and in
    float32. footprint (n,): width in world units of the area that a point stands for, or None.
    """

    face_idx: np.ndarray
    corners: np.ndarray
    exact: np.ndarray
    weights: np.ndarray
    footprint: np.ndarray | None

    def __len__(self) -> int:
        return len(self.face_idx)

    def part(self, chosen: np.ndarray | slice) -> _SurfacePoints:
        """Return the points with these indices (m,)."""
        return _SurfacePoints(
            self.face_idx[chosen],
            self.corners[:, chosen],
            self.exact[:, chosen],
            self.weights[:, chosen],
            None if self.footprint is None else self.footprint[chosen],
        )


class SurfaceLookup:
    """Look up one scene's materials. Mip levels and tangents are made when first needed. Thread-safe."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.face_normals, self.face_areas = face_normals(TriMesh(scene.vertices, scene.faces))
        self._readers: dict[tuple[int, ...], TextureReader] = {}
        self._constants: dict[int, np.ndarray | None] = {}
        self.skip_constant = True
        self._lock = threading.RLock()
        self._uv_areas: dict[int, np.ndarray] = {}
        self._tangents: dict[int, np.ndarray] = {}
        self._faces = np.ascontiguousarray(scene.faces.T)
        self._flat = _columns(self.face_normals)
        self._normals, self._colors = (None if x is None else _columns(x) for x in (scene.normals, scene.colors))
        self._uvs = [_columns(uv, np.float64) for uv in scene.uvs]

    def alpha_faces(self) -> np.ndarray:
        """Find the faces whose material is alpha-tested, MASK or BLEND: (f,) bool."""
        tested = np.array([m.alpha_mode != "OPAQUE" for m in self.scene.materials] or [False])
        return tested[self.scene.material_idx]

    def _reader(self, *textures: Texture) -> TextureReader:
        """Return the reader of textures that have one layout (see same_layout). The first call makes it."""
        key = tuple(id(t) for t in textures)
        with self._lock:
            if key not in self._readers:
                self._readers[key] = TextureReader(*textures)
            return self._readers[key]

    def constant(self, texture: Texture) -> np.ndarray | None:
        """Return the linear value (c,) of a texture whose texels are all the same, else None."""
        if id(texture) not in self._constants:
            texels = texture.image.reshape(-1, 1 if texture.image.ndim == 2 else texture.image.shape[2])
            scatter = texels[:: max(1, len(texels) // 64)]
            same = bool((scatter == texels[0]).all() and (texels == texels[0]).all())
            self._constants[id(texture)] = TextureReader(texture).stored(np.zeros(1, np.int64))[0] if same else None
        return self._constants[id(texture)]

    def _uv(self, texture: Texture) -> np.ndarray | None:
        """Return the texture's UV set (v, 2), or None where the scene lacks it."""
        sets = self.scene.uvs
        return sets[texture.uv_set] if texture.uv_set < len(sets) else None

    def _density(self, texture: Texture, face_idx: np.ndarray) -> np.ndarray:
        """Compute texels per world unit (n,) on faces: the square root of the ratio of areas."""
        with self._lock:
            self._measure_uv(texture)
        height, width = texture.image.shape[:2]
        stretch = abs(texture.scale[0] * texture.scale[1]) * height * width
        return np.sqrt(self._uv_areas[texture.uv_set][face_idx] * stretch)

    def _measure_uv(self, texture: Texture) -> None:
        """Compute the ratio (f,) of each face's area in the texture's UV set to its area in world units, once a set."""
        if texture.uv_set not in self._uv_areas:
            a, b, c = (self._uv(texture)[self.scene.faces[:, i]] for i in range(3))
            u, v = b - a, c - a
            area = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
            self._uv_areas[texture.uv_set] = area / np.maximum(self.face_areas, 1e-300)

    def _surface_points(
        self, face_idx: np.ndarray, barycentric: np.ndarray, footprint: np.ndarray | None = None
    ) -> _SurfacePoints:
        """Make surface points from faces (n,) and barycentric coordinates (n, 3)."""
        face_idx, exact = np.asarray(face_idx, np.intp), _columns(barycentric, np.float64)
        return _SurfacePoints(
            face_idx, np.take(self._faces, face_idx, axis=1), exact, exact.astype(np.float32), footprint
        )

    def _read(self, textures: dict[str, Texture | None], at: _SurfacePoints) -> dict[str, np.ndarray]:
        """Read textures at n surface points: linear texels (c, n) by name.

        A texture that is None, or whose UV set the scene lacks, is left out. Textures of one layout are read together.
        """
        layouts: dict[tuple, list[str]] = {}
        out: dict[str, np.ndarray] = {}
        for name, texture in textures.items():
            if texture is None or self._uv(texture) is None:
                continue
            value = self.constant(texture) if self.skip_constant else None
            if value is None:
                layouts.setdefault(same_layout(texture), []).append(name)
            else:
                out[name] = np.broadcast_to(value[:, None], (len(value), len(at)))
        uvs = {}
        for names in layouts.values():
            texture = textures[names[0]]
            if texture.uv_set not in uvs:
                uvs[texture.uv_set] = _interpolated(self._uvs[texture.uv_set], at.corners, at.exact).T
            width = None if at.footprint is None else at.footprint * self._density(texture, at.face_idx)
            reader = self._reader(*(textures[name] for name in names))
            texels = reader.read(uvs[texture.uv_set], width).T
            out |= {name: texels[part] for name, part in zip(names, reader.parts, strict=True)}
        return out

    def _shading_normals(self, at: _SurfacePoints) -> np.ndarray:
        """Interpolate unit vertex normals (3, n); the face's normal where there are none, or where they cancel."""
        if self._normals is None:
            return np.take(self._flat, at.face_idx, axis=1)
        smooth = _interpolated(self._normals, at.corners, at.weights)
        length = np.sqrt(dot(smooth, smooth))
        vanishing = np.flatnonzero(length <= 1e-6)
        if len(vanishing):
            smooth[:, vanishing], length[vanishing] = self._flat[:, at.face_idx[vanishing]], 1.0
        smooth /= length
        return smooth

    def _tangent(self, texture: Texture, at: _SurfacePoints) -> np.ndarray:
        """Interpolate tangents with handedness (4, n): the file's, else MikkTSpace's for the texture's UV set."""
        with self._lock:
            self._make_tangents(texture)
        values = self._tangents[texture.uv_set]
        corners = at.corners if values.shape[1] == len(self.scene.vertices) else [3 * at.face_idx + i for i in range(3)]
        out = np.empty((4, len(at)), np.float32)
        out[:3] = _interpolated(values[:3], corners, at.weights)
        out[3] = np.where(np.take(values[3], corners[0]) < 0, np.float32(-1), np.float32(1))
        return out

    def _make_tangents(self, texture: Texture) -> None:
        """Make the tangents of a UV set: (4, v) at vertices where the file has them, else (4, 3 f) at face corners."""
        if texture.uv_set in self._tangents:
            return
        scene = self.scene
        if scene.tangents is not None and texture.uv_set == 0:
            self._tangents[0] = _columns(scene.tangents)
            return
        from gdtool.geometry.tangents import corner_tangents

        flat = scene.normals is None
        normals = self.face_normals if scene.normals is None else scene.normals
        normal_idx = np.repeat(np.arange(len(scene.faces))[:, None], 3, 1) if flat else None
        tangents = corner_tangents(
            TriMesh(scene.vertices, scene.faces), normals, self._uv(texture), scene.faces, normal_idx
        )
        self._tangents[texture.uv_set] = _columns(tangents.reshape(-1, 4))

    def _normal_mapped(
        self, texture: Texture, scale: float, texel: np.ndarray, normal: np.ndarray, tangent: np.ndarray
    ) -> np.ndarray:
        """Apply a normal map: unit normals (3, n) from its texels (c, n), vertex normals (3, n) and tangents (4, n)."""
        along, across, up = (np.float32(2) * texel[i] - np.float32(1) for i in range(3))
        if scale != 1.0:
            along, across = along * np.float32(scale), across * np.float32(scale)
        c, s = np.cos(texture.rotation), np.sin(texture.rotation)
        if s != 0.0 or texture.scale[0] < 0 or texture.scale[1] < 0:
            # The texture transform turns the map's axes: turn the perturbation back to the UV's axes.
            along, across = (
                along * np.float32(np.sign(texture.scale[0])),
                across * np.float32(np.sign(texture.scale[1])),
            )
            c, s = np.float32(c), np.float32(s)
            along, across = c * along + s * across, -s * along + c * across
        across *= tangent[3]
        out = np.empty_like(normal)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            bitangent = normal[j] * tangent[k]
            bitangent -= normal[k] * tangent[j]
            bitangent *= across
            bitangent += along * tangent[i]
            bitangent += up * normal[i]
            out[i] = bitangent
        out /= np.maximum(np.sqrt(dot(out, out)), np.float32(1e-30))
        return out

    def alpha(self, face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Look up alpha (n,), and the cutoff (n,) below which a point is absent.

        The cutoff is 0 for OPAQUE materials, the material's for MASK, and 0.5 for BLEND.
        """
        scene, at = self.scene, self._surface_points(face_idx, barycentric)
        alpha, cutoff = np.ones(len(at), np.float32), np.zeros(len(at), np.float32)
        owner = scene.material_idx[at.face_idx]
        for m in np.unique(owner):
            material = scene.materials[m]
            if material.alpha_mode == "OPAQUE":
                continue
            chosen = np.flatnonzero(owner == m)
            here = at.part(chosen)
            value = np.full(len(chosen), material.base_color[3], np.float32)
            texel = self._read({"color": material.base_color_texture}, here).get("color")
            if texel is not None and len(texel) in (2, 4):
                value *= texel[-1]
            if self._colors is not None:
                value *= _interpolated(self._colors[3:], here.corners, here.weights)[0]
            alpha[chosen] = value
            cutoff[chosen] = material.alpha_cutoff if material.alpha_mode == "MASK" else 0.5
        return alpha, cutoff

    def attributes(
        self,
        face_idx: np.ndarray,
        barycentric: np.ndarray,
        footprint: np.ndarray | None = None,
        directions: np.ndarray | None = None,
        emission: bool = True,
    ) -> dict[str, np.ndarray]:
        """Look up all attributes of n points.

        Args:
            face_idx: (n,) faces.
            barycentric: (n, 3) coordinates on them.
            footprint: (n,) widths in world units of the areas that the points stand for; they choose the mip level.
            directions: (n, 3) rays that see the points. Normals are then turned to the side that is seen, as glTF asks
                for double-sided materials. This is done for all materials, since files whose winding and normals
                disagree are common.
            emission: whether to look up the emission; it is 0 otherwise.

        Returns:
            albedo and emissive (n, 3) linear, roughness, metallic and alpha (n,), normal and geometric_normal (n, 3)
                unit, f0 and f90 (n,) of the dielectric part at normal and grazing incidence (KHR_materials_ior,
                _specular), all float32; unlit (n,) bool.
        """
        scene, n = self.scene, len(face_idx)
        points = self._surface_points(
            face_idx, barycentric, None if footprint is None else np.broadcast_to(footprint, (n,))
        )
        out = _Attributes.empty(n)
        vertex_normal = self._shading_normals(points)
        normal = vertex_normal
        owner = scene.material_idx[points.face_idx]
        present = np.flatnonzero(np.bincount(owner))
        for m in present:
            material = scene.materials[m]
            alone = len(present) == 1
            at = slice(None) if alone else np.flatnonzero(owner == m)
            here = points if alone else points.part(at)
            shines = emission and any(material.emissive)
            texels = self._read(
                {
                    "color": material.base_color_texture,
                    "surface": material.metallic_roughness_texture,
                    "normal": material.normal_texture,
                    "emissive": material.emissive_texture if shines else None,
                },
                here,
            )
            self._fill(out, at, material, texels, here)
            if shines:
                texel = texels.get("emissive")
                out.emissive[:, at] = np.asarray(material.emissive, np.float32)[:, None] * (
                    texel[:3] if texel is not None else np.float32(1)
                )
            texel = texels.get("normal")
            if texel is not None and len(texel) >= 3:
                mapped = self._normal_mapped(
                    material.normal_texture,
                    material.normal_scale,
                    texel,
                    vertex_normal[:, at],
                    self._tangent(material.normal_texture, here),
                )
                if normal is vertex_normal:
                    normal = mapped if alone else vertex_normal.copy()
                if not alone:
                    normal[:, at] = mapped
        geometric = np.take(self._flat, points.face_idx, axis=1)
        if directions is not None:
            side = dot(geometric, directions.T)
            geometric = geometric * np.where(side > 0, np.float32(-1), np.float32(1))
            normal = normal * np.where(dot(vertex_normal, geometric) < 0, np.float32(-1), np.float32(1))
        return out.as_dict(normal, geometric)

    def _fill(
        self, out: _Attributes, at, material: Material, texels: dict[str, np.ndarray], here: _SurfacePoints
    ) -> None:
        """Fill the attributes of points of one material, except for their normals and emission.

        at: index of the points in out. texels: what _read() returned for these points, which are `here`.
        """
        color = np.repeat(np.asarray(material.base_color, np.float32)[:, None], len(here), 1)
        texel = texels.get("color")
        if texel is not None:
            color[:3] *= texel[:3] if len(texel) >= 3 else texel[:1]
            if len(texel) in (2, 4):
                color[3] *= texel[-1]
        if self._colors is not None:
            color *= _interpolated(self._colors, here.corners, here.weights)
        out.albedo[:, at] = color[:3]
        if material.alpha_mode != "OPAQUE":
            out.alpha[at] = color[3]
        texel = texels.get("surface")
        textured = texel is not None and len(texel) >= 3
        out.roughness[at] = np.float32(material.roughness) * (texel[1] if textured else np.float32(1))
        out.metallic[at] = np.float32(material.metallic) * (texel[2] if textured else np.float32(1))
        out.unlit[at] = material.unlit
        out.f0[at] = min(((material.ior - 1) / (material.ior + 1)) ** 2 * material.specular, 1.0)
        out.f90[at] = min(material.specular, 1.0)


@dataclass
class _Attributes:
    """Collect the attributes of n points: vectors (3, n), scalars (n,)."""

    albedo: np.ndarray
    emissive: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    alpha: np.ndarray
    unlit: np.ndarray
    f0: np.ndarray
    f90: np.ndarray

    @classmethod
    def empty(cls, n: int) -> _Attributes:
        """Allocate the attributes of n points: opaque, lit and without emission."""
        return cls(
            albedo=np.empty((3, n), np.float32),
            emissive=np.zeros((3, n), np.float32),
            roughness=np.empty(n, np.float32),
            metallic=np.empty(n, np.float32),
            alpha=np.ones(n, np.float32),
            unlit=np.zeros(n, bool),
            f0=np.empty(n, np.float32),
            f90=np.empty(n, np.float32),
        )

    def as_dict(self, normal: np.ndarray, geometric: np.ndarray) -> dict[str, np.ndarray]:
        """Clip the attributes to their ranges, and return them and the normals (3, n) by name; vectors are (n, 3)."""
        for values in (self.albedo, self.roughness, self.metallic, self.alpha):
            np.clip(values, 0, 1, out=values)
        return {
            "albedo": self.albedo.T,
            "roughness": self.roughness,
            "metallic": self.metallic,
            "alpha": self.alpha,
            "emissive": np.maximum(self.emissive, 0).T,
            "unlit": self.unlit,
            "f0": self.f0,
            "f90": self.f90,
            "normal": normal.T,
            "geometric_normal": geometric.T,
        }


def surface_attributes(
    scene: Scene, face_idx: np.ndarray, barycentric: np.ndarray, footprint: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Look up the attributes of n points of a scene, as SurfaceLookup.attributes does, without keeping the lookup."""
    return SurfaceLookup(scene).attributes(np.asarray(face_idx), np.asarray(barycentric, np.float64), footprint)
