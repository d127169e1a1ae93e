"""Render a model from the front with gdtool: python show_in_gdtool.py MODEL OUT.png [unlit|ENV]

Frame and sun are those of show_in_three.mjs and show_in_blender.py. The picture is shaded from the exact buffers with
Lambert's law, or lit by an environment without shadows, because three.js has no shadows for such a light.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from gdtool.assets.load import load_scene
from gdtool.cameras import rig
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.images.color import srgb_from_linear
from gdtool.images.io import write_png
from gdtool.shading.lights.studio import studio
from gdtool.shading.render.direct import DirectLight, LightOptions
from gdtool.shading.render.render import Renderer, render_buffers


def main(model: str, out: str, mode: str = "lit") -> None:
    scene = load_scene(model)
    scene = replace(scene, vertices=transform_points(invert_similarity(unit_box(scene.vertices)), scene.vertices))
    front = next(camera for camera in rig("six", 512) if camera.name == "front")
    if mode in ("lit", "unlit"):
        images = render_buffers(scene, front)
        sun = np.maximum(images["normal"] @ (np.array([-1, 1, 1]) / np.sqrt(3)), 0)
        color, mask = images["albedo"] * (1.0 if mode == "unlit" else 0.3 + sun[..., None]), images["mask"]
    else:
        renderer = Renderer(scene)
        images = renderer.buffers(
            front,
            16,
            DirectLight(renderer, studio(mode, 0, fit=False)[0], 16, options=LightOptions(shadows=False)).color(),
        )
        color, mask = images["color"], images["mask"]
    write_png(out, np.concatenate([srgb_from_linear(np.clip(color, 0, 1)), mask[..., None]], -1))


if __name__ == "__main__":
    main(*sys.argv[1:])
