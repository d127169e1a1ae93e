"""Ground-truth views of PBR models: lit color, normal, depth, albedo, roughness, metallic and mask.

Use it to make training data, to feed a model you already have into reconstruct, and to judge a finished asset: with
--cameras it is rendered through the cameras of other views. Sources are .glb, .gltf, .obj, .ply or .stl files, and
procedural:SEED or procedural:FIRST..LAST for generated objects. Faces are seen from both sides; BLEND materials are
seen where alpha is at least one half.

Example:
  gdtool render-dataset procedural:0..9 -o data
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.folder import Folder
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import LEAST_EXPOSURE, MOST_EXPOSURE, MOST_SEED, Inputs, Output, SecondInput, Stage, file_option

if TYPE_CHECKING:
    import numpy as np

    from gdtool.assets.scene import Scene
    from gdtool.cameras import Camera
    from gdtool.shading.render.dataset import PreparedLight
    from gdtool.shading.render.direct import DirectLight
    from gdtool.shading.render.render import Renderer

ALL = (*DOMAINS, "closed_form")


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of render-dataset."""

    size: Annotated[int, Meta(ge=16, le=4096, description="width and height of a view in pixels")] = 256
    samples: Annotated[
        int,
        Meta(ge=1, le=1024, description="the most samples per pixel; pixels whose mean is known get fewer, at least 4"),
    ] = 16
    light_samples: Annotated[
        int, Meta(ge=1, le=1024, description="directions per sample, from the light and from the reflection each")
    ] = 4
    light: file_option(
        "random (seeded by the object's name), random:NUMBER, dark, mid, bright, or a lat-long .hdr or .exr file"
    ) = "random"
    exposure: Annotated[
        float,
        Meta(
            ge=LEAST_EXPOSURE,
            le=MOST_EXPOSURE,
            description="factor on the color; 1: a white card in the light's brightest direction has radiance 0.8",
        ),
    ] = 1.0
    rig: Annotated[Literal["six", "wonder3d", "turntable", "sphere"], Meta(description="where the cameras stand")] = (
        "six"
    )
    views: Annotated[int, Meta(ge=1, le=1000, description="how many cameras, for turntable and sphere")] = 8
    elevation: Annotated[float, Meta(ge=-89, le=89, description="of the turntable's cameras, degrees")] = 0.0
    fov: Annotated[
        float, Meta(ge=0, le=120, description="across, degrees, for perspective cameras; 0: orthographic")
    ] = 0.0
    domains: Annotated[tuple[str, ...], Meta(description="what to write")] = ALL
    brdf: Annotated[
        Literal["gltf", "paper"],
        Meta(description="reflection model of color and closed_form; gltf is what engines use"),
    ] = "gltf"
    normalize: Annotated[
        bool, Meta(description="centre the bounding box and scale its longest side to 1; see --cameras")
    ] = True
    turn: Annotated[
        float,
        Meta(
            ge=0,
            le=180,
            description="turn the object about the vertical, by its name and --seed, "
            "by up to so many degrees either way",
        ),
    ] = 0.0
    condition_views: Annotated[
        int, Meta(ge=0, le=1000, description="pictures from the front at random elevation, projection and scale")
    ] = 0
    filter: Annotated[
        Literal["all", "complete-pbr"],
        Meta(
            description="complete-pbr: refuse a model when more than 5 % of its area lacks "
            "a base color or metallic-roughness texture"
        ),
    ] = "all"
    seed: Annotated[
        int, Meta(ge=0, le=MOST_SEED, description="seed of everything random, together with the object's name")
    ] = 0


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --light and options that contradict one another would stop the run with."""
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
    import numpy as np

    from gdtool.folders.views import Views, write_views
    from gdtool.shading.render import dataset
    from gdtool.shading.render.render import Renderer

    views_given: Folder | None = inputs.second.get("cameras")
    generated = isinstance(inputs.main, str)
    scene = _read_scene(inputs, options, out)
    placement = dataset.Placement(inputs.main, inputs.name, views_given, options.normalize, options.turn, options.seed)
    scene, source_from_world = dataset.place_scene(scene, placement)
    cameras = _cameras(views_given, options)
    renderer, lamps = Renderer(scene, out.threads), None
    if options.condition_views or not {"color", "closed_form"}.isdisjoint(options.domains):
        with out.step("light"):
            light = dataset.light_name(options.light or "random", inputs.name, options.seed, views_given)
            lamps = dataset.prepare_light(renderer, light, options.light_samples, options.seed, options.brdf)
    with out.step("render"):

        def view(camera: Camera) -> dict[str, np.ndarray]:
            return dataset.render_view(renderer, camera, options.samples, lamps, options.domains, options.exposure)

        frames = list(out.progress(renderer.render_each(view, cameras), len(cameras), "views"))
    mask = np.stack([frame["mask"] for frame in frames])
    if not mask.any():
        raise InputError(
            inputs.name,
            "is not in the picture of any camera",
            "name views of this object with --cameras, or leave out --no-normalize",
        )
    images = {d: np.stack([frame[d] for frame in frames]) for d in ALL if d in options.domains}
    with out.step("conditions"):
        if options.condition_views and lamps is not None:
            rng = np.random.default_rng([options.seed, dataset.seed_of(inputs.name)])
            _write_conditions(out, renderer, lamps.direct, options, rng)
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
            clipped_share=float((images["color"][mask > 0] > 1).mean()) if "color" in images else 0.0,
            conditions=options.condition_views,
            model=generated,
            report=_report(scene, renderer, mask, lamps),
        )
    _tell_skips(out, renderer, options, lamps)


def _read_scene(inputs: Inputs, options: Options, out: Output) -> Scene:
    """Read the model, warn of what is odd in it, and refuse it where --filter asks for more."""
    from gdtool.assets.load import load_scene
    from gdtool.geometry import shells
    from gdtool.shading.render.dataset import require_complete_pbr

    with out.step("read"):
        scene = load_scene(inputs.main.file("asset.glb") if isinstance(inputs.main, Folder) else inputs.main)
    for note in scene.notes:
        out.warn(note)
    # The parts of generated objects overlap on purpose.
    if not isinstance(inputs.main, str) and (inner := shells.told(scene.vertices, scene.faces, welded=False)):
        out.warn(inner)
    if options.filter != "all":
        require_complete_pbr(scene, inputs.name)
    return scene


def _cameras(views: Folder | None, options: Options) -> list[Camera]:
    """Return the cameras of the given views, else those of the rig."""
    from gdtool.cameras.camera import SIX_VIEWS, rig
    from gdtool.shading.render.rigs import sphere, turntable

    if views is not None:
        from gdtool.folders.records import read_cameras

        return read_cameras(views.file("cameras.json"))
    if options.rig == "turntable":
        return turntable(options.views, options.size, options.elevation, options.fov)
    if options.rig == "sphere":
        return sphere(options.views, options.size, options.fov)
    if options.fov:
        return turntable(0, options.size, options.elevation, options.fov, SIX_VIEWS)
    return rig(options.rig, options.size)


def _write_conditions(
    out: Output, renderer: Renderer, direct: DirectLight, options: Options, rng: np.random.Generator
) -> None:
    """Render and write the condition pictures, straight alpha, and their cameras."""
    import numpy as np

    from gdtool.folders.records import write_cameras
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.io import write_png
    from gdtool.shading.render.rigs import condition_camera

    cameras = [condition_camera(rng, f"{i:03d}", options.size) for i in range(options.condition_views)]
    frames = renderer.render_each(
        lambda camera: renderer.buffers(camera, options.samples, direct.color(options.exposure)), cameras
    )
    for camera, frame in zip(cameras, out.progress(frames, len(cameras), "conditions"), strict=True):
        color = srgb_from_linear(np.clip(frame["color"], 0, 1))
        write_png(out.path(f"condition/{camera.name}.png"), np.concatenate([color, frame["mask"][..., None]], -1))
    write_cameras(out.path("condition.json"), cameras)


def _report(scene: Scene, renderer: Renderer, mask: np.ndarray, lamps: PreparedLight | None) -> dict[str, float]:
    """Collect the figures of the manifest."""
    report = {
        "faces": len(scene.faces),
        "materials": len(scene.materials),
        "samples": renderer.counts.samples,
        "shadow_rays": renderer.counts.shadow_rays,
        "foreground_share": float((mask > 0).mean()),
    }
    if lamps is not None:
        report["environment_scale"] = lamps.environment.scale
        report |= {f"light_fit_{name}": value for name, value in lamps.record["fit_error"].items()}
    return report


def _tell_skips(out: Output, renderer: Renderer, options: Options, lamps: PreparedLight | None) -> None:
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
    version=7,
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
