"""Decode KHR_draco_mesh_compression with the optional package DracoPy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gdtool.core.errors import ResourceError

if TYPE_CHECKING:
    from gdtool.assets.gltf.document import GltfFile
    from gdtool.assets.gltf.schema import DracoPrimitive, Primitive


_EXPORT_ANEW = "export it again, or without Draco compression"


def read_draco(
    file: GltfFile, compressed: DracoPrimitive, primitive: Primitive, subject: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Decode a compressed primitive: attributes (count, ...) float64 by name, and triangle indices (3f,) int64.

    subject names the primitive in errors. Raises InputError for a stream that does not decode or lacks an attribute
    that the file promises, ResourceError without DracoPy.
    """
    try:
        import DracoPy
    except ImportError:
        raise ResourceError(
            file.path, "is compressed with Draco, which needs the package DracoPy", "pip install DracoPy"
        ) from None
    content = bytes(file.view(compressed.buffer_view))
    for index in (primitive.attributes["POSITION"], *([primitive.indices] if primitive.indices is not None else [])):
        file.check_memory(
            file.item(file.document.accessors, index, "accessor").count * 48, subject, "export it with fewer faces"
        )
    try:
        mesh = DracoPy.decode(content)
        stored = {item["unique_id"]: np.asarray(item["data"]) for item in mesh.attributes}
        indices = np.asarray(mesh.faces).reshape(-1).astype(np.int64)
    except Exception as error:  # the binding raises its own types, and bare Exception
        raise file.refuse(
            f"{subject}: its Draco stream does not decode ({str(error)[:80] or type(error).__name__})", _EXPORT_ANEW
        ) from None
    attributes = {}
    for name, identity in compressed.attributes.items():
        if name.startswith("_"):
            continue
        if identity not in stored:
            raise file.refuse(f"{subject}: its Draco stream holds no {name}", _EXPORT_ANEW)
        record = (
            file.item(file.document.accessors, primitive.attributes[name], "accessor")
            if name in primitive.attributes
            else None
        )
        array = stored[identity]
        array = array.reshape(len(array), -1)
        normalized = name.startswith("COLOR_") or (record is not None and record.normalized)
        if normalized and array.dtype.kind in "iu":
            attributes[name] = np.maximum(array / np.iinfo(array.dtype).max, -1.0)
        else:
            attributes[name] = array.astype(np.float64)
    if "POSITION" not in attributes:
        raise file.refuse(f"{subject}: its Draco stream holds no POSITION", _EXPORT_ANEW)
    return attributes, indices
