"""EXT_meshopt_compression, through the optional package meshopt."""

from __future__ import annotations

from collections.abc import Callable

from gdtool.assets.gltf_schema import MeshoptView
from gdtool.core.errors import InputError, ResourceError


def decode_view(source: bytes, packed: MeshoptView, refuse: Callable[..., InputError]) -> bytes:
    """The bytes that a compressed buffer view stands for: count elements, byteStride apart.

    refuse makes the InputError for a stream that does not decode. Raises ResourceError without the package.
    """
    try:
        import meshopt
    except ImportError:
        raise ResourceError(refuse("").subject, "is compressed with meshopt, which needs the package meshopt",
                            "pip install meshopt, or unpack it with gltfpack or gltf-transform") from None
    try:
        return meshopt.decode_gltf_buffer(source, packed.count, packed.byte_stride, packed.mode, packed.filter).tobytes()
    except (RuntimeError, ValueError) as error:
        raise refuse(f"has a meshopt stream that does not decode ({str(error)[:80]})") from None
