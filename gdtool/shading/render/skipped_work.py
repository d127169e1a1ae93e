"""Report the work that a rendering left out because the scene did not need it, and the time that this saved."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gdtool.shading.render.render import BASE_SAMPLES

if TYPE_CHECKING:
    from gdtool.shading.render.direct import DirectLight
    from gdtool.shading.render.render import Renderer

TEXTURES = {
    "base color": "base_color_texture",
    "metallic-roughness": "metallic_roughness_texture",
    "normal": "normal_texture",
    "emissive": "emissive_texture",
}


class SkippedStep(NamedTuple):
    """Describe work that was left out: what, why, and the seconds that it would have taken."""

    what: str
    why: str
    seconds: float


def skipped_work(renderer: Renderer, samples: int, light: DirectLight | None) -> list[SkippedStep]:
    """List the work that the renderer and the light have left out so far.

    samples: the most samples of a pixel. Seconds are the measured time of one such step, times the number of steps left
    out. For a texture that does not exist it is the time of reading a tiny one.
    """
    return [
        *_texture_lookups(renderer),
        *_samples(renderer, samples),
        *_shadow_rays(renderer),
        *([] if light is None else _prefiltered_levels(light)),
    ]


def _texture_lookups(renderer: Renderer) -> list[SkippedStep]:
    """List the lookups of textures that are absent or constant, and the alpha tests of opaque scenes."""
    scene, taken, out = renderer.scene, max(renderer.counts.samples, 1), []
    absent = [what for what, name in TEXTURES.items() if all(getattr(m, name) is None for m in scene.materials)]
    if absent:
        seconds = float(_lookup_seconds() * taken)
        out += [SkippedStep(f"{what} lookups", "no material has such a texture", seconds) for what in absent]
    for what, name in TEXTURES.items():
        textures = [getattr(material, name) for material in scene.materials]
        if what not in absent and all(t is None or renderer.lookup.constant(t) is not None for t in textures):
            seconds = float(_lookup_seconds() * taken)
            out.append(SkippedStep(f"{what} lookups", "the texture is one value everywhere", seconds))
    if renderer.tested is None:
        out.append(SkippedStep("alpha tests", "every material is opaque", float(_lookup_seconds() * taken)))
    return out


def _samples(renderer: Renderer, samples: int) -> list[SkippedStep]:
    """List the rays outside the object's bounds, and the samples of pixels whose mean was known with fewer."""
    counts, out = renderer.counts, []
    taken = max(counts.samples, 1)
    if counts.pixels_in_bounds < counts.pixels:
        outside = counts.pixels - counts.pixels_in_bounds
        why = f"{outside / counts.pixels:.0%} of the pixels lie outside the object's projected bounds"
        seconds = outside * min(BASE_SAMPLES, samples) * counts.seconds.get("rays", 0.0) / taken
        out.append(SkippedStep("rays", why, float(seconds)))
    fewer = counts.pixels_in_bounds * samples - counts.samples
    if fewer > 0:
        in_bounds = max(counts.pixels_in_bounds, 1)
        uniform = 1 - counts.pixels_refined / in_bounds
        why = (
            f"{uniform:.0%} of the pixels in bounds are uniform and got {BASE_SAMPLES} of {samples}; "
            f"{counts.samples / in_bounds:.1f} on average"
        )
        out.append(SkippedStep("samples", why, float(fewer * counts.seconds.get("samples", 0.0) / taken)))
    return out


def _shadow_rays(renderer: Renderer) -> list[SkippedStep]:
    """List the shadow rays that were not cast."""
    counts, out = renderer.counts, []
    below, convex, rare = counts.shadow_rays_below_horizon, counts.shadow_rays_convex, counts.shadow_rays_rare
    directions = counts.shadow_rays + below + convex + rare
    each = counts.seconds.get("directions", 0.0) / max(directions, 1)
    if below:
        why = f"{below / directions:.0%} of the directions are below the horizon"
        out.append(SkippedStep("shadow rays", why, float(below * each)))
    if convex:
        why = "nothing lies in front of a convex object's outside"
        out.append(SkippedStep("shadow rays of convex objects", why, float(convex * each)))
    if rare:
        why = (
            f"{rare / directions:.0%} of the directions contribute little light and were left out by chance, "
            "with a larger weight for the others"
        )
        out.append(SkippedStep("shadow rays toward little light", why, float(rare * each)))
    return out


def _prefiltered_levels(light: DirectLight) -> list[SkippedStep]:
    """List the prefiltered images that the scene's roughness did not need."""
    from gdtool.shading.lights.prefilter import ROUGHNESS_LEVELS

    if light.prefiltered is None or not light.prefiltered.images:
        return []
    made = light.prefiltered.images
    if len(made) == len(ROUGHNESS_LEVELS):
        return []
    texels = sum(level.side**2 for level in ROUGHNESS_LEVELS)
    here = sum(ROUGHNESS_LEVELS[k].side ** 2 for k in made)
    why = f"the scene's roughness needs {len(made)} of {len(ROUGHNESS_LEVELS)}"
    return [SkippedStep("prefiltered levels", why, float(light.prefiltered.seconds * (texels - here) / here))]


def _lookup_seconds(count: int = 4096) -> float:
    """Measure the seconds of a texture lookup at one point, on this machine, over count points."""
    from gdtool.assets.scene import Texture
    from gdtool.shading.render.textures import TextureReader

    reader = TextureReader(Texture(np.zeros((2, 2, 3), np.uint8), "srgb"))
    uv = np.random.default_rng(0).random((count, 2))
    reader.read(uv)  # the first read warms up
    started = time.perf_counter()
    reader.read(uv)
    return (time.perf_counter() - started) / count
