"""Views to a watertight surface with albedo, roughness and metallic at every vertex.

Use it after sample-views or render-dataset, or on a views folder of your own. Any subset of the domains will do: depth
and normals shape the surface where there are any, silhouettes bound it, material views color it. The grid method
(default) carves and refines a signed distance grid in seconds; the paper method fits the SDF and material networks.

Example:
  gdtool reconstruct cat.asset/views
"""

from __future__ import annotations

import contextlib
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core import log
from gdtool.core.errors import InputError, UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import MOST_SECONDS, MOST_SEED, Inputs, Output, Stage

# Below this share of points that another view confirms, depth and normals say less of the shape than the silhouettes
# do.
LEAST_AGREEMENT = 0.25
# Below this share of normals that fit the slope of the depth they describe another surface (a broken normal map, say).
LEAST_FITTING_NORMALS = 0.5
AROUND = 0.5  # seconds of --budget for start-up and publication


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of reconstruct."""

    method: Annotated[
        Literal["grid", "paper"], Meta(description="grid: carve and refine; paper: SDF and material networks")
    ] = "grid"
    resolution: Annotated[
        int,
        Meta(ge=0, le=512, description="grid samples along a unit of length; 0: a little finer than the views' pixels"),
    ] = 0
    steps: Annotated[int, Meta(ge=1, le=100_000, description="paper: the most optimisation steps of each phase")] = 1000
    precision: Annotated[
        Literal["float32", "bfloat16"],
        Meta(description="paper: of the networks' layers while the first shape is fitted; the end is always float32"),
    ] = "float32"
    root: Annotated[
        Literal["secant", "median"], Meta(description="paper: surface point between two samples of a ray")
    ] = "secant"
    brdf: Annotated[Literal["gltf", "paper"], Meta(description="paper: reflection model that color is fitted with")] = (
        "gltf"
    )
    budget: Annotated[
        float,
        Meta(
            ge=0,
            le=MOST_SECONDS,
            description="seconds to be done in: grid takes a coarser grid, paper shortens its schedule; 0: as long as it helps",
        ),
    ] = 0.0
    ignore: Annotated[tuple[str, ...], Meta(description="domains to leave out, for example depth,normal")] = ()
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="seed of everything random")] = 0


def check(inputs: Inputs, options: Options) -> None:
    """Raise UsageError for domains that there are not."""
    unknown = sorted(set(options.ignore) - set(DOMAINS))
    if unknown:
        raise UsageError("--ignore", f"{unknown[0]!r} is no domain", f"choose from {', '.join(DOMAINS)}")


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Reconstruct one views folder. Raises ResourceError where it takes longer than --budget by far
    (stages/limits.py)."""
    from gdtool.stages.limits import held_to

    cure = f"raise --budget to {max(round(2 * options.budget), 1)}, or leave it out"
    with held_to(options.budget, "--budget", inputs.name, cure) if options.budget else contextlib.nullcontext():
        _run(inputs, options, out)


def _run(inputs: Inputs, options: Options, out: Output) -> None:
    from gdtool.fields.appearance.appearance import AppearanceOptions, appearance
    from gdtool.fields.grid.fusion import (
        AlignmentOptions,
        BUMPY,
        FusionOptions,
        SMALL,
        align_depth,
        finest_pixel,
        fuse_within_budget,
        grid_step,
        is_closed_manifold,
        prepare_all,
        silhouettes_outvoted,
    )
    from gdtool.fields.views.depth_alignment import agreement
    from gdtool.folders.surface import Surface, write_surface
    from gdtool.folders.views import read_views
    from gdtool.geometry.normals import vertex_normals

    folder, clock = inputs.main, _clock(options)
    with out.step("read"):
        views = read_views(folder, tuple(d for d in DOMAINS if d not in options.ignore))
    for domain in DOMAINS:
        if domain not in views.images:
            out.skip(domain, "left out by --ignore" if domain in options.ignore else "the views do not hold it")
    _check_masks(folder.path, views, out)

    step = grid_step(views.cameras, options.resolution)
    with out.step("align"):
        normal = _normals(views, out)
        depth = _depth(views, out)
        alike = ("albedo", "color") if "depth" in views.images else ("albedo", "color", "normal")
        colors = [views.images[domain] for domain in alike if domain in views.images]
        prepared, before, noise = align_depth(views.cameras, views.mask, depth, normal, step, AlignmentOptions(clock=clock, tell=log.status, colors=colors))
        agreed = agreement(prepared)
        if agreed < LEAST_AGREEMENT:
            out.warn(
                f"depth and normals do not fit together (a view confirms {agreed:.0%} of another's points); the silhouettes alone give the shape"
            )
            prepared, noise = prepare_all(views.cameras, views.mask, None, None), 0.0
        outvoted = silhouettes_outvoted(prepared)
        if noise == before and depth is not None:
            out.skip("alignment of depth", f"the views agree to {noise / step:.3f} of a grid step")
        if outvoted:
            out.warn(
                f"the silhouettes contradict one another: up to {outvoted} of {len(prepared)} are outvoted at a point"
            )
    grow = SMALL * finest_pixel(views.cameras) if folder.content.picture else 0.0
    if not grow:
        out.skip("growth of the surface", "no model made the views of a picture")
    with out.step("fuse"):
        try:
            shape, coarser = fuse_within_budget(prepared, step, options=FusionOptions(noise=noise, outvoted=outvoted, has_normals=normal is not None, grow=grow, picture_view=folder.content.picture), clock=clock)
        except ValueError as error:
            raise InputError(folder.path, str(error), "give masks and cameras of one object") from None
    if shape.bumps is None or shape.bumps <= BUMPY:
        out.skip(
            "surface by normals",
            f"it is within {shape.bumps:.1f} degrees of them"
            if shape.bumps is not None
            else "there are none"
            if normal is None
            else "the silhouettes alone give the shape"
            if all(prepared_view.planes is None for prepared_view in prepared)
            else "the views agree",
        )
    if not shape.restored:
        out.skip(
            "parts that the picture alone shows",
            "the views together have something behind each of its pixels"
            if grow and noise
            else "the views agree"
            if grow
            else "no model made the views of a picture",
        )
    if coarser:
        out.skip("the whole grid", f"--budget has no time for it: the surface is taken {coarser}")
    _check_cameras(folder, views.cameras, shape.vertices)
    vertices, faces, figures, fit = shape.vertices, shape.faces, {}, None
    if options.method == "paper":
        vertices, faces, figures, fit = _fit(views, prepared, shape, options, out)
    with out.step("materials"):
        normals = vertex_normals(vertices, faces)
        look = appearance(views.cameras, views.mask, views.images, vertices, faces, normals, AppearanceOptions(step=shape.step, light=views.light, seed=options.seed))
        for what, reason in look.skipped:
            out.skip(what, reason)
    if fit is not None:
        _use_fit(fit, vertices, views, look, options, out)
    surface = Surface(
        vertices,
        faces,
        look.albedo,
        look.roughness,
        look.metallic,
        look.confidence,
        normals,
        look.light,
        look.views,
        look.residual,
    )
    report = {
        "seen_share": float((shape.support > 0.02).mean()),
        "pieces_dropped": shape.dropped,
        "grid_step": shape.step,
        "disagreement_before": before,
        "disagreement": noise,
        "grown": grow,
        "restored_share": shape.restored,
        "agreement": agreed,
        "silhouettes_outvoted": outvoted,
        "mean_confidence": float(look.confidence.mean()),
        **look.figures,
        **figures,
    }
    with out.step("write"):
        write_surface(
            out,
            surface,
            watertight=is_closed_manifold(faces),
            method=options.method,
            field=fit is not None,
            source_from_world=folder.content.source_from_world,
            report=report,
        )


def _clock(options: Options):
    """Counts down what --budget leaves the grid method; the paper's counts its own."""
    from gdtool.fields.clock import Clock

    return Clock(max(options.budget - AROUND, 1e-3) if options.budget and options.method == "grid" else 0.0)


def _fit(views, prepared, shape, options: Options, out: Output):
    """The paper's networks, started from the grid's shape, and the mesh of their surface.

    prepared: the aligned views. Where there are normals and no depth, theirs is what holds the surface in its place:
    normals alone let it drift."""
    from gdtool.fields.grid.fusion import is_closed_manifold
    from gdtool.fields.grid.refine import keep_pieces
    from gdtool.fields.neural.paper import PaperOptions, extract_network, fit_networks

    images = _with_depth(views, prepared)
    volume = 0 if "depth" in images else options.steps // 3
    if not volume:
        out.skip("volume start", f"{'depth' if 'depth' in views.images else 'normal'} views say where the surface is")
    settings = PaperOptions(
        options.steps,
        volume,
        options.steps,
        rule=options.root,
        brdf=options.brdf,
        seed=options.seed,
        budget=options.budget,
        device=out.device,
        precision=options.precision,
    )
    with out.step("networks"):
        fit, figures = fit_networks(
            views.cameras,
            views.mask,
            images,
            shape.vertices,
            shape.faces,
            settings,
            lambda count, label: out.progress(range(count), count, label),
        )
    with out.step("extract"):
        vertices, faces = extract_network(fit.sdf, shape.step, out.device)
        if len(faces):
            vertices, faces = keep_pieces(vertices, faces, shape.step)
    if not is_closed_manifold(faces):
        out.warn("the networks' surface is not closed; the grid's is kept")
        return shape.vertices, shape.faces, figures, None
    return vertices, faces, figures, fit


def _with_depth(views, prepared) -> dict:
    """The views' images, with the depth that the aligned views came to where there was none and normals gave it."""
    import numpy as np

    found = {
        id(prepared_view.camera): (prepared_view.points - prepared_view.camera.position)
        @ -prepared_view.camera.backward
        for prepared_view in prepared
        if prepared_view.points is not None
    }
    if "depth" in views.images or not found:
        return views.images
    return views.images | {
        "depth": np.stack(
            [found.get(id(camera), np.zeros_like(mask)) for camera, mask in zip(views.cameras, views.mask, strict=True)]
        ).astype(np.float32)
    }


def _use_fit(fit, vertices, views, look, options: Options, out: Output) -> None:
    """Put the material network's values, where views supervised it, and the fitted light into look; save the
    networks."""
    from gdtool.fields.neural.paper import light_record, network_materials, save_field

    values = network_materials(fit.material, vertices, out.device)
    supervised = [name for name in ("albedo", "roughness", "metallic") if name in views.images]
    for name in supervised or ("albedo", "roughness", "metallic") if "color" in views.images else supervised:
        setattr(look, name, values[name] if name == "albedo" else values[name][:, 0])
    if "color" in views.images:
        look.light = light_record(fit)
    save_field(out.path("field.safetensors"), fit)


def _normals(views, out: Output):
    """Normal views (k, h, w, 3); None where there are none, or where they contradict the depth."""
    from gdtool.fields.views.depth_alignment import normals_fit_depth

    normal, depth = views.images.get("normal"), views.images.get("depth")
    if normal is None or depth is None:
        return normal
    fit = normals_fit_depth(views.cameras, views.mask, depth, normal)
    if fit < LEAST_FITTING_NORMALS:
        out.warn(f"only {fit:.0%} of the normals fit the slope of the depth; they are left out of the shape")
        return None
    return normal


def _depth(views, out: Output):
    """Depth views (k, h, w); without them, what the normals give, matched from view to view; None without either."""
    from gdtool.fields.grid.fusion import depth_for

    if "depth" in views.images or "normal" not in views.images:
        out.skip(
            "matching of views",
            "depth views say where the surface is" if "depth" in views.images else "there are no normals to match",
        )
        return views.images.get("depth")
    alike = {domain: views.images[domain] for domain in ("albedo", "roughness", "metallic") if domain in views.images}
    with out.step("match views"):
        return depth_for(views.cameras, views.mask, views.images["normal"], alike)


def _check_cameras(folder, cameras, vertices) -> None:
    """Raises InputError for a camera that has a part of the surface behind it."""
    from gdtool.cameras import project

    for camera in cameras:
        if project(camera, vertices)[1].min() <= 0:
            raise InputError(
                folder.file("cameras.json"),
                f"camera {camera.name!r} is inside the object or looks away from it",
                "give it a world_from_camera outside the object, -z towards it",
            )


def _check_masks(path, views, out: Output) -> None:
    """Warn about views that show nothing. Raises InputError when none shows anything."""
    shown = [(views.mask[k] > 0.5).any() for k in range(len(views.cameras))]
    if not any(shown):
        raise InputError(path, "every mask is empty", "paint the object white in the masks")
    for name, good in zip(views.names, shown, strict=True):
        if not good:
            out.warn(f"view {name}: its mask is empty; the view is left out")


STAGE = Stage(name="reconstruct", version=18, reads=("views",), writes="surface", Options=Options, run=run, check=check)
