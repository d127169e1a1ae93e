"""Recover the light from color views, and materials from color where there is no material view.

Closed-form color is linear in the lobes' amplitudes. With known materials the light is therefore one non-negative least
squares. With color alone, light and albedo are known up to a scale: color that the normals explain goes to the light,
the rest to the albedo. Occlusion (a few rays against the surface) keeps shadow out of the albedo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gdtool.fields.appearance.materials import Observations, toward_camera
from gdtool.geometry.meshes import TriMesh
from gdtool.images.sampling import bilinear

SAMPLES = 4000  # pixels of color that the light is solved from
SHARPNESS = (4.0, 12.0)  # of the lobes that are tried
_CLIPPED = 0.97  # linear color; brighter pixels may be clipped
# Roughness and metallic that are tried, and the relative residual by which a metal has to fit better.
MATERIAL_TRIALS = ((0.25, 0.0), (0.5, 0.0), (0.8, 0.0), (0.3, 1.0), (0.6, 1.0))
METAL_PENALTY = 0.03
LEAST_VISIBLE = 0.05  # share of all light that bounces into the deepest hollow
_PRIOR = 0.25  # rays: weight of the share of all light in a lobe's share
MEAN_ALBEDO = 0.45  # light and albedo are only known up to a factor; this is where it is put


class ShadedPoints(NamedTuple):
    """Points to shade: normals, view (toward the camera), albedo (n, 3); roughness, metallic (n,)."""

    normals: np.ndarray
    view: np.ndarray
    albedo: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    visibility: Visibility


class ColorSamples(NamedTuple):
    """Pixels of color: index of the vertex (n,), direction to the camera (n, 3), linear color (n, 3)."""

    vertex: np.ndarray
    view: np.ndarray
    color: np.ndarray


class ColorMaterials(NamedTuple):
    """Materials found from color: albedo (v, 3), one roughness and metallic, the light's record and its residual."""

    albedo: np.ndarray
    roughness: float
    metallic: float
    light: dict
    residual: float


def color_samples(
    cameras,
    color: np.ndarray,
    mask: np.ndarray,
    seen: Observations,
    vertices: np.ndarray,
    rng: np.random.Generator,
    count: int = SAMPLES,
) -> ColorSamples:
    """Sample pairs of a vertex and a view that sees it well.

    Clipped colors are left out, because they are only lower bounds.
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
    return ColorSamples(vertex[pick], view[pick], value[pick])


def _response(points: ShadedPoints, axes: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Compute the color (n, 3, k) of n points under each lobe alone, white and of amplitude 1, times its visibility."""
    import torch

    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians

    def tensor(x):
        """Convert to float32."""
        return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)

    out = []
    with torch.no_grad():
        for axis, width in zip(axes, sharpness, strict=True):
            lobe = SphericalGaussians(tensor(axis[None]), tensor([width]), torch.ones(1, 3))
            out.append(shade(*(tensor(values) for values in points[:5]), lobe).numpy())
    return np.stack(out, -1) * points.visibility.of_lobes(axes, sharpness)[:, None]


def fit_amplitudes(response: np.ndarray, color: np.ndarray, rounds: int = 4) -> tuple[np.ndarray, float]:
    """Solve for non-negative amplitudes (k, 3) that explain color (n, 3); also returns the mean relative residual.

    Each round reweights by the size of the residual, twice as hard where the picture is darker than the light predicts:
    such points lie in shadow, which the closed form lacks.
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


def recover_light(points: ShadedPoints, color: np.ndarray, known: dict | None = None) -> tuple[dict, float]:
    """Find the light that explains the color (n, 3) of points with known materials: a record of light.json and its
    residual.

    known: a light whose axes and sharpness to keep. Without one, sixteen evenly spread lobes of the best fitting
    sharpness are used. The residual is relative to the mean color.
    """
    from gdtool.shading.sampling import fibonacci

    if known is not None:
        shapes = [(np.asarray(known["axes"], np.float64), np.asarray(known["sharpness"], np.float64))]
    else:
        shapes = [(fibonacci(16), np.full(16, width)) for width in SHARPNESS]
    best = None
    for axes, sharpness in shapes:
        amplitudes, residual = fit_amplitudes(_response(points, axes, sharpness), color)
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
    """Hold which directions each vertex sees unoccluded.

    directions (v, r, 3): cosine-weighted over each vertex's hemisphere. open (v, r) bool.
    """

    directions: np.ndarray
    open: np.ndarray

    def at(self, vertex: np.ndarray) -> Visibility:
        """Select the vertices of these indices."""
        return Visibility(self.directions[vertex], self.open[vertex])

    def of_lobes(self, axes: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
        """Compute the share (v, k) of each lobe's light that arrives; behind the horizon, the share of all light."""
        share = self.open.mean(1, keepdims=True) + np.zeros((1, len(axes)))
        for k, (axis, width) in enumerate(zip(axes, sharpness, strict=True)):
            weight = np.exp(width * (self.directions @ np.asarray(axis, np.float32) - 1))
            total = weight.sum(1)
            # A few rays see a sharp lobe badly: the share of all light stands in for what they miss.
            share[:, k] = ((weight * self.open).sum(1) + _PRIOR * share[:, k]) / (total + _PRIOR)
        return np.maximum(share, LEAST_VISIBLE)


def visibility(
    mesh: TriMesh,
    normals: np.ndarray,
    offset: float,
    rng: np.random.Generator,
    rays: int = 16,
) -> Visibility:
    """Trace `rays` directions from each vertex against the surface. offset: world units by which rays start off it."""
    vertices = mesh.vertices
    from gdtool.geometry.rays import RayCaster

    caster = RayCaster(mesh)
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
    """Build the visibility of points with normals (v, 3) that nothing occludes."""
    return Visibility(np.asarray(normals, np.float32)[:, None], np.ones((len(normals), 1), bool))


def materials_from_color(
    normals: np.ndarray,
    color: np.ndarray,
    weight: np.ndarray,
    seen: Visibility,
    samples: ColorSamples,
    light: dict | None,
) -> ColorMaterials:
    """Solve for materials and light from fused color (v, 3) alone.

    light: a known light. Without one, the light is used that best explains the color of an object of one grey albedo.
    Roughness and metallic are single numbers: the pair whose highlights fit the views best.
    """
    import torch

    from gdtool.shading.bsdf.closed_form import shade_parts
    from gdtool.shading.bsdf.sg import SphericalGaussians

    vertex, view, value = samples
    grey = np.full((len(vertex), 3), MEAN_ALBEDO)
    best, best_score, visible = None, np.inf, seen.at(vertex)
    for roughness, metallic in MATERIAL_TRIALS:
        points = ShadedPoints(
            normals[vertex],
            view,
            grey,
            np.full(len(vertex), roughness),
            np.full(len(vertex), metallic),
            visible,
        )
        if light is None:
            candidate, residual = recover_light(points, value)
        else:
            candidate = light
            lit = _response(points, np.asarray(light["axes"]), np.asarray(light["sharpness"]))
            lit = np.einsum("nck,kc->nc", lit, np.asarray(light["amplitudes"]))
            residual = float(np.abs(lit / max(lit.mean(), 1e-9) - value / max(value.mean(), 1e-9)).mean())
        # Most things are no metal: metal has to fit clearly better.
        score = residual + METAL_PENALTY * metallic
        if best is None or score < best_score:
            best_score, best = score, (roughness, metallic, candidate, residual)
    roughness, metallic, best_light, residual = best
    count = len(normals)
    unit_color, base = np.zeros((count, 3)), np.zeros((count, 3))
    arrives = seen.of_lobes(np.asarray(best_light["axes"]), np.asarray(best_light["sharpness"]))
    n = torch.as_tensor(np.ascontiguousarray(normals), dtype=torch.float32)
    white, black, rough = torch.ones(count, 3), torch.zeros(count, 3), torch.full((count,), roughness)
    with torch.no_grad():
        for k in range(len(best_light["axes"])):
            lobe = SphericalGaussians.from_record(
                {name: best_light[name][k : k + 1] for name in ("axes", "sharpness", "amplitudes")}
            )
            diffuse, specular = shade_parts(n, n, white, rough, torch.full((count,), metallic), lobe)
            unit_color += (specular if metallic else diffuse).numpy() * arrives[:, k : k + 1]
            if not metallic:
                base += shade_parts(n, n, black, rough, torch.zeros(count), lobe)[1].numpy() * arrives[:, k : k + 1]
    floor = 0.05 * unit_color.mean()
    albedo = np.maximum(color - base, 0.1 * color) / np.maximum(unit_color, floor)
    if light is None:
        albedo *= MEAN_ALBEDO / max(float(np.average(albedo.mean(1), weights=weight + 1e-9)), 1e-6)
    return ColorMaterials(np.clip(albedo, 0.02, 0.95), roughness, metallic, best_light, residual)
