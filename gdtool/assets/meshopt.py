"""EXT_meshopt_compression, through the optional package meshoptimizer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.assets.gltf_schema import MeshoptView
from gdtool.core.errors import InputError, ResourceError


def decode_view(source: bytes, packed: MeshoptView, refuse: Callable[..., InputError]) -> bytes:
    """The bytes that a compressed buffer view stands for: count elements, byteStride apart.

    refuse makes the InputError for a stream that does not decode. Raises ResourceError without the package.
    """
    try:
        import meshoptimizer
    except ImportError:
        raise ResourceError(refuse("").subject, "is compressed with meshopt, which needs the package meshoptimizer",
                            "pip install meshoptimizer, or unpack it with gltfpack or gltf-transform") from None
    count, stride = packed.count, packed.byte_stride
    try:
        if packed.mode == "ATTRIBUTES":
            if stride % 4:
                raise ValueError("a stride that is no multiple of four")
            out = meshoptimizer.decode_vertex_buffer(count, stride, source, dtype=np.dtype(("u1", stride)))
            out = np.ascontiguousarray(out).reshape(-1).view(np.uint8)
            filters = {"OCTAHEDRAL": meshoptimizer.decode_filter_oct, "QUATERNION": meshoptimizer.decode_filter_quat,
                       "EXPONENTIAL": meshoptimizer.decode_filter_exp}
            if packed.filter != "NONE":
                done = filters[packed.filter](out.view(np.float32) if stride % 4 == 0 else out, count, stride)
                out = np.ascontiguousarray(out if done is None else done).reshape(-1).view(np.uint8)
        else:
            if stride not in (2, 4):
                raise ValueError(f"indices of {stride} bytes")
            decode = meshoptimizer.decode_index_buffer if packed.mode == "TRIANGLES" else meshoptimizer.decode_index_sequence
            # the binding hands back 32-bit words into which narrower indices were written side by side
            out = np.ascontiguousarray(decode(count, stride, source)).view(np.uint8)[:count * stride]
    except (RuntimeError, ValueError) as error:
        raise refuse(f"has a meshopt stream that does not decode ({str(error)[:80]})") from None
    return out.tobytes()
