"""Materials, textures and images of a glTF 2.0 document."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.gltf_document import EXPORT, GltfFile
from gdtool.assets.gltf_schema import MaterialRecord, SpecularGlossiness, TextureInfo
from gdtool.assets.scene import Material, Texture

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_DIELECTRIC_F0 = 0.04
# Of one pixel of a converted material: two maps of up to four 16-bit channels at the common size, each through a row
# copy, and 4 + 3 bytes out.
_CONVERTED_BYTES = 2 * 2 * 8 + 7


class MaterialReader:
    """Reads the materials of one file; images that several materials share are decoded once and stay one array."""

    def __init__(self, file: GltfFile):
        self.file = file
        self._images: dict[int, np.ndarray] = {}
        self._held = 0  # bytes of the decoded images

    def material(self, index: int) -> Material:
        """Material `index` of the file, specular-glossiness converted to metallic-roughness."""
        record: MaterialRecord = self.file.item(self.file.document.materials, index, "material")
        extensions, surface = record.extensions, record.pbr_metallic_roughness
        strength = (
            extensions.KHR_materials_emissive_strength.emissive_strength
            if extensions.KHR_materials_emissive_strength
            else 1.0
        )
        emissive = tuple(max(0.0, x) * strength for x in record.emissive_factor)
        if not np.isfinite(emissive).all():
            raise self.file.refuse(f"material {index}: its emission is not finite", "lower its emissive strength")
        specular = extensions.KHR_materials_specular
        if specular and (
            specular.specular_texture
            or specular.specular_color_texture
            or specular.specular_color_factor != (1.0, 1.0, 1.0)
        ):
            self.file.notes.append(f"material {index}: specular colour and textures are ignored")
        out = Material(
            name=record.name or f"material_{index}",
            base_color=_unit(surface.base_color_factor),
            metallic=_unit((surface.metallic_factor,))[0],
            roughness=_unit((surface.roughness_factor,))[0],
            emissive=emissive,
            alpha_mode=record.alpha_mode,
            alpha_cutoff=record.alpha_cutoff,
            double_sided=record.double_sided,
            unlit=extensions.KHR_materials_unlit is not None,
            ior=extensions.KHR_materials_ior.ior if extensions.KHR_materials_ior else 1.5,
            specular=specular.specular_factor if specular else 1.0,
            base_color_texture=self._texture(surface.base_color_texture, "srgb"),
            metallic_roughness_texture=self._texture(surface.metallic_roughness_texture, "linear"),
            normal_texture=self._texture(record.normal_texture, "linear"),
            normal_scale=record.normal_texture.scale if record.normal_texture else 1.0,
            occlusion_texture=self._texture(record.occlusion_texture, "linear"),
            occlusion_strength=record.occlusion_texture.strength if record.occlusion_texture else 1.0,
            emissive_texture=self._texture(record.emissive_texture, "srgb"),
        )
        if extensions.KHR_materials_pbrSpecularGlossiness is not None:
            self.file.notes.append(f"material {index}: specular-glossiness is converted to metallic-roughness")
            out = self._converted(out, extensions.KHR_materials_pbrSpecularGlossiness, index)
        return out

    def _texture(self, info: TextureInfo | None, encoding: str) -> Texture | None:
        if info is None:
            return None
        record = self.file.item(self.file.document.textures, info.index, "texture")
        source = record.source
        if record.extensions.EXT_texture_webp is not None:
            source = record.extensions.EXT_texture_webp.source
        if source is None:
            other = (
                "KHR_texture_basisu, which gdtool does not read"
                if record.extensions.KHR_texture_basisu
                else "no image that gdtool knows"
            )
            raise self.file.refuse(f"texture {info.index} has {other}", "export it with PNG or JPEG textures")
        transform = info.extensions.KHR_texture_transform
        out = Texture(self._image(source), encoding, info.tex_coord)
        if transform is not None:
            out = replace(
                out,
                offset=transform.offset,
                rotation=transform.rotation,
                scale=transform.scale,
                uv_set=info.tex_coord if transform.tex_coord is None else transform.tex_coord,
            )
        if record.sampler is not None:
            sampler = self.file.item(self.file.document.samplers, record.sampler, "sampler")
            out = replace(
                out,
                wrap_u=_WRAPS[sampler.wrap_s],
                wrap_v=_WRAPS[sampler.wrap_t],
                filter="nearest" if sampler.mag_filter == 9728 else "linear",
            )
        return out

    def _image(self, index: int) -> np.ndarray:
        """(h, w, 3 or 4) uint8 or uint16; grey is spread over the three colours."""
        if index not in self._images:
            from gdtool.images.io import decode_image, read_image

            record = self.file.item(self.file.document.images, index, "image")
            if record.uri is not None:
                content = self.file.resolve(record.uri, f"image {index}")
            elif record.buffer_view is not None:
                content = bytes(self.file.view(record.buffer_view))
            else:
                raise self.file.refuse(f"image {index} has neither a URI nor a buffer view", EXPORT)
            if isinstance(content, Path):
                image = read_image(content)
            else:
                image = decode_image(content, f"{self.file.path}: image {index}")
            if image.shape[2] < 3:
                image = np.concatenate([np.repeat(image[..., :1], 3, -1), image[..., 1:]], -1)
            self._held += image.nbytes
            self.file.check_memory(self._held, f"image {index} and those before it", "export it with smaller textures")
            self._images[index] = image
        return self._images[index]

    def _converted(self, material: Material, record: SpecularGlossiness, index: int) -> Material:
        """Return the metallic-roughness material that reflects most nearly what the specular-glossiness one does."""
        diffuse_texture = self._texture(record.diffuse_texture, "srgb")
        specular_texture = self._texture(record.specular_glossiness_texture, "srgb")
        if specular_texture is None:
            specular, metallic_of = (
                np.array(record.specular_factor),
                _metallic(np.array(record.diffuse_factor[:3]), np.array(record.specular_factor)),
            )
            if diffuse_texture is None or metallic_of == 0:
                base = _base_color(np.array(record.diffuse_factor[:3]), specular, metallic_of)
                return replace(
                    material,
                    base_color=_unit((*base, record.diffuse_factor[3])),
                    metallic=float(metallic_of),
                    roughness=_unit((1 - record.glossiness_factor,))[0],
                    base_color_texture=diffuse_texture,
                    metallic_roughness_texture=None,
                )
        return self._converted_maps(material, record, diffuse_texture, specular_texture, index)

    def _converted_maps(
        self,
        material: Material,
        record: SpecularGlossiness,
        diffuse_texture: Texture | None,
        specular_texture: Texture | None,
        index: int,
    ) -> Material:
        from gdtool.images.color import linear_from_srgb, rgba, srgb_from_linear
        from gdtool.images.io import quantized

        given = [t for t in (diffuse_texture, specular_texture) if t is not None]
        if len({_lookup(t) for t in given}) > 1:
            raise self.file.refuse(
                f"material {index} is specular-glossiness with two different texture lookups, which gdtool cannot "
                f"convert",
                "export it as metallic-roughness",
            )
        height, width = max(t.image.shape[0] for t in given), max(t.image.shape[1] for t in given)
        size = height * width * _CONVERTED_BYTES
        self.file.check_memory(
            size, f"converting material {index} at {width}x{height} pixels", "export it as metallic-roughness"
        )

        def pixels(texture: Texture | None) -> np.ndarray:
            image = np.full((1, 1, 4), 255, np.uint8) if texture is None else texture.image
            rows = np.arange(height) * image.shape[0] // height
            columns = np.arange(width) * image.shape[1] // width
            return image[rows][:, columns]

        def linear(image: np.ndarray) -> np.ndarray:
            image = rgba(image)
            return np.concatenate([linear_from_srgb(image[..., :3]), image[..., 3:]], -1)

        diffuse, gloss = pixels(diffuse_texture), pixels(specular_texture)
        diffuse_factor = np.array(record.diffuse_factor, np.float32)
        gloss_factor = np.array([*record.specular_factor, record.glossiness_factor], np.float32)
        encoded, surface = np.empty((height, width, 4), np.uint8), np.empty((height, width, 3), np.uint8)
        for rows in np.array_split(np.arange(height), -(-height // 64)):  # a 4096² map whole would take gigabytes
            d, g = (linear(x[rows]) * f for x, f in ((diffuse, diffuse_factor), (gloss, gloss_factor)))
            metallic = _metallic(d[..., :3], g[..., :3])
            base = np.clip(_base_color(d[..., :3], g[..., :3], metallic[..., None]), 0, 1)
            encoded[rows] = quantized(np.concatenate([srgb_from_linear(base), d[..., 3:]], -1))
            surface[rows] = quantized(np.stack([np.ones_like(metallic), 1 - g[..., 3], metallic], -1))
        return replace(
            material,
            base_color=(1.0, 1.0, 1.0, 1.0),
            metallic=1.0,
            roughness=1.0,
            base_color_texture=replace(given[0], image=encoded, encoding="srgb"),
            metallic_roughness_texture=replace(given[0], image=surface, encoding="linear"),
        )


def _lookup(texture: Texture) -> tuple:
    return texture.uv_set, texture.offset, texture.rotation, texture.scale, texture.wrap_u, texture.wrap_v


def _unit(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(min(1.0, max(0.0, float(x))) for x in values)


def _brightness(color: np.ndarray) -> np.ndarray:
    """Perceived brightness of linear RGB (..., 3)."""
    return np.sqrt(np.square(color) @ np.array([0.299, 0.587, 0.114], color.dtype))


def _metallic(diffuse: np.ndarray, specular: np.ndarray) -> np.ndarray:
    """Metallic (...) for which base color b satisfies both models' brightness.

    Of d (1 - max s) = b (1 - m)(1 - 0.04) and s = 0.04 (1 - m) + b m, b eliminated: a quadratic in m, its root in [0,
    1]."""
    f0, d, s = _DIELECTRIC_F0, _brightness(diffuse), _brightness(specular)
    kept = d * (1 - specular.max(-1)) / (1 - f0)
    # f0 m² + (kept - 2 f0 + s) m + (f0 - s) = 0, from s (1 - m) = f0 (1 - m)² + kept m
    b, c = kept - 2 * f0 + s, f0 - s
    root = (-b + np.sqrt(np.maximum(b * b - 4 * f0 * c, 0))) / (2 * f0)
    return np.where(s <= f0, 0.0, np.clip(root, 0, 1)).astype(diffuse.dtype)


def _base_color(diffuse: np.ndarray, specular: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """Linear base color (..., 3): from the diffuse color where it is a dielectric, from the specular where a metal."""
    strength = specular.max(-1, keepdims=True)
    from_diffuse = diffuse * (1 - strength) / (1 - _DIELECTRIC_F0) / np.maximum(1 - metallic, 1e-4)
    from_specular = (specular - _DIELECTRIC_F0 * (1 - metallic)) / np.maximum(metallic, 1e-4)
    weight = metallic * metallic
    return np.clip(from_diffuse, 0, 1) * (1 - weight) + np.clip(from_specular, 0, 1) * weight
