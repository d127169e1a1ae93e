"""Convert specular-glossiness materials (KHR_materials_pbrSpecularGlossiness) to metallic-roughness.

The formulas are those of the extension's sample converter (Khronos glTF repository, convert-between-workflows). Base
colour and metallic are chosen so that diffuse and specular reflection keep their brightness; roughness is
1 - glossiness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gdtool.assets.gltf.document import GltfFile
from gdtool.assets.gltf.schema import SpecularGlossiness
from gdtool.assets.scene import Material, Texture

_DIELECTRIC_F0 = 0.04  # reflectance at normal incidence of a dielectric with index of refraction 1.5
# Bytes of a pixel of a converted material: two maps of up to four 16-bit channels at the common size, each with a copy
# of its rows, and 4 + 3 bytes of result.
_CONVERTED_BYTES = 2 * 2 * 8 + 7
_ROWS_AT_ONCE = 64  # converted in float32; a map of 4096² pixels at once would take gigabytes


@dataclass(frozen=True)
class SpecularGlossinessMaterial:
    """Hold a material to convert: what both models share, the extension's record and textures, and its index in the
    file.
    """

    material: Material
    record: SpecularGlossiness
    diffuse_texture: Texture | None
    specular_texture: Texture | None
    index: int


def convert(file: GltfFile, source: SpecularGlossinessMaterial) -> Material:
    """Return the metallic-roughness material whose reflection is nearest to that of a specular-glossiness one.

    Raises InputError where the two textures are looked up differently, ResourceError for maps that are too large.
    """
    record, diffuse_texture = source.record, source.diffuse_texture
    if source.specular_texture is None:
        diffuse, specular = np.array(record.diffuse_factor[:3]), np.array(record.specular_factor)
        metallic = _metallic(diffuse, specular)
        if diffuse_texture is None or metallic == 0:
            red, green, blue = _base_color(diffuse, specular, metallic)
            return replace(
                source.material,
                base_color=clipped_rgba(red, green, blue, record.diffuse_factor[3]),
                metallic=float(metallic),
                roughness=clipped(1 - record.glossiness_factor),
                base_color_texture=diffuse_texture,
                metallic_roughness_texture=None,
            )
    return _converted_maps(file, source)


def _converted_maps(file: GltfFile, source: SpecularGlossinessMaterial) -> Material:
    """Convert the maps pixel by pixel, at the height of the highest and the width of the widest."""
    from gdtool.images.color import linear_from_srgb, rgba, srgb_from_linear
    from gdtool.images.io import quantized

    record = source.record
    textures = [texture for texture in (source.diffuse_texture, source.specular_texture) if texture is not None]
    if len({_lookup(texture) for texture in textures}) > 1:
        raise file.refuse(
            f"material {source.index} is specular-glossiness with two different texture lookups, which gdtool cannot "
            f"convert",
            "export it as metallic-roughness",
        )
    height, width = max(t.image.shape[0] for t in textures), max(t.image.shape[1] for t in textures)
    size = height * width * _CONVERTED_BYTES
    file.check_memory(
        size, f"converting material {source.index} at {width}x{height} pixels", "export it as metallic-roughness"
    )

    def resized(texture: Texture | None) -> np.ndarray:
        image = np.full((1, 1, 4), 255, np.uint8) if texture is None else texture.image
        rows = np.arange(height) * image.shape[0] // height
        columns = np.arange(width) * image.shape[1] // width
        return image[rows][:, columns]

    def linear(image: np.ndarray) -> np.ndarray:
        image = rgba(image)
        return np.concatenate([linear_from_srgb(image[..., :3]), image[..., 3:]], -1)

    diffuse, gloss = resized(source.diffuse_texture), resized(source.specular_texture)
    diffuse_factor = np.array(record.diffuse_factor, np.float32)
    gloss_factor = np.array([*record.specular_factor, record.glossiness_factor], np.float32)
    encoded, surface = np.empty((height, width, 4), np.uint8), np.empty((height, width, 3), np.uint8)
    for rows in np.array_split(np.arange(height), -(-height // _ROWS_AT_ONCE)):
        d, g = (linear(x[rows]) * f for x, f in ((diffuse, diffuse_factor), (gloss, gloss_factor)))
        metallic = _metallic(d[..., :3], g[..., :3])
        base = np.clip(_base_color(d[..., :3], g[..., :3], metallic[..., None]), 0, 1)
        encoded[rows] = quantized(np.concatenate([srgb_from_linear(base), d[..., 3:]], -1))
        surface[rows] = quantized(np.stack([np.ones_like(metallic), 1 - g[..., 3], metallic], -1))
    return replace(
        source.material,
        base_color=(1.0, 1.0, 1.0, 1.0),
        metallic=1.0,
        roughness=1.0,
        base_color_texture=replace(textures[0], image=encoded, encoding="srgb"),
        metallic_roughness_texture=replace(textures[0], image=surface, encoding="linear"),
    )


def clipped(value: float) -> float:
    """Clip a factor to [0, 1]."""
    return min(1.0, max(0.0, float(value)))


def clipped_rgba(red: float, green: float, blue: float, alpha: float) -> tuple[float, float, float, float]:
    """Clip the factors of a colour to [0, 1]."""
    return clipped(red), clipped(green), clipped(blue), clipped(alpha)


def _lookup(texture: Texture) -> tuple:
    """List the properties of a texture that decide which texel a point of the surface reads."""
    return texture.uv_set, texture.offset, texture.rotation, texture.scale, texture.wrap_u, texture.wrap_v


def _brightness(color: np.ndarray) -> np.ndarray:
    """Compute the perceived brightness (...) of linear RGB (..., 3)."""
    return np.sqrt(np.square(color) @ np.array([0.299, 0.587, 0.114], color.dtype))


def _metallic(diffuse: np.ndarray, specular: np.ndarray) -> np.ndarray:
    """Solve for the metallic value m (...) at which both models have the same brightness.

    With base colour b, diffuse d, specular s and dielectric reflectance f0, the models agree where
    d (1 - max s) = b (1 - m)(1 - f0) and s = f0 (1 - m) + b m. Without b this is a quadratic in m:
    f0 m² + (k - 2 f0 + s) m + (f0 - s) = 0 with k = d (1 - max s) / (1 - f0). Returns its root in [0, 1].
    """
    f0, d, s = _DIELECTRIC_F0, _brightness(diffuse), _brightness(specular)
    k = d * (1 - specular.max(-1)) / (1 - f0)
    b, c = k - 2 * f0 + s, f0 - s
    root = (-b + np.sqrt(np.maximum(b * b - 4 * f0 * c, 0))) / (2 * f0)
    return np.where(s <= f0, 0.0, np.clip(root, 0, 1)).astype(diffuse.dtype)


def _base_color(diffuse: np.ndarray, specular: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """Compute the linear base colour (..., 3): a dielectric's from the diffuse colour, a metal's from the specular."""
    strength = specular.max(-1, keepdims=True)
    from_diffuse = diffuse * (1 - strength) / (1 - _DIELECTRIC_F0) / np.maximum(1 - metallic, 1e-4)
    from_specular = (specular - _DIELECTRIC_F0 * (1 - metallic)) / np.maximum(metallic, 1e-4)
    weight = metallic * metallic
    return np.clip(from_diffuse, 0, 1) * (1 - weight) + np.clip(from_specular, 0, 1) * weight
