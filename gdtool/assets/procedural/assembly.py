"""An object in the making: parts with their finishes, joined into one normalised glTF scene."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural.finishes import Finish, Shape
from gdtool.assets.procedural.parts import Part
from gdtool.assets.scene import Scene


class Assembly:
    """Collects (part, finish); parts that were given the same finish object share one material."""

    def __init__(self):
        self.parts: list[Part] = []
        self.finishes: list[Finish] = []

    def add(self, part: Part, finish: Finish) -> None:
        """Add a part with its finish."""
        self.parts.append(part)
        self.finishes.append(finish)

    def add_pair(self, part: Part, finish: Finish) -> None:
        """Add a part and its mirror image in x."""
        self.add(part, finish)
        self.add(part.mirrored(), finish)

    def scene(self, name: str) -> Scene:
        """One scene, bounding box centred at the origin, longest side 1. uvs: (surface set, field set)."""
        everything = np.concatenate([part.vertices for part in self.parts])
        low, high = everything.min(axis=0), everything.max(axis=0)
        scale, center = 1.0 / (high - low).max(), (low + high) / 2
        groups: dict[int, list[int]] = {}
        for i, finish in enumerate(self.finishes):
            groups.setdefault(id(finish), []).append(i)

        vertices, normals, faces, material_idx, surface_uv, field_uv, materials = [], [], [], [], [], [], []
        offset = 0
        for members in groups.values():
            parts = [self.parts[i] for i in members]
            points = (np.concatenate([part.vertices for part in parts]) - center) * scale
            directions = np.concatenate([part.normals for part in parts])
            starts = np.cumsum([0, *[len(part.vertices) for part in parts]])
            triangles = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
            look = self.finishes[members[0]](
                Shape(points, directions, lambda p=points, n=directions, f=triangles: convexity(p, n, f))
            )
            vertices.append(points)
            normals.append(directions)
            faces.append(triangles + offset)
            material_idx.append(np.full(len(triangles), len(materials), np.int32))
            surface_uv.extend(_tiled_uv(part, scale, look.tiles_per_unit) for part in parts)
            field_uv.append(np.zeros((len(points), 2)) if look.field_uv is None else look.field_uv)
            materials.append(look.material)
            offset += len(points)
        return Scene(
            vertices=np.concatenate(vertices),
            faces=np.concatenate(faces).astype(np.int32),
            materials=tuple(materials),
            material_idx=np.concatenate(material_idx),
            normals=np.concatenate(normals),
            uvs=(np.concatenate(surface_uv), np.concatenate(field_uv)),
            name=name,
        )


def _tiled_uv(part: Part, scale: float, tiles_per_unit: float) -> np.ndarray:
    """Texture coordinates in tiles; a grid's own coordinates get whole numbers of tiles so that its seam closes."""
    if part.extent is None:
        return part.uv * scale * tiles_per_unit
    repeats = np.maximum(1, np.round(np.array(part.extent) * scale * tiles_per_unit))
    return part.uv * repeats


def convexity(points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Smoothed mean curvature per vertex (v,) of the welded mesh, scaled to about 1 on a sharp convex edge, < 0 in
    hollows."""
    _, weld = np.unique(
        np.round(points * 1e6).astype(np.int64) @ np.array([1, 2_097_143, 4_398_016_094_209]), return_inverse=True
    )
    count = weld.max() + 1
    share = np.bincount(weld, minlength=count)
    position = np.stack([np.bincount(weld, points[:, k], count) / share for k in range(3)], -1)
    normal = np.stack([np.bincount(weld, normals[:, k], count) for k in range(3)], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    edges = weld[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
    a, b = edges[:, 0], edges[:, 1]
    step = position[b] - position[a]
    turn = np.einsum("ij,ij->i", normal[b] - normal[a], step) / np.maximum(np.linalg.norm(step, axis=1), 1e-6)
    degree = np.maximum(np.bincount(a, minlength=count) + np.bincount(b, minlength=count), 1)
    value = (np.bincount(a, turn, count) + np.bincount(b, turn, count)) / degree * 3.0
    for _ in range(2):
        value = 0.5 * value + 0.5 * (np.bincount(a, value[b], count) + np.bincount(b, value[a], count)) / degree
    return np.clip(value, -1.5, 1.5)[weld]
