"""Render objects for ground-truth views: accept or refuse them, choose their light, and render views and conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.cameras import Camera
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.kinds import DOMAINS, ViewsContent
from gdtool.geometry.enclosed_bodies import enclosed_bodies_warning
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.images.color import srgb_from_linear
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import BUNDLED
from gdtool.shading.lights.environment import Environment
from gdtool.shading.lights.studio import studio
from gdtool.shading.render.direct import DirectLight
from gdtool.shading.render.placement import seed_of
from gdtool.shading.render.render import Renderer
from gdtool.shading.render.rigs import condition_camera

# Least share of an object's area with textures for the object to count as complete.
MIN_COMPLETE_AREA = 0.95
# Random lights are numbered below this.
RANDOM_LIGHTS = 10**9


def examine(scene: Scene, name: str, generated: bool, complete: bool) -> Iterator[str]:
    """Yield a warning for each oddity of a model: what its reader ignored, and parts inside of others.

    complete: raise InputError, after the warnings, where textures are missing (require_complete_pbr).
    """
    yield from scene.notes
    # The parts of generated objects overlap on purpose.
    if not generated and (inner := enclosed_bodies_warning(TriMesh(scene.vertices, scene.faces), welded=False)):
        yield inner
    if complete:
        require_complete_pbr(scene, name)


def require_complete_pbr(scene: Scene, name: str) -> None:
    """Raise InputError where more than 5 % of a scene's area lacks a base color or metallic-roughness texture."""
    complete = np.array(
        [
            (m.base_color_texture is not None or scene.colors is not None) and m.metallic_roughness_texture is not None
            for m in scene.materials
        ]
    )
    area = face_normals(TriMesh(scene.vertices, scene.faces))[1]
    share = float(area[complete[scene.material_idx]].sum() / max(area.sum(), 1e-300))
    if share < MIN_COMPLETE_AREA:
        raise InputError(
            name,
            f"has complete PBR textures on {share:.0%} of its area only",
            "leave out --filter to take it all the same",
        )


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
        used = views.content_as(ViewsContent).environment
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


@dataclass(frozen=True)
class ViewOptions:
    """Choose how views are rendered: most samples per pixel, images to keep by domain, factor on the color."""

    samples: int
    domains: tuple[str, ...]
    exposure: float


def render_views(
    renderer: Renderer,
    cameras: list[Camera],
    lamps: PreparedLight | None,
    options: ViewOptions,
    progress: Callable = lambda iterable, total, label: iterable,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Render the images of all views by domain, (k, h, w[, 3]) float32, and their coverage (k, h, w).

    lamps may be None where domains have neither "color" nor "closed_form". progress(iterable, total, label) reports the
    views done.
    """

    def render(camera: Camera) -> dict[str, np.ndarray]:
        return _render_view(renderer, camera, lamps, options)

    frames = list(progress(renderer.render_each(render, cameras), len(cameras), "views"))
    domains = [domain for domain in (*DOMAINS, "closed_form") if domain in options.domains]
    images = {domain: np.stack([frame[domain] for frame in frames]) for domain in domains}
    return images, np.stack([frame["mask"] for frame in frames])


def _render_view(
    renderer: Renderer, camera: Camera, lamps: PreparedLight | None, options: ViewOptions
) -> dict[str, np.ndarray]:
    """Render one view's images by domain, "color" and "closed_form" only where they are asked for."""
    shade = lamps.direct.color(options.exposure) if lamps is not None and "color" in options.domains else None
    frame = renderer.buffers(camera, options.samples, shade)
    if lamps is not None and "closed_form" in options.domains:
        from gdtool.shading.bsdf.closed_form import closed_form_image

        frame["closed_form"] = closed_form_image(frame, camera, lamps.lobes, lamps.direct.brdf) * options.exposure
    return frame


def condition_cameras(count: int, size: int, name: str, seed: int) -> list[Camera]:
    """Draw the cameras of condition pictures, size pixels wide, by seed and the object's name."""
    rng = np.random.default_rng([seed, seed_of(name)])
    return [condition_camera(rng, f"{i:03d}", size) for i in range(count)]


def render_conditions(
    renderer: Renderer, cameras: list[Camera], direct: DirectLight, options: ViewOptions
) -> Iterator[np.ndarray]:
    """Render a condition picture (h, w, 4) for each camera: sRGB with straight alpha, in [0, 1]."""
    shade = direct.color(options.exposure)
    for frame in renderer.render_each(lambda camera: renderer.buffers(camera, options.samples, shade), cameras):
        color = srgb_from_linear(np.clip(frame["color"], 0, 1))
        yield np.concatenate([color, frame["mask"][..., None]], -1)


def clipped_share(images: dict[str, np.ndarray], mask: np.ndarray) -> float:
    """Compute the share of color values on the object that are above 1; 0 without color images."""
    return float((images["color"][mask > 0] > 1).mean()) if "color" in images else 0.0


def figures(scene: Scene, renderer: Renderer, mask: np.ndarray, lamps: PreparedLight | None) -> dict[str, float]:
    """Collect the figures of the manifest."""
    report = {
        "faces": len(scene.faces),
        "materials": len(scene.materials),
        "samples": renderer.counts.samples,
        "shadow_rays": renderer.counts.shadow_rays,
        "foreground_share": float((mask > 0).mean()),
    }
    if lamps is not None:
        report["environment_scale"] = lamps.environment.scale
        report |= {f"light_fit_{name}": value for name, value in lamps.record["fit_error"].items()}
    return report
