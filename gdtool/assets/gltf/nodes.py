"""Walk the node tree of a glTF file: which nodes the scene shows, their transforms, and how skins move vertices."""

from __future__ import annotations

import numpy as np

from gdtool.assets.gltf.document import EXPORT, GltfFile
from gdtool.assets.gltf.schema import Node, Primitive

_UNSKINNED = "export it without the skin"
_MAX_INFLUENCE_SETS = 8  # JOINTS_0 to JOINTS_7: 32 joints a vertex, more than any exporter writes


def visible_nodes(file: GltfFile) -> list[int]:
    """List the indices of the default scene's nodes, parents before children; all nodes where the file has no scene.

    Raises InputError where the scene reaches a node twice.
    """
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


def world_matrices(file: GltfFile) -> list[np.ndarray]:
    """Compute world_from_node (4, 4) of every node.

    Raises InputError where the nodes are not trees or a transform is not finite.
    """
    nodes = file.document.nodes
    parent = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.children:
            file.item(nodes, child, "node")
            if parent[child] >= 0 or child == index:
                raise file.refuse(f"node {child} has two parents or is its own: the nodes must be a tree", EXPORT)
            parent[child] = index
    worlds: dict[int, np.ndarray] = {}
    stack = [i for i in range(len(nodes)) if parent[i] < 0]
    while stack:
        index = stack.pop()
        local = _local_matrix(file, nodes[index], index)
        worlds[index] = local if parent[index] < 0 else worlds[parent[index]] @ local
        stack += nodes[index].children
    for index in range(len(nodes)):
        if index not in worlds:
            raise file.refuse(f"node {index} is part of a cycle: the nodes must be a tree", EXPORT)
        if not np.isfinite(worlds[index]).all():
            raise file.refuse(f"node {index} has a transform that is not finite", "reset the transform of that node")
    return [worlds[index] for index in range(len(nodes))]


def _local_matrix(file: GltfFile, node: Node, index: int) -> np.ndarray:
    """Compute parent_from_node (4, 4), from the node's matrix or its translation, rotation and scale."""
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


def joint_matrices(
    file: GltfFile, node: Node, worlds: list[np.ndarray], primitive: Primitive, count: int, subject: str
) -> np.ndarray | None:
    """Blend world_from_bind (count, 4, 4) for each vertex of a skinned primitive; None for a rigid one.

    glTF 2.0 specification, section 3.7.3. worlds: world_from_node of every node. subject names the primitive in errors.
    """
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
    for k in range(_MAX_INFLUENCE_SETS):
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
