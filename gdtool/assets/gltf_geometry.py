"""How large the geometry of a glTF file becomes when all its instances are expanded, told from its JSON alone."""

from __future__ import annotations

from dataclasses import dataclass

from gdtool.assets.gltf_document import SIMPLIFY, GltfFile
from gdtool.assets.gltf_schema import Primitive
from gdtool.core.errors import ResourceError

MAX_ELEMENTS = 2**31 - 1  # vertices or faces of a Scene, whose indices are int32

# Bytes of one vertex as read_gltf holds it, float64, by attribute.
_VERTEX_BYTES = {"POSITION": 24, "NORMAL": 24, "TANGENT": 32, "COLOR_0": 32}
_UV_BYTES = 16
_FACE_BYTES = 24  # of one face in its part: int64 corners
# Moved to the whole, put together and made int32, with the index of its material.
_JOINED_FACE_BYTES = 24 + 24 + 12 + 12
_PART_BYTES = 4096  # of one primitive under one node: its Python objects and array headers
# While one primitive is read and placed: each component as stored and as float64, a delta of a morph target, and the
# results of the transform.
_COMPONENT_BYTES = 32
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_SKIN_BYTES = 6 * 128  # of one vertex's (4, 4) float64 matrix and those it is blended, divided and applied through
_CORNER_BYTES = 64  # of one index: int64, and what np.unique sorts and returns


@dataclass(frozen=True)
class Geometry:
    """vertices and faces of all instances together, and the bytes that read_gltf takes to make them, its copies
    included."""

    parts: int
    vertices: int
    faces: int
    size: int


def check_geometry(file: GltfFile, visible: list[int]) -> None:
    """Raise ResourceError, with the prediction, when the meshes of the visible nodes would take more memory than one
    input may.

    So do more than MAX_ELEMENTS vertices or faces.
    """
    found = predicted_geometry(file, visible)
    what = f"its geometry ({found.vertices:,} vertices, {found.faces:,} faces in {found.parts:,} instances)"
    file.check_memory(found.size, what, SIMPLIFY)
    if max(found.vertices, found.faces) > MAX_ELEMENTS:
        raise ResourceError(file.path, f"{what} is more than {MAX_ELEMENTS:,} of a kind", SIMPLIFY)


def predicted_geometry(file: GltfFile, visible: list[int]) -> Geometry:
    """Return what the meshes of the visible nodes expand to; no buffer is read. Raises InputError for references that
    lead nowhere."""
    parts = vertices = faces = kept = most = 0
    flat_corners = 0
    names: set[str] = set()
    meshes: dict[int, list[_Need]] = {}
    for index in visible:
        node = file.document.nodes[index]
        if node.mesh is None:
            continue
        if node.mesh not in meshes:
            primitives = file.item(file.document.meshes, node.mesh, "mesh").primitives
            meshes[node.mesh] = [need for need in (_need(file, one) for one in primitives) if need is not None]
        for need in meshes[node.mesh]:
            parts += 1
            vertices += need.vertices
            faces += need.faces
            kept += need.kept
            most = max(most, need.passing + (need.skin if node.skin is not None else 0))
            names |= need.names
            if "NORMAL" not in need.names:
                flat_corners += 3 * need.faces
    # Where only some parts have normals, the others get a vertex for each corner (gltf_read._flat).
    split = flat_corners if "NORMAL" in names else 0
    width = sum(_width(name) for name in names)
    held = kept + faces * _FACE_BYTES + parts * _PART_BYTES
    joining = split * width + (vertices + split) * width + faces * _JOINED_FACE_BYTES
    return Geometry(parts, vertices, faces, held + max(most, joining))


@dataclass(frozen=True)
class _Need:
    """One primitive: its size, the attributes that are kept, the bytes held of it, and those that pass while it is
    read."""

    vertices: int
    faces: int
    names: frozenset[str]
    kept: int
    passing: int
    skin: int


def _need(file: GltfFile, primitive: Primitive) -> _Need | None:
    """None for points, lines and what has no positions."""
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
    return _Need(
        vertices,
        faces,
        names,
        vertices * sum(_width(name) for name in names),
        count * components * _COMPONENT_BYTES + corners * _CORNER_BYTES,
        count * _SKIN_BYTES,
    )


def _width(name: str) -> int:
    """Bytes a vertex of an attribute that a Scene keeps; 0 for others."""
    return _UV_BYTES if name.startswith("TEXCOORD_") else _VERTEX_BYTES.get(name, 0)
