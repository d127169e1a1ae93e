"""What a rendering did not do because the scene did not need it, and about how long that would have taken."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from gdtool.shading.render.render import BASE

if TYPE_CHECKING:
    from gdtool.shading.render.direct import DirectLight
    from gdtool.shading.render.render import Renderer

TEXTURES = {
    "base color": "base_color_texture",
    "metallic-roughness": "metallic_roughness_texture",
    "normal": "normal_texture",
    "emissive": "emissive_texture",
}


def savings(renderer: Renderer, samples: int, light: DirectLight | None) -> list[tuple[str, str, float]]:
    """(what, why, seconds) of each skip. Seconds are what one such step took here, times the steps left out; those of a
    texture that is not there are what reading a tiny one takes."""
    counts, scene, out = renderer.counts, renderer.scene, []
    taken = max(counts.samples, 1)
    absent = [what for what, name in TEXTURES.items() if all(getattr(m, name) is None for m in scene.materials)]
    if absent:
        each = _lookup_seconds() * taken
        out += [(f"{what} lookups", "no material has such a texture", each) for what in absent]
    flat = [
        what
        for what, name in TEXTURES.items()
        if what not in absent
        and all(
            t is None or renderer.lookup.constant(t) is not None for t in (getattr(m, name) for m in scene.materials)
        )
    ]
    out += [(f"{what} lookups", "the texture is one value everywhere", _lookup_seconds() * taken) for what in flat]
    if renderer.tested is None:
        out.append(("alpha tests", "every material is opaque", _lookup_seconds() * taken))
    if counts.pixels_in_bounds < counts.pixels:
        outside = counts.pixels - counts.pixels_in_bounds
        reason = f"{outside / counts.pixels:.0%} of the pixels lie outside the object's projected bounds"
        out.append(("rays", reason, outside * min(BASE, samples) * counts.seconds.get("rays", 0.0) / taken))
    fewer = counts.pixels_in_bounds * samples - counts.samples
    if fewer > 0:
        even = 1 - counts.pixels_refined / max(counts.pixels_in_bounds, 1)
        reason = f"{even:.0%} of the pixels in bounds are even and got {BASE} of {samples}; {counts.samples / max(counts.pixels_in_bounds, 1):.1f} on average"
        out.append(("samples", reason, fewer * counts.seconds.get("samples", 0.0) / taken))
    directions = (
        counts.shadow_rays + counts.shadow_rays_below_horizon + counts.shadow_rays_convex + counts.shadow_rays_rare
    )
    each = counts.seconds.get("directions", 0.0) / max(directions, 1)
    if counts.shadow_rays_below_horizon:
        reason = f"{counts.shadow_rays_below_horizon / directions:.0%} of the directions are below the horizon"
        out.append(("shadow rays", reason, counts.shadow_rays_below_horizon * each))
    if counts.shadow_rays_convex:
        out.append(
            (
                "shadow rays of convex objects",
                "nothing lies in front of a convex object's outside",
                counts.shadow_rays_convex * each,
            )
        )
    if counts.shadow_rays_rare:
        reason = f"{counts.shadow_rays_rare / directions:.0%} of the directions bring little light and were left out by chance, the others counting for more"
        out.append(("shadow rays toward little light", reason, counts.shadow_rays_rare * each))
    if light is not None and light.prefiltered is not None and light.prefiltered.images:
        from gdtool.shading.lights.prefilter import LADDER

        made = light.prefiltered.images
        if len(made) < len(LADDER):
            texels = sum(side**2 for _, side, _ in LADDER)
            here = sum(LADDER[level][1] ** 2 for level in made)
            reason = f"the scene's roughness needs {len(made)} of {len(LADDER)}"
            out.append(("prefiltered levels", reason, light.prefiltered.seconds * (texels - here) / here))
    return [(what, why, float(seconds)) for what, why, seconds in out]


def _lookup_seconds(count: int = 4096) -> float:
    """Seconds that reading a texture at one point takes on this machine."""
    from gdtool.assets.scene import Texture
    from gdtool.shading.render.textures import TextureReader

    reader = TextureReader(Texture(np.zeros((2, 2, 3), np.uint8), "srgb"))
    uv = np.random.default_rng(0).random((count, 2))
    reader.read(uv)
    at = time.perf_counter()
    reader.read(uv)
    return (time.perf_counter() - at) / count
