"""Ground-truth views of PBR models: lit color, normal, depth, albedo, roughness, metallic and mask.

Use it to make training data, to feed a model you already have into reconstruct, and to judge a finished asset: with
--cameras it is rendered through the cameras of other views. Sources are .glb, .gltf, .obj, .ply or .stl files, and
procedural:SEED or procedural:FIRST..LAST for generated objects. Faces are seen from both sides; BLEND materials are
seen where alpha is at least one half.

Example:
  gdtool render-dataset procedural:0..9 -o data
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

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
    from gdtool.shading.bsdf.sg import SphericalGaussians
    from gdtool.shading.lights.environment import Environment
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
            description="turn the object about the vertical, by its name and --seed, by up to so many degrees either way",
        ),
    ] = 0.0
    condition_views: Annotated[
        int, Meta(ge=0, le=1000, description="pictures from the front at random elevation, projection and scale")
    ] = 0
    filter: Annotated[
        Literal["all", "complete-pbr"],
        Meta(
            description="complete-pbr: refuse a model when more than 5 % of its area lacks a base color or metallic-roughness texture"
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

    from gdtool.assets.load import load_scene
    from gdtool.folders.views import Views, write_views
    from gdtool.geometry import shells
    from gdtool.shading.render.render import Renderer

    given: Folder | None = inputs.second.get("cameras")
    source = inputs.main.file("asset.glb") if isinstance(inputs.main, Folder) else inputs.main
    with out.step("read"):
        scene = load_scene(source)
    for note in scene.notes:
        out.warn(note)
    generated = isinstance(inputs.main, str)  # parts of generated objects overlap as their makers meant it
    if not generated and (inner := shells.told(scene.vertices, scene.faces, welded=False)):
        out.warn(inner)
    _filter(scene, inputs.name, options)
    scene, source_from_world = _placed(scene, inputs, given, options)
    cameras = _cameras(given, options)
    rng = np.random.default_rng([options.seed, _number(inputs.name)])

    lit = bool(options.condition_views) or not {"color", "closed_form"}.isdisjoint(options.domains)
    renderer = Renderer(scene, out.threads)
    lamps = light = None
    if lit:
        with out.step("light"):
            lamps = _light(renderer, inputs, given, options)
            light = lamps.record
    with out.step("render"):
        frames = list(
            out.progress(
                renderer.render_each(lambda camera: _view(renderer, camera, lamps, options), cameras), len(cameras), "views"
            )
        )
    wanted = [d for d in ALL if d in options.domains]
    mask = np.stack([frame["mask"] for frame in frames])
    if not mask.any():
        raise InputError(
            inputs.name,
            "is not in the picture of any camera",
            "name views of this object with --cameras, or leave out --no-normalize",
        )
    views = Views(cameras, {d: np.stack([frame[d] for frame in frames]) for d in wanted}, mask, light)

    with out.step("conditions"):
        if options.condition_views:
            _write_conditions(out, renderer, lamps.direct, options, rng)
    with out.step("write"):
        if generated:
            from gdtool.assets.gltf_write import write_glb

            write_glb(out.path("source.glb"), scene)
        clipped = 0.0
        if "color" in views.images:
            clipped = float((views.images["color"][mask > 0] > 1).mean())
        counts = renderer.counts
        report = {
            "faces": len(scene.faces),
            "materials": len(scene.materials),
            "samples": counts.samples,
            "shadow_rays": counts.shadow_rays,
            "foreground_share": float((mask > 0).mean()),
        }
        if light is not None:
            report |= {
                "environment_scale": lamps.environment.scale,
                **{f"light_fit_{k}": v for k, v in light["fit_error"].items()},
            }
        write_views(
            out,
            views,
            source_from_world=source_from_world,
            exposure=options.exposure,
            environment=light["environment"] if light else "",
            clipped_share=clipped,
            conditions=options.condition_views,
            model=generated,
            report=report,
        )
    _tell_skips(out, renderer, options, lamps)


def _number(text: str) -> int:
    """A stable 64-bit number of a text."""
    return int.from_bytes(hashlib.sha256(text.encode(errors="surrogateescape")).digest()[:8], "big")


def _filter(scene: Scene, name: str, options: Options) -> None:
    if options.filter == "all":
        return
    import numpy as np

    from gdtool.geometry.normals import face_normals

    complete = np.array(
        [
            (m.base_color_texture is not None or scene.colors is not None) and m.metallic_roughness_texture is not None
            for m in scene.materials
        ]
    )
    area = face_normals(scene.vertices, scene.faces)[1]
    share = float(area[complete[scene.material_idx]].sum() / max(area.sum(), 1e-300))
    if share < 0.95:
        raise InputError(
            name,
            f"has complete PBR textures on {share:.0%} of its area only",
            "leave out --filter to take it all the same",
        )


def _placed(scene: Scene, inputs: Inputs, given: Folder | None, options: Options) -> tuple[Scene, np.ndarray]:
    """The scene in the frame of the views, and source_from_world.

    --no-normalize leaves it where it is, --turn turns it first. With --cameras it is put where that folder's object was
    when it comes from the same source, is left when it is an asset or its box is about normalised, and is normalised
    otherwise."""
    import dataclasses

    import numpy as np

    from gdtool.core import sources
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    identity = np.eye(4)
    own = unit_box(scene.vertices[np.unique(scene.faces)])
    matrix = own if options.normalize else identity
    if options.turn:
        matrix = _turned(scene.vertices[np.unique(scene.faces)], inputs.name, options)
    if given is not None and options.normalize:
        theirs = np.array(given.content.source_from_world).reshape(4, 4)
        before = [entry.digest for entry in given.manifest.inputs if entry.role == "source"]
        asset = _asset_of(inputs.main)
        about_normal = abs(own[0, 0] - 1) < 0.1 and np.abs(own[:3, 3]).max() < 0.1
        if asset is not None:
            matrix = (
                np.array(asset.content.source_from_world).reshape(4, 4) if asset.content.frame == "source" else identity
            )
        elif sources.digest(inputs.main) in before:
            matrix = theirs
        elif about_normal:
            matrix = identity
    if np.array_equal(matrix, identity):
        return scene, identity
    directions = {}
    if matrix[:3, :3].astype(bool).sum() > 3:  # turned, and not only scaled
        rotation = matrix[:3, :3] / (matrix[:3, 0] ** 2).sum() ** 0.5
        directions = {
            name: np.concatenate([x[:, :3] @ rotation, x[:, 3:]], 1)
            for name in ("normals", "tangents")
            if (x := getattr(scene, name)) is not None
        }
    return dataclasses.replace(
        scene, vertices=transform_points(invert_similarity(matrix), scene.vertices), **directions
    ), matrix


def _turned(vertices: np.ndarray, name: str, options: Options) -> np.ndarray:
    """source_from_world (4, 4) of --turn: y stays where it is."""
    import numpy as np

    from gdtool.geometry.frames import unit_box

    angle = np.radians(np.random.default_rng([options.seed, _number(name), 1]).uniform(-options.turn, options.turn))
    source_from_turned = np.eye(4)
    source_from_turned[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return (
        source_from_turned @ unit_box(vertices @ source_from_turned[:3, :3])
        if options.normalize
        else source_from_turned
    )


def _asset_of(source: Any) -> Folder | None:
    """The asset folder that a source is, or that its file lies in."""
    from gdtool.core.folder import is_folder, open_folder

    if isinstance(source, Folder):
        return source
    if isinstance(source, Path) and is_folder(source.parent):
        folder = open_folder(source.parent, check=False)
        return folder if folder.kind == "asset" else None
    return None


def _cameras(given: Folder | None, options: Options) -> list[Camera]:
    from gdtool.shading.render.rigs import sphere, turntable

    if given is not None:
        from gdtool.folders.records import read_cameras

        return read_cameras(given.file("cameras.json"))
    if options.rig == "turntable":
        return turntable(options.views, options.size, options.elevation, options.fov)
    if options.rig == "sphere":
        return sphere(options.views, options.size, options.fov)
    from gdtool.cameras.camera import SIX_VIEWS, rig

    if options.fov:
        return turntable(0, options.size, options.elevation, options.fov, SIX_VIEWS)
    return rig(options.rig, options.size)


class _Lamps(NamedTuple):
    """The light of one object in the forms it is used in; record is that of light.json."""

    environment: Environment
    lobes: SphericalGaussians
    record: dict[str, Any]
    direct: DirectLight


def _light(renderer: Renderer, inputs: Inputs, given: Folder | None, options: Options) -> _Lamps:
    import torch

    from gdtool.shading.lights.studio import studio
    from gdtool.shading.render.direct import DirectLight

    # Shading runs in threads of its own, a chunk each; torch's own would only wait for each other.
    torch.set_num_threads(1)
    source = options.light or "random"
    if source == "random" and given is not None:
        theirs = given.content.environment
        # A light that a name brings back is used again; a file is not here to be read.
        source = theirs if theirs.startswith("random:") or theirs in ("dark", "mid", "bright") else source
    if source == "random":
        source = f"random:{(_number(inputs.name) + options.seed) % 10**9}"
    environment, lobes, record = studio(source, options.seed)
    return _Lamps(
        environment,
        lobes,
        record,
        DirectLight(renderer, environment, options.light_samples, options.seed, options.brdf),
    )


def _view(renderer: Renderer, camera: Camera, lamps: _Lamps | None, options: Options) -> dict[str, np.ndarray]:
    frame = renderer.buffers(
        camera, options.samples, lamps.direct.color(options.exposure) if "color" in options.domains else None
    )
    if "closed_form" in options.domains:
        from gdtool.shading.bsdf.closed_form import closed_form_image

        frame["closed_form"] = closed_form_image(frame, camera, lamps.lobes, options.brdf) * options.exposure
    return frame


def _write_conditions(
    out: Output, renderer: Renderer, direct: DirectLight, options: Options, rng: np.random.Generator
) -> None:
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


def _tell_skips(out: Output, renderer: Renderer, options: Options, lamps: _Lamps | None) -> None:
    """What the scene did not need."""
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
