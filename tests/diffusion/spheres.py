"""Make analytic training data: a painted sphere for each seed, in the default rig's views."""

from __future__ import annotations

import numpy as np

from gdtool.cameras import rays, rig
from gdtool.folders.views import Views

LIGHT = {
    "kind": "spherical_gaussians",
    "axes": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
    "sharpness": [1.0, 4.0],
    "amplitudes": [[0.5, 0.5, 0.5], [0.3, 0.2, 0.1]],
}


def sphere_views(
    seed: int, size: int = 32, domains=("color", "normal", "depth", "albedo", "roughness", "metallic")
) -> Views:
    """Render a sphere of radius 0.5 at the origin analytically, with exact depth.

    It is red where x > 0 and green elsewhere. The seed sets its brightness, roughness and metallic.
    """
    cameras = rig("six", size)
    rng = np.random.default_rng(seed)
    tint, roughness, metallic = 0.3 + 0.7 * rng.random(), rng.random(), float(rng.random() < 0.5)
    stacks: dict[str, list] = {d: [] for d in (*domains, "mask")}
    for camera in cameras:
        origins, directions = rays(camera)
        b = (origins * directions).sum(-1)
        square = b * b - ((origins**2).sum(-1) - 0.25)
        mask = square > 0
        depth = np.where(mask, -b - np.sqrt(np.maximum(square, 0)), 0)
        normal = np.where(mask[..., None], (origins + depth[..., None] * directions) / 0.5, 0)
        albedo = np.where(normal[..., :1] > 0, [0.8, 0.2, 0.1], [0.1, 0.7, 0.2]) * tint * mask[..., None]
        lit = albedo * np.clip(normal[..., 2:] * 0.5 + 0.5, 0, 1)
        every = {
            "color": lit,
            "normal": normal,
            "depth": depth,
            "albedo": albedo,
            "roughness": roughness * mask,
            "metallic": metallic * mask,
            "mask": mask,
        }
        for name, stack in stacks.items():
            stack.append(np.asarray(every[name], np.float32))
    images = {name: np.stack(stack) for name, stack in stacks.items()}
    return Views(cameras, {d: images[d] for d in domains}, images["mask"], LIGHT)
