"""Compute materials, confidence and light of a reconstructed surface from whatever domains the views hold."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gdtool.fields.appearance.materials import confidence, fuse, observe, spread
from gdtool.geometry.meshes import TriMesh

MATERIALS = ("albedo", "roughness", "metallic")
LEAST_SAMPLES = 64  # pixels of color below which no light is solved for


@dataclass
class Appearance:
    """Hold what was found at the v vertices, and the light.

    albedo (v, 3), roughness, metallic, confidence (v,); views (v,) uint8 and residual (v,) as in a Surface; light:
    record of light.json or None; figures by name; skipped: pairs of a step and the reason it was skipped.
    """

    albedo: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    confidence: np.ndarray
    views: np.ndarray
    residual: np.ndarray
    light: dict | None = None
    figures: dict[str, float | str] = field(default_factory=dict)
    skipped: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class AppearanceOptions:
    """Set how materials and light are found.

    step: world units between the vertices, about. light: record of a known light, if any. shadows: whether the surface
    occludes the light in the explanation of color.
    """

    step: float
    light: dict | None = None
    seed: int = 0
    shadows: bool = True


def appearance(
    cameras,
    mask: np.ndarray,
    images: dict[str, np.ndarray],
    mesh: TriMesh,
    normals: np.ndarray,
    options: AppearanceOptions,
) -> Appearance:
    """Fuse the material views; recover the light from color; solve for materials without a view from color."""
    vertices, faces = mesh.vertices, mesh.faces
    from gdtool.fields.appearance.light import (
        ShadedPoints,
        color_samples,
        materials_from_color,
        recover_light,
        unoccluded,
        visibility,
    )

    rng = np.random.default_rng(options.seed)
    seen = observe(cameras, mask, mesh, normals, 0.5 * options.step)
    weight = seen.weight.sum(0)
    out = Appearance(
        np.full((len(vertices), 3), 0.5, np.float32),
        np.full(len(vertices), 0.5, np.float32),
        np.zeros(len(vertices), np.float32),
        (1 - np.exp(-4 * weight)).astype(np.float32),
        (seen.weight > 0).sum(0).astype(np.uint8),
        np.zeros(len(vertices), np.float32),
    )
    fused = {}
    for name in (*MATERIALS, "color"):
        if name in images and (name != "color" or "albedo" not in images):
            stack = images[name]
            value, weight, residual = fuse(stack if stack.ndim == 4 else stack[..., None], mask, seen)
            fused[name] = np.clip(spread(value, weight, faces), 0, 1)
            if name in ("albedo", "color"):
                out.confidence, out.residual = confidence(weight, residual), residual.astype(np.float32)
                out.figures[f"{name}_residual"] = float(np.average(residual, weights=weight + 1e-9))
    for name in MATERIALS:
        if name in fused:
            setattr(out, name, fused[name] if name == "albedo" else fused[name][:, 0])
    if "color" not in images:
        out.skipped.append(("light", "there is no color to recover it from"))
        return out
    samples = color_samples(cameras, images["color"], mask, seen, vertices, rng)
    if len(samples.vertex) < LEAST_SAMPLES:
        out.skipped.append(("light", "too few pixels of color are seen and not clipped"))
        out.albedo = fused.get("color", out.albedo)
        return out
    reaches = visibility(mesh, normals, 0.5 * options.step, rng) if options.shadows else unoccluded(normals)
    if "albedo" in fused:
        points = ShadedPoints(
            normals[samples.vertex],
            samples.view,
            out.albedo[samples.vertex],
            out.roughness[samples.vertex],
            out.metallic[samples.vertex],
            reaches.at(samples.vertex),
        )
        out.light, residual = recover_light(points, samples.color, options.light)
    else:
        albedo, roughness, metallic, out.light, residual = materials_from_color(
            normals, fused["color"], weight, reaches, samples, options.light
        )
        out.albedo = spread(albedo, weight, faces)
        # A roughness or metallic view, where there is one, says more than the single number found.
        out.roughness = out.roughness if "roughness" in fused else np.full(len(vertices), roughness, np.float32)
        out.metallic = out.metallic if "metallic" in fused else np.full(len(vertices), metallic, np.float32)
        # Solved, not seen: later stages should prefer anything better.
        out.confidence = 0.5 * out.confidence
    out.figures["light_residual"] = residual
    return out
