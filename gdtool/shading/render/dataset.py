"""Prepare objects for ground-truth views: accept or refuse, place and turn them, and choose their light."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.cameras import Camera
from gdtool.core import sources
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, is_folder, open_folder
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.geometry.normals import face_normals
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import BUNDLED
from gdtool.shading.lights.environment import Environment
from gdtool.shading.lights.studio import studio
from gdtool.shading.render.direct import DirectLight
from gdtool.shading.render.render import Renderer

# Least share of an object's area with textures for the object to count as complete.
MIN_COMPLETE_AREA = 0.95
# A bounding box is about normalised when its centre and its longest side are off by less than this.
ABOUT_NORMALISED = 0.1
# Random lights are numbered below this.
RANDOM_LIGHTS = 10**9


def seed_of(name: str) -> int:
    """Hash a name to a 64-bit number that is the same on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode(errors="surrogateescape")).digest()[:8], "big")


def require_complete_pbr(scene: Scene, name: str) -> None:
    """Raise InputError where more than 5 % of a scene's area lacks a base color or metallic-roughness texture."""
    complete = np.array(
        [
            (m.base_color_texture is not None or scene.colors is not None) and m.metallic_roughness_texture is not None
            for m in scene.materials
        ]
    )
    area = face_normals(scene.vertices, scene.faces)[1]
    share = float(area[complete[scene.material_idx]].sum() / max(area.sum(), 1e-300))
    if share < MIN_COMPLETE_AREA:
        raise InputError(
            name,
            f"has complete PBR textures on {share:.0%} of its area only",
            "leave out --filter to take it all the same",
        )


@dataclass(frozen=True)
class Placement:
    """Describe how an object is placed in the views' frame.

    source: what the scene was read from. name: the object's. views: a views folder of the same object whose placing is
    repeated, or None. normalize: whether to centre and scale the scene to the unit box. turn: the largest turn about
    the y axis, in degrees. seed: decides the angle, together with the name.
    """

    source: Folder | Path | str
    name: str
    views: Folder | None
    normalize: bool
    turn: float
    seed: int


def place_scene(scene: Scene, placement: Placement) -> tuple[Scene, np.ndarray]:
    """Move a scene into the views' frame; also returns the matrix source_from_world (4, 4).

    Without placement.views the scene is normalised and turned as the placement says. With a views folder, and with
    placement.normalize, the first of these rules that applies is followed. An asset is placed by the frame that its
    folder records. A scene from the views' source is placed as that folder placed it. A scene whose bounding box is
    about normalised stays. Any other scene is normalised.
    """
    identity = np.eye(4)
    used = scene.vertices[np.unique(scene.faces)]
    box = unit_box(used)
    matrix = box if placement.normalize else identity
    if placement.turn:
        matrix = _random_turn(used, placement)
    views = placement.views
    if views is not None and placement.normalize:
        digests = [entry.digest for entry in views.manifest.inputs if entry.role == "source"]
        asset = _asset_of(placement.source)
        if asset is not None:
            in_source = asset.content.frame == "source"
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


def _random_turn(vertices: np.ndarray, placement: Placement) -> np.ndarray:
    """Choose a random turn about the y axis: source_from_world (4, 4), normalised where the placement says so.

    vertices (v, 3): those that faces use. The angle is uniform within placement.turn degrees to either side.
    """
    rng = np.random.default_rng([placement.seed, seed_of(placement.name), 1])
    angle = np.radians(rng.uniform(-placement.turn, placement.turn))
    source_from_turned = np.eye(4)
    source_from_turned[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    if not placement.normalize:
        return source_from_turned
    return source_from_turned @ unit_box(vertices @ source_from_turned[:3, :3])


def _asset_of(source: Any) -> Folder | None:
    """Return the asset folder that a source is, or that its file is in, else None."""
    if isinstance(source, Folder):
        return source
    if isinstance(source, Path) and is_folder(source.parent):
        folder = open_folder(source.parent, check=False)
        return folder if folder.kind == "asset" else None
    return None


class PreparedLight(NamedTuple):
    """Hold the light of one object in four forms.

    environment: metered. lobes: spherical Gaussians. record: what light.json stores. direct: estimates light on surface
    points.
    """

    environment: Environment
    lobes: SphericalGaussians
    record: dict[str, Any]
    direct: DirectLight


def light_name(light: str, name: str, seed: int, views: Folder | None) -> str:
    """Resolve the light "random" to a name that studio() takes; any other light is returned unchanged.

    With a views folder it is the name of that folder's light, if it is a random or a bundled one. Otherwise it is
    random:NUMBER, where seed and the object's name decide the number.
    """
    if light == "random" and views is not None:
        used = views.content.environment
        # The file of another light may be missing here.
        light = used if used.startswith("random:") or used in BUNDLED else light
    if light == "random":
        light = f"random:{(seed_of(name) + seed) % RANDOM_LIGHTS}"
    return light


def prepare_light(renderer: Renderer, light: str, samples: int, seed: int, brdf: str) -> PreparedLight:
    """Prepare a light by its name, as studio() takes it, for shading the renderer's scene.

    samples: directions that a point draws from the light, and as many from its reflection. brdf: "gltf" or "paper".
    """
    import torch

    # Chunks of points are shaded in threads of this program; torch's threads would only slow them down.
    torch.set_num_threads(1)
    environment, lobes, record = studio(light, seed)
    return PreparedLight(environment, lobes, record, DirectLight(renderer, environment, samples, seed, brdf))


def render_view(
    renderer: Renderer,
    camera: Camera,
    samples: int,
    light: PreparedLight | None,
    domains: tuple[str, ...],
    exposure: float,
) -> dict[str, np.ndarray]:
    """Render one view's images (h, w[, c]) by domain; "color" and "closed_form" only where domains has them.

    samples: the most samples of a pixel. light: may be None where neither of the two is rendered. exposure: factor on
    color.
    """
    shade = None if light is None or "color" not in domains else light.direct.color(exposure)
    frame = renderer.buffers(camera, samples, shade)
    if light is not None and "closed_form" in domains:
        from gdtool.shading.bsdf.closed_form import closed_form_image

        frame["closed_form"] = closed_form_image(frame, camera, light.lobes, light.direct.brdf) * exposure
    return frame
