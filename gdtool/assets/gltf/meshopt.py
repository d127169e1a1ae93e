"""Decode EXT_meshopt_compression with the optional package meshopt."""

from __future__ import annotations

from pathlib import Path

from gdtool.assets.gltf.schema import MeshoptView
from gdtool.core.errors import InputError, ResourceError


def decode_view(source: bytes, compressed: MeshoptView, path: Path) -> bytes:
    """Decompress a buffer view into count elements, byteStride apart.

    path: the file that holds it, for errors. Raises InputError for a stream that does not decode, ResourceError without
    the package.
    """
    try:
        import meshopt
    except ImportError:
        raise ResourceError(
            path,
            "is compressed with meshopt, which needs the package meshopt",
            "pip install meshopt, or unpack it with gltfpack or gltf-transform",
        ) from None
    try:
        return meshopt.decode_gltf_buffer(
            source, compressed.count, compressed.byte_stride, compressed.mode, compressed.filter
        ).tobytes()
    except (RuntimeError, ValueError) as error:
        raise InputError(
            path, f"has a meshopt stream that does not decode ({str(error)[:80]})", "compress it again with gltfpack"
        ) from None
