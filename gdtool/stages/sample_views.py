"""Make six views of an object, in six domains, from one picture of it.

Takes an image with alpha, or one that is then cut out of its background, for sure where that is plain and as a guess
where it is busy, or any image with --mask or --matting. The subject is cropped and centred as in training. Writes
color, normal, depth, albedo, roughness, metallic and masks of the default rig for reconstruct, at the model's own
resolution, and the picture as it was framed at its own, for bake. What the picture shows and the outlines of the other
views leave no room for is drawn into them. The albedo of its own view gets the picture's contrast, as far as that is
paint and not light. What the model takes for rather metal than not is metal. It warns of pictures unlike the model's
training, and where the result shows that the model is unsure of it. Use --no-crop when the picture is framed like the
rig's front view already (an orthographic render of a normalised object).

Example:
  gdtool sample-views cat.png --seed 7
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast

import msgspec
from msgspec import Meta

from gdtool.core.errors import UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import MOST_SEED, Inputs, Output, SecondInput, Stage, file_option


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of sample-views."""

    steps: (
        Annotated[int, Meta(ge=1, le=1000, description="Denoising steps; without it what measured best for the model.")]
        | None
    ) = None
    guidance: Annotated[
        float, Meta(ge=0, le=30, description="Classifier-free guidance; 1: none, and half the time.")
    ] = 1.0
    guided_from: Annotated[
        float, Meta(ge=0, le=1, description="Least noise that guidance acts at, as a share of the timesteps.")
    ] = 0.0
    guided_to: Annotated[
        float,
        Meta(ge=0, le=1, description="Most noise that guidance acts at; outside there is none, and half the time."),
    ] = 1.0
    scheduler: Annotated[Literal["ddim", "dpm"], Meta(description="Sampler: DDIM or DPM-Solver++.")] = "ddim"
    mirror: Annotated[
        bool,
        Meta(
            description="Take the mean with what the picture's mirror image gives, where the model is one that gains "
            "from it; twice the time."
        ),
    ] = True
    seed: Annotated[
        int, Meta(ge=0, le=MOST_SEED, description="Seed of the noise, the same for every object whatever the order.")
    ] = 0
    domains: Annotated[
        tuple[str, ...], Meta(description="Domains to write; color is made in any case, being the primary.")
    ] = DOMAINS
    mask: file_option("Image that is bright where the subject is.") = None
    matting: file_option(
        "ONNX file of a network that cuts the subject out of any background: u2net.onnx, u2netp.onnx or silueta.onnx "
        "(needs gdtool[matting])."
    ) = None
    crop: Annotated[bool, Meta(description="Centre the subject and scale it as in training.")] = True
    precision: Annotated[Literal["float32", "bfloat16"], Meta(description="Arithmetic of the networks.")] = "float32"
    compile: Annotated[
        bool,
        Meta(
            description="Compile the network first (torch.compile, needs a C++ compiler): two minutes the first time, "
            "ten seconds afterwards, then a third less time a step."
        ),
    ] = False


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --mask and --matting would stop the run with."""
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
    from gdtool.diffusion.data.condition import PictureOptions, make_condition, trained_extent
    from gdtool.diffusion.inference.pipeline import sample_condition, warn_of_doubts
    from gdtool.diffusion.inference.result import views_from_images
    from gdtool.diffusion.inference.sampling import SamplingOptions
    from gdtool.diffusion.network.encoding import BACKGROUND

    torch.set_num_threads(out.threads)
    with out.step("load"):
        chosen = inputs.second["model"]
        folder = cast(Path, getattr(chosen, "path", chosen))
        model = (wonder3d.load if wonder3d.recognises(folder) else load_model)(folder).to(out.device)
    config = model.config
    domains = _domains(options, config)
    with out.step("condition"):
        extent = trained_extent(config.convention)
        framing = PictureOptions(options.mask, options.matting, options.crop, extent, config.image_size)
        condition, picture = make_condition(cast(Path, inputs.main), inputs.name, framing, out.warn)
    with out.step("sample"):
        settings = SamplingOptions(
            domains=domains,
            steps=options.steps or config.sampling_steps,
            guidance=options.guidance,
            guided_from=options.guided_from,
            guided_to=options.guided_to,
            seed=options.seed,
            mirror=None if options.mirror else False,
            scheduler=options.scheduler,
            precision=options.precision,
        )
        images = sample_condition(model, folder, condition, settings, options.compile, inputs.name, out)
    if config.convention == "wonder3d" and "normal" in images:
        images["normal"] = wonder3d.premultiplied_normals(images["normal"])
    rig_name = "wonder3d" if config.convention == "wonder3d" else "six"
    cameras = {camera.name: camera for camera in rig(rig_name, config.image_size)}
    views, report = views_from_images(
        {d: x[0].cpu() for d, x in images.items()},
        [cameras[name] for name in config.views],
        BACKGROUND[config.backgrounds[0]],
        domains,
        condition[..., 3],
    )
    warn_of_doubts(folder, report, config, settings, inputs.name, out)
    with out.step("write"):
        _write(views, report, condition, picture, domains, out)


def _domains(options: Options, config) -> tuple[str, ...]:
    """Return the domains to write; without --domains all that the model has. Raises UsageError for others."""
    domains = config.domains if options.domains == DOMAINS else options.domains
    unknown = [d for d in domains if d not in config.domains]
    if unknown or not domains:
        raise UsageError(
            "--domains",
            f"{unknown[0] if unknown else 'nothing'} is not a domain of this model",
            f"choose from {','.join(config.domains)}",
        )
    return domains


def _write(views, report, condition, picture, domains, out: Output) -> None:
    """Write the views folder, the condition as the model was shown it, and the framed picture."""
    from gdtool.diffusion.data.condition import encode_rgba
    from gdtool.folders.views import write_views
    from gdtool.images.io import write_png

    write_png(out.path("condition/000.png"), encode_rgba(condition))
    shown = "front" if "front" in views.names else ""  # the view that is the picture's own
    if not report["drawn_share"]:
        out.skip(
            "parts of the picture in the other views",
            "each has room for all of them" if shown else "no view is the picture's own",
        )
    if not report["painted_share"] and "albedo" in domains:
        out.skip(
            "paint of the picture",
            "its detail is light, or metal, by the model's albedo" if shown else "no view is the picture's own",
        )
    if shown:
        write_png(out.path("picture.png"), encode_rgba(picture))
    write_views(out, views, conditions=1, picture=shown, report=report)


STAGE = Stage(
    name="sample-views",
    version=12,
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
