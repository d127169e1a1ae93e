"""What a scene's surface is made of at given points of its triangles (glTF 2.0 metallic-roughness)."""

from __future__ import annotations

import threading

import numpy as np

from gdtool.assets.scene import Scene, Texture
from gdtool.geometry.normals import face_normals
from gdtool.shading.textures import TextureReader, same_layout

ATTRIBUTES = ("albedo", "roughness", "metallic", "normal", "geometric_normal", "alpha", "emissive")


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.sqrt(np.einsum("ij,ij->i", v, v)), 1e-30)[:, None]


def _interpolated(values: np.ndarray, corners: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """(n, c) values (v, c) at the corners (n, 3), by barycentric weights (n, 3)."""
    out = np.take(values, corners[:, 0], axis=0) * barycentric[:, :1]
    for i in (1, 2):
        out += np.take(values, corners[:, i], axis=0) * barycentric[:, i:i + 1]
    return out


class SurfaceLookup:
    """Material lookup of one scene; textures' coarser levels and tangents are made when first needed."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.face_normals, self.face_areas = face_normals(scene.vertices, scene.faces)
        self._readers: dict[tuple[int, ...], TextureReader] = {}
        self._constants: dict[int, np.ndarray | None] = {}
        self.skip_constant = True
        self._lock = threading.RLock()
        self._uv_areas: dict[int, np.ndarray] = {}
        self._tangents: dict[int, np.ndarray] = {}

    def alpha_faces(self) -> np.ndarray:
        """(f,) bool: faces whose material is alpha-tested (MASK or BLEND)."""
        tested = np.array([m.alpha_mode != "OPAQUE" for m in self.scene.materials] or [False])
        return tested[self.scene.material_idx]

    def _reader(self, *textures: Texture) -> TextureReader:
        key = tuple(id(t) for t in textures)
        with self._lock:
            if key not in self._readers:
                self._readers[key] = TextureReader(*textures)
            return self._readers[key]

    def constant(self, texture: Texture) -> np.ndarray | None:
        """(c,) linear value of a texture whose texels are all the same: a factor that was stored as a map."""
        if id(texture) not in self._constants:
            texels = texture.image.reshape(-1, 1 if texture.image.ndim == 2 else texture.image.shape[2])
            scatter = texels[:: max(1, len(texels) // 64)]
            same = bool((scatter == texels[0]).all() and (texels == texels[0]).all())
            self._constants[id(texture)] = TextureReader(texture).stored(np.zeros(1, np.int64))[0] if same else None
        return self._constants[id(texture)]

    def _uv(self, texture: Texture) -> np.ndarray | None:
        sets = self.scene.uvs
        return sets[texture.uv_set] if texture.uv_set < len(sets) else None

    def _density(self, texture: Texture, face_idx: np.ndarray) -> np.ndarray:
        """Texels per world unit (n,) on faces, square root of the ratio of areas."""
        with self._lock:
            self._measure_uv(texture)
        height, width = texture.image.shape[:2]
        stretch = abs(texture.scale[0] * texture.scale[1]) * height * width
        return np.sqrt(self._uv_areas[texture.uv_set][face_idx] * stretch)

    def _measure_uv(self, texture: Texture) -> None:
        if texture.uv_set not in self._uv_areas:
            a, b, c = (self._uv(texture)[self.scene.faces[:, i]] for i in range(3))
            u, v = b - a, c - a
            area = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
            self._uv_areas[texture.uv_set] = area / np.maximum(self.face_areas, 1e-300)

    def _read(self, textures: dict[str, Texture | None], face_idx: np.ndarray, barycentric: np.ndarray, footprint) -> dict[str, np.ndarray]:
        """By name (n, c) linear texels of the textures that there are and whose UV set there is; those of one layout are
        looked up at once."""
        together: dict[tuple, list[str]] = {}
        out: dict[str, np.ndarray] = {}
        for name, texture in textures.items():
            if texture is None or self._uv(texture) is None:
                continue
            value = self.constant(texture) if self.skip_constant else None
            if value is None:
                together.setdefault(same_layout(texture), []).append(name)
            else:
                out[name] = np.broadcast_to(value, (len(face_idx), len(value)))
        places = {}
        for names in together.values():
            texture = textures[names[0]]
            if texture.uv_set not in places:
                places[texture.uv_set] = _interpolated(self._uv(texture), self.scene.faces[face_idx], barycentric)
            width = None if footprint is None else footprint * self._density(texture, face_idx)
            reader = self._reader(*(textures[name] for name in names))
            texels = reader.read(places[texture.uv_set], width)
            out |= {name: texels[:, part] for name, part in zip(names, reader.parts, strict=True)}
        return out

    def shading_normals(self, face_idx: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        """(n, 3) unit interpolated vertex normals, the face's where there are none."""
        flat = self.face_normals[face_idx]
        if self.scene.normals is None:
            return flat
        smooth = _interpolated(self.scene.normals, self.scene.faces[face_idx], barycentric)
        length = np.sqrt(np.einsum("ij,ij->i", smooth, smooth))[:, None]
        return np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), flat)

    def _tangent(self, texture: Texture, face_idx: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        """(n, 4) interpolated tangents: the file's, else MikkTSpace's for the texture's UV set."""
        if self.scene.tangents is not None and texture.uv_set == 0:
            faces = self.scene.faces[face_idx]
            out = _interpolated(self.scene.tangents, faces, barycentric)
            out[:, 3] = np.where(self.scene.tangents[faces[:, 0], 3] < 0, -1.0, 1.0)
            return out
        else:
            with self._lock:
                self._make_tangents(texture)
            corners = self._tangents[texture.uv_set][face_idx]
        out = np.einsum("nij,ni->nj", corners, barycentric)
        out[:, 3] = np.where(corners[:, 0, 3] < 0, -1.0, 1.0)
        return out

    def _make_tangents(self, texture: Texture) -> None:
        if texture.uv_set not in self._tangents:
            from gdtool.texture.tangents import corner_tangents

            scene = self.scene
            own = scene.normals is None
            normals = self.face_normals if own else scene.normals
            normal_idx = np.repeat(np.arange(len(scene.faces))[:, None], 3, 1) if own else None
            self._tangents[texture.uv_set] = corner_tangents(scene.vertices, scene.faces, normals, self._uv(texture), scene.faces, normal_idx)

    def _normal_mapped(self, texture: Texture, scale: float, texel: np.ndarray, normal: np.ndarray, tangent: np.ndarray) -> np.ndarray:
        local = 2.0 * texel[:, :3] - 1.0
        along, across = local[:, :1] * scale, local[:, 1:2] * scale
        c, s = np.cos(texture.rotation), np.sin(texture.rotation)
        if s != 0.0 or texture.scale[0] < 0 or texture.scale[1] < 0:
            # The map's axes are turned against the UV's: bring the perturbation back to the UV's axes.
            along, across = along * np.sign(texture.scale[0]), across * np.sign(texture.scale[1])
            along, across = c * along + s * across, -s * along + c * across
        bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
        return _unit(along * tangent[:, :3] + across * bitangent + local[:, 2:3] * normal)

    def alpha(self, face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Alpha (n,) and the alpha below which a point is not there (n,): 0 for OPAQUE, the cutoff for MASK, 0.5 for BLEND."""
        scene = self.scene
        alpha, cutoff = np.ones(len(face_idx), np.float32), np.zeros(len(face_idx), np.float32)
        owner = scene.material_idx[face_idx]
        for m in np.unique(owner):
            material = scene.materials[m]
            if material.alpha_mode == "OPAQUE":
                continue
            chosen = np.flatnonzero(owner == m)
            value = np.full(len(chosen), material.base_color[3], np.float32)
            texel = self._read({"color": material.base_color_texture}, face_idx[chosen], barycentric[chosen], None).get("color")
            if texel is not None and texel.shape[1] in (2, 4):
                value *= texel[:, -1]
            if scene.colors is not None:
                value *= np.einsum("ni,ni->n", scene.colors[scene.faces[face_idx[chosen]], 3], barycentric[chosen]).astype(np.float32)
            alpha[chosen] = value
            cutoff[chosen] = material.alpha_cutoff if material.alpha_mode == "MASK" else 0.5
        return alpha, cutoff

    def attributes(self, face_idx: np.ndarray, barycentric: np.ndarray, footprint: np.ndarray | None = None,
                   directions: np.ndarray | None = None, emission: bool = True) -> dict[str, np.ndarray]:
        """Attributes at n points: albedo, emissive (n, 3) linear, roughness, metallic, alpha (n,), normal and
        geometric_normal (n, 3) unit, f0 and f90 (n,) of the dielectric part at normal and at grazing incidence (KHR_materials_ior, _specular),
        unlit (n,) bool; float32.

        footprint (n,): width in world units that a point stands for; picks the texture level. directions (n, 3): rays
        that see the points; normals are then turned to the seen side, as glTF asks for double-sided materials (and as
        is done here for all, since files whose winding and normals disagree are common). Without emission it is 0, and
        not looked up.
        """
        scene, n = self.scene, len(face_idx)
        footprint = None if footprint is None else np.broadcast_to(footprint, (n,))
        albedo, emissive = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        roughness, metallic = np.empty(n, np.float32), np.empty(n, np.float32)
        alpha, unlit = np.ones(n, np.float32), np.zeros(n, bool)
        f0, f90 = np.empty(n, np.float32), np.empty(n, np.float32)
        vertex_normal = self.shading_normals(face_idx, barycentric)
        normal = vertex_normal.copy()
        owner = scene.material_idx[face_idx]
        present = np.flatnonzero(np.bincount(owner))
        for m in present:
            material = scene.materials[m]
            at = slice(None) if len(present) == 1 else np.flatnonzero(owner == m)
            here = (face_idx[at], barycentric[at], None if footprint is None else footprint[at])
            color = np.broadcast_to(np.asarray(material.base_color, np.float32), (len(here[0]), 4)).copy()
            texels = self._read({"color": material.base_color_texture, "surface": material.metallic_roughness_texture, "normal": material.normal_texture,
                                 "emissive": material.emissive_texture if emission and any(material.emissive) else None}, *here)
            texel = texels.get("color")
            if texel is not None:
                color[:, :3] *= texel[:, :3] if texel.shape[1] >= 3 else texel[:, :1]
                if texel.shape[1] in (2, 4):
                    color[:, 3] *= texel[:, -1]
            if scene.colors is not None:
                color *= _interpolated(scene.colors, scene.faces[here[0]], here[1]).astype(np.float32)
            albedo[at] = color[:, :3]
            alpha[at] = color[:, 3] if material.alpha_mode != "OPAQUE" else 1.0
            texel = texels.get("surface")
            roughness[at] = material.roughness * (texel[:, 1] if texel is not None and texel.shape[1] >= 3 else 1.0)
            metallic[at] = material.metallic * (texel[:, 2] if texel is not None and texel.shape[1] >= 3 else 1.0)
            texel = texels.get("emissive")
            emissive[at] = np.asarray(material.emissive if emission else (0, 0, 0), np.float32) * (texel[:, :3] if texel is not None else 1.0)
            unlit[at] = material.unlit
            f0[at] = min(((material.ior - 1) / (material.ior + 1)) ** 2 * material.specular, 1.0)
            f90[at] = min(material.specular, 1.0)
            texel = texels.get("normal")
            if texel is not None and texel.shape[1] >= 3:
                tangent = self._tangent(material.normal_texture, *here[:2])
                normal[at] = self._normal_mapped(material.normal_texture, material.normal_scale, texel, vertex_normal[at], tangent)
        geometric = self.face_normals[face_idx]
        if directions is not None:
            geometric *= np.where(np.einsum("ij,ij->i", geometric, directions) > 0, -1.0, 1.0)[:, None]
            normal *= np.where(np.einsum("ij,ij->i", vertex_normal, geometric) < 0, -1.0, 1.0)[:, None]
        for values in (albedo, roughness, metallic, alpha):
            np.clip(values, 0, 1, out=values)
        return {"albedo": albedo, "roughness": roughness, "metallic": metallic,
                "alpha": alpha, "emissive": np.maximum(emissive, 0), "unlit": unlit, "f0": f0, "f90": f90,
                "normal": normal.astype(np.float32), "geometric_normal": geometric.astype(np.float32)}


def surface_attributes(scene: Scene, face_idx: np.ndarray, barycentric: np.ndarray, footprint: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """SurfaceLookup(scene).attributes for one call: see there."""
    return SurfaceLookup(scene).attributes(np.asarray(face_idx), np.asarray(barycentric, np.float64), footprint)
