"""A strict reading of glTF 2.0 into one Scene: nodes, skins, primitives."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gdtool.assets.gltf_document import EXPORT, SIMPLIFY, GltfFile, printed
from gdtool.assets.gltf_geometry import check_geometry
from gdtool.assets.gltf_materials import MaterialReader
from gdtool.assets.gltf_schema import Node, Primitive
from gdtool.assets.scene import DEFAULT_MATERIAL, Material, Scene
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.topology import has_repeated_corner

_UV_SET = re.compile(r"TEXCOORD_[0-9]{1,3}")
_UNSKINNED = "export it without the skin"


@dataclass
class Part:
    """One primitive under one node, in world space; arrays as in Scene, None where the file has none."""

    vertices: np.ndarray
    faces: np.ndarray
    material: int | None
    normals: np.ndarray | None = None
    tangents: np.ndarray | None = None
    uvs: tuple[np.ndarray | None, ...] = ()
    colors: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all its arrays."""
        return sum(
            a.nbytes
            for a in (self.vertices, self.faces, self.normals, self.tangents, self.colors, *self.uvs)
            if a is not None
        )


def read_gltf(path: str | Path) -> Scene:
    """Read the default scene of a .glb or .gltf: every triangle of every node, in world space and in rest pose.

    Skins stand as their joints do without animation; morph targets at their default weights. Strips and fans become
    triangles, points and lines are left out (and noted). A primitive without a material gets DEFAULT_MATERIAL.
    Raises InputError naming the file and the fault, required extensions that are not known by name; ResourceError with
    the prediction, before any geometry is decoded, where all of it would take more memory than one input may."""
    file = GltfFile(Path(path))
    parts: list[Part] = []
    held = 0
    worlds = _world_matrices(file)
    visible = _visible(file)
    check_geometry(file, visible)
    for index in visible:
        node = file.document.nodes[index]
        if node.mesh is None:
            continue
        mesh = file.item(file.document.meshes, node.mesh, "mesh")
        for number, primitive in enumerate(mesh.primitives):
            subject = f"mesh {node.mesh}, primitive {number}"
            part = _read_primitive(file, primitive, node.weights or mesh.weights, subject)
            if part is not None:
                matrices = _joint_matrices(file, node, worlds, primitive, len(part.vertices), subject)
                parts.append(_compact(_placed(part, worlds[index] if matrices is None else matrices)))
                held += parts[-1].nbytes
                # Draco streams may hold more than is said.
                file.check_memory(held, f"{subject} and the geometry before it", SIMPLIFY)
    if not parts:
        raise file.refuse("has no faces", "export the model with its meshes")
    return _joined(file, parts)


def _visible(file: GltfFile) -> list[int]:
    """Nodes of the default scene, in order; of the whole file where it has no scene."""
    document = file.document
    if document.scenes:
        roots = file.item(document.scenes, document.scene or 0, "scene").nodes
    else:
        children = {child for node in document.nodes for child in node.children}
        roots = [i for i in range(len(document.nodes)) if i not in children]
    out, stack, seen = [], list(reversed(roots)), set()
    while stack:
        index = stack.pop()
        if index in seen:
            raise file.refuse(
                f"its scene shows node {index} twice", "name each root node once in the scene, and no child"
            )
        seen.add(index)
        out.append(index)
        stack += reversed(file.item(document.nodes, index, "node").children)
    return out


def _world_matrices(file: GltfFile) -> list[np.ndarray]:
    """(4, 4) world_from_node of every node. InputError where the nodes are no forest."""
    nodes = file.document.nodes
    parent = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.children:
            file.item(nodes, child, "node")
            if parent[child] >= 0 or child == index:
                raise file.refuse(f"node {child} has two parents or is its own: the nodes must be a tree", EXPORT)
            parent[child] = index
    worlds: list[np.ndarray | None] = [None] * len(nodes)
    stack = [i for i in range(len(nodes)) if parent[i] < 0]
    while stack:
        index = stack.pop()
        local = _local_matrix(file, nodes[index], index)
        worlds[index] = local if parent[index] < 0 else worlds[parent[index]] @ local
        stack += nodes[index].children
    for index, world in enumerate(worlds):
        if world is None:
            raise file.refuse(f"node {index} is part of a cycle: the nodes must be a tree", EXPORT)
        if not np.isfinite(world).all():
            raise file.refuse(f"node {index} has a transform that is not finite", "reset the transform of that node")
    return worlds


def _local_matrix(file: GltfFile, node: Node, index: int) -> np.ndarray:
    if node.matrix is not None:
        matrix = np.array(node.matrix, np.float64).reshape(4, 4).T  # stored by columns
        if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
            raise file.refuse(f"node {index} has a matrix that is not affine", "reset the transform of that node")
        return matrix
    x, y, z, w = node.rotation
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if not 0.9 < length < 1.1:
        raise file.refuse(
            f"node {index} has a rotation that is not a unit quaternion (length {length:.3g})",
            "reset the rotation of that node",
        )
    x, y, z, w = x / length, y / length, z / length, w / length
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, :3] *= node.scale
    out[:3, 3] = node.translation
    return out


def _read_primitive(file: GltfFile, primitive: Primitive, weights: tuple[float, ...], subject: str) -> Part | None:
    """Return the primitive in its node's space; None for points and lines."""
    if primitive.mode < 4:
        file.notes.append(f"{subject}: {'points' if primitive.mode == 0 else 'lines'} are left out")
        return None
    if "POSITION" not in primitive.attributes:
        file.notes.append(f"{subject}: has no positions and is left out")
        return None
    packed = primitive.extensions.KHR_draco_mesh_compression
    if packed is not None:
        from gdtool.assets.draco import read_draco

        attributes, indices = read_draco(file, packed, primitive, subject)
    else:
        attributes = {
            name: file.floats(index, always_normalized=name.startswith("COLOR_"))
            for name, index in primitive.attributes.items()
            if not name.startswith("_")
        }
        indices = None
        if primitive.indices is not None:
            stored, record = file.accessor(primitive.indices)
            if record.type != "SCALAR" or stored.dtype.kind != "u":
                raise file.refuse(f"{subject}: its indices are not unsigned integers", EXPORT)
            indices = stored.astype(np.int64)
    count = len(attributes["POSITION"])
    for name, width in (
        ("POSITION", 3),
        ("NORMAL", 3),
        ("TANGENT", 4),
        *((n, 2) for n in attributes if n.startswith("TEXCOORD_")),
    ):
        if name in attributes and attributes[name].shape[1:] != (width,):
            raise file.refuse(f"{subject}: {printed(name)} is not a vector of {width}", EXPORT)
    for name, array in attributes.items():
        if len(array) != count:
            raise file.refuse(f"{subject}: {printed(name)} has {len(array)} elements, POSITION {count}", EXPORT)
    _add_targets(file, primitive, weights, attributes, subject)
    if not np.isfinite(attributes["POSITION"]).all():
        raise file.refuse(
            f"{subject}: vertex {int(np.argwhere(~np.isfinite(attributes['POSITION']))[0][0])} is not finite",
            "remove that vertex or move it to a finite place",
        )
    if indices is None:
        indices = np.arange(count)
    if len(indices) and indices.max() >= count:
        raise file.refuse(f"{subject}: refers to vertex {int(indices.max())}, but has {count}", EXPORT)
    faces = _triangles(indices, primitive.mode)
    if not len(faces):
        file.notes.append(f"{subject}: has no faces")
        return None
    sets = [int(name[9:]) for name in attributes if _UV_SET.fullmatch(name)]
    uvs = tuple(
        attributes.get(f"TEXCOORD_{i}") for i in range(max(sets, default=-1) + 1 if max(sets, default=0) < 32 else 0)
    )
    colors = attributes.get("COLOR_0")
    if colors is not None:
        if colors.shape[1:] not in ((3,), (4,)):
            raise file.refuse(f"{subject}: COLOR_0 is neither RGB nor RGBA", EXPORT)
        colors = np.concatenate([colors[:, :3], colors[:, 3:] if colors.shape[1] == 4 else np.ones((count, 1))], 1)
    for name, arrays in (
        ("a texture coordinate", uvs),
        ("a vertex color", (colors,)),
        ("a normal", (attributes.get("NORMAL"),)),
    ):
        if any(a is not None and not np.isfinite(a).all() for a in arrays):
            raise file.refuse(f"{subject}: {name} is not finite", "export it without that attribute")
    tangents = attributes.get("TANGENT")
    if tangents is not None and not np.isfinite(tangents).all():
        file.notes.append(f"{subject}: its tangents are not finite and are left out")
        tangents = None
    return Part(attributes["POSITION"], faces, primitive.material, attributes.get("NORMAL"), tangents, uvs, colors)


def _add_targets(
    file: GltfFile, primitive: Primitive, weights: tuple[float, ...], attributes: dict[str, np.ndarray], subject: str
) -> None:
    for weight, target in zip(weights, primitive.targets, strict=False):
        for name in ("POSITION", "NORMAL"):
            if weight and name in target and name in attributes:
                delta = file.floats(target[name])
                if delta.shape != attributes[name].shape:
                    raise file.refuse(
                        f"{subject}: a morph target's {name} has another shape", "export it without morph targets"
                    )
                attributes[name] = attributes[name] + weight * delta


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """(f, 3) from a list (4), strip (5) or fan (6); specification, section 3.7.2.1. Incomplete ends are dropped."""
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    i = np.arange(len(indices) - 2)
    corners = (i, i + 1 + i % 2, i + 2 - i % 2) if mode == 5 else (i + 1, i + 2, np.zeros_like(i))
    faces = indices[np.stack(corners, 1)]
    return faces[~has_repeated_corner(faces)]  # strips join by empty triangles


def _joint_matrices(
    file: GltfFile, node: Node, worlds: list[np.ndarray], primitive: Primitive, count: int, subject: str
) -> np.ndarray | None:
    """(v, 4, 4) world_from_vertex of a skinned primitive, None for a rigid one (specification, section 3.7.3)."""
    if node.skin is None or "JOINTS_0" not in primitive.attributes or "WEIGHTS_0" not in primitive.attributes:
        return None
    if primitive.extensions.KHR_draco_mesh_compression is not None:
        file.notes.append(f"{subject}: its skin is compressed and taken as it is stored")
        return None
    skin = file.item(file.document.skins, node.skin, "skin")
    joints = np.stack([file.item(worlds, joint, "node") for joint in skin.joints])
    if skin.inverse_bind_matrices is not None:
        inverse = file.floats(skin.inverse_bind_matrices)
        if inverse.shape[1:] != (4, 4) or len(inverse) < len(joints):
            raise file.refuse(
                f"skin {node.skin} has {len(inverse)} inverse bind matrices for {len(joints)} joints", _UNSKINNED
            )
        joints = joints @ inverse[: len(joints)].transpose(0, 2, 1)  # stored by columns
    out, total = np.zeros((count, 4, 4)), np.zeros(count)
    for k in range(8):
        if f"JOINTS_{k}" not in primitive.attributes or f"WEIGHTS_{k}" not in primitive.attributes:
            break
        index, _ = file.accessor(primitive.attributes[f"JOINTS_{k}"])
        weight = file.floats(primitive.attributes[f"WEIGHTS_{k}"], always_normalized=True)
        if (
            index.shape != (count, 4)
            or weight.shape != (count, 4)
            or index.dtype.kind != "u"
            or not np.isfinite(weight).all()
        ):
            raise file.refuse(f"{subject}: its joints and weights are not four a vertex", _UNSKINNED)
        if (index[weight > 0] >= len(joints)).any():
            raise file.refuse(f"{subject}: refers to a joint out of range (its skin has {len(joints)})", _UNSKINNED)
        for j in range(4):
            out += weight[:, j, None, None] * joints[np.where(weight[:, j] > 0, index[:, j], 0)]
        total += weight.sum(1)
    if not (total > 0).all():
        raise file.refuse(
            f"{subject}: a vertex has no skin weight",
            "normalize the weights of all its vertices, or export it without the skin",
        )
    return out / total[:, None, None]


def _placed(part: Part, matrix: np.ndarray) -> Part:
    """Return the part under matrix (4, 4), or (v, 4, 4) one per vertex. A mirroring matrix turns the faces' winding."""

    def apply(linear: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        return np.einsum("...ij,...j->...i", linear, vectors)

    linear = matrix[..., :3, :3]
    determinant = np.linalg.det(linear)
    mirrored = bool(np.median(determinant) < 0)
    part.vertices = apply(linear, part.vertices) + matrix[..., :3, 3]
    if mirrored:
        part.faces = part.faces[:, ::-1]
    if part.normals is not None:
        # the cofactor matrix moves normals, also where a scale is zero
        rows = [linear[..., i, :] for i in range(3)]
        cofactor = np.stack([np.cross(rows[1], rows[2]), np.cross(rows[2], rows[0]), np.cross(rows[0], rows[1])], -2)
        part.normals = _unit(apply(cofactor, part.normals)) * (-1 if mirrored else 1)
    if part.tangents is not None:
        direction = _unit(apply(linear, part.tangents[:, :3]))
        part.tangents = np.concatenate([direction, part.tangents[:, 3:] * (-1 if mirrored else 1)], 1)
    return part


def _compact(part: Part) -> Part:
    """Return the part without the vertices that no face refers to: primitives often share one long buffer."""
    used, faces = np.unique(part.faces, return_inverse=True)
    if len(used) == len(part.vertices):
        return part

    def pick(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array[used]

    return Part(
        part.vertices[used],
        faces.reshape(-1, 3),
        part.material,
        pick(part.normals),
        pick(part.tangents),
        tuple(pick(uv) for uv in part.uvs),
        pick(part.colors),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _joined(file: GltfFile, parts: list[Part]) -> Scene:
    """One Scene of all parts; what some parts lack is filled in so that it changes nothing that is seen."""
    reader = MaterialReader(file)
    slots = sorted({part.material for part in parts if part.material is not None})
    materials: list[Material] = [reader.material(index) for index in slots]
    if any(part.material is None for part in parts):
        materials.append(DEFAULT_MATERIAL)
        file.notes.append("faces without a material get a grey dielectric of roughness 0.5")
    place = {index: i for i, index in enumerate(slots)} | {None: len(materials) - 1}
    if any(part.normals is not None for part in parts):
        parts = [part if part.normals is not None else _flat(part) for part in parts]
    tangents = _common_tangents(file, parts, [materials[place[part.material]] for part in parts])
    counts = [len(part.vertices) for part in parts]
    first = np.cumsum([0, *counts[:-1]])
    set_count = max(len(part.uvs) for part in parts)
    for material in materials:
        for texture in (material.base_color_texture, material.metallic_roughness_texture, material.normal_texture):
            if texture is not None and texture.uv_set >= set_count:
                raise file.refuse(
                    f"material {material.name!r} looks up texture coordinates {texture.uv_set}, which no mesh has",
                    "export it with that UV map",
                )
    uvs = []
    for k in range(set_count):
        given = [part.uvs[k] if k < len(part.uvs) else None for part in parts]
        uvs.append(
            None
            if all(uv is None for uv in given)
            else np.concatenate([np.zeros((n, 2)) if uv is None else uv for uv, n in zip(given, counts, strict=True)])
        )
    colors = None
    if any(part.colors is not None for part in parts):
        colors = np.concatenate(
            [np.ones((n, 4)) if p.colors is None else p.colors for p, n in zip(parts, counts, strict=True)]
        )
    return Scene(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, first, strict=True)]).astype(np.int32),
        materials=tuple(materials),
        material_idx=np.repeat([place[part.material] for part in parts], [len(part.faces) for part in parts]).astype(
            np.int32
        ),
        normals=None if parts[0].normals is None else np.concatenate([part.normals for part in parts]),
        tangents=tangents,
        uvs=tuple(uvs),
        colors=colors,
        name=file.path.stem,
        notes=tuple(dict.fromkeys(file.notes)),
    )


def _flat(part: Part) -> Part:
    """Return the part with every face's corners its own and the face's normal on them: glTF's rule for missing
    normals."""
    from gdtool.geometry.normals import face_normals

    corner = part.faces.reshape(-1)
    vertices = part.vertices[corner]
    faces = np.arange(len(corner)).reshape(-1, 3)
    normals = np.repeat(face_normals(TriMesh(vertices, faces))[0], 3, axis=0)
    uvs = tuple(None if uv is None else uv[corner] for uv in part.uvs)
    return Part(
        vertices, faces, part.material, normals, None, uvs, None if part.colors is None else part.colors[corner]
    )


def _common_tangents(file: GltfFile, parts: list[Part], materials: list[Material]) -> np.ndarray | None:
    """(v, 4), or None where a part that needs tangents has none (they are computed then, for all alike)."""
    if all(part.tangents is None for part in parts):
        return None
    if any(
        part.tangents is None and material.normal_texture is not None
        for part, material in zip(parts, materials, strict=True)
    ):
        file.notes.append("tangents are only on some parts and are computed anew")
        return None
    out = []
    for part in parts:
        if part.tangents is None:
            axis = np.where(np.abs(part.normals[:, :1]) < 0.9, (1.0, 0, 0), (0, 1.0, 0))
            out.append(np.concatenate([_unit(np.cross(part.normals, axis)), np.ones((len(axis), 1))], 1))
        else:
            out.append(part.tangents)
    return np.concatenate(out)
