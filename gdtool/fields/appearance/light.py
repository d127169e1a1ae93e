"""The light recovered from color views, and materials from color where no material view is at hand.

Closed-form color is linear in the lobes' amplitudes, so with the materials known the light is one non-negative least
squares. With nothing but color, light and albedo are known up to a scale: what the normals explain goes to the light,
what is left to the albedo, and occlusion (a few rays against the surface) keeps shadow out of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.fields.appearance.materials import Observations, toward_camera
from gdtool.images.sampling import bilinear

SAMPLES = 4000
SHARPNESS = (4.0, 12.0)
_CLIPPED = 0.97
LEAST_VISIBLE = 0.05  # light that bounces into the deepest hollow
_PRIOR = 0.25  # rays
MEAN_ALBEDO = 0.45  # light and albedo are only known up to a factor; this is where it is put


def color_samples(
    cameras,
    color: np.ndarray,
    mask: np.ndarray,
    seen: Observations,
    vertices: np.ndarray,
    rng: np.random.Generator,
    count: int = SAMPLES,
):
    """Pairs of a vertex and a view that sees it well: vertex (n,), direction to the camera (n, 3), color (n, 3) linear.

    Clipped colors are left out: they say only "at least".
    """
    vertex, view, value = [], [], []
    for k, camera in enumerate(cameras):
        pixels = seen.pixels[k]
        chosen = np.flatnonzero(seen.weight[k] > 0.02)
        both = bilinear(
            np.concatenate([color[k] * mask[k][..., None], mask[k][..., None]], -1).astype(np.float32), pixels[chosen]
        )
        value.append(both[:, :3] / np.maximum(both[:, 3:], 1e-6))
        vertex.append(chosen)
        view.append(toward_camera(camera, vertices[chosen]))
    vertex, view, value = (np.concatenate(x) for x in (vertex, view, value))
    good = np.flatnonzero(value.max(1) < _CLIPPED)
    pick = good if len(good) <= count else rng.choice(good, count, replace=False)
    return vertex[pick], view[pick], value[pick]


def _response(normals, view, albedo, roughness, metallic, axes, sharpness, seen: Visibility) -> np.ndarray:
    """Color (n, 3, k) of n points under each lobe alone, white and of amplitude 1, as far as its light arrives."""
    import torch

    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians

    def tensor(x):
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    out = []
    with torch.no_grad():
        for axis, width in zip(axes, sharpness, strict=True):
            lobe = SphericalGaussians(tensor(axis[None]), tensor([width]), torch.ones(1, 3))
            out.append(
                shade(tensor(normals), tensor(view), tensor(albedo), tensor(roughness), tensor(metallic), lobe).numpy()
            )
    return np.stack(out, -1) * seen.of_lobes(axes, sharpness)[:, None]


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
            ridge = 1e-3 * np.sqrt((rows**2).sum() / response.shape[2]) * np.eye(response.shape[2])
            # The triangular factor stands for all rows, so the iterations of nnls see 16 of them.
            q, r = np.linalg.qr(np.concatenate([rows, ridge]))
            amplitudes[:, channel] = nnls(r, q[: len(rows)].T @ (color[:, channel] * weight))[0]
        residual = (np.einsum("nck,kc->nc", response, amplitudes) - color).mean(1) / scale
        gap = np.where(residual > 0, 2 * residual, residual) / 0.25
        weight = 1 / (1 + gap**2)
    return amplitudes, float(np.abs(residual).mean())


def recover_light(
    normals, view, color, albedo, roughness, metallic, seen: Visibility, known: dict | None = None
) -> tuple[dict, float]:
    """A record of light.json that explains color (n, 3) of points with known materials, and its relative residual.

    known: a light whose axes and sharpness to keep. Else sixteen lobes spread evenly, of the sharpness that fits best.
    """
    from gdtool.shading.sampling import fibonacci

    if known is not None:
        shapes = [(np.asarray(known["axes"], np.float64), np.asarray(known["sharpness"], np.float64))]
    else:
        shapes = [(fibonacci(16), np.full(16, width)) for width in SHARPNESS]
    best = None
    for axes, sharpness in shapes:
        amplitudes, residual = fit_amplitudes(
            _response(normals, view, albedo, roughness, metallic, axes, sharpness, seen), color
        )
        if best is None or residual < best[1]:
            best = (
                {
                    "kind": "spherical_gaussians",
                    "axes": axes.tolist(),
                    "sharpness": sharpness.tolist(),
                    "amplitudes": amplitudes.tolist(),
                },
                residual,
            )
    return best


@dataclass(frozen=True)
class Visibility:
    """What the surface leaves open: directions (v, r, 3) over each vertex' hemisphere, by the cosine; open (v, r)
    bool."""

    directions: np.ndarray
    open: np.ndarray

    def at(self, vertex: np.ndarray) -> Visibility:
        """That of the vertices of these indices."""
        return Visibility(self.directions[vertex], self.open[vertex])

    def of_lobes(self, axes: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
        """Share (v, k) of each lobe's light that arrives; of a lobe behind the horizon, of all light."""
        share = self.open.mean(1, keepdims=True) + np.zeros((1, len(axes)))
        for k, (axis, width) in enumerate(zip(axes, sharpness, strict=True)):
            weight = np.exp(width * (self.directions @ np.asarray(axis, np.float32) - 1))
            total = weight.sum(1)
            # A few rays see a sharp lobe badly: the share of all light stands in for what they miss.
            share[:, k] = ((weight * self.open).sum(1) + _PRIOR * share[:, k]) / (total + _PRIOR)
        return np.maximum(share, LEAST_VISIBLE)


def visibility(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    offset: float,
    rng: np.random.Generator,
    rays: int = 16,
) -> Visibility:
    """Which of rays directions from each vertex meet the surface again; offset: world units they start off it."""
    from gdtool.geometry.rays import RayCaster

    caster = RayCaster(vertices, faces)
    up = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(up, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    bitangent = np.cross(normals, tangent)
    turn = rng.random(len(vertices))
    origins = vertices + offset * normals
    directions, free = np.empty((len(vertices), rays, 3), np.float32), np.empty((len(vertices), rays), bool)
    for k in range(rays):
        radius = np.sqrt((k + 0.5) / rays)
        angle = 2 * np.pi * (turn + k * 0.618034)
        direction = (
            radius * np.cos(angle)[:, None] * tangent
            + radius * np.sin(angle)[:, None] * bitangent
            + np.sqrt(1 - radius**2) * normals
        )
        directions[:, k], free[:, k] = direction, ~caster.occluded(origins, np.ascontiguousarray(direction))
    return Visibility(directions, free)


def unoccluded(normals: np.ndarray) -> Visibility:
    """That of points (v, 3) that nothing hides: all light arrives."""
    return Visibility(np.asarray(normals, np.float32)[:, None], np.ones((len(normals), 1), bool))


def materials_from_color(
    normals: np.ndarray, color: np.ndarray, weight: np.ndarray, seen: Visibility, samples, light: dict | None
) -> tuple[np.ndarray, float, float, dict, float]:
    """Albedo (v, 3), one roughness, one metallic, the light and its residual, from fused color (v, 3) alone.

    samples: what color_samples gave. light: a known light; without one it is what explains the color of an object of
    one grey albedo best. Roughness and metallic are single numbers: the pair whose highlights fit the views best.
    """
    import torch

    from gdtool.shading.bsdf.closed_form import shade_parts
    from gdtool.shading.bsdf.sg import SphericalGaussians

    vertex, view, value = samples
    grey = np.full((len(vertex), 3), MEAN_ALBEDO)
    shaded = seen.at(vertex)
    best = None
    for roughness, metallic in ((0.25, 0.0), (0.5, 0.0), (0.8, 0.0), (0.3, 1.0), (0.6, 1.0)):
        fixed = (np.full(len(vertex), roughness), np.full(len(vertex), metallic), shaded)
        found, residual = (
            (light, 0.0) if light is not None else recover_light(normals[vertex], view, value, grey, *fixed)
        )
        if light is not None:
            lit = _response(
                normals[vertex],
                view,
                grey,
                *fixed[:2],
                np.asarray(light["axes"]),
                np.asarray(light["sharpness"]),
                shaded,
            )
            lit = np.einsum("nck,kc->nc", lit, np.asarray(light["amplitudes"]))
            residual = float(np.abs(lit / max(lit.mean(), 1e-9) - value / max(value.mean(), 1e-9)).mean())
        # Metal needs to pay its way: most things are not.
        if best is None or residual + 0.03 * metallic < best[0]:
            best = (residual + 0.03 * metallic, roughness, metallic, found, residual)
    _, roughness, metallic, found, residual = best
    count = len(normals)
    unit_color, base = np.zeros((count, 3)), np.zeros((count, 3))
    arrives = seen.of_lobes(np.asarray(found["axes"]), np.asarray(found["sharpness"]))
    n = torch.as_tensor(np.ascontiguousarray(normals), dtype=torch.float32)
    white, black, rough = torch.ones(count, 3), torch.zeros(count, 3), torch.full((count,), roughness)
    with torch.no_grad():
        for k in range(len(found["axes"])):
            lobe = SphericalGaussians.from_record(
                {name: found[name][k : k + 1] for name in ("axes", "sharpness", "amplitudes")}
            )
            diffuse, specular = shade_parts(n, n, white, rough, torch.full((count,), metallic), lobe)
            unit_color += (specular if metallic else diffuse).numpy() * arrives[:, k : k + 1]
            if not metallic:
                base += shade_parts(n, n, black, rough, torch.zeros(count), lobe)[1].numpy() * arrives[:, k : k + 1]
    floor = 0.05 * unit_color.mean()
    albedo = np.maximum(color - base, 0.1 * color) / np.maximum(unit_color, floor)
    if light is None:
        albedo *= MEAN_ALBEDO / max(float(np.average(albedo.mean(1), weights=weight + 1e-9)), 1e-6)
    return np.clip(albedo, 0.02, 0.95), roughness, metallic, found, residual
