"""Render the lit color of a scene from one camera: set up the renderer and the light, and render."""

from __future__ import annotations

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.cameras import Camera
from gdtool.shading.lights.environment import Environment
from gdtool.shading.render.direct import DirectLight
from gdtool.shading.render.render import Renderer


def render_color(
    scene: Scene,
    camera: Camera,
    environment: Environment,
    samples: int = 16,
    light_samples: int = 16,
    seed: int = 0,
    brdf: str = "gltf",
) -> tuple[np.ndarray, np.ndarray]:
    """Render direct light with shadows: color (h, w, 3) linear radiance, and mask (h, w) coverage in [0, 1].

    samples: the most samples of a pixel. light_samples: directions that a point draws from the light, and as many from
    its reflection. brdf: "gltf" or "paper".
    """
    renderer = Renderer(scene)
    light = DirectLight(renderer, environment, light_samples, seed, brdf)
    images = renderer.buffers(camera, samples, light.color())
    return images["color"], images["mask"]
