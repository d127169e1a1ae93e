"""Predict from its JSON how much memory the geometry of a glTF file takes once all instances are expanded.

A file of a few kilobytes may show one mesh under a million nodes. It must be refused before a buffer is read.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdtool.assets.gltf.document import SIMPLIFY, GltfFile
from gdtool.assets.gltf.schema import Primitive
from gdtool.core.errors import ResourceError

MAX_ELEMENTS = 2**31 - 1  # vertices or faces of a Scene, whose indices are int32

# Bytes of a vertex attribute as read_gltf holds it, float64.
_VERTEX_BYTES = {"POSITION": 24, "NORMAL": 24, "TANGENT": 32, "COLOR_0": 32}
_UV_BYTES = 16
_FACE_BYTES = 24  # a face of a part: three int64 indices
# A face while parts are joined: offset (int64), concatenated (int64), converted (int32), and its material's index with
# the copies of np.repeat.
_JOINED_FACE_BYTES = 24 + 24 + 12 + 12
_PART_BYTES = 4096  # a primitive under a node: its Python objects and array headers
# A component while its primitive is read and transformed: as stored, as float64, the displacement of a morph target,
# and the results of the transform.
_COMPONENT_BYTES = 32
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_SKIN_BYTES = 6 * 128  # a skinned vertex: its matrix (4, 4) float64 and five temporary ones while it is blended
_CORNER_BYTES = 64  # an index: int64, and what np.unique sorts and returns


@dataclass(frozen=True)
class Geometry:
    """Count instances of primitives, their vertices and faces together, and the peak bytes of reading them."""

    parts: int
    vertices: int
    faces: int
    size: int


def check_geometry(file: GltfFile, visible: list[int]) -> None:
    """Raise ResourceError, with the prediction, where the meshes of the visible nodes are too large.

    Too large is more memory than one input may take, or more than MAX_ELEMENTS vertices or faces.
    """
    geometry = predicted_geometry(file, visible)
    what = f"its geometry ({geometry.vertices:,} vertices, {geometry.faces:,} faces in {geometry.parts:,} instances)"
    file.check_memory(geometry.size, what, SIMPLIFY)
    if max(geometry.vertices, geometry.faces) > MAX_ELEMENTS:
        raise ResourceError(file.path, f"{what} is more than {MAX_ELEMENTS:,} of a kind", SIMPLIFY)


def predicted_geometry(file: GltfFile, visible: list[int]) -> Geometry:
    """Predict what the meshes of the visible nodes expand to, without reading a buffer.

    Raises InputError for indices out of range.
    """
    parts = vertices = faces = scene_bytes = peak = 0
    flat_corners = 0
    names: set[str] = set()
    meshes: dict[int, list[_PrimitiveSize]] = {}
    for index in visible:
        node = file.document.nodes[index]
        if node.mesh is None:
            continue
        if node.mesh not in meshes:
            primitives = file.item(file.document.meshes, node.mesh, "mesh").primitives
            sizes = (_primitive_size(file, primitive) for primitive in primitives)
            meshes[node.mesh] = [size for size in sizes if size is not None]
        for size in meshes[node.mesh]:
            parts += 1
            vertices += size.vertices
            faces += size.faces
            scene_bytes += size.scene_bytes
            peak = max(peak, size.temporary + (size.skin if node.skin is not None else 0))
            names |= size.names
            if "NORMAL" not in size.names:
                flat_corners += 3 * size.faces
    # Where only some parts have normals, the others get a vertex for each corner (read._flat_shaded).
    split = flat_corners if "NORMAL" in names else 0
    width = sum(_width(name) for name in names)
    held_bytes = scene_bytes + faces * _FACE_BYTES + parts * _PART_BYTES
    joining = split * width + (vertices + split) * width + faces * _JOINED_FACE_BYTES
    return Geometry(parts, vertices, faces, held_bytes + max(peak, joining))


@dataclass(frozen=True)
class _PrimitiveSize:
    """Count a primitive's vertices and faces, and the bytes that reading it takes.

    names: the attributes that a Scene holds. scene_bytes: of these once the primitive is read. temporary: bytes while
    it is read. skin: further bytes where it is skinned.
    """

    vertices: int
    faces: int
    names: frozenset[str]
    scene_bytes: int
    temporary: int
    skin: int


def _primitive_size(file: GltfFile, primitive: Primitive) -> _PrimitiveSize | None:
    """Predict the size of one primitive; None for points, lines and what has no positions."""
    if primitive.mode < 4 or "POSITION" not in primitive.attributes:
        return None
    records = {
        name: file.item(file.document.accessors, index, "accessor") for name, index in primitive.attributes.items()
    }
    count = records["POSITION"].count
    corners = (
        count if primitive.indices is None else file.item(file.document.accessors, primitive.indices, "accessor").count
    )
    faces = corners // 3 if primitive.mode == 4 else max(corners - 2, 0)
    names = frozenset(name for name in records if _width(name))
    vertices = min(count, 3 * faces)
    components = sum(_COMPONENTS[record.type] for name, record in records.items() if not name.startswith("_"))
    return _PrimitiveSize(
        vertices=vertices,
        faces=faces,
        names=names,
        scene_bytes=vertices * sum(_width(name) for name in names),
        temporary=count * components * _COMPONENT_BYTES + corners * _CORNER_BYTES,
        skin=count * _SKIN_BYTES,
    )


def _width(name: str) -> int:
    """Return the bytes per vertex of an attribute that a Scene keeps, 0 for others."""
    return _UV_BYTES if name.startswith("TEXCOORD_") else _VERTEX_BYTES.get(name, 0)
