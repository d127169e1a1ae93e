"""The triangle scene with glTF 2.0 materials that every reader returns and every writer takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Wrap = Literal["repeat", "clamp", "mirror"]
Filter = Literal["linear", "nearest"]


@dataclass(frozen=True)
class Texture:
    """An image and how glTF 2.0 says to look it up.

    image: (h, w, c) uint8, uint16 or float32, row 0 at the top, c = 1..4, straight alpha.
    encoding: "srgb" when the three colour channels are sRGB-encoded (alpha never is), else "linear".
    uv' = offset + rotate(scale * uv), KHR_texture_transform; rotation in radians, counter-clockwise.
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
    """glTF 2.0 metallic-roughness material. Colours are linear, factors in [0, 1] (emissive may exceed 1).

    Channels: base_color_texture RGBA, metallic_roughness_texture G = roughness, B = metallic, normal_texture tangent
    space +Y up, occlusion_texture R, emissive_texture RGB.
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


# What a face without a material is made of: glTF's default is a rough metal, which no such file means.
DEFAULT_MATERIAL = Material(name="default", base_color=(0.8, 0.8, 0.8, 1.0), metallic=0.0, roughness=0.5)


@dataclass(frozen=True)
class Scene:
    """Triangles in one right-handed, Y-up frame, all node transforms applied.

    vertices (v, 3) float64; faces (f, 3) int32, counter-clockwise seen from outside.
    normals (v, 3) unit or None (then flat); tangents (v, 4) with handedness in w, or None.
    uvs: one (v, 2) float64 array per set, (0, 0) at the image's top left; a set may be None.
    colors (v, 4) linear, or None. material_idx (f,) int32 into materials.
    notes: what a reader ignored or repaired, one line each.
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

    def __post_init__(self):
        if self.material_idx is None:
            object.__setattr__(self, "material_idx", np.zeros(len(self.faces), np.int32))
