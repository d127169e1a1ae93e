"""Place an object for rendering: into the unit box, where an earlier object stood, or turned at random."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.core import sources
from gdtool.core.folder import Folder, is_folder, open_folder
from gdtool.core.kinds import AssetContent
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

# A bounding box is about normalised when its centre and its longest side are off by less than this.
ABOUT_NORMALISED = 0.1


def seed_of(name: str) -> int:
    """Hash a name to a 64-bit number that is the same on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode(errors="surrogateescape")).digest()[:8], "big")


def in_unit_box(scene: Scene) -> tuple[Scene, np.ndarray]:
    """Centre a scene's bounding box and scale its longest side to 1; also returns source_from_world (4, 4).

    Normals and tangents stay: the scene is not turned.
    """
    matrix = unit_box(scene.vertices[np.unique(scene.faces)])
    return dataclasses.replace(scene, vertices=transform_points(invert_similarity(matrix), scene.vertices)), matrix


@dataclass(frozen=True)
class Placement:
    """How to place an object.

    source: what its scene was read from; name: of the object. views: a folder whose object's place is taken over.
    normalize: whether to centre and scale it to the unit box. turn: the largest turn about the vertical, in degrees;
    the angle is drawn by seed and name.
    """

    source: Folder | Path | str
    name: str
    views: Folder | None
    normalize: bool
    turn: float
    seed: int


def place_scene(scene: Scene, placement: Placement) -> tuple[Scene, np.ndarray]:
    """Bring a scene into the frame of the views; also returns source_from_world (4, 4).

    Where a views folder is given, the scene is put where that folder's object was, if it comes from the same source. An
    asset is in its folder's frame, and a scene whose box is about normalised stays. Any other is normalised.
    """
    identity = np.eye(4)
    used = scene.vertices[np.unique(scene.faces)]
    box = unit_box(used)
    matrix = box if placement.normalize else identity
    if placement.turn:
        matrix = _turned(used, placement)
    views = placement.views
    if views is not None and placement.normalize:
        digests = [entry.digest for entry in views.manifest.inputs if entry.role == "source"]
        asset = _asset_of(placement.source)
        if asset is not None:
            in_source = asset.content_as(AssetContent).frame == "source"
            matrix = np.array(asset.content.source_from_world).reshape(4, 4) if in_source else identity
        elif sources.digest(placement.source) in digests:
            matrix = np.array(views.content.source_from_world).reshape(4, 4)
        elif abs(box[0, 0] - 1) < ABOUT_NORMALISED and np.abs(box[:3, 3]).max() < ABOUT_NORMALISED:
            matrix = identity
    if np.array_equal(matrix, identity):
        return scene, identity
    directions = {}
    if matrix[:3, :3].astype(bool).sum() > 3:  # turned, and not only scaled
        rotation = matrix[:3, :3] / (matrix[:3, 0] ** 2).sum() ** 0.5
        directions = {
            name: np.concatenate([x[:, :3] @ rotation, x[:, 3:]], 1)
            for name in ("normals", "tangents")
            if (x := getattr(scene, name)) is not None
        }
    vertices = transform_points(invert_similarity(matrix), scene.vertices)
    return dataclasses.replace(scene, vertices=vertices, **directions), matrix


def _turned(vertices: np.ndarray, placement: Placement) -> np.ndarray:
    """Draw a turn about the y axis: source_from_world (4, 4), normalised where asked for."""
    rng = np.random.default_rng([placement.seed, seed_of(placement.name), 1])
    angle = np.radians(rng.uniform(-placement.turn, placement.turn))
    source_from_turned = np.eye(4)
    source_from_turned[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    if not placement.normalize:
        return source_from_turned
    return source_from_turned @ unit_box(vertices @ source_from_turned[:3, :3])


def _asset_of(source: Any) -> Folder | None:
    """Return the asset folder that a source is, or that its file lies in."""
    if isinstance(source, Folder):
        return source
    if isinstance(source, Path) and is_folder(source.parent):
        folder = open_folder(source.parent, check=False)
        return folder if folder.kind == "asset" else None
    return None
