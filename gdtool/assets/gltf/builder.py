"""Build the JSON and the binary chunk of a GLB: buffer views, accessors, textures, images."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from gdtool import __version__
from gdtool.assets.scene import Texture
from gdtool.core.errors import ResourceError

# Values of the specification's properties: componentType, wrapS, filters, bufferView.target (sections 5.1, 5.11, 5.26).
_COMPONENT = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
_WRAP = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_FILTERS = {"linear": (9729, 9987), "nearest": (9728, 9984)}  # magnification; minification with mip maps
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class GlbBuilder:
    """Collect the JSON and the binary chunk of a GLB.

    pngs: by the id of an image array, its PNG where there is one already, as bytes or as the name of a file beside the
    .glb.
    """

    def __init__(self, pngs: Mapping[int, str | bytes]) -> None:
        self._pngs = pngs
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": f"gdtool {__version__}"}, "scene": 0}
        self.binary = bytearray()
        self.extensions: set[str] = set()
        self._images: dict[tuple[int, bool], tuple[np.ndarray, int]] = {}

    def unique(self, kind: str, item: dict[str, Any]) -> int:
        """Return the index of an item in json[kind]; an equal item is not added twice."""
        items = self.json.setdefault(kind, [])
        if item not in items:
            items.append(item)
        return items.index(item)

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes as a new buffer view, aligned to four bytes, and return its index."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        if target:
            view["target"] = target
        self.binary += content
        return self._append("bufferViews", view)

    def accessor(self, array: np.ndarray, kind: str, target: int, bounds: bool = False) -> int:
        """Append an array as a new accessor and return its index.

        Vertex indices are stored as uint16 where all are below 65535, which the specification reserves, else as uint32.
        kind: the accessor's type, such as "VEC3". bounds: write min and max, as POSITION must have.
        """
        if target == ELEMENT_ARRAY_BUFFER:
            array = array.astype(np.uint16 if array.max() < 65535 else np.uint32)
        array = np.ascontiguousarray(array)
        item: dict[str, Any] = {
            "bufferView": self.view(array.astype(array.dtype.newbyteorder("<")).tobytes(), target),
            "componentType": _COMPONENT[array.dtype.name],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            item |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        return self._append("accessors", item)

    def texture(self, texture: Texture, encoding: str, uv_slots: list[int]) -> dict[str, Any]:
        """Add a texture with its image and sampler, and return its textureInfo.

        encoding: of the file's image. uv_slots: the UV sets of the scene that are written, in order.
        """
        magnify, minify = _FILTERS[texture.filter]
        sampler = self.unique(
            "samplers",
            {"magFilter": magnify, "minFilter": minify, "wrapS": _WRAP[texture.wrap_u], "wrapT": _WRAP[texture.wrap_v]},
        )
        info: dict[str, Any] = {
            "index": self.unique("textures", {"sampler": sampler, "source": self._image(texture, encoding)})
        }
        uv_set = uv_slots.index(texture.uv_set) if texture.uv_set in uv_slots else 0
        if uv_set:
            info["texCoord"] = uv_set
        transform = {
            "offset": [float(x) for x in texture.offset],
            "rotation": float(texture.rotation),
            "scale": [float(x) for x in texture.scale],
        }
        if transform != {"offset": [0.0, 0.0], "rotation": 0.0, "scale": [1.0, 1.0]}:
            info["extensions"] = {"KHR_texture_transform": transform}
            self.extensions.add("KHR_texture_transform")
        return info

    def _image(self, texture: Texture, encoding: str) -> int:
        """Add the image of a texture as PNG, once for each array and encoding, and return its index."""
        convert = texture.encoding != encoding
        key = (id(texture.image), convert)
        if key not in self._images:
            from gdtool.images.io import encode_png

            png = None if convert else self._pngs.get(id(texture.image))
            if png is None:
                png = encode_png(_encoded(texture.image, texture.encoding, encoding))
            item: dict[str, Any] = {"uri": png} if isinstance(png, str) else {"bufferView": self.view(png)}
            item["mimeType"] = "image/png"
            # The array stays referenced, so that no other array gets its id.
            self._images[key] = texture.image, self._append("images", item)
        return self._images[key][1]

    def _append(self, kind: str, item: dict[str, Any]) -> int:
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def packed(self) -> bytes:
        """Assemble the GLB (glTF 2.0 specification, section 4). Raises ResourceError beyond 4 GiB."""
        if self.extensions:
            self.json["extensionsUsed"] = sorted(self.extensions)
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.binary)
        if total >= 1 << 32:
            raise ResourceError(
                "asset.glb",
                f"would have {total >> 30} GiB, more than the format's 4",
                "use fewer faces or smaller maps",
            )
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, total),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(self.binary), b"BIN\0"),
                bytes(self.binary),
            ]
        )


def _encoded(image: np.ndarray, from_encoding: str, to_encoding: str) -> np.ndarray:
    """Convert the colour channels of an image, not its alpha; an image in that encoding already stays as it is."""
    if from_encoding == to_encoding:
        return image
    from gdtool.images.color import linear_from_srgb, srgb_from_linear, unit_range

    pixels = unit_range(image).reshape(*image.shape[:2], -1)
    colors = pixels.shape[2] - (pixels.shape[2] in (2, 4))
    convert = srgb_from_linear if to_encoding == "srgb" else linear_from_srgb
    return np.concatenate([convert(pixels[..., :colors]), pixels[..., colors:]], -1)
