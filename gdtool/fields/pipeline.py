"""Run the steps from views to a surface: check pictures, align, fuse, fit networks on request, add materials."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gdtool.cameras import Camera, project
from gdtool.core import log
from gdtool.core.errors import InputError
from gdtool.core.stage import Output
from gdtool.fields.clock import Clock
from gdtool.fields.grid.fusion import (
    BUMPY_DEGREES,
    SHRINKAGE_PX,
    AlignmentOptions,
    FusionOptions,
    Shape,
    align_depth,
    depth_for,
    finest_pixel,
    fuse_within_budget,
    grid_step,
    is_closed_manifold,
    prepare_all,
    silhouettes_outvoted,
)
from gdtool.fields.grid.refine import keep_pieces
from gdtool.fields.views.depth_alignment import agreement, normals_fit_depth
from gdtool.fields.views.prepared_view import PreparedView
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import vertex_normals

if TYPE_CHECKING:
    from gdtool.fields.appearance.appearance import Appearance
    from gdtool.fields.neural.fit import Fit
    from gdtool.fields.neural.paper import PaperOptions

# Share of points that another view confirms. Below it depth and normals say less of the shape than the silhouettes do.
LEAST_AGREEMENT = 0.25
# Share of normals that fit the slope of the depth. Below it they describe another surface (a broken normal map, say).
LEAST_FITTING_NORMALS = 0.5
STARTUP_SECONDS = 0.5  # of a budget: start-up and publication
VOLUME_SHARE = 3  # without depth, one step of volume rendering for so many steps of each other phase
SEEN_SUPPORT = 0.02  # weight of the views above which a vertex counts as seen
MATERIALS = ("albedo", "roughness", "metallic")


@dataclass(frozen=True)
class ViewImages:
    """Views of one object: k cameras, mask (k, h, w), images by domain (k, h, w[, 3]), and where they were read."""

    cameras: list[Camera]
    names: list[str]
    mask: np.ndarray
    images: dict[str, np.ndarray]
    path: Path
    of_picture: bool


@dataclass(frozen=True)
class AlignedViews:
    """Prepared views with how they agree, and the grid step (world units) that suits them.

    disagreement_before, disagreement: world units, before and after alignment. agreement: share of points that another
    view confirms. outvoted: silhouettes that may miss a point of the object. has_normals: whether normals shape the
    surface.
    """

    views: list[PreparedView]
    step: float
    disagreement_before: float
    disagreement: float
    agreement: float
    outvoted: int
    has_normals: bool


@dataclass
class Surface:
    """A closed mesh, and where networks were fitted the fit and its figures."""

    mesh: TriMesh
    fit: Fit | None = None
    figures: dict[str, float] = field(default_factory=dict)


def time_limit(budget: float) -> Clock:
    """Start a clock of the seconds that a budget leaves for computation; 0 for no limit."""
    return Clock(max(budget - STARTUP_SECONDS, 1e-3) if budget else 0.0)


def check_masks(views: ViewImages, out: Output) -> None:
    """Warn about views that show nothing. Raises InputError when none shows anything."""
    shown = [(views.mask[k] > 0.5).any() for k in range(len(views.cameras))]
    if not any(shown):
        raise InputError(views.path, "every mask is empty", "paint the object white in the masks")
    for name, good in zip(views.names, shown, strict=True):
        if not good:
            out.warn(f"view {name}: its mask is empty; the view is left out")


def align(views: ViewImages, resolution: int, clock: Clock, out: Output) -> AlignedViews:
    """Prepare the views and align their depth; fall back to silhouettes where depth and normals do not fit together."""
    step = grid_step(views.cameras, resolution)
    normal = _normals(views, out)
    depth = _depth(views, out)
    alike = ("albedo", "color") if "depth" in views.images else ("albedo", "color", "normal")
    colors = [views.images[domain] for domain in alike if domain in views.images]
    options = AlignmentOptions(clock, log.status, colors)
    prepared, before, noise = align_depth(views.cameras, views.mask, depth, normal, step, options)
    agreed = agreement(prepared)
    if agreed < LEAST_AGREEMENT:
        out.warn(
            f"depth and normals do not fit together (a view confirms {agreed:.0%} of another's points); "
            "the silhouettes alone give the shape"
        )
        prepared, noise = prepare_all(views.cameras, views.mask, None, None), 0.0
    outvoted = silhouettes_outvoted(prepared)
    if noise == before and depth is not None:
        out.skip("alignment of depth", f"the views agree to {noise / step:.3f} of a grid step")
    if outvoted:
        out.warn(f"the silhouettes contradict one another: up to {outvoted} of {len(prepared)} are outvoted at a point")
    return AlignedViews(prepared, step, before, noise, agreed, outvoted, normal is not None)


def growth(views: ViewImages, out: Output) -> float:
    """Return the world units by which the surface of views that a model made of a picture is moved out."""
    grow = SHRINKAGE_PX * finest_pixel(views.cameras) if views.of_picture else 0.0
    if not grow:
        out.skip("growth of the surface", "no model made the views of a picture")
    return grow


def fuse(views: ViewImages, aligned: AlignedViews, grow: float, picture_view: str, clock: Clock, out: Output) -> Shape:
    """Fuse aligned views into a mesh. Raises InputError where the silhouettes have no common volume."""
    options = FusionOptions(aligned.disagreement, aligned.outvoted, aligned.has_normals, grow, picture_view)
    with out.step("fuse"):
        try:
            shape, coarser = fuse_within_budget(aligned.views, aligned.step, clock, options)
        except ValueError as error:
            raise InputError(views.path, str(error), "give masks and cameras of one object") from None
    _tell_skipped(shape, aligned, grow, out)
    if coarser:
        out.skip("the whole grid", f"--budget has no time for it: the surface is taken {coarser}")
    return shape


def _tell_skipped(shape: Shape, aligned: AlignedViews, grow: float, out: Output) -> None:
    """Record which steps of the fusion were not needed, and why."""
    if shape.bumps is None or shape.bumps <= BUMPY_DEGREES:
        if shape.bumps is not None:
            reason = f"it is within {shape.bumps:.1f} degrees of them"
        elif not aligned.has_normals:
            reason = "there are none"
        elif all(view.planes is None for view in aligned.views):
            reason = "the silhouettes alone give the shape"
        else:
            reason = "the views agree"
        out.skip("surface by normals", reason)
    if not shape.restored:
        if not grow:
            reason = "no model made the views of a picture"
        elif aligned.disagreement:
            reason = "the views together have something behind each of its pixels"
        else:
            reason = "the views agree"
        out.skip("parts that the picture alone shows", reason)


def figures_of(aligned: AlignedViews, shape: Shape, grow: float) -> dict[str, float]:
    """Return the report's figures of alignment and fusion."""
    return {
        "seen_share": float((shape.support > SEEN_SUPPORT).mean()),
        "pieces_dropped": shape.dropped,
        "grid_step": shape.step,
        "disagreement_before": aligned.disagreement_before,
        "disagreement": aligned.disagreement,
        "grown": grow,
        "restored_share": shape.restored,
        "agreement": aligned.agreement,
        "silhouettes_outvoted": aligned.outvoted,
    }


def check_cameras(path: Path, cameras: list[Camera], vertices: np.ndarray) -> None:
    """Raise InputError for a camera that has a part of the surface behind it. path: of cameras.json."""
    for camera in cameras:
        if project(camera, vertices)[1].min() <= 0:
            raise InputError(
                path,
                f"camera {camera.name!r} is inside the object or looks away from it",
                "give it a world_from_camera outside the object, -z towards it",
            )


def fit_paper(views: ViewImages, aligned: AlignedViews, shape: Shape, options: PaperOptions, out: Output) -> Surface:
    """Fit the paper's networks, started from the grid's shape, and extract their surface.

    Where there are normals and no depth, the depth of the aligned views holds the surface in its place: normals alone
    let it drift. The grid's shape is kept where the networks' surface is not closed.
    """
    from dataclasses import replace

    from gdtool.fields.neural.paper import extract_network, fit_networks

    images = _with_depth(views, aligned.views)
    volume = 0 if "depth" in images else options.surface_steps // VOLUME_SHARE
    if not volume:
        out.skip("volume start", f"{'depth' if 'depth' in views.images else 'normal'} views say where the surface is")
    with out.step("networks"):
        fit, figures = fit_networks(
            views.cameras,
            views.mask,
            images,
            shape.mesh,
            replace(options, volume_steps=volume),
            lambda count, label: out.progress(range(count), count, label),
        )
    with out.step("extract"):
        mesh = extract_network(fit.sdf, shape.step, out.device)
        if len(mesh.faces):
            mesh = keep_pieces(mesh, shape.step)
    if not is_closed_manifold(mesh.faces):
        out.warn("the networks' surface is not closed; the grid's is kept")
        return Surface(shape.mesh, None, figures)
    return Surface(mesh, fit, figures)


def use_fit(surface: Surface, views: ViewImages, look: Appearance, out: Output) -> None:
    """Put the material network's values, where views supervised it, and the fitted light into look; save the
    networks."""
    from gdtool.fields.neural.paper import light_record, network_materials, save_field

    values = network_materials(surface.fit.material, surface.mesh.vertices, out.device)
    supervised = [name for name in MATERIALS if name in views.images]
    for name in supervised or MATERIALS if "color" in views.images else supervised:
        setattr(look, name, values[name] if name == "albedo" else values[name][:, 0])
    if "color" in views.images:
        look.light = light_record(surface.fit)
    save_field(out.path("field.safetensors"), surface.fit)


def find_materials(
    views: ViewImages, surface: Surface, step: float, light: dict[str, Any] | None, seed: int, out: Output
) -> tuple[np.ndarray, Appearance]:
    """Find the normals (v, 3) of the surface's vertices, and their materials and light.

    step: of the grid, world units. light: the record of the views' light, where it is known.
    """
    from gdtool.fields.appearance.appearance import AppearanceOptions, appearance

    with out.step("materials"):
        normals = vertex_normals(surface.mesh)
        options = AppearanceOptions(step, light, seed)
        look = appearance(views.cameras, views.mask, views.images, surface.mesh, normals, options)
    for what, reason in look.skipped:
        out.skip(what, reason)
    if surface.fit is not None:
        use_fit(surface, views, look, out)
    return normals, look


def _with_depth(views: ViewImages, prepared: list[PreparedView]) -> dict[str, np.ndarray]:
    """Return the images, with the aligned views' depth added where there is none and normals gave it."""
    depth_of = {
        id(view.camera): (view.points - view.camera.position) @ -view.camera.backward
        for view in prepared
        if view.points is not None
    }
    if "depth" in views.images or not depth_of:
        return views.images
    stack = [
        depth_of.get(id(camera), np.zeros_like(mask)) for camera, mask in zip(views.cameras, views.mask, strict=True)
    ]
    return views.images | {"depth": np.stack(stack).astype(np.float32)}


def _normals(views: ViewImages, out: Output) -> np.ndarray | None:
    """Return normal views (k, h, w, 3); None where there are none, or where they contradict the depth."""
    normal, depth = views.images.get("normal"), views.images.get("depth")
    if normal is None or depth is None:
        return normal
    fit = normals_fit_depth(views.cameras, views.mask, depth, normal)
    if fit < LEAST_FITTING_NORMALS:
        out.warn(f"only {fit:.0%} of the normals fit the slope of the depth; they are left out of the shape")
        return None
    return normal


def _depth(views: ViewImages, out: Output) -> np.ndarray | None:
    """Return depth views (k, h, w); without them the depth that normals and matching give; None without either."""
    if "depth" in views.images or "normal" not in views.images:
        out.skip(
            "matching of views",
            "depth views say where the surface is" if "depth" in views.images else "there are no normals to match",
        )
        return views.images.get("depth")
    alike = {domain: views.images[domain] for domain in MATERIALS if domain in views.images}
    with out.step("match views"):
        return depth_for(views.cameras, views.mask, views.images["normal"], alike)
