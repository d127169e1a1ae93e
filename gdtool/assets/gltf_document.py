"""A glTF 2.0 file as it lies on disk: container, JSON, URIs, buffers, accessors."""

from __future__ import annotations

import base64
import binascii
import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import msgspec
import numpy as np

from gdtool.assets.gltf_schema import Accessor, Document
from gdtool.core.errors import InputError, ResourceError, from_os_error
from gdtool.core.reading import bytes_of

SUPPORTED = {
    "EXT_meshopt_compression", "EXT_texture_webp", "KHR_draco_mesh_compression", "KHR_materials_emissive_strength", "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness", "KHR_materials_specular", "KHR_materials_unlit", "KHR_mesh_quantization", "KHR_texture_transform",
}
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SHAPES = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


class GltfFile:
    """An opened .glb or .gltf: its decoded document, and bytes and accessors on demand.

    Raises InputError for whatever the specification forbids and is looked at, ResourceError where an accessor alone
    would not fit in memory.
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
        self._buffers: dict[int, bytes] = {}
        self._views: dict[int, bytes] = {}
        for name in self.document.extensions_required:
            if name not in SUPPORTED:
                raise InputError(path, f"requires the extension {name}, which gdtool does not know", "export it without")
        ignored = sorted(set(self.document.extensions_used) - SUPPORTED)
        self.notes += [f"extension {name} is ignored" for name in ignored]

    def refuse(self, fact: str, cure: str = "") -> InputError:
        """The error to raise for a fault of this file."""
        return InputError(self.path, fact, cure)

    def item(self, items: Sequence[Any], index: int, what: str) -> Any:
        """items[index]; InputError when there is none."""
        if index >= len(items):
            raise self.refuse(f"refers to {what} {index}, but has {len(items)}")
        return items[index]

    def _split(self, content: bytes) -> tuple[bytes, bytes | None]:
        """JSON and binary chunks of a GLB (specification, section 4.4)."""
        if len(content) < 20:
            raise self.refuse("is cut short (a GLB has at least 20 bytes)")
        version, length = struct.unpack_from("<II", content, 4)
        if version != 2:
            raise self.refuse(f"is binary glTF {version}, gdtool reads 2")
        if length != len(content):
            raise self.refuse(f"says it has {length} bytes, but has {len(content)}")
        chunks: list[tuple[bytes, bytes]] = []
        at = 12
        while at < length:
            if at + 8 > length:
                raise self.refuse("is cut short within a chunk's header")
            size, kind = struct.unpack_from("<I4s", content, at)
            if at + 8 + size > length:
                raise self.refuse(f"has a chunk of {size} bytes that reaches past its end")
            chunks.append((kind, content[at + 8:at + 8 + size]))
            at += 8 + size
        if not chunks or chunks[0][0] != b"JSON":
            raise self.refuse("does not begin with a JSON chunk")
        return chunks[0][1], chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None

    def _decode(self, text: bytes) -> Document:
        try:
            document = msgspec.json.decode(text.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0 "), type=Document)
        except msgspec.ValidationError as error:
            fact = str(error)
            raise self.refuse(f"is not valid glTF: {fact[:1].lower() + fact[1:]}") from None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise self.refuse(f"is not glTF ({error})") from None
        version = document.asset.version.split(".")[0]
        if version != "2" or document.asset.min_version not in ("2.0", "2"):
            raise self.refuse(f"is glTF {document.asset.version}, gdtool reads 2.0", "export it as glTF 2.0")
        return document

    def resolve(self, uri: str, what: str) -> bytes | Path:
        """Bytes of a data: URI, or the path of the file a relative one names."""
        if uri[:5].lower() == "data:":
            head, comma, body = uri[5:].partition(",")
            if not comma:
                raise self.refuse(f"{what} has a data: URI without data")
            try:
                return base64.b64decode(unquote(body), validate=True) if head.lower().endswith(";base64") else unquote_to_bytes(body)
            except (binascii.Error, ValueError):
                raise self.refuse(f"{what} has a data: URI that is not base64") from None
        if _SCHEME.match(uri) or uri.startswith(("/", "\\")) or "\0" in uri:
            raise self.refuse(f"{what} has the URI {uri[:60]!r}; gdtool reads relative ones only", "put the file beside the model")
        path = self.path.parent / unquote(uri)
        if not path.is_file():
            raise self.refuse(f"{what} is in {uri[:80]!r}, which does not exist")
        return path

    def buffer(self, index: int) -> bytes:
        """The bytes of a buffer, byteLength of them."""
        if index not in self._buffers:
            record = self.item(self.document.buffers, index, "buffer")
            if record.uri is not None:
                content = self.resolve(record.uri, f"buffer {index}")
                if isinstance(content, Path):
                    try:
                        content = content.read_bytes()
                    except OSError as error:
                        raise from_os_error(error, content) from None
            elif index == 0 and self._binary is not None:
                content = self._binary
            else:
                raise self.refuse(f"buffer {index} has no URI and the file no binary chunk for it")
            if len(content) < record.byte_length:
                raise self.refuse(f"buffer {index} has {len(content)} bytes, not the {record.byte_length} it says")
            self._buffers[index] = content[:record.byte_length]
        return self._buffers[index]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view, decompressed where EXT_meshopt_compression packs them."""
        if index not in self._views:
            record = self.item(self.document.buffer_views, index, "buffer view")
            packed = record.extensions.EXT_meshopt_compression
            if packed is not None:
                from gdtool.assets.meshopt import decode_view

                source = self._slice(self.buffer(packed.buffer), packed.byte_offset, packed.byte_length, index)
                self.check_memory(packed.count * packed.byte_stride, f"buffer view {index}")
                self._views[index] = decode_view(source, packed, self.refuse)
            else:
                self._views[index] = self._slice(self.buffer(record.buffer), record.byte_offset, record.byte_length, index)
        return self._views[index]

    def _slice(self, content: bytes, offset: int, length: int, index: int) -> bytes:
        if offset + length > len(content):
            raise self.refuse(f"buffer view {index} reaches past the end of its buffer ({offset + length} of {len(content)} bytes)")
        return content[offset:offset + length]

    def check_memory(self, size: int, what: str) -> None:
        """ResourceError when size bytes are more than half of this machine's memory."""
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if size > memory // 2:
            raise ResourceError(self.path, f"{what} would take {size / 2**30:.1f} GiB of this machine's {memory / 2**30:.1f}", "use a smaller model")

    def accessor(self, index: int) -> tuple[np.ndarray, Accessor]:
        """The stored numbers of an accessor, (count, ...) in their own type with sparse values set in, and its record."""
        record: Accessor = self.item(self.document.accessors, index, "accessor")
        dtype, shape = np.dtype(_DTYPES[record.component_type]), _SHAPES[record.type]
        self.check_memory(record.count * dtype.itemsize * int(np.prod(shape)), f"accessor {index}")
        if record.buffer_view is None:
            out = np.zeros((record.count, *shape), dtype)
        else:
            view = self.item(self.document.buffer_views, record.buffer_view, "buffer view")
            packed = view.extensions.EXT_meshopt_compression
            stride = packed.byte_stride if packed is not None and packed.mode == "ATTRIBUTES" else view.byte_stride
            out = self._strided(record.buffer_view, record.byte_offset, stride, record.count, dtype, shape, index)
        if record.sparse is not None:
            out = self._overridden(out, record.sparse, index)
        return out, record

    def _strided(self, view: int, offset: int, stride: int | None, count: int, dtype: np.dtype, shape: tuple[int, ...], index: int) -> np.ndarray:
        content = self.view(view)
        rows = shape[0] if len(shape) == 2 else 1
        # columns of matrices begin at multiples of four bytes (specification, section 3.6.2.4)
        column = (shape[-1] if shape else 1) * dtype.itemsize
        column_stride = -(-column // 4) * 4 if rows > 1 else column
        size = column_stride * rows
        stride = stride or size
        if stride < size:
            raise self.refuse(f"accessor {index} has elements of {size} bytes, {stride} apart")
        if offset + stride * (count - 1) + size > len(content):
            raise self.refuse(f"accessor {index} reaches past the end of its buffer view "
                              f"({offset + stride * (count - 1) + size} of {len(content)} bytes)")
        inner = (column_stride, dtype.itemsize) if rows > 1 else (dtype.itemsize,) * len(shape)
        return np.ndarray((count, *shape), dtype, content, offset, (stride, *inner))

    def _overridden(self, base: np.ndarray, sparse: Any, index: int) -> np.ndarray:
        if sparse.count > len(base):
            raise self.refuse(f"accessor {index} overrides {sparse.count} of its {len(base)} elements")
        dtype = np.dtype(_DTYPES[sparse.indices.component_type])
        where = self._strided(sparse.indices.buffer_view, sparse.indices.byte_offset, None, sparse.count, dtype, (), index).astype(np.int64)
        values = self._strided(sparse.values.buffer_view, sparse.values.byte_offset, None, sparse.count, base.dtype, base.shape[1:], index)
        if where.max() >= len(base) or (np.diff(where) <= 0).any():
            raise self.refuse(f"accessor {index} has sparse indices out of range or order")
        out = base.copy()
        out[where] = values
        return out

    def floats(self, index: int, always_normalized: bool = False) -> np.ndarray:
        """An accessor as float64, normalised integers decoded (specification, section 3.11).

        always_normalized: integers are normalised even where the file forgets to say so.
        """
        stored, record = self.accessor(index)
        if record.component_type == 5126 or not (record.normalized or always_normalized):
            return stored.astype(np.float64)
        return np.maximum(stored.astype(np.float64) / np.iinfo(stored.dtype).max, -1.0)
