"""Read the materials, textures and images of a glTF 2.0 file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from gdtool.assets.gltf.document import EXPORT, GltfFile
from gdtool.assets.gltf.schema import MaterialRecord, Sampler, SpecularGlossiness, TextureInfo
from gdtool.assets.gltf.specular_glossiness import SpecularGlossinessMaterial, clipped, clipped_rgba, convert
from gdtool.assets.scene import Filter, Material, Texture, Wrap

# Values of the specification's sampler properties (section 5.26).
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728


class MaterialReader:
    """Read the materials of one file; an image that several materials share is decoded once and stays one array."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self._images: dict[int, np.ndarray] = {}
        self._held = 0  # bytes of the decoded images

    def material(self, index: int) -> Material:
        """Read a material, converted to metallic-roughness where it is specular-glossiness.

        Factors are clipped to [0, 1]. Raises InputError, ResourceError.
        """
        record: MaterialRecord = self.file.item(self.file.document.materials, index, "material")
        extensions, surface = record.extensions, record.pbr_metallic_roughness
        strength = (
            extensions.KHR_materials_emissive_strength.emissive_strength
            if extensions.KHR_materials_emissive_strength
            else 1.0
        )
        red, green, blue = (max(0.0, x) * strength for x in record.emissive_factor)
        emissive = (red, green, blue)
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
            base_color=clipped_rgba(*surface.base_color_factor),
            metallic=clipped(surface.metallic_factor),
            roughness=clipped(surface.roughness_factor),
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

    def _converted(self, material: Material, record: SpecularGlossiness, index: int) -> Material:
        diffuse = self._texture(record.diffuse_texture, "srgb")
        specular = self._texture(record.specular_glossiness_texture, "srgb")
        return convert(self.file, SpecularGlossinessMaterial(material, record, diffuse, specular, index))

    def _texture(self, info: TextureInfo | None, encoding: Literal["srgb", "linear"]) -> Texture | None:
        """Read a texture with its image, transform and sampler; None without one."""
        if info is None:
            return None
        record = self.file.item(self.file.document.textures, info.index, "texture")
        source = record.source
        if record.extensions.EXT_texture_webp is not None:
            source = record.extensions.EXT_texture_webp.source
        if source is None:
            fault = (
                "KHR_texture_basisu, which gdtool does not read"
                if record.extensions.KHR_texture_basisu
                else "no image that gdtool knows"
            )
            raise self.file.refuse(f"texture {info.index} has {fault}", "export it with PNG or JPEG textures")
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
            sampler: Sampler = self.file.item(self.file.document.samplers, record.sampler, "sampler")
            texture_filter: Filter = "nearest" if sampler.mag_filter == _NEAREST else "linear"
            out = replace(out, wrap_u=_WRAPS[sampler.wrap_s], wrap_v=_WRAPS[sampler.wrap_t], filter=texture_filter)
        return out

    def _image(self, index: int) -> np.ndarray:
        """Decode an image (h, w, 3 or 4), uint8 or uint16; grey is repeated in the three colours."""
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
