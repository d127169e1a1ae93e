"""Pictures of an asset or a model under any light.

Use it to see what bake made, to compare lights, and for turntables. Takes an asset folder or a .glb, .gltf, .obj, .ply
or .stl file, and lights it by one of the bundled lights or by a lat-long .hdr or .exr image (--env). --light says how:
sampled becomes exact with more samples, prefiltered is quick and close, sg is what training and reconstruction compute
with. --budget and --target-psnr say how long to go on instead of --samples.

Example:
  gdtool relight cat.asset/asset --env bright --views 8
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import UsageError
from gdtool.core.folder import Folder
from gdtool.core.kinds import RendersContent
from gdtool.core.stage import LEAST_EXPOSURE, MOST_EXPOSURE, MOST_SECONDS, MOST_SEED, Inputs, Output, Stage, file_option

if TYPE_CHECKING:
    import numpy as np

    from gdtool.assets.scene import Scene
    from gdtool.cameras import Camera
    from gdtool.shading.render.direct import DirectLight
    from gdtool.shading.render.render import Renderer

# The most samples per pixel of a view that --budget or --target-psnr ends.
OPEN_ENDED = 4096


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of relight."""

    env: file_option("dark, mid, bright, random:NUMBER, or a lat-long .hdr or .exr file") = "mid"
    views: Annotated[int, Meta(ge=1, le=1000, description="1: from the front; more: a turntable")] = 1
    elevation: Annotated[float, Meta(ge=-89, le=89, description="of the cameras, degrees")] = 10.0
    fov: Annotated[float, Meta(ge=0, le=120, description="across, degrees; 0: orthographic")] = 30.0
    size: Annotated[int, Meta(ge=16, le=8192, description="width and height in pixels")] = 512
    light: Annotated[
        Literal["sampled", "prefiltered", "sg"],
        Meta(
            description="how --env lights: sampled, exact direct light with shadows; "
            "prefiltered, the light averaged over reflection lobes, shadows from a few rays; "
            "sg, closed form of sixteen spherical Gaussians, no shadows"
        ),
    ] = "sampled"
    samples: Annotated[
        int,
        Meta(ge=1, le=4096, description="the most samples per pixel; pixels whose mean is known get fewer, at least 4"),
    ] = 64
    light_samples: Annotated[
        int,
        Meta(
            ge=0,
            le=1024,
            description="directions per sample, from the light and from the reflection each; "
            "0, prefiltered only: no shadows",
        ),
    ] = 4
    budget: (
        Annotated[
            float,
            Meta(
                gt=0,
                le=MOST_SECONDS,
                description="seconds for the rendering of all views, up to 4096 samples per pixel; "
                "the pictures then depend on the machine",
            ),
        ]
        | None
    ) = None
    target_psnr: (
        Annotated[
            float,
            Meta(
                ge=10,
                le=60,
                description="dB, estimated while rendering, at which a view is done, up to 4096 samples per pixel",
            ),
        ]
        | None
    ) = None
    exposure: Annotated[
        float,
        Meta(
            ge=LEAST_EXPOSURE,
            le=MOST_EXPOSURE,
            description="factor on the color; 1: a white card in the light's brightest direction has radiance 0.8",
        ),
    ] = 1.0
    brdf: Annotated[Literal["gltf", "paper"], Meta(description="reflection model; gltf is what engines use")] = "gltf"
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="seed of everything random")] = 0


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --env and options that exclude one another would stop the run with."""
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

    import numpy as np
    import torch

    from gdtool.shading.lights.studio import studio
    from gdtool.shading.render.direct import DirectLight, LightOptions
    from gdtool.shading.render.pictures import PictureOptions, render_pictures
    from gdtool.shading.render.render import Renderer
    from gdtool.shading.render.rigs import turntable
    from gdtool.stages.limits import held_to

    torch.set_num_threads(1)  # shading runs in threads of this program
    scene, matrix = _read_scene(inputs, out)
    with out.step("light"):
        environment, lobes, record = studio(options.env or "mid", options.seed, fit=options.light == "sg")
    cameras = turntable(options.views, options.size, options.elevation, options.fov)
    cure = "raise --budget, or lower --size or --views"
    held = (
        contextlib.nullcontext() if options.budget is None else held_to(options.budget, "--budget", inputs.name, cure)
    )
    with held, out.step("render"):
        renderer, direct = Renderer(scene, out.threads), None
        if options.light != "sg":
            how = LightOptions(options.light)
            direct = DirectLight(renderer, environment, options.light_samples, options.seed, options.brdf, how)
        how = PictureOptions(
            _most_samples(options), options.exposure, options.brdf, options.budget, options.target_psnr
        )
        rendered = render_pictures(renderer, direct or lobes, cameras, how, out.progress)
    with out.step("write"):
        _write(out, cameras, rendered.images)
    known = [x for x in rendered.psnr if x is not None]
    _tell(out, options, renderer, direct, known)
    out.content = RendersContent(
        frames=len(cameras),
        environment=environment.name,
        light=options.light,
        exposure=options.exposure,
        source_from_world=tuple(float(x) for x in matrix.ravel()),
        report={
            "clipped_share": float(np.mean(rendered.clipped)),
            "environment_scale": environment.scale,
            "samples": renderer.counts.samples,
            "shadow_rays": renderer.counts.shadow_rays,
            **({"estimated_psnr": min(known)} if known else {}),
            **{f"light_fit_{name}": value for name, value in record["fit_error"].items()},
        },
    )


def _most_samples(options: Options) -> int:
    """Return the most samples per pixel: those of --samples, or OPEN_ENDED where a goal ends a view."""
    return options.samples if options.budget is None and options.target_psnr is None else OPEN_ENDED


def _read_scene(inputs: Inputs, out: Output) -> tuple[Scene, np.ndarray]:
    """Read the asset or model in the normalised frame, and the matrix (4, 4) from there to its file's frame."""
    import dataclasses

    import numpy as np

    from gdtool.assets.load import load_scene
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    with out.step("read"):
        scene = load_scene(inputs.main.file("asset.glb") if isinstance(inputs.main, Folder) else inputs.main)
        matrix = unit_box(scene.vertices[np.unique(scene.faces)])
        scene = dataclasses.replace(scene, vertices=transform_points(invert_similarity(matrix), scene.vertices))
    for note in scene.notes:
        out.warn(note)
    return scene, matrix


def _write(out: Output, cameras: list[Camera], pictures: list[np.ndarray]) -> None:
    """Write the pictures, their cameras, and a contact sheet that is about square."""
    import math

    from gdtool.folders.records import write_cameras
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_png

    for camera, picture in zip(cameras, pictures, strict=True):
        write_png(out.path(f"{camera.name}.png"), picture)
    write_cameras(out.path("cameras.json"), cameras)
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    write_png(out.path("contact_sheet.png"), contact_sheet(rows))


def _tell(
    out: Output, options: Options, renderer: Renderer, direct: DirectLight | None, known_psnr: list[float]
) -> None:
    """Record what was left out, and warn of a --target-psnr that was not reached."""
    from gdtool.shading.render.skipped_work import skipped_work

    samples = _most_samples(options)
    if options.light == "sg":
        out.skip("shadows", "the closed form has none")
    else:
        out.skip("the light's fit by spherical Gaussians", f"--light {options.light} does not use it")
    for what, why, seconds in skipped_work(renderer, samples, direct):
        out.skip(what, why, seconds)
    if options.target_psnr is not None and (not known_psnr or min(known_psnr) < options.target_psnr):
        out.warn(f"--target-psnr {options.target_psnr:g} was not reached by {samples} samples per pixel")


STAGE = Stage(
    name="relight", version=6, reads=("asset", "model-file"), writes="renders", Options=Options, run=run, check=check
)
