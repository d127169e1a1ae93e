"""Render ground-truth views of PBR models: lit color, normal, depth, albedo, roughness, metallic and mask.

Use it to make training data, to feed a model you already have into reconstruct, and to judge a finished asset: with
--cameras it is rendered through the cameras of other views. Sources are .glb, .gltf, .obj, .ply or .stl files, and
procedural:SEED or procedural:FIRST..LAST for generated objects. Faces are seen from both sides; BLEND materials are
opaque where alpha is at least one half.

Example:
  gdtool render-dataset procedural:0..9 -o data
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import FILE, Inputs, Output, SecondInput, Stage
from gdtool.stages.shared_options import Brdf, Exposure, Fov, Seed

if TYPE_CHECKING:
    from gdtool.shading.render.dataset import PreparedLight
    from gdtool.shading.render.render import Renderer

ALL = (*DOMAINS, "closed_form")  # every image that a view can have


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool render-dataset`."""

    size: Annotated[int, Meta(ge=16, le=4096, description="Width and height of a view, pixels.")] = 256
    samples: Annotated[
        int,
        Meta(ge=1, le=1024, description="Most samples per pixel. A pixel with little noise gets fewer, at least 4."),
    ] = 16
    light_samples: Annotated[
        int, Meta(ge=1, le=1024, description="Directions per sample from the light, and as many from the reflection.")
    ] = 4
    light: Annotated[
        str | None,
        Meta(
            description="random (seeded by the object's name), random:NUMBER, dark, mid, bright, or a lat-long .hdr or "
            ".exr file.",
            extra=FILE,
        ),
    ] = "random"
    exposure: Exposure = 1.0
    rig: Annotated[
        Literal["six", "wonder3d", "turntable", "sphere"], Meta(description="Arrangement of the cameras.")
    ] = "six"
    views: Annotated[int, Meta(ge=1, le=1000, description="Number of cameras of a turntable or a sphere.")] = 8
    elevation: Annotated[float, Meta(ge=-89, le=89, description="Elevation of a turntable's cameras, degrees.")] = 0.0
    fov: Fov = 0.0
    domains: Annotated[tuple[str, ...], Meta(description="Images to write of each view.")] = ALL
    brdf: Brdf = "gltf"
    normalize: Annotated[
        bool, Meta(description="Centre the bounding box and scale its longest side to 1; see --cameras.")
    ] = True
    turn: Annotated[
        float,
        Meta(
            ge=0,
            le=180,
            description="Turn the object about the vertical by a random angle of up to so many degrees either way, "
            "drawn by its name and --seed.",
        ),
    ] = 0.0
    condition_views: Annotated[
        int,
        Meta(
            ge=0, le=1000, description="Number of pictures from the front with random elevation, projection and scale."
        ),
    ] = 0
    filter: Annotated[
        Literal["all", "complete-pbr"],
        Meta(
            description="complete-pbr: refuse a model where more than 5 % of the area lacks a base color or "
            "metallic-roughness texture."
        ),
    ] = "all"
    seed: Seed = 0


def check(inputs: Inputs, options: Options) -> None:
    """Refuse, before the run, a bad --light and options that contradict one another."""
    from gdtool.shading.lights.bundled import BUNDLED
    from gdtool.stages import early

    unknown = sorted(set(options.domains) - set(ALL))
    if unknown:
        raise UsageError("--domains", f"{unknown[0]!r} is no domain", f"choose from {', '.join(ALL)}")
    if options.turn and inputs.second.get("cameras") is not None:
        raise UsageError(
            "--turn", "does not go with --cameras, whose folder says how the object stands", "leave out one of the two"
        )
    early.require_fov(options.fov)
    if options.light not in (None, "random"):
        early.require_environment("--light", options.light, BUNDLED)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Render one model."""
    from gdtool.folders.models import load_model
    from gdtool.folders.records import read_cameras
    from gdtool.folders.views import Views, write_conditions, write_views
    from gdtool.shading.render import dataset
    from gdtool.shading.render.placement import Placement, place_scene
    from gdtool.shading.render.render import Renderer
    from gdtool.shading.render.rigs import cameras_by_rig

    views = inputs.second_folder("cameras")
    generated = isinstance(inputs.main, str)
    with out.step("read"):
        scene = load_model(inputs.main)
    for warning in dataset.examine(scene, inputs.name, generated, complete=options.filter != "all"):
        out.warn(warning)
    placement = Placement(inputs.main, inputs.name, views, options.normalize, options.turn, options.seed)
    scene, source_from_world = place_scene(scene, placement)
    if views is not None:
        cameras = read_cameras(views.file("cameras.json"))
    else:
        cameras = cameras_by_rig(options.rig, options.views, options.size, options.elevation, options.fov)
    renderer = Renderer(scene, out.threads)
    lamps: PreparedLight | None = None
    if options.condition_views or not {"color", "closed_form"}.isdisjoint(options.domains):
        with out.step("light"):
            light = dataset.light_name(options.light or "random", inputs.name, options.seed, views)
            lamps = dataset.prepare_light(renderer, light, options.light_samples, options.seed, options.brdf)
    with out.step("render"):
        how = dataset.ViewOptions(options.samples, options.domains, options.exposure)
        images, mask = dataset.render_views(renderer, cameras, lamps, how, out.progress)
    if not mask.any():
        raise InputError(
            inputs.name,
            "is not in the picture of any camera",
            "name views of this object with --cameras, or leave out --no-normalize",
        )
    if options.condition_views and lamps is not None:
        with out.step("conditions"):
            condition_cameras = dataset.condition_cameras(
                options.condition_views, options.size, inputs.name, options.seed
            )
            pictures = dataset.render_conditions(renderer, condition_cameras, lamps.direct, how)
            write_conditions(out, condition_cameras, pictures)
    with out.step("write"):
        if generated:
            from gdtool.assets.gltf.write import write_glb

            write_glb(out.path("source.glb"), scene)
        write_views(
            out,
            Views(cameras, images, mask, lamps.record if lamps else None),
            source_from_world=source_from_world,
            exposure=options.exposure,
            environment=lamps.record["environment"] if lamps else "",
            clipped_share=dataset.clipped_share(images, mask),
            conditions=options.condition_views,
            model=generated,
            report=dataset.figures(scene, renderer, mask, lamps),
        )
    _record_skips(out, renderer, options, lamps)


def _record_skips(out: Output, renderer: Renderer, options: Options, lamps: PreparedLight | None) -> None:
    """Record what the scene and the options did not need."""
    from gdtool.shading.render.skipped_work import skipped_work

    if lamps is None:
        out.skip("light", "neither color, closed_form nor condition images are asked for")
    for what, why, seconds in skipped_work(renderer, options.samples, None if lamps is None else lamps.direct):
        out.skip(what, why, seconds)
    for domain in ALL:
        if domain not in options.domains:
            out.skip(domain, "left out by --domains")


STAGE = Stage(
    name="render-dataset",
    version=8,
    reads=("model-file", "asset"),
    writes="views",
    Options=Options,
    run=run,
    check=check,
    dataset=True,
    second_inputs={
        "cameras": SecondInput(
            "views", search=False, help="Views folder whose cameras, frame and light are used again."
        )
    },
)
