"""Measure whether the views of one object agree, without ground truth.

The domains overlap: the material maps under light give the color, the slopes of depth give the normals, and a point
that two cameras see is the same point.
"""

from __future__ import annotations

import numpy as np

from gdtool.cameras import project, rays
from gdtool.folders.views import Views

FULL_COVERAGE = 0.99  # coverage of a pixel whose value is not mixed with the background
DEPTH_EDGE = 0.05  # world units: a larger difference in depth between neighbours is an edge and no slope
HIDDEN_DISTANCE = 0.1  # world units: a point further behind the surface that another view sees is hidden from it


def consistency(views: Views) -> dict[str, float]:
    """Compute four measures of agreement, by name, as the functions below define them.

    They are rerendered_psnr (dB), slope_degrees (median), reprojection_depth (median, world units) and
    reprojection_share (of points within 0.02 world units).
    """
    distance, share = reprojection(views)
    return {
        "rerendered_psnr": rerendered_psnr(views),
        "slope_degrees": slope_degrees(views),
        "reprojection_depth": distance,
        "reprojection_share": share,
    }


def rerendered_psnr(views: Views, count: int = 4000, seed: int = 0) -> float:
    """Compute the PSNR in dB of the color views against the other maps, shaded under one light.

    The light is the sum of spherical Gaussians that explains the color best, by least squares at `count` random
    foreground pixels of all views. The PSNR is taken in sRGB at as many other pixels. Shading is in closed form, so
    shadows and reflections of the object in itself count as error.
    """
    import torch

    from gdtool.fields.appearance.light import ShadedPoints, recover_light, unoccluded
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.metrics import psnr
    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians

    inside = views.mask > FULL_COVERAGE
    toward = (
        np.stack([c.backward for c in views.cameras])[:, None, None]
        .repeat(inside.shape[1], 1)
        .repeat(inside.shape[2], 2)
    )
    rows = np.random.default_rng(seed).permutation(int(inside.sum()))[: 2 * count]
    pick = {
        d: views.images[d][inside][rows].astype(np.float32)
        for d in ("color", "normal", "albedo", "roughness", "metallic")
    }
    toward = toward[inside][rows].astype(np.float32)
    fit, test = slice(0, len(rows) // 2), slice(len(rows) // 2, None)
    surface = [pick["normal"], toward, pick["albedo"], pick["roughness"], pick["metallic"]]
    points = ShadedPoints(*(values[fit] for values in surface), unoccluded(pick["normal"][fit]))
    light, _ = recover_light(points, pick["color"][fit])
    lobes = SphericalGaussians(
        *(torch.tensor(np.array(light[name]), dtype=torch.float32) for name in ("axes", "sharpness", "amplitudes"))
    )
    rendered = shade(*(torch.from_numpy(values[test]) for values in surface), lobes).clamp(0, 1).numpy()
    return psnr(srgb_from_linear(rendered)[None], srgb_from_linear(np.clip(pick["color"][test], 0, 1))[None])


def slope_degrees(views: Views) -> float:
    """Measure the median angle in degrees between the normals and the slope of depth, away from depth's edges.

    The slope is a central difference over pixels that the object covers. NaN where no pixel can be used.
    """
    angles = []
    for k, camera in enumerate(views.cameras):
        points = _points(camera, views.images["depth"][k])
        inside, depth = views.mask[k] > FULL_COVERAGE, views.images["depth"][k]
        along, across = points[1:-1, 2:] - points[1:-1, :-2], points[:-2, 1:-1] - points[2:, 1:-1]
        normal = np.cross(along, across)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        good = inside[1:-1, 1:-1] & inside[1:-1, 2:] & inside[1:-1, :-2] & inside[2:, 1:-1] & inside[:-2, 1:-1]
        good &= (np.abs(depth[1:-1, 2:] - depth[1:-1, :-2]) < DEPTH_EDGE) & (
            np.abs(depth[2:, 1:-1] - depth[:-2, 1:-1]) < DEPTH_EDGE
        )
        cosine = (normal * views.images["normal"][k][1:-1, 1:-1]).sum(-1)[good]
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    every = np.concatenate(angles)
    return float(np.median(every)) if len(every) else float("nan")


def reprojection(views: Views) -> tuple[float, float]:
    """Project each view's points into the other views and compare depth: median difference, and share within 0.02.

    Differences are along the other camera's axis, in world units. A point that lies more than HIDDEN_DISTANCE behind
    the other view's surface is hidden there and left out. A point over the other view's background counts as
    HIDDEN_DISTANCE. A point in front of the surface counts with its difference.
    """
    distances = []
    for i, camera in enumerate(views.cameras):
        inside = views.mask[i] > FULL_COVERAGE
        points = _points(camera, views.images["depth"][i])[inside]
        for j, other in enumerate(views.cameras):
            if i == j:
                continue
            xy, depth = project(other, points)
            column, row = (
                np.clip(xy[:, a].astype(int), 0, size - 1) for a, size in ((0, other.width), (1, other.height))
            )
            there = views.mask[j][row, column] > FULL_COVERAGE
            outside = views.mask[j][row, column] < 1 - FULL_COVERAGE
            behind = depth - views.images["depth"][j][row, column]
            distances.append(np.full(int(outside.sum()), HIDDEN_DISTANCE))
            distances.append(np.abs(behind[there & (behind < HIDDEN_DISTANCE)]))
    every = np.concatenate(distances)
    return (float(np.median(every)), float((every < 0.02).mean())) if len(every) else (float("nan"), float("nan"))


def _points(camera, depth: np.ndarray) -> np.ndarray:
    """Convert depth (h, w) along the axis of an orthographic camera, in world units, to world points (h, w, 3)."""
    origins, directions = rays(camera)
    return origins + depth[..., None] * directions
