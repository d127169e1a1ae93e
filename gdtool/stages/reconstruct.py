"""Views to a watertight surface with albedo, roughness and metallic at every vertex.

Use it after sample-views or render-dataset, or on a views folder of your own. Any subset of the domains will do: depth
and normals shape the surface where there are any, silhouettes bound it, material views color it. The grid method
(default) carves and refines a signed distance grid in seconds; the paper method fits the SDF and material networks.

Example:
  gdtool reconstruct cat.asset/views
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import Inputs, Output, Stage

MATERIALS = ("albedo", "roughness", "metallic")


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of reconstruct."""

    method: Annotated[Literal["grid", "paper"], Meta(description="grid: carve and refine; paper: SDF and material networks")] = "grid"
    resolution: Annotated[int, Meta(ge=0, le=512, description="grid samples along a unit of length; 0: a little finer than the views' pixels")] = 0
    ignore: Annotated[tuple[str, ...], Meta(description="domains to leave out, for example depth,normal")] = ()
    seed: Annotated[int, Meta(ge=0, description="seed of everything random")] = 0


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Reconstruct one views folder."""
    import numpy as np

    from gdtool.fields.fusion import align_depth, fuse_views, grid_step, is_closed_manifold, silhouettes_outvoted
    from gdtool.folders.surface import Surface, write_surface
    from gdtool.folders.views import read_views
    from gdtool.geometry.normals import vertex_normals

    unknown = sorted(set(options.ignore) - set(DOMAINS))
    if unknown:
        raise UsageError("--ignore", f"{unknown[0]!r} is no domain", f"choose from {', '.join(DOMAINS)}")
    folder = inputs.main
    with out.step("read"):
        views = read_views(folder, tuple(d for d in DOMAINS if d not in options.ignore))
    for domain in DOMAINS:
        if domain not in views.images:
            out.skip(domain, "left out by --ignore" if domain in options.ignore else "the views do not hold it")
    _check_masks(folder.path, views, out)

    step = grid_step(views.cameras, options.resolution)
    with out.step("align"):
        sights, before, noise = align_depth(views.cameras, views.mask, views.images.get("depth"), views.images.get("normal"), step)
        outvoted = silhouettes_outvoted(sights)
        if noise == before and "depth" in views.images:
            out.skip("alignment of depth", f"the views agree to {noise / step:.3f} of a grid step")
        if outvoted:
            out.warn(f"the silhouettes contradict one another: up to {outvoted} of {len(sights)} are outvoted at a point")
    with out.step("fuse"):
        try:
            shape = fuse_views(sights, step, noise, outvoted)
        except ValueError as error:
            raise InputError(folder.path, str(error), "check the masks and cameras") from None
    with out.step("materials"):
        normals = vertex_normals(shape.vertices, shape.faces)
        values, confidence = _materials(views, shape, normals, out)
    surface = Surface(shape.vertices, shape.faces, values["albedo"], values["roughness"][:, 0], values["metallic"][:, 0],
                      confidence, normals, None)
    report = {"seen_share": float((shape.support > 0.02).mean()), "pieces_dropped": shape.dropped, "grid_step": shape.step,
              "disagreement_before": before, "disagreement": noise, "silhouettes_outvoted": outvoted,
              "mean_confidence": float(np.mean(confidence))}
    with out.step("write"):
        write_surface(out, surface, watertight=is_closed_manifold(shape.faces), method=options.method,
                      source_from_world=folder.content.source_from_world, report=report)


def _check_masks(path, views, out: Output) -> None:
    """Warn about views that show nothing. Raises InputError when none shows anything."""
    shown = [(views.mask[k] > 0.5).any() for k in range(len(views.cameras))]
    if not any(shown):
        raise InputError(path, "every mask is empty", "the views show no object")
    for name, good in zip(views.names, shown, strict=True):
        if not good:
            out.warn(f"view {name}: its mask is empty; the view is left out")


def _materials(views, shape, normals, out: Output):
    """Material values by name (v, c), and confidence (v,)."""
    import numpy as np

    from gdtool.fields.materials import confidence, fuse, observe, spread

    seen = observe(views.cameras, views.mask, shape.vertices, shape.faces, normals, 0.5 * shape.step)
    values, trust = {}, np.zeros(len(shape.vertices), np.float32)
    fallback = {"albedo": "color", "roughness": None, "metallic": None}
    constant = {"albedo": 0.5, "roughness": 0.5, "metallic": 0.0}
    for name in MATERIALS:
        source = name if name in views.images else fallback[name]
        if source not in views.images:
            values[name] = np.full((len(shape.vertices), 3 if name == "albedo" else 1), constant[name], np.float32)
            continue
        images = views.images[source]
        value, weight, residual = fuse(images if images.ndim == 4 else images[..., None], views.mask, seen)
        values[name] = np.clip(spread(value, weight, shape.faces), 0, 1)
        if name == "albedo":
            trust = confidence(weight, residual)
    return values, trust


STAGE = Stage(name="reconstruct", version=1, reads=("views",), writes="surface", Options=Options, run=run)
