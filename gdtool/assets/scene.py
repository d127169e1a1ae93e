"""Define the triangle scene with glTF 2.0 materials that every reader returns and every writer takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Wrap = Literal["repeat", "clamp", "mirror"]
Filter = Literal["linear", "nearest"]


@dataclass(frozen=True)
class Texture:
    """Hold an image and how to look it up, in the terms of glTF 2.0.

    image: (h, w, c) uint8, uint16 or float32, row 0 at the top, c = 1 to 4, alpha not premultiplied.
    encoding: "srgb" where the colour channels are sRGB-encoded (alpha never is), else "linear".
    uv_set: index into Scene.uvs. offset, rotation (radians, counter-clockwise) and scale are those of
    KHR_texture_transform: uv' = offset + rotate(scale * uv).
    """

    image: np.ndarray
    encoding: Literal["srgb", "linear"] = "linear"
    uv_set: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    wrap_u: Wrap = "repeat"
    wrap_v: Wrap = "repeat"
    filter: Filter = "linear"


@dataclass(frozen=True)
class Material:
    """Hold a glTF 2.0 metallic-roughness material. Colours are linear; factors lie in [0, 1], emissive may exceed 1.

    Channels: RGBA of base_color_texture; roughness in G and metallic in B of metallic_roughness_texture; tangent-space
    normals with +Y up in normal_texture; R of occlusion_texture; RGB of emissive_texture. Textures multiply factors.
    """

    name: str = "material"
    base_color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    metallic: float = 1.0
    roughness: float = 1.0
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False
    ior: float = 1.5
    specular: float = 1.0
    base_color_texture: Texture | None = None
    metallic_roughness_texture: Texture | None = None
    normal_texture: Texture | None = None
    normal_scale: float = 1.0
    occlusion_texture: Texture | None = None
    occlusion_strength: float = 1.0
    emissive_texture: Texture | None = None


# Stands in for a missing material. glTF's default is a rough metal, which is not what such files look like elsewhere.
DEFAULT_MATERIAL = Material(name="default", base_color=(0.8, 0.8, 0.8, 1.0), metallic=0.0, roughness=0.5)


@dataclass(frozen=True)
class Scene:
    """Hold triangles in one right-handed, Y-up frame, all node transforms applied.

    vertices (v, 3) float64; faces (f, 3) int32, counter-clockwise seen from outside.
    normals (v, 3), unit vectors; None means flat shading. tangents (v, 4), handedness in w, or None.
    uvs: an array (v, 2) float64 for each UV set, (0, 0) at the image's top left; a set may be None.
    colors (v, 4), linear, or None. material_idx (f,) int32 into materials; zeros where None is given.
    notes: what a reader ignored or repaired, a line each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    materials: tuple[Material, ...] = (DEFAULT_MATERIAL,)
    material_idx: np.ndarray | None = None
    normals: np.ndarray | None = None
    tangents: np.ndarray | None = None
    uvs: tuple[np.ndarray | None, ...] = ()
    colors: np.ndarray | None = None
    name: str = "object"
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if self.material_idx is None:
            object.__setattr__(self, "material_idx", np.zeros(len(self.faces), np.int32))

    @property
    def face_materials(self) -> np.ndarray:
        """Return material_idx (f,), which is never None once the scene is made."""
        assert self.material_idx is not None
        return self.material_idx
