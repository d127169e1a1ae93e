"""Make six views of an object, in six domains, from one picture of it, or from several.

The picture needs an alpha channel, --mask or --matting; without them the subject is cut out of a plain background, and
guessed where the background is busy. The subject is cropped and centred as in training; use --no-crop for an
orthographic render of a normalised object, framed like the rig's front view.

Writes color, normal, depth, albedo, roughness, metallic and masks of the default rig for reconstruct, at the model's
resolution, and the framed picture at its own resolution for bake. Three steps follow the sampling. Parts of the picture
for which the outlines of the other views leave no room are added to those views. The front albedo takes over the
picture's contrast where that is paint and not light. Metallic values are pushed to 0 or 1. A warning tells of
a picture unlike those of the training, and of views that the model is unsure of.

Pictures of other sides, and views whose domains are known, are taken over as they are, and the rest is made to fit. The
options are the views' names: --left is the camera at -X, to the left of the front one. Of a car that faces the front
camera it sees the car's own right side.

Examples:
  gdtool sample-views cat.png --seed 7
  gdtool sample-views --front car.png --back behind.png --left left.png
  gdtool render-dataset mesh.obj --domains normal,depth -o shape
  gdtool sample-views photo.png --given shape
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from gdtool.core.errors import UsageError
from gdtool.core.kinds import DOMAINS, VIEW_NAMES
from gdtool.core.stage import FILE, Inputs, Output, SecondInput, Stage
from gdtool.stages.sampling_options import (
    Compile,
    Eta,
    Guidance,
    GuidedFrom,
    GuidedTo,
    Mirror,
    PictureOf,
    Precision,
    Scheduler,
    Seed,
    Spacing,
    Steps,
    ViewName,
)

if TYPE_CHECKING:
    from gdtool.diffusion.inference.conditions import Conditions
    from gdtool.folders.views import Views


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool sample-views`."""

    steps: Steps = None
    guidance: Guidance = None
    guided_from: GuidedFrom = 0.0
    guided_to: GuidedTo = 1.0
    scheduler: Scheduler = "ddim"
    eta: Eta = None
    spacing: Spacing = "auto"
    mirror: Mirror = True
    seed: Seed = 0
    view: ViewName = "front"
    front: PictureOf = None
    front_right: PictureOf = None
    right: PictureOf = None
    back: PictureOf = None
    left: PictureOf = None
    front_left: PictureOf = None
    domains: Annotated[
        tuple[str, ...],
        Meta(description="Domains to write. They are what a run of all would write: those that they read are sampled."),
    ] = DOMAINS
    mask: Annotated[
        str | None, Meta(description="Picture of the same size that is bright where the subject is.", extra=FILE)
    ] = None
    matting: Annotated[
        str | None,
        Meta(
            description="ONNX file of a network that cuts the subject out of any background: u2net.onnx, u2netp.onnx "
            "or silueta.onnx (needs gdtool[matting]).",
            extra=FILE,
        ),
    ] = None
    crop: Annotated[bool, Meta(description="Centre the subject and scale it as in training.")] = True
    precision: Precision = "float32"
    compile: Compile = False


def check(inputs: Inputs, options: Options) -> None:
    """Refuse, before the run, a bad --mask and a --matting without its package."""
    from gdtool.stages import early

    if options.mask is not None:
        mask, image = (
            early.require_picture("--mask", options.mask),
            early.require_picture("the source", str(inputs.main)),
        )
        if sorted(mask) != sorted(image):  # a camera held upright swaps the two
            from gdtool.diffusion.data.condition import mask_size_error

            raise mask_size_error(options.mask, mask, image)
    for view, path in other_pictures(options).items():
        if view == options.view:
            raise UsageError(f"--{view}", "is what the source shows", "give one of the two, or --view")
        early.require_picture(f"--{view}", path)
    if options.matting is not None:
        early.require_file("--matting", options.matting)
        early.require_package("onnxruntime", "--matting", "pip install 'gdtool[matting]', or give a mask with --mask")


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Sample and write a views folder. Raises InputError for images and models that cannot be used."""
    import torch

    from gdtool.diffusion.checkpoint import wonder3d
    from gdtool.diffusion.checkpoint.weights import load_model
    from gdtool.diffusion.data.condition import PictureOptions
    from gdtool.diffusion.inference.conditions import make_conditions
    from gdtool.diffusion.inference.pipeline import choose_domains, sample_conditions, sampling_options

    torch.set_num_threads(out.threads)
    with out.step("load"):
        folder = inputs.second_path("model")
        assert folder is not None  # the bundled model is the default
        model = (wonder3d.load if wonder3d.recognises(folder) else load_model)(folder).to(out.device)
    config = model.config
    domains = choose_domains(None if options.domains == DOMAINS else options.domains, config)
    settings = sampling_options(options, domains)
    with out.step("condition"):
        framing = PictureOptions(
            options.mask, options.matting, options.crop, config.image_size, config.convention == "wonder3d"
        )
        paths = {options.view: inputs.path, **{view: Path(path) for view, path in other_pictures(options).items()}}
        conditions = make_conditions(model, paths, inputs.second_folder("given"), framing, out.warn)
    with out.step("sample"):
        views, report = sample_conditions(model, folder, conditions, settings, options.compile, inputs.name, out)
    with out.step("write"):
        _write(views, report | asdict(settings.used_with(config)), conditions, domains, out)


def other_pictures(options: Options) -> dict[str, str]:
    """Return the paths of the pictures that options give, by view."""
    return {name: path for name in VIEW_NAMES if (path := getattr(options, name)) is not None}


def _write(views: Views, report: dict[str, Any], conditions: Conditions, domains: tuple[str, ...], out: Output) -> None:
    """Write the views folder, the condition image that the model saw, and the framed picture."""
    from gdtool.diffusion.data.condition import encode_rgba
    from gdtool.diffusion.inference.pipeline import tell_unused_picture
    from gdtool.folders.views import write_views
    from gdtool.images.io import write_png

    write_png(out.path("condition/000.png"), encode_rgba(conditions.condition))
    own_view = "front" if "front" in views.names and conditions.picture is not None else ""
    tell_unused_picture(report, domains, bool(own_view), out)
    if own_view and conditions.picture is not None:
        write_png(out.path("picture.png"), encode_rgba(conditions.picture))
    matrix = conditions.given.source_from_world
    write_views(out, views, source_from_world=matrix, conditions=1, picture=own_view, report=report)


STAGE = Stage(
    name="sample-views",
    version=13,
    reads=("image-file",),
    networks=True,
    writes="views",
    Options=Options,
    run=run,
    check=check,
    second_inputs={
        "model": SecondInput(
            "model",
            search=False,
            default="models/default",
            foreign=True,
            help="Model folder of gdtool train, or Wonder3D v1 as a folder or hub id; the bundled model without it.",
        ),
        "given": SecondInput(
            "views",
            search=False,
            help="Views of the default rig whose images are known, in whatever domains the folder has: the geometry of "
            "a mesh, or another tool's color.",
        ),
    },
)
