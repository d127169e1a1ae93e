"""Collect the parts of an object with their finishes, and join them into one normalised scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gdtool.assets.procedural.finishes import Finish, Shape
from gdtool.assets.procedural.parts import Part
from gdtool.assets.scene import Material, Scene


@dataclass(frozen=True)
class _Placement:
    """Hold where a part's vertices lie in the finished scene: (vertices - center) * scale."""

    center: np.ndarray
    scale: float


class _Patch(NamedTuple):
    """Hold the parts that share a material, as a piece of the scene's arrays; faces count from the piece's first
    vertex.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    surface_uv: np.ndarray
    field_uv: np.ndarray
    material: Material


class Assembly:
    """Collect parts with their finishes; parts added with the same finish object share a material."""

    def __init__(self) -> None:
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
        """Join all parts into a scene whose bounding box is centred at the origin and has a longest side of 1.

        uvs: the surface's texture coordinates and those of the fields (see finishes.py).
        """
        everything = np.concatenate([part.vertices for part in self.parts])
        low, high = everything.min(axis=0), everything.max(axis=0)
        placement = _Placement((low + high) / 2, 1.0 / (high - low).max())
        parts_by_finish: dict[int, list[Part]] = {}
        for part, finish in zip(self.parts, self.finishes, strict=True):
            parts_by_finish.setdefault(id(finish), []).append(part)
        finish_by_id = {id(finish): finish for finish in self.finishes}
        patches = [_patch(parts, finish_by_id[key], placement) for key, parts in parts_by_finish.items()]
        starts = np.cumsum([0, *[len(patch.vertices) for patch in patches]])
        return Scene(
            vertices=np.concatenate([patch.vertices for patch in patches]),
            faces=np.concatenate([patch.faces + start for patch, start in zip(patches, starts, strict=False)]).astype(
                np.int32
            ),
            materials=tuple(patch.material for patch in patches),
            material_idx=np.repeat(np.arange(len(patches), dtype=np.int32), [len(patch.faces) for patch in patches]),
            normals=np.concatenate([patch.normals for patch in patches]),
            uvs=(
                np.concatenate([patch.surface_uv for patch in patches]),
                np.concatenate([patch.field_uv for patch in patches]),
            ),
            name=name,
        )


def _patch(parts: list[Part], finish: Finish, placement: _Placement) -> _Patch:
    """Place parts and apply the finish that they share."""
    points = (np.concatenate([part.vertices for part in parts]) - placement.center) * placement.scale
    normals = np.concatenate([part.normals for part in parts])
    starts = np.cumsum([0, *[len(part.vertices) for part in parts]])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    look = finish(Shape(points, normals, lambda: convexity(points, normals, faces)))
    return _Patch(
        vertices=points,
        normals=normals,
        faces=faces,
        surface_uv=np.concatenate([_tiled_uv(part, placement.scale, look.tiles_per_unit) for part in parts]),
        field_uv=np.zeros((len(points), 2)) if look.field_uv is None else look.field_uv,
        material=look.material,
    )


def _tiled_uv(part: Part, scale: float, tiles_per_unit: float) -> np.ndarray:
    """Scale a part's texture coordinates to tiles, a whole number of them around a grid so that its seam closes."""
    if part.extent is None:
        return part.uv * scale * tiles_per_unit
    repeats = np.maximum(1, np.round(np.array(part.extent) * scale * tiles_per_unit))
    return part.uv * repeats


def convexity(points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Measure the smoothed mean curvature at each vertex (v,), after welding vertices of equal position.

    It is about 1 on a sharp convex edge and negative in hollows, clipped to [-1.5, 1.5], without a unit.
    """
    _, weld = np.unique(
        np.round(points * 1e6).astype(np.int64) @ np.array([1, 2_097_143, 4_398_016_094_209]), return_inverse=True
    )
    count = weld.max() + 1
    share = np.bincount(weld, minlength=count)
    position = np.stack([np.bincount(weld, points[:, k], count) / share for k in range(3)], -1)
    normal = np.stack([np.bincount(weld, normals[:, k], count) for k in range(3)], -1)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    edges = weld[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
    a, b = edges[:, 0], edges[:, 1]
    step = position[b] - position[a]
    turn = np.einsum("ij,ij->i", normal[b] - normal[a], step) / np.maximum(np.linalg.norm(step, axis=1), 1e-6)
    degree = np.maximum(np.bincount(a, minlength=count) + np.bincount(b, minlength=count), 1)
    value = (np.bincount(a, turn, count) + np.bincount(b, turn, count)) / degree * 3.0
    for _ in range(2):
        value = 0.5 * value + 0.5 * (np.bincount(a, value[b], count) + np.bincount(b, value[a], count)) / degree
    return np.clip(value, -1.5, 1.5)[weld]
