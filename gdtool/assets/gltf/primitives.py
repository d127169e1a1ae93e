"""Read the triangles and vertex attributes of glTF primitives and move them into world space."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from gdtool.assets.gltf.document import EXPORT, GltfFile, printed
from gdtool.assets.gltf.schema import Primitive
from gdtool.geometry.topology import has_repeated_corner

_UV_SET = re.compile(r"TEXCOORD_[0-9]{1,3}")
_MAX_UV_SETS = 32  # a higher number is a fault of the file, and each set below it would cost an array


@dataclass
class MeshPart:
    """Hold one primitive under one node: arrays as in Scene, None where the file has none, and its material's index."""

    vertices: np.ndarray
    faces: np.ndarray
    material: int | None
    normals: np.ndarray | None = None
    tangents: np.ndarray | None = None
    uvs: tuple[np.ndarray | None, ...] = ()
    colors: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Count the bytes of all its arrays."""
        return sum(
            a.nbytes
            for a in (self.vertices, self.faces, self.normals, self.tangents, self.colors, *self.uvs)
            if a is not None
        )


def read_primitive(file: GltfFile, primitive: Primitive, weights: tuple[float, ...], subject: str) -> MeshPart | None:
    """Read a primitive in its node's space; None, with a note, for points, lines and what has no faces.

    weights: of the morph targets. subject names the primitive in notes and errors. Raises InputError.
    """
    if primitive.mode < 4:
        file.notes.append(f"{subject}: {'points' if primitive.mode == 0 else 'lines'} are left out")
        return None
    if "POSITION" not in primitive.attributes:
        file.notes.append(f"{subject}: has no positions and is left out")
        return None
    attributes, indices = _stored_arrays(file, primitive, subject)
    _check_shapes(file, attributes, subject)
    _add_morph_targets(file, primitive, weights, attributes, subject)
    positions = attributes["POSITION"]
    if not np.isfinite(positions).all():
        raise file.refuse(
            f"{subject}: vertex {int(np.argwhere(~np.isfinite(positions))[0][0])} is not finite",
            "remove that vertex or move it to a finite place",
        )
    if indices is None:
        indices = np.arange(len(positions))
    if len(indices) and indices.max() >= len(positions):
        raise file.refuse(f"{subject}: refers to vertex {int(indices.max())}, but has {len(positions)}", EXPORT)
    faces = _triangles(indices, primitive.mode)
    if not len(faces):
        file.notes.append(f"{subject}: has no faces")
        return None
    part = MeshPart(
        positions,
        faces,
        primitive.material,
        attributes.get("NORMAL"),
        attributes.get("TANGENT"),
        _uv_sets(attributes),
        _rgba_colors(file, attributes, subject),
    )
    _check_finite(file, part, subject)
    return part


def _stored_arrays(
    file: GltfFile, primitive: Primitive, subject: str
) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Read the attributes (count, ...) by name, float64, and the vertex indices, int64, or None without any."""
    compressed = primitive.extensions.KHR_draco_mesh_compression
    if compressed is not None:
        from gdtool.assets.gltf.draco import read_draco

        return read_draco(file, compressed, primitive, subject)
    attributes = {
        name: file.floats(index, always_normalized=name.startswith("COLOR_"))
        for name, index in primitive.attributes.items()
        if not name.startswith("_")
    }
    if primitive.indices is None:
        return attributes, None
    stored, record = file.accessor(primitive.indices)
    if record.type != "SCALAR" or stored.dtype.kind != "u":
        raise file.refuse(f"{subject}: its indices are not unsigned integers", EXPORT)
    return attributes, stored.astype(np.int64)


def _check_shapes(file: GltfFile, attributes: dict[str, np.ndarray], subject: str) -> None:
    """Raise InputError where an attribute has another width or count than the specification or POSITION says."""
    widths = [("POSITION", 3), ("NORMAL", 3), ("TANGENT", 4)]
    widths += [(name, 2) for name in attributes if name.startswith("TEXCOORD_")]
    for name, width in widths:
        if name in attributes and attributes[name].shape[1:] != (width,):
            raise file.refuse(f"{subject}: {printed(name)} is not a vector of {width}", EXPORT)
    count = len(attributes["POSITION"])
    for name, array in attributes.items():
        if len(array) != count:
            raise file.refuse(f"{subject}: {printed(name)} has {len(array)} elements, POSITION {count}", EXPORT)


def _add_morph_targets(
    file: GltfFile, primitive: Primitive, weights: tuple[float, ...], attributes: dict[str, np.ndarray], subject: str
) -> None:
    """Add the weighted displacements of morph targets to positions and normals, in place of the arrays."""
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
    """Form triangles (f, 3) from the indices of a list (mode 4), strip (5) or fan (6); incomplete ends are dropped.

    glTF 2.0 specification, section 3.7.2.1. Strips are joined by faces with a repeated vertex, which are left out.
    """
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    i = np.arange(len(indices) - 2)
    corners = (i, i + 1 + i % 2, i + 2 - i % 2) if mode == 5 else (i + 1, i + 2, np.zeros_like(i))
    faces = indices[np.stack(corners, 1)]
    return faces[~has_repeated_corner(faces)]


def _uv_sets(attributes: dict[str, np.ndarray]) -> tuple[np.ndarray | None, ...]:
    """Order the texture coordinates by set number; None for a number that is left out."""
    numbers = [int(name[9:]) for name in attributes if _UV_SET.fullmatch(name)]
    if max(numbers, default=0) >= _MAX_UV_SETS:
        return ()
    return tuple(attributes.get(f"TEXCOORD_{i}") for i in range(max(numbers, default=-1) + 1))


def _rgba_colors(file: GltfFile, attributes: dict[str, np.ndarray], subject: str) -> np.ndarray | None:
    """Return the vertex colours (v, 4), alpha 1 where the file stores RGB; None without any."""
    colors = attributes.get("COLOR_0")
    if colors is None:
        return None
    if colors.shape[1:] not in ((3,), (4,)):
        raise file.refuse(f"{subject}: COLOR_0 is neither RGB nor RGBA", EXPORT)
    return np.concatenate([colors[:, :3], colors[:, 3:] if colors.shape[1] == 4 else np.ones((len(colors), 1))], 1)


def _check_finite(file: GltfFile, part: MeshPart, subject: str) -> None:
    """Raise InputError for attributes that are not finite; drop such tangents, which can be computed anew."""
    for name, arrays in (
        ("a texture coordinate", part.uvs),
        ("a vertex color", (part.colors,)),
        ("a normal", (part.normals,)),
    ):
        if any(a is not None and not np.isfinite(a).all() for a in arrays):
            raise file.refuse(f"{subject}: {name} is not finite", "export it without that attribute")
    if part.tangents is not None and not np.isfinite(part.tangents).all():
        file.notes.append(f"{subject}: its tangents are not finite and are left out")
        part.tangents = None


def placed(part: MeshPart, matrix: np.ndarray) -> MeshPart:
    """Transform a part in place by one matrix (4, 4), or by one for each vertex (v, 4, 4), and return it.

    A mirroring matrix reverses the faces' winding and the handedness of the tangents.
    """

    def apply(linear: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        return np.einsum("...ij,...j->...i", linear, vectors)

    linear = matrix[..., :3, :3]
    determinant = np.linalg.det(linear)
    mirrored = bool(np.median(determinant) < 0)
    part.vertices = apply(linear, part.vertices) + matrix[..., :3, 3]
    if mirrored:
        part.faces = part.faces[:, ::-1]
    if part.normals is not None:
        # The cofactor matrix transforms normals even where a scale is zero and the inverse does not exist.
        rows = [linear[..., i, :] for i in range(3)]
        cofactor = np.stack([np.cross(rows[1], rows[2]), np.cross(rows[2], rows[0]), np.cross(rows[0], rows[1])], -2)
        part.normals = unit(apply(cofactor, part.normals)) * (-1 if mirrored else 1)
    if part.tangents is not None:
        direction = unit(apply(linear, part.tangents[:, :3]))
        part.tangents = np.concatenate([direction, part.tangents[:, 3:] * (-1 if mirrored else 1)], 1)
    return part


def compact(part: MeshPart) -> MeshPart:
    """Remove the vertices that no face refers to: primitives often share one long buffer."""
    used, faces = np.unique(part.faces, return_inverse=True)
    if len(used) == len(part.vertices):
        return part

    def pick(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array[used]

    return MeshPart(
        part.vertices[used],
        faces.reshape(-1, 3),
        part.material,
        pick(part.normals),
        pick(part.tangents),
        tuple(pick(uv) for uv in part.uvs),
        pick(part.colors),
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
