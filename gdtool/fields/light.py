"""The light recovered from color views, and materials from color where no material view is at hand.

Closed-form color is linear in the lobes' amplitudes, so with the materials known the light is one non-negative least
squares. With nothing but color, light and albedo are known up to a scale: what the normals explain goes to the light,
what is left to the albedo, and occlusion (a few rays against the surface) keeps shadow out of it.
"""

from __future__ import annotations

import numpy as np

from gdtool.fields.materials import Observations, toward_camera
from gdtool.fields.sights import bilinear

SAMPLES = 4000
SHARPNESS = (4.0, 12.0)
_CLIPPED = 0.97
MEAN_ALBEDO = 0.45  # light and albedo are only known up to a factor; this is where it is put


def color_samples(cameras, color: np.ndarray, mask: np.ndarray, seen: Observations, vertices: np.ndarray, rng: np.random.Generator,
                  count: int = SAMPLES):
    """Pairs of a vertex and a view that sees it well: vertex (n,), direction to the camera (n, 3), color (n, 3) linear.

    Clipped colors are left out: they say only "at least".
    """
    vertex, view, value = [], [], []
    for k, camera in enumerate(cameras):
        pixels = seen.pixels[k]
        chosen = np.flatnonzero(seen.weight[k] > 0.02)
        both = bilinear(np.concatenate([color[k] * mask[k][..., None], mask[k][..., None]], -1).astype(np.float32), pixels[chosen])
        value.append(both[:, :3] / np.maximum(both[:, 3:], 1e-6))
        vertex.append(chosen)
        view.append(toward_camera(camera, vertices[chosen]))
    vertex, view, value = (np.concatenate(x) for x in (vertex, view, value))
    good = np.flatnonzero(value.max(1) < _CLIPPED)
    pick = good if len(good) <= count else rng.choice(good, count, replace=False)
    return vertex[pick], view[pick], value[pick]


def _response(normals, view, albedo, roughness, metallic, axes, sharpness, occlusion) -> np.ndarray:
    """Color (n, 3, k) of n points under each lobe alone, white and of amplitude 1; occlusion (n,) dims all."""
    import torch

    from gdtool.shading.closed_form import shade
    from gdtool.shading.sg import SphericalGaussians

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    out = []
    with torch.no_grad():
        for axis, width in zip(axes, sharpness, strict=True):
            lobe = SphericalGaussians(tensor(axis[None]), tensor([width]), torch.ones(1, 3))
            out.append(shade(tensor(normals), tensor(view), tensor(albedo), tensor(roughness), tensor(metallic), lobe).numpy())
    return np.stack(out, -1) * occlusion[:, None, None]


def fit_amplitudes(response: np.ndarray, color: np.ndarray, rounds: int = 4) -> tuple[np.ndarray, float]:
    """Non-negative amplitudes (k, 3) for color (n, 3), and the mean relative residual.

    Reweighted each round by the residual's size, twice as hard where the picture is darker than the light says: those
    points lie in shadow, which the closed form does not have.
    """
    from scipy.optimize import nnls

    amplitudes = np.zeros((response.shape[2], 3))
    weight = np.ones(len(color))
    scale = max(float(color.mean()), 1e-6)
    for _ in range(rounds):
        for channel in range(3):
            rows = response[:, channel] * weight[:, None]
            ridge = 1e-3 * np.sqrt((rows ** 2).sum() / response.shape[2]) * np.eye(response.shape[2])
            # The triangular factor stands for all rows, so the iterations of nnls see 16 of them.
            q, r = np.linalg.qr(np.concatenate([rows, ridge]))
            amplitudes[:, channel] = nnls(r, q[:len(rows)].T @ (color[:, channel] * weight))[0]
        residual = (np.einsum("nck,kc->nc", response, amplitudes) - color).mean(1) / scale
        gap = np.where(residual > 0, 2 * residual, residual) / 0.25
        weight = 1 / (1 + gap ** 2)
    return amplitudes, float(np.abs(residual).mean())


def recover_light(normals, view, color, albedo, roughness, metallic, occlusion, known: dict | None = None) -> tuple[dict, float]:
    """A record of light.json that explains color (n, 3) of points with known materials, and its relative residual.

    known: a light whose axes and sharpness to keep. Else sixteen lobes spread evenly, of the sharpness that fits best.
    """
    from gdtool.shading.lights import fibonacci

    if known is not None:
        shapes = [(np.asarray(known["axes"], np.float64), np.asarray(known["sharpness"], np.float64))]
    else:
        shapes = [(fibonacci(16), np.full(16, width)) for width in SHARPNESS]
    best = None
    for axes, sharpness in shapes:
        amplitudes, residual = fit_amplitudes(_response(normals, view, albedo, roughness, metallic, axes, sharpness, occlusion), color)
        if best is None or residual < best[1]:
            best = ({"kind": "spherical_gaussians", "axes": axes.tolist(), "sharpness": sharpness.tolist(),
                     "amplitudes": amplitudes.tolist()}, residual)
    return best


def ambient_occlusion(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, offset: float, rng: np.random.Generator,
                      rays: int = 16) -> np.ndarray:
    """Share (v,) of the cosine-weighted hemisphere that the surface itself leaves open."""
    from gdtool.geometry.rays import RayCaster

    caster = RayCaster(vertices, faces)
    up = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(up, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    bitangent = np.cross(normals, tangent)
    turn = rng.random(len(vertices))
    origins = vertices + offset * normals
    open_share = np.zeros(len(vertices))
    for k in range(rays):
        radius = np.sqrt((k + 0.5) / rays)
        angle = 2 * np.pi * (turn + k * 0.618034)
        direction = (radius * np.cos(angle)[:, None] * tangent + radius * np.sin(angle)[:, None] * bitangent
                     + np.sqrt(1 - radius ** 2) * normals)
        open_share += ~caster.occluded(origins, np.ascontiguousarray(direction))
    return open_share / rays


def materials_from_color(normals: np.ndarray, color: np.ndarray, weight: np.ndarray, occlusion: np.ndarray, samples,
                         light: dict | None) -> tuple[np.ndarray, float, float, dict, float]:
    """Albedo (v, 3), one roughness, one metallic, the light and its residual, from fused color (v, 3) alone.

    samples: what color_samples gave. light: a known light; without one it is what explains the color of an object of
    one grey albedo best. Roughness and metallic are single numbers: the pair whose highlights fit the views best.
    """
    import torch

    from gdtool.shading.closed_form import shade_parts
    from gdtool.shading.sg import SphericalGaussians

    vertex, view, value = samples
    grey = np.full((len(vertex), 3), MEAN_ALBEDO)
    shaded = occlusion[vertex]
    best = None
    for roughness, metallic in ((0.25, 0.0), (0.5, 0.0), (0.8, 0.0), (0.3, 1.0), (0.6, 1.0)):
        fixed = (np.full(len(vertex), roughness), np.full(len(vertex), metallic), shaded)
        found, residual = (light, 0.0) if light is not None else recover_light(normals[vertex], view, value, grey, *fixed)
        if light is not None:
            lit = _response(normals[vertex], view, grey, *fixed[:2], np.asarray(light["axes"]), np.asarray(light["sharpness"]), shaded)
            lit = np.einsum("nck,kc->nc", lit, np.asarray(light["amplitudes"]))
            residual = float(np.abs(lit / max(lit.mean(), 1e-9) - value / max(value.mean(), 1e-9)).mean())
        # Metal needs to pay its way: most things are not.
        if best is None or residual + 0.03 * metallic < best[0]:
            best = (residual + 0.03 * metallic, roughness, metallic, found, residual)
    _, roughness, metallic, found, residual = best
    lights = SphericalGaussians.from_record(found)
    count = len(normals)
    with torch.no_grad():
        n = torch.as_tensor(normals, dtype=torch.float32)
        diffuse, specular = shade_parts(n, n, torch.ones(count, 3), torch.full((count,), roughness), torch.full((count,), metallic), lights)
        dull = shade_parts(n, n, torch.zeros(count, 3), torch.full((count,), roughness), torch.zeros(count), lights)[1]
    unit_color = (specular if metallic else diffuse).numpy() * occlusion[:, None]
    base = 0.0 if metallic else dull.numpy() * occlusion[:, None]
    floor = 0.05 * unit_color.mean()
    albedo = np.maximum(color - base, 0.1 * color) / np.maximum(unit_color, floor)
    if light is None:
        albedo *= MEAN_ALBEDO / max(float(np.average(albedo.mean(1), weights=weight + 1e-9)), 1e-6)
    return np.clip(albedo, 0.02, 0.95), roughness, metallic, found, residual
