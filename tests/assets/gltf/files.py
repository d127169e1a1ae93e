"""Build small glTF files in code."""

from __future__ import annotations

import copy
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from gdtool.images.io import encode_png

_COMPONENT = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
_KIND = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


class Builder:
    """Build a glTF document and its one buffer; `document` may be edited before it is written."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }
        self.binary = b""

    def view(self, content: bytes, **extra: Any) -> int:
        """Append bytes as a buffer view and return its index."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content), **extra}
        )
        self.binary += content
        return len(self.document["bufferViews"]) - 1

    def add(self, array: np.ndarray, **extra: Any) -> int:
        """Append an array as an accessor and return its index."""
        stride = {}
        stored = array
        # Rows of vertex attributes begin at multiples of four.
        if array.ndim == 2 and (array.itemsize * array.shape[1]) % 4:
            size = array.itemsize * array.shape[1]
            stored = np.zeros((len(array), -(-size // 4) * 4), np.uint8)
            stored[:, :size] = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), size)
            stride = {"byteStride": stored.shape[1]}
        view = self.view(np.ascontiguousarray(stored).tobytes(), **stride)
        self.document["accessors"].append(
            {
                "bufferView": view,
                "componentType": _COMPONENT[array.dtype.name],
                "count": len(array),
                "type": _KIND[array.shape[1:]],
                **extra,
            }
        )
        return len(self.document["accessors"]) - 1

    def primitive(self, attributes: dict[str, int], indices: int | None = None, **extra: Any) -> None:
        """Append a primitive, of accessor indices, to the first mesh."""
        item = {"attributes": attributes, **extra}
        if indices is not None:
            item["indices"] = indices
        self.document["meshes"][0]["primitives"].append(item)

    def glb(self) -> bytes:
        """Assemble the GLB."""
        document = copy.deepcopy(self.document)
        if self.binary:
            document["buffers"] = [{"byteLength": len(self.binary)}]
        return pack(json.dumps(document).encode(), self.binary)

    def write(self, path: Path) -> Path:
        """Write the GLB to a path, which is returned."""
        path.write_bytes(self.glb())
        return path


def pack(text: bytes, binary: bytes) -> bytes:
    """Assemble a GLB of a JSON and a binary chunk."""
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(text) + (8 + len(binary) if binary else 0)
    out = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text
    return out + (struct.pack("<I4s", len(binary), b"BIN\0") + binary if binary else b"")


def quad(**material: Any) -> Builder:
    """Build a unit square facing +Z with normals and texture coordinates, and a material of the given properties."""
    builder = Builder()
    attributes = {
        "POSITION": builder.add(QUAD),
        "NORMAL": builder.add(np.tile(np.float32([0, 0, 1]), (4, 1))),
        "TEXCOORD_0": builder.add(QUAD[:, :2] * np.float32([1, -1]) + np.float32([0, 1])),
    }
    extra = {}
    if material:
        builder.document["materials"] = [material]
        extra = {"material": 0}
    builder.primitive(attributes, builder.add(QUAD_FACES), **extra)
    return builder


def with_textures(**textures: np.ndarray) -> Builder:
    """Build a quad with a material `m` and embedded images; texture i is the i-th keyword argument."""
    builder = quad(name="m")
    views = [builder.view(encode_png(image)) for image in textures.values()]
    builder.document["images"] = [{"bufferView": view, "mimeType": "image/png"} for view in views]
    builder.document["textures"] = [{"source": i} for i in range(len(views))]
    return builder
