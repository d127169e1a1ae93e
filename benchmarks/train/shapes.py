"""Compare the shapes of models by their occupancy on a coarse grid, to find copies among training objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.assets.load import load_scene
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import RayCaster

CELLS = 48  # cells along each side of the unit box: a twentieth of a chair's leg is seen, a bevel is not
RAYS = 2  # rays across a cell, each way: thin parts are hit that lie beside a cell's centre
_CHUNK = 512  # objects whose cells are held as float32 at a time: 230 MB


def occupancy(path: Path) -> np.ndarray:
    """Carve a model's cells from its depth along both ways of the three axes; returns (CELLS³ / 8,) packed bits.

    The model is centred and its longest side is 1, as render-dataset places it. A cell is full where a ray meets the
    surface, and where no side sees its centre. Axes x, y, z of the model's frame.
    """
    scene = load_scene(path)
    vertices = transform_points(invert_similarity(unit_box(scene.vertices[np.unique(scene.faces)])), scene.vertices)
    caster = RayCaster(TriMesh(vertices, scene.faces), 1)
    centres = (np.arange(CELLS * RAYS) + 0.5) / (CELLS * RAYS) - 0.5
    place = (np.arange(CELLS) + 0.5) / CELLS  # of a cell along the ray, from the side where it starts
    hidden, surface = np.ones((CELLS,) * 3, bool), np.zeros((CELLS,) * 3, bool)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for sign in (1.0, -1.0):
            origins = np.full((len(centres) ** 2, 3), -sign)  # half a unit outside the box
            origins[:, others] = np.stack(np.meshgrid(centres, centres, indexing="ij"), -1).reshape(-1, 2)
            direction = sign * np.eye(3)[axis]
            hits = caster.first_hit(origins, np.broadcast_to(direction, origins.shape))
            points = origins[hits.is_hit] + hits.distance[hits.is_hit, None] * direction
            surface[tuple(np.clip(np.floor((points + 0.5) * CELLS).astype(int), 0, CELLS - 1).T)] = True
            depth = hits.distance.reshape(CELLS, RAYS, CELLS, RAYS).min((1, 3)) - 0.5
            behind = place[None, None] >= depth[..., None]
            hidden &= np.moveaxis(behind if sign > 0 else behind[..., ::-1], -1, axis)
    return np.packbits(hidden | surface)


def turned(cells: np.ndarray) -> list[np.ndarray]:
    """Return eight copies of cells (CELLS,) * 3: turned by quarters about the vertical, and mirrored."""
    return [np.rot90(one, k, (0, 2)) for one in (cells, cells[::-1]) for k in range(4)]


def best_overlaps(some: list[np.ndarray], others: list[np.ndarray]) -> np.ndarray:
    """Compute the largest intersection over union of each pair's cells, over the eight ways to turn the first.

    some, others: packed bits of occupancy(). Returns (len(some), len(others)).
    """
    out = np.zeros((len(some), len(others)), np.float32)
    for start in range(0, len(others), _CHUNK):
        right = np.unpackbits(np.stack(others[start : start + _CHUNK]), axis=1).astype(np.float32)
        volume = right.sum(1)
        for row, packed in enumerate(some):
            ways = np.stack([x.reshape(-1) for x in turned(np.unpackbits(packed).reshape((CELLS,) * 3))])
            shared = right @ ways.T.astype(np.float32)
            either = volume[:, None] + float(ways[0].sum()) - shared
            out[row, start : start + _CHUNK] = (shared / np.maximum(either, 1)).max(1)
    return out
