"""Open glTF 2.0 files: container, JSON, URIs, buffers, buffer views and accessors."""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import msgspec
import numpy as np

from gdtool.assets.gltf.schema import Accessor, Document, Sparse
from gdtool.core.errors import InputError, from_os_error
from gdtool.core.memory import require_memory
from gdtool.core.names import quoted, uri_path
from gdtool.core.reading import bytes_of, require_regular_file

SUPPORTED = {
    "EXT_meshopt_compression",
    "EXT_texture_webp",
    "KHR_draco_mesh_compression",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SHAPES = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
_FLOAT32 = 5126  # componentType
# Bytes that an object of the JSON takes once it is decoded. Measured on the worst case: a node of three characters,
# with the matrix that is computed for it.
_OBJECT_BYTES = 600

EXPORT = "export it again as glTF 2.0"
COPY = "copy or download it again"
SIMPLIFY = "export it with fewer faces or fewer instances"


@dataclass(frozen=True)
class _Elements:
    """Locate equally spaced elements: buffer view, byte offset, byte stride (None: packed), count, type, shape."""

    view: int
    offset: int
    stride: int | None
    count: int
    dtype: np.dtype
    shape: tuple[int, ...]


class GltfFile:
    """Hold an opened .glb or .gltf: its decoded document, and its bytes and accessors on demand.

    Buffers, buffer views and the chunks of a GLB are memory views of what was read, not copies. All methods raise
    InputError where they meet a breach of the specification, and ResourceError where the result would take more memory
    than one input may. notes collects what was ignored or assumed, a line each.
    """

    def __init__(self, path: Path):
        self.path = path
        self.notes: list[str] = []
        content = bytes_of(path)
        if content[:4] == b"glTF":
            text, self._binary = self._split(content)
        else:
            text, self._binary = content, None
        self.document = self._decode(text)
        self._buffers: dict[int, memoryview] = {}
        self._views: dict[int, memoryview] = {}
        self._unpacked = 0  # bytes of decompressed buffer views
        for name in self.document.extensions_required:
            if name not in SUPPORTED:
                raise InputError(
                    path,
                    f"requires the extension {printed(name)}, which gdtool does not know",
                    "export it without that extension",
                )
        ignored = sorted(set(self.document.extensions_used) - SUPPORTED)
        self.notes += [f"extension {printed(name)} is ignored" for name in ignored]

    def refuse(self, fact: str, cure: str) -> InputError:
        """Make the error to raise for a fault of this file."""
        return InputError(self.path, fact, cure)

    def item(self, items: Sequence[Any], index: int, what: str) -> Any:
        """Return items[index]; raises InputError, naming the kind of item, where there is none."""
        if index >= len(items):
            raise self.refuse(f"refers to {what} {index}, but has {len(items)}", EXPORT)
        return items[index]

    def _split(self, content: bytes) -> tuple[bytes, memoryview | None]:
        """Return the JSON chunk and the binary chunk of a GLB (glTF 2.0 specification, section 4.4)."""
        if len(content) < 20:
            raise self.refuse("is cut short (a GLB has at least 20 bytes)", COPY)
        version, length = struct.unpack_from("<II", content, 4)
        if version != 2:
            raise self.refuse(f"is binary glTF {version}, gdtool reads 2", "export it as glTF 2.0")
        if length != len(content):
            raise self.refuse(f"says it has {length} bytes, but has {len(content)}", COPY)
        chunks: list[tuple[bytes, memoryview]] = []
        at = 12
        while at < length:
            if at + 8 > length:
                raise self.refuse("is cut short within a chunk's header", COPY)
            size, kind = struct.unpack_from("<I4s", content, at)
            if at + 8 + size > length:
                raise self.refuse(f"has a chunk of {size} bytes that reaches past its end", COPY)
            chunks.append((kind, memoryview(content)[at + 8 : at + 8 + size]))
            at += 8 + size
        if not chunks or chunks[0][0] != b"JSON":
            raise self.refuse("does not begin with a JSON chunk", EXPORT)
        return bytes(chunks[0][1]), chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None

    def _decode(self, text: bytes) -> Document:
        """Decode and check the JSON against the types of schema.py, and check its version."""
        self.check_memory(text.count(b"{") * _OBJECT_BYTES, f"its JSON of {text.count(b'{'):,} objects", SIMPLIFY)
        try:
            document = msgspec.json.decode(text.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0 "), type=Document)
        except msgspec.ValidationError as error:
            fact = str(error)
            raise self.refuse(f"is not valid glTF: {fact[:1].lower() + fact[1:]}", EXPORT) from None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise self.refuse(f"is not glTF ({error})", EXPORT) from None
        version = document.asset.version.split(".")[0]
        if version != "2" or document.asset.min_version not in ("2.0", "2"):
            raise self.refuse(f"is glTF {printed(document.asset.version)}, gdtool reads 2.0", "export it as glTF 2.0")
        return document

    def resolve(self, uri: str, what: str) -> bytes | Path:
        """Return the bytes of a data: URI, or the path of the regular file that a relative URI names.

        That file must lie in the folder of this one, after percent-decoding and after following links: a model must not
        make gdtool read other files. what names the reference in errors.
        """
        if uri[:5].lower() == "data:":
            head, comma, body = uri[5:].partition(",")
            if not comma:
                raise self.refuse(f"{what} has a data: URI without data", EXPORT)
            try:
                return (
                    base64.b64decode(unquote(body), validate=True)
                    if head.lower().endswith(";base64")
                    else unquote_to_bytes(body)
                )
            except (binascii.Error, ValueError):
                raise self.refuse(f"{what} has a data: URI that is not base64", EXPORT) from None
        path = uri_path(self.path.parent, uri, self.path, f"the URI of {what}")
        if not path.exists():
            raise self.refuse(
                f"{what} is in {quoted(uri)}, which does not exist",
                "put that file beside the model or embed it in a .glb",
            )
        require_regular_file(path)
        return path

    def buffer(self, index: int) -> memoryview:
        """Return the first byteLength bytes of a buffer."""
        if index not in self._buffers:
            record = self.item(self.document.buffers, index, "buffer")
            content: bytes | memoryview
            if record.uri is not None:
                target = self.resolve(record.uri, f"buffer {index}")
                content = self._read_buffer(target, record.byte_length, index) if isinstance(target, Path) else target
            elif index == 0 and self._binary is not None:
                content = self._binary
            else:
                raise self.refuse(f"buffer {index} has no URI and the file no binary chunk for it", EXPORT)
            if len(content) < record.byte_length:
                raise self.refuse(
                    f"buffer {index} has {len(content)} bytes, not the {record.byte_length} it says", COPY
                )
            self._buffers[index] = memoryview(content)[: record.byte_length]
        return self._buffers[index]

    def _read_buffer(self, path: Path, length: int, index: int) -> bytes:
        """Read the first `length` bytes of a file, fewer where it has fewer."""
        try:
            self.check_memory(min(path.stat().st_size, length), f"buffer {index}", SIMPLIFY)
            with path.open("rb") as file:
                return file.read(length)
        except OSError as error:
            raise from_os_error(error, path) from None

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view, decompressed where it uses EXT_meshopt_compression."""
        if index not in self._views:
            record = self.item(self.document.buffer_views, index, "buffer view")
            packed = record.extensions.EXT_meshopt_compression
            if packed is not None:
                from gdtool.assets.gltf.meshopt import decode_view

                source = self._slice(self.buffer(packed.buffer), packed.byte_offset, packed.byte_length, index)
                self._unpacked += packed.count * packed.byte_stride
                self.check_memory(self._unpacked, f"decompressing buffer view {index} and those before it", SIMPLIFY)
                self._views[index] = memoryview(decode_view(bytes(source), packed, self.path))
            else:
                self._views[index] = self._slice(
                    self.buffer(record.buffer), record.byte_offset, record.byte_length, index
                )
        return self._views[index]

    def _slice(self, content: memoryview, offset: int, length: int, index: int) -> memoryview:
        if offset + length > len(content):
            raise self.refuse(
                f"buffer view {index} reaches past the end of its buffer ({offset + length} of {len(content)} bytes)",
                EXPORT,
            )
        return content[offset : offset + length]

    def check_memory(self, size: int, what: str, cure: str) -> None:
        """Raise ResourceError where `size` bytes are more than one input may take; what tells their use."""
        require_memory(size, self.path, what, cure)

    def accessor(self, index: int) -> tuple[np.ndarray, Accessor]:
        """Return an accessor's numbers (count, ...) as the file stores them, sparse values included, and its record.

        Sparse accessors are copied; all others are views of the file's bytes.
        """
        record: Accessor = self.item(self.document.accessors, index, "accessor")
        dtype, shape = np.dtype(_DTYPES[record.component_type]), _SHAPES[record.type]
        self.check_memory(record.count * dtype.itemsize * int(np.prod(shape)), f"accessor {index}", SIMPLIFY)
        if record.buffer_view is None:
            out = np.zeros((record.count, *shape), dtype)
        else:
            view = self.item(self.document.buffer_views, record.buffer_view, "buffer view")
            packed = view.extensions.EXT_meshopt_compression
            stride = packed.byte_stride if packed is not None and packed.mode == "ATTRIBUTES" else view.byte_stride
            elements = _Elements(record.buffer_view, record.byte_offset, stride, record.count, dtype, shape)
            out = self._strided(elements, index)
        if record.sparse is not None:
            out = self._overridden(out, record.sparse, index)
        return out, record

    def _strided(self, elements: _Elements, index: int) -> np.ndarray:
        """View equally spaced elements of a buffer view as an array (count, *shape); index: of the accessor."""
        offset, count, dtype, shape = elements.offset, elements.count, elements.dtype, elements.shape
        content = self.view(elements.view)
        rows = shape[0] if len(shape) == 2 else 1
        # The columns of matrices begin at multiples of four bytes (glTF 2.0 specification, section 3.6.2.4).
        column = (shape[-1] if shape else 1) * dtype.itemsize
        column_stride = -(-column // 4) * 4 if rows > 1 else column
        size = column_stride * rows
        stride = elements.stride or size
        if stride < size:
            raise self.refuse(f"accessor {index} has elements of {size} bytes, {stride} apart", EXPORT)
        if offset + stride * (count - 1) + size > len(content):
            raise self.refuse(
                f"accessor {index} reaches past the end of its buffer view "
                f"({offset + stride * (count - 1) + size} of {len(content)} bytes)",
                EXPORT,
            )
        inner = (column_stride, dtype.itemsize) if rows > 1 else (dtype.itemsize,) * len(shape)
        return np.ndarray((count, *shape), dtype, content, offset, (stride, *inner))

    def _overridden(self, base: np.ndarray, sparse: Sparse, index: int) -> np.ndarray:
        """Copy the elements of an accessor and replace those that its sparse record lists."""
        if sparse.count > len(base):
            raise self.refuse(f"accessor {index} overrides {sparse.count} of its {len(base)} elements", EXPORT)
        dtype = np.dtype(_DTYPES[sparse.indices.component_type])
        places = _Elements(sparse.indices.buffer_view, sparse.indices.byte_offset, None, sparse.count, dtype, ())
        where = self._strided(places, index).astype(np.int64)
        values = self._strided(
            _Elements(
                sparse.values.buffer_view, sparse.values.byte_offset, None, sparse.count, base.dtype, base.shape[1:]
            ),
            index,
        )
        if where.max() >= len(base) or (np.diff(where) <= 0).any():
            raise self.refuse(f"accessor {index} has sparse indices out of range or order", EXPORT)
        out = base.copy()
        out[where] = values
        return out

    def floats(self, index: int, always_normalized: bool = False) -> np.ndarray:
        """Read an accessor as float64, normalised integers scaled to [0, 1] or [-1, 1] (specification, section 3.11).

        always_normalized: treat integers as normalised even where the file forgets to say so.
        """
        stored, record = self.accessor(index)
        if record.component_type == _FLOAT32 or not (record.normalized or always_normalized):
            return stored.astype(np.float64)
        return np.maximum(stored.astype(np.float64) / np.iinfo(stored.dtype).max, -1.0)


def printed(name: str) -> str:
    """Format a name from a file for a message: as it is where it is short and printable, else escaped and cut."""
    return name if name.isprintable() and len(name) <= 80 else quoted(name)
