"""Views of analytic solids, sphere-traced, and views folders made of arrays: what the reconstruction tests start
from."""

from __future__ import annotations

import numpy as np

from gdtool.cameras import rays, rig

LIGHT = np.array([0.4, 0.7, 0.6]) / np.linalg.norm([0.4, 0.7, 0.6])


def sphere(points, radius=0.5):
    return np.linalg.norm(points, axis=-1) - radius


def cube(points, half=0.5):
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def torus(points, major=0.35, minor=0.15):
    """Axis along z: the front camera looks through the hole."""
    ring = np.hypot(points[..., 0], points[..., 1]) - major
    return np.hypot(ring, points[..., 2]) - minor


def two_balls(points):
    return np.minimum(sphere(points - [0.3, 0, 0], 0.2), sphere(points + [0.3, 0, 0], 0.2))


def gradient(distance, points, h=1e-5):
    steps = np.eye(3) * h
    out = np.stack([distance(points + s) - distance(points - s) for s in steps], -1)
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)


def material(points):
    """Smooth albedo (n, 3), roughness (n,), metallic (n,) in space."""
    return 0.5 + 0.3 * np.sin(4 * points), 0.5 + 0.3 * np.sin(3 * points[..., 1]), (points[..., 0] > 0) * 1.0


def views_of(distance, size=96, samples=2, cameras=None):
    """cameras (of the default rig without any), images by domain and mask (k, h, w): samples^2 rays a pixel, averaged
    over the covered ones. Solids lie within 0.9 of the origin, cameras outside."""
    cameras, images, masks = cameras or rig("six", size), {}, []
    for camera in cameras:
        total, cover = {}, np.zeros((size, size))
        for i in range(samples):
            for j in range(samples):
                x, y = np.meshgrid(np.arange(size) + (i + 0.5) / samples, np.arange(size) + (j + 0.5) / samples)
                origins, directions = rays(camera, np.stack([x, y], -1))
                # Along the ray, which of a perspective camera is longer than the depth.
                far = np.linalg.norm(camera.position) + 1
                along = np.full((size, size), far - 2)
                for _ in range(160):
                    along = np.minimum(along + distance(origins + along[..., None] * directions), far + 1)
                points = origins + along[..., None] * directions
                depth = along * -(directions @ camera.backward)
                hit = (along < far) & (np.abs(distance(points)) < 1e-4)
                normal = gradient(distance, points)
                albedo, roughness, metallic = material(points)
                color = albedo * (0.25 + 0.75 * np.clip(normal @ LIGHT, 0, 1))[..., None]
                for name, value in {
                    "color": color,
                    "normal": normal,
                    "depth": depth,
                    "albedo": albedo,
                    "roughness": roughness,
                    "metallic": metallic,
                }.items():
                    total[name] = total.get(name, 0) + np.where(hit if value.ndim == 2 else hit[..., None], value, 0)
                cover += hit
        for name, value in total.items():
            value = value / np.maximum(cover, 1).reshape(cover.shape + (1,) * (value.ndim - 2))
            if name == "normal":
                value = value / np.maximum(np.linalg.norm(value, axis=-1, keepdims=True), 1e-9)
            images.setdefault(name, []).append(value)
        masks.append(cover / samples**2)
    return cameras, {n: np.stack(v).astype(np.float32) for n, v in images.items()}, np.stack(masks).astype(np.float32)


def views_folder(path, cameras, images, mask, light=None):
    """Publish a views folder at path, as any other program could, and return path."""
    import msgspec

    from gdtool.core.runner import Settings, run_one
    from gdtool.core.stage import Stage
    from gdtool.folders.views import Views, write_views

    class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
        pass

    def run(inputs, options, out):
        write_views(out, Views(cameras, images, mask, light))

    stage = Stage(name="test-views", version=1, reads=("image-file",), writes="views", Options=Options, run=run)
    source = path.parent / f"{path.name}.source.png"
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_bytes(b"x")
    run_one(stage, [source], Options(), {}, Settings(output=path))
    return path
