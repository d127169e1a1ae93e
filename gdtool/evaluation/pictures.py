"""Compare pictures: views with views, renders with renders, and a result's own buffers with the views of its source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gdtool.assets.scene import Material, Scene
from gdtool.cameras import Camera, same_view
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.kinds import AssetContent, RendersContent
from gdtool.core.sources import Source
from gdtool.folders.models import load_model
from gdtool.folders.records import read_cameras
from gdtool.folders.surface import Surface, read_surface
from gdtool.folders.views import read_views
from gdtool.geometry.frames import invert_similarity, transform_points
from gdtool.images.color import linear_from_srgb
from gdtool.images.io import read_image
from gdtool.images.metrics import resized_views, views_metrics
from gdtool.shading.render.render import Renderer

# The domains that a renderer's buffers hold without any light.
UNLIT_DOMAINS = ("normal", "depth", "albedo", "roughness", "metallic")

Buffers = dict[str, np.ndarray]


class PictureSet(NamedTuple):
    """Hold pictures of k views: images by domain (k, h, w[, 3]), coverage (k, h, w), and the names of the views."""

    images: dict[str, np.ndarray]
    mask: np.ndarray
    names: list[str]

    def pick(self, names: list[str]) -> PictureSet:
        """Return the pictures of some views, in that order."""
        rows = [self.names.index(name) for name in names]
        return PictureSet({domain: stack[rows] for domain, stack in self.images.items()}, self.mask[rows], names)

    def resize(self, height: int, width: int) -> PictureSet:
        """Return the pictures at another size, in pixels."""
        return PictureSet(*resized_views(self.images, self.mask, height, width), self.names)


def compare_folders(result: Folder, reference: Folder, perceptual: bool = True) -> dict[str, int | float | str]:
    """Measure the pictures of two views folders, or of two renders folders, over the views that both hold.

    Where the sizes differ, both are scaled to the smaller one. perceptual: also measure color by LPIPS and FLIP;
    "skipped" says which of these cannot be measured here, why, and what to install. Raises InputError where no view is
    in both, or where a view was not taken by the same camera.
    """
    read = _read_renders if result.kind == "renders" else _read_views
    pictures, truth = read(result), read(reference)
    shared = [name for name in truth.names if name in pictures.names]
    if not shared:
        raise InputError(
            result.path,
            f"has no view in common with {reference.path} ({', '.join(truth.names)})",
            f"run gdtool render-dataset with --cameras {reference.path}"
            if result.kind == "views"
            else "render both with the same --views",
        )
    if result.kind == "views":
        _require_same_cameras(result, reference, shared)
    height, width = min(pictures.mask.shape[1:], truth.mask.shape[1:])
    small, true_small = pictures.pick(shared).resize(height, width), truth.pick(shared).resize(height, width)
    figures: dict[str, int | float | str] = {
        "views": len(shared),
        **views_metrics(small.images, small.mask, true_small.images, true_small.mask),
    }
    return figures | _perceptual_figures(small, true_small) if perceptual else figures


def _perceptual_figures(pictures: PictureSet, truth: PictureSet) -> dict[str, int | float | str]:
    """Measure color by LPIPS and FLIP, where both sets have color; "skipped" names what cannot be measured, and why."""
    from gdtool.images import perceptual

    if "color" not in pictures.images or "color" not in truth.images:
        return {}
    reasons = perceptual.missing()
    names = [name for name in perceptual.FIGURES if name not in reasons]
    values = perceptual.perceptual_metrics(
        pictures.images["color"], pictures.mask, truth.images["color"], truth.mask, names
    )
    figures: dict[str, int | float | str] = {f"color_{name}": value for name, value in values.items()}
    if reasons:
        by_reason = {
            reason: [f"color_{n}" for n, why in reasons.items() if why == reason] for reason in reasons.values()
        }
        figures["skipped"] = ". ".join(f"{', '.join(names)}: {reason}" for reason, names in by_reason.items())
    return figures


def compare_rendered(result: Source, views: Folder) -> dict[str, int | float]:
    """Render a result's unlit buffers through the cameras of a views folder, and measure them against its pictures."""
    truth = read_views(views, UNLIT_DOMAINS)
    images: dict[str, np.ndarray] = {}
    for scene, channels in _scenes_of(result):
        renderer = Renderer(scene)
        buffers = [renderer.buffers(camera) for camera in truth.cameras]
        images |= {
            domain: np.stack([channel(frame) for frame in buffers])
            for domain, channel in channels.items()
            if domain in (*truth.images, "mask")
        }
    mask = images.pop("mask")
    return {"views": len(truth.cameras), **views_metrics(images, mask, truth.images, truth.mask)}


def _read_views(folder: Folder) -> PictureSet:
    """Read a views folder."""
    views = read_views(folder)
    return PictureSet(views.images, views.mask, list(views.names))


def _read_renders(folder: Folder) -> PictureSet:
    """Read the frames of a renders folder as linear color. Raises InputError for different sizes or missing alpha."""
    names = [f"{i:03d}" for i in range(folder.content_as(RendersContent).frames)]
    frames = [read_image(folder.file(f"{name}.png")) for name in names]
    if len({frame.shape for frame in frames}) > 1 or frames[0].shape[2] != 4:
        raise InputError(folder.path, "has frames of different sizes, or without alpha", "run gdtool relight again")
    stack = np.stack(frames).astype(np.float32) / np.iinfo(frames[0].dtype).max
    return PictureSet({"color": linear_from_srgb(stack[..., :3]).astype(np.float32)}, stack[..., 3], names)


def _require_same_cameras(result: Folder, reference: Folder, names: list[str]) -> None:
    """Raise InputError where a view was taken by another camera; the sizes of the pictures may differ."""
    cameras, true_cameras = (_cameras_by_name(folder) for folder in (result, reference))
    for name in names:
        if not same_view(cameras[name], true_cameras[name]):
            raise InputError(
                result.path,
                f"sees {name} from another camera than {reference.path}",
                f"run gdtool render-dataset with --cameras {reference.path}",
            )


def _cameras_by_name(folder: Folder) -> dict[str, Camera]:
    """Read the cameras of a views folder."""
    return {camera.name: camera for camera in read_cameras(folder.file("cameras.json"))}


def _buffer(name: str) -> Callable[[Buffers], np.ndarray]:
    """Return a function that returns one of the buffers of a rendered frame, by its name."""
    return lambda buffers: buffers[name]


def _albedo_channel(index: int) -> Callable[[Buffers], np.ndarray]:
    """Return a function that returns one channel (0 to 2) of the base color of a rendered frame."""
    return lambda buffers: buffers["albedo"][..., index]


def _scenes_of(source: Source) -> list[tuple[Scene, dict[str, Callable[[Buffers], np.ndarray]]]]:
    """List the scenes to render for a result, in the normalised frame, each with the domains to take from its buffers.

    A surface has its material at the vertices, where a Scene has a base color only. So roughness and metallic are
    rendered as the base color of a second scene.
    """
    if not isinstance(source, Folder) or source.kind != "surface":
        all_domains = {name: _buffer(name) for name in (*UNLIT_DOMAINS, "mask")}
        scene = load_model(source)
        if isinstance(source, Folder) and source.content_as(AssetContent).frame == "source":
            scene = _normalised(scene, source)
        return [(scene, all_domains)]
    surface = read_surface(source)
    scene = _scene_of_surface(surface)
    packed = _rgba(np.stack([surface.roughness, surface.metallic, surface.metallic], -1))
    return [
        (scene, {name: _buffer(name) for name in ("normal", "depth", "albedo", "mask")}),
        (replace(scene, colors=packed), {"roughness": _albedo_channel(0), "metallic": _albedo_channel(1)}),
    ]


def _scene_of_surface(surface: Surface) -> Scene:
    """Make a scene of a surface with its albedo at the vertices."""
    return Scene(
        surface.vertices,
        surface.faces,
        (Material("surface", metallic=0.0),),
        normals=surface.normals,
        colors=_rgba(surface.albedo),
    )


def _rgba(color: np.ndarray) -> np.ndarray:
    """Append an alpha of 1 to colors (v, 3)."""
    return np.concatenate([color, np.ones((len(color), 1))], -1)


def _normalised(scene: Scene, folder: Folder) -> Scene:
    """Move the scene of an asset from its source's frame to the normalised one."""
    matrix = invert_similarity(np.array(folder.content.source_from_world).reshape(4, 4))
    turn = matrix[:3, :3] / np.linalg.norm(matrix[:3, 0])
    normals = None if scene.normals is None else scene.normals @ turn.T
    tangents = (
        None if scene.tangents is None else np.concatenate([scene.tangents[:, :3] @ turn.T, scene.tangents[:, 3:]], 1)
    )
    return replace(scene, vertices=transform_points(matrix, scene.vertices), normals=normals, tangents=tangents)
