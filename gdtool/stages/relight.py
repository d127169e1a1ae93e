"""Render pictures of an asset or a model under any light.

Use it to see a baked asset, to compare lights, and for turntables. It takes an asset folder or a .glb, .gltf, .obj,
.ply or .stl file, and lights it by one of the bundled lights or by a lat-long .hdr or .exr image (--env). --light
chooses the method: sampled becomes exact with more samples, prefiltered is quick and close, sg is the one that training
and reconstruction use. --budget and --target-psnr end the rendering instead of --samples.

Example:
  gdtool relight cat.asset/asset --env bright --views 8
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import UsageError
from gdtool.core.kinds import RendersContent
from gdtool.core.stage import FILE, MOST_SECONDS, Inputs, Output, Stage
from gdtool.stages.shared_options import Brdf, Exposure, Fov, Seed

if TYPE_CHECKING:
    import numpy as np

    from gdtool.cameras import Camera
    from gdtool.shading.render.direct import DirectLight
    from gdtool.shading.render.pictures import Pictures
    from gdtool.shading.render.render import Renderer


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool relight`."""

    env: Annotated[
        str | None,
        Meta(description="Light: dark, mid, bright, random:NUMBER, or a lat-long .hdr or .exr file.", extra=FILE),
    ] = "mid"
    views: Annotated[int, Meta(ge=1, le=1000, description="1: a view from the front; more: a turntable.")] = 1
    elevation: Annotated[float, Meta(ge=-89, le=89, description="Elevation of the cameras, degrees.")] = 10.0
    fov: Fov = 30.0
    size: Annotated[int, Meta(ge=16, le=8192, description="Width and height of a picture, pixels.")] = 512
    light: Annotated[
        Literal["sampled", "prefiltered", "sg"],
        Meta(
            description="How to compute the light. sampled: exact direct light with shadows. prefiltered: the light "
            "averaged over reflection lobes, shadows from a few rays. sg: closed form of sixteen spherical Gaussians, "
            "no shadows."
        ),
    ] = "sampled"
    samples: Annotated[
        int,
        Meta(ge=1, le=4096, description="Most samples per pixel. A pixel with little noise gets fewer, at least 4."),
    ] = 64
    light_samples: Annotated[
        int,
        Meta(
            ge=0,
            le=1024,
            description="Directions per sample from the light, and as many from the reflection. 0: no shadows, for "
            "--light prefiltered only.",
        ),
    ] = 4
    budget: (
        Annotated[
            float,
            Meta(
                gt=0,
                le=MOST_SECONDS,
                description="Seconds for the rendering of all views, up to 4096 samples per pixel. The pictures then "
                "depend on the machine.",
            ),
        ]
        | None
    ) = None
    target_psnr: (
        Annotated[
            float,
            Meta(ge=10, le=60, description="Estimated PSNR at which a view is done, dB, up to 4096 samples per pixel."),
        ]
        | None
    ) = None
    exposure: Exposure = 1.0
    brdf: Brdf = "gltf"
    seed: Seed = 0


def check(inputs: Inputs, options: Options) -> None:
    """Refuse, before the run, a bad --env and options that exclude one another."""
    from gdtool.shading.lights.bundled import BUNDLED
    from gdtool.stages import early

    if options.budget is not None and options.target_psnr is not None:
        raise UsageError("--budget and --target-psnr", "exclude each other", "leave one of them out")
    if options.light == "sampled" and not options.light_samples:
        raise UsageError("--light-samples 0", "leaves --light sampled without light", "use --light prefiltered")
    if options.light == "sg" and (options.budget, options.target_psnr) != (None, None):
        raise UsageError("--light sg", "is free of noise", "leave out --budget and --target-psnr")
    early.require_fov(options.fov)
    early.require_environment("--env", options.env or "mid", BUNDLED)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Light one asset or model."""
    import contextlib

    import torch

    from gdtool.folders.models import load_model
    from gdtool.shading.lights.studio import studio
    from gdtool.shading.render.direct import DirectLight, LightOptions
    from gdtool.shading.render.pictures import PictureOptions, render_pictures
    from gdtool.shading.render.placement import in_unit_box
    from gdtool.shading.render.render import Renderer
    from gdtool.shading.render.rigs import turntable
    from gdtool.stages.limits import limited_to

    torch.set_num_threads(1)  # shading runs in threads of this program
    with out.step("read"):
        scene, source_from_world = in_unit_box(load_model(inputs.main))
    for note in scene.notes:
        out.warn(note)
    with out.step("light"):
        environment, lobes, record = studio(options.env or "mid", options.seed, fit=options.light == "sg")
    cameras = turntable(options.views, options.size, options.elevation, options.fov)
    how = PictureOptions(options.samples, options.exposure, options.brdf, options.budget, options.target_psnr)
    cure = "raise --budget, or lower --size or --views"
    held = (
        contextlib.nullcontext()
        if options.budget is None
        else limited_to(options.budget, "--budget", inputs.name, cure)
    )
    with held, out.step("render"):
        renderer, direct = Renderer(scene, out.threads), None
        if options.light != "sg":
            kind = LightOptions(options.light)
            direct = DirectLight(renderer, environment, options.light_samples, options.seed, options.brdf, kind)
        pictures = render_pictures(renderer, direct or lobes, cameras, how, out.progress)
    with out.step("write"):
        _write(out, cameras, pictures.images)
    _record_skips(out, options, renderer, direct, pictures, how.most_samples)
    out.content = RendersContent(
        frames=len(cameras),
        environment=environment.name,
        light=options.light,
        exposure=options.exposure,
        source_from_world=tuple(float(x) for x in source_from_world.ravel()),
        report={
            "clipped_share": pictures.clipped_share,
            "environment_scale": environment.scale,
            "samples": renderer.counts.samples,
            "shadow_rays": renderer.counts.shadow_rays,
            **({} if pictures.least_psnr is None else {"estimated_psnr": pictures.least_psnr}),
            **{f"light_fit_{name}": value for name, value in record["fit_error"].items()},
        },
    )


def _write(out: Output, cameras: list[Camera], pictures: list[np.ndarray]) -> None:
    """Write the pictures, their cameras, and a contact sheet."""
    from gdtool.folders.records import write_cameras
    from gdtool.images.contact import square_sheet
    from gdtool.images.io import write_png

    for camera, picture in zip(cameras, pictures, strict=True):
        write_png(out.path(f"{camera.name}.png"), picture)
    write_cameras(out.path("cameras.json"), cameras)
    write_png(out.path("contact_sheet.png"), square_sheet(pictures))


def _record_skips(
    out: Output, options: Options, renderer: Renderer, direct: DirectLight | None, pictures: Pictures, samples: int
) -> None:
    """Record what was left out, and warn of a --target-psnr that was not reached.

    samples: the most that a pixel could get.
    """
    from gdtool.shading.render.skipped_work import skipped_work

    if options.light == "sg":
        out.skip("shadows", "the closed form has none")
    else:
        out.skip("the light's fit by spherical Gaussians", f"--light {options.light} does not use it")
    for what, why, seconds in skipped_work(renderer, samples, direct):
        out.skip(what, why, seconds)
    goal, reached = options.target_psnr, pictures.least_psnr
    if goal is not None and (reached is None or reached < goal):
        out.warn(f"--target-psnr {goal:g} was not reached by {samples} samples per pixel")


STAGE = Stage(
    name="relight", version=6, reads=("asset", "model-file"), writes="renders", Options=Options, run=run, check=check
)
