"""Reconstruct a watertight surface from views, with albedo, roughness and metallic at every vertex.

Use it after sample-views or render-dataset, or on a views folder of your own. Any subset of the domains is accepted:
depth and normals shape the surface, silhouettes bound it, material views color it. The grid method (default) carves and
refines a signed distance grid in seconds; the paper method fits networks of distance and material.

Example:
  gdtool reconstruct cat.asset/views
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import UsageError
from gdtool.core.folder import Folder
from gdtool.core.kinds import DOMAINS, ViewsContent
from gdtool.core.stage import MOST_SECONDS, Inputs, Output, Stage
from gdtool.stages.shared_options import Seed

if TYPE_CHECKING:
    import numpy as np

    from gdtool.fields import pipeline
    from gdtool.fields.appearance.appearance import Appearance
    from gdtool.fields.neural.paper import PaperOptions


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool reconstruct`."""

    method: Annotated[
        Literal["grid", "paper"],
        Meta(description="grid: carve and refine a distance grid. paper: fit networks of distance and material."),
    ] = "grid"
    resolution: Annotated[
        int,
        Meta(
            ge=0, le=512, description="Grid samples along a unit of length; 0: a little finer than the views' pixels."
        ),
    ] = 0
    steps: Annotated[int, Meta(ge=1, le=100_000, description="paper: most optimisation steps of each phase.")] = 1000
    precision: Annotated[
        Literal["float32", "bfloat16"],
        Meta(description="paper: arithmetic while the first shape is fitted; the rest is always float32."),
    ] = "float32"
    root: Annotated[
        Literal["secant", "median"],
        Meta(description="paper: how the surface point between two samples of a ray is found."),
    ] = "secant"
    brdf: Annotated[
        Literal["gltf", "paper"], Meta(description="paper: reflection model that color is fitted with.")
    ] = "gltf"
    budget: Annotated[
        float,
        Meta(
            ge=0,
            le=MOST_SECONDS,
            description="Seconds that the run may take: grid then uses a coarser grid, paper fewer steps. 0: as long "
            "as it helps.",
        ),
    ] = 0.0
    ignore: Annotated[tuple[str, ...], Meta(description="Domains to leave out, for example depth,normal.")] = ()
    seed: Seed = 0


def check(inputs: Inputs, options: Options) -> None:
    """Raise UsageError for an unknown domain."""
    unknown = sorted(set(options.ignore) - set(DOMAINS))
    if unknown:
        raise UsageError("--ignore", f"{unknown[0]!r} is no domain", f"choose from {', '.join(DOMAINS)}")


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Reconstruct one views folder.

    Raises ResourceError where it takes much longer than --budget (limits.limited_to).
    """
    from gdtool.stages.limits import limited_to

    cure = f"raise --budget to {max(round(2 * options.budget), 1)}, or leave it out"
    with limited_to(options.budget, "--budget", inputs.name, cure) if options.budget else contextlib.nullcontext():
        _reconstruct(inputs.folder, options, out)


def _reconstruct(folder: Folder, options: Options, out: Output) -> None:
    """Read the views, make the surface with its materials, and write both."""
    from gdtool.fields import pipeline
    from gdtool.folders.views import read_views

    # The paper's method divides the budget among its steps itself.
    clock = pipeline.time_limit(options.budget if options.method == "grid" else 0.0)
    with out.step("read"):
        read = read_views(folder, tuple(d for d in DOMAINS if d not in options.ignore))
    for domain in DOMAINS:
        if domain not in read.images:
            out.skip(domain, "left out by --ignore" if domain in options.ignore else "the views do not hold it")
    picture = folder.content_as(ViewsContent).picture
    views = pipeline.ViewImages(read.cameras, list(read.names), read.mask, read.images, folder.path, bool(picture))
    pipeline.check_masks(views, out)
    with out.step("align"):
        aligned = pipeline.align(views, options.resolution, clock, out)
    grow = pipeline.growth(views, out)
    shape = pipeline.fuse(views, aligned, grow, picture, clock, out)
    pipeline.check_cameras(folder.file("cameras.json"), views.cameras, shape.mesh.vertices)
    surface = pipeline.Surface(shape.mesh)
    if options.method == "paper":
        surface = pipeline.fit_paper(views, aligned, shape, _paper_options(options, out), out)
    normals, look = pipeline.find_materials(views, surface, shape.step, read.light, options.seed, out)
    figures = {
        **pipeline.figures_of(aligned, shape, grow),
        "mean_confidence": float(look.confidence.mean()),
        **look.figures,
        **surface.figures,
    }
    with out.step("write"):
        _write(folder, surface, normals, look, options.method, figures, out)


def _paper_options(options: Options, out: Output) -> PaperOptions:
    """Return the settings of the paper's networks."""
    from gdtool.fields.neural.paper import PaperOptions

    return PaperOptions(
        options.steps,
        0,
        options.steps,
        rule=options.root,
        brdf=options.brdf,
        seed=options.seed,
        budget=options.budget,
        device=out.device,
        precision=options.precision,
    )


def _write(
    folder: Folder,
    reconstructed: pipeline.Surface,
    normals: np.ndarray,
    look: Appearance,
    method: str,
    figures: dict[str, float | str],
    out: Output,
) -> None:
    """Write the surface of the views in folder."""
    from gdtool.fields.grid.fusion import is_closed_manifold
    from gdtool.folders.surface import Surface, write_surface

    surface = Surface(
        reconstructed.mesh.vertices,
        reconstructed.mesh.faces,
        look.albedo,
        look.roughness,
        look.metallic,
        look.confidence,
        normals,
        look.light,
        look.views,
        look.residual,
    )
    write_surface(
        out,
        surface,
        watertight=is_closed_manifold(reconstructed.mesh.faces),
        method=method,
        field=reconstructed.fit is not None,
        source_from_world=folder.content.source_from_world,
        report=figures,
    )


STAGE = Stage(
    name="reconstruct",
    version=19,
    reads=("views",),
    writes="surface",
    Options=Options,
    run=run,
    check=check,
    networks=True,
)
