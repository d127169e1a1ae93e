"""Make six views of an object, in six domains, from one picture of it.

The picture needs an alpha channel, --mask or --matting; without them the subject is cut out of a plain background, and
guessed where the background is busy. The subject is cropped and centred as in training; use --no-crop for an
orthographic render of a normalised object, framed like the rig's front view.

Writes color, normal, depth, albedo, roughness, metallic and masks of the default rig for reconstruct, at the model's
resolution, and the framed picture at its own resolution for bake. Three steps follow the sampling. Parts of the picture
for which the outlines of the other views leave no room are added to those views. The front albedo takes over the
picture's contrast where that is paint and not light. Metallic values are pushed to 0 or 1. A warning tells of
a picture unlike those of the training, and of views that the model is unsure of.

Example:
  gdtool sample-views cat.png --seed 7
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta

from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import FILE, MOST_SEED, Inputs, Output, SecondInput, Stage
from gdtool.stages.sampling_options import Eta, Guidance, GuidedFrom, GuidedTo, Scheduler, Spacing, Steps

if TYPE_CHECKING:
    import numpy as np

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
    mirror: Annotated[
        bool,
        Meta(
            description="Average with the views of the picture's mirror image, where the model's card says that it "
            "gains from that; twice the time."
        ),
    ] = True
    seed: Annotated[
        int, Meta(ge=0, le=MOST_SEED, description="Seed of the noise, the same for every object whatever the order.")
    ] = 0
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
    precision: Annotated[Literal["float32", "bfloat16"], Meta(description="Arithmetic of the networks.")] = "float32"
    compile: Annotated[
        bool,
        Meta(
            description="Compile the network first (torch.compile, needs a C++ compiler). It takes two minutes the "
            "first time and ten seconds afterwards, and saves a third of each step."
        ),
    ] = False


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
    if options.matting is not None:
        early.require_file("--matting", options.matting)
        early.require_package("onnxruntime", "--matting", "pip install 'gdtool[matting]', or give a mask with --mask")


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Sample and write a views folder. Raises InputError for images and models that cannot be used."""
    import torch

    from gdtool.cameras import rig
    from gdtool.diffusion.checkpoint import wonder3d
    from gdtool.diffusion.checkpoint.weights import load_model
    from gdtool.diffusion.data.condition import PictureOptions, make_condition
    from gdtool.diffusion.inference.pipeline import (
        Subject,
        choose_domains,
        sample_subject,
        sampling_options,
        warn_of_doubts,
    )
    from gdtool.diffusion.inference.result import views_from_images
    from gdtool.diffusion.network.encoding import BACKGROUND

    torch.set_num_threads(out.threads)
    with out.step("load"):
        folder = inputs.second_path("model")
        assert folder is not None  # the bundled model is the default
        model = (wonder3d.load if wonder3d.recognises(folder) else load_model)(folder).to(out.device)
    config = model.config
    domains = choose_domains(None if options.domains == DOMAINS else options.domains, config)
    settings, of_wonder3d = sampling_options(options, domains), config.convention == "wonder3d"
    used = asdict(settings.used_with(config))
    with out.step("condition"):
        framing = PictureOptions(options.mask, options.matting, options.crop, config.image_size, of_wonder3d)
        condition, picture = make_condition(inputs.path, inputs.name, framing, out.warn)
    with out.step("sample"):
        subject = Subject(inputs.name, condition)
        images, silhouettes = sample_subject(model, folder, subject, settings, options.compile, out)
    if of_wonder3d and "normal" in images:
        images["normal"] = wonder3d.premultiplied_normals(images["normal"])
    cameras = {camera.name: camera for camera in rig("wonder3d" if of_wonder3d else "six", config.image_size)}
    views, report = views_from_images(
        {d: x[0].cpu() for d, x in images.items()},
        [cameras[name] for name in config.views],
        BACKGROUND[config.backgrounds[0]],
        domains,
        condition[..., 3],
        silhouettes,
    )
    warn_of_doubts(folder, report, config, settings, inputs.name, out)
    with out.step("write"):
        _write(views, report | used, condition, picture, domains, out)


def _write(
    views: Views,
    report: dict[str, Any],
    condition: np.ndarray,
    picture: np.ndarray,
    domains: tuple[str, ...],
    out: Output,
) -> None:
    """Write the views folder, the condition image that the model saw, and the framed picture."""
    from gdtool.diffusion.data.condition import encode_rgba
    from gdtool.diffusion.inference.pipeline import tell_unused_picture
    from gdtool.folders.views import write_views
    from gdtool.images.io import write_png

    write_png(out.path("condition/000.png"), encode_rgba(condition))
    own_view = "front" if "front" in views.names else ""  # the view that the picture was taken from
    tell_unused_picture(report, domains, bool(own_view), out)
    if own_view:
        write_png(out.path("picture.png"), encode_rgba(picture))
    write_views(out, views, conditions=1, picture=own_view, report=report)


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
        )
    },
)
