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

import contextlib
from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.ending import temporary_folder
from gdtool.core.errors import InputError, ResourceError, UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.core.stage import MOST_SEED, Inputs, Output, SecondInput, Stage, file_option

FINEST = 8  # pixels of picture.png across one of a view


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
            description="Take the mean with what the picture's mirror image gives, where the model is one that gains from it; twice the time."
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
        "ONNX file of a network that cuts the subject out of any background: u2net.onnx, u2netp.onnx or silueta.onnx (needs gdtool[matting])."
    ) = None
    crop: Annotated[bool, Meta(description="Centre the subject and scale it as in training.")] = True
    precision: Annotated[Literal["float32", "bfloat16"], Meta(description="Arithmetic of the networks.")] = "float32"
    compile: Annotated[
        bool,
        Meta(
            description="Compile the network first (torch.compile, needs a C++ compiler): two minutes the first time, ten seconds afterwards, then a third less time a step."
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
            raise _wrong_size(options.mask, mask, image)
    if options.matting is not None:
        early.require_file("--matting", options.matting)
        early.require_package("onnxruntime", "--matting", "pip install 'gdtool[matting]', or give a mask with --mask")


def _wrong_size(mask: str, size: tuple[int, int], wanted: tuple[int, int]) -> InputError:
    return InputError(
        mask, f"is {size[0]}x{size[1]}, the image {wanted[0]}x{wanted[1]}", f"scale it to {wanted[0]}x{wanted[1]}"
    )


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Sample and write a views folder. Raises InputError for images and models that cannot be used."""
    import torch

    from gdtool.cameras import rig
    from gdtool.diffusion.checkpoint import wonder3d
    from gdtool.diffusion.checkpoint.weights import load_model
    from gdtool.diffusion.data.objects import to_tensor_condition
    from gdtool.diffusion.inference.familiarity import doubts, read_ranges, unfamiliar
    from gdtool.diffusion.inference.result import views_from_images
    from gdtool.diffusion.network.encoding import BACKGROUND
    from gdtool.folders.views import write_views
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.io import write_png

    torch.set_num_threads(out.threads)
    with out.step("load"):
        chosen = inputs.second["model"]
        folder = getattr(chosen, "path", chosen)
        model = (wonder3d.load if wonder3d.recognises(folder) else load_model)(folder).to(out.device)
    config = model.config
    # Without --domains: all that the model has.
    domains = config.domains if options.domains == DOMAINS else options.domains
    unknown = [d for d in domains if d not in config.domains]
    if unknown or not domains:
        raise UsageError(
            "--domains",
            f"{unknown[0] if unknown else 'nothing'} is not a domain of this model",
            f"choose from {','.join(config.domains)}",
        )
    with out.step("condition"):
        condition, picture = _condition(inputs, options, config, out)
    with out.step("sample"):
        rgba = to_tensor_condition(condition)
        known = read_ranges(folder)
        strange = unfamiliar(rgba[0].numpy(), known)
        if strange:
            out.warn(
                f"{inputs.name}: unlike the pictures this model was trained on, expect less of it: {'; '.join(strange)}"
            )
        rgba = rgba.to(out.device)
        # The order that convolutions work in; a twentieth quicker, the same to rounding.
        model.unet.to(memory_format=torch.channels_last)
        images = _sampled(
            model,
            options.compile,
            rgba,
            domains=domains,
            steps=options.steps or config.sampling_steps,
            guidance=options.guidance,
            guided_from=options.guided_from,
            guided_to=options.guided_to,
            seed=options.seed,
            mirror=None if options.mirror else False,
            scheduler=options.scheduler,
            precision=options.precision,
            progress=out.progress,
        )
        if options.guidance != 1 and (options.guided_from > 0 or options.guided_to < 1):
            out.skip("guidance of some steps", "they are outside --guided-from and --guided-to")
    if config.convention == "wonder3d" and "normal" in images:
        images["normal"] = wonder3d.premultiplied_normals(images["normal"])
    cameras = {
        camera.name: camera
        for camera in rig("wonder3d" if config.convention == "wonder3d" else "six", config.image_size)
    }
    views, report = views_from_images(
        {d: x[0].cpu() for d, x in images.items()},
        [cameras[name] for name in config.views],
        BACKGROUND[config.backgrounds[0]],
        domains,
        condition[..., 3],
    )
    # What is usual was measured as the model is sampled when nothing is asked for.
    if (
        options.steps in (None, config.sampling_steps)
        and options.guidance == 1
        and options.mirror
        and domains == config.domains
    ):
        unsure = doubts(report, known)
        if unsure:
            out.warn(
                f"{inputs.name}: the model is unsure of the views that the picture does not show ({'; '.join(unsure)}): look at contact_sheet.png "
                "before going on, and try a picture straight from the front, or another --model"
            )
    else:
        out.skip(
            "the model's doubt of its result",
            "what is usual is known of the model's own steps, without guidance, in all domains",
        )
    with out.step("write"):
        # what the model was shown, after cutting out and framing
        write_png(out.path("condition/000.png"), srgb_from_linear_rgba(condition, srgb_from_linear))
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
            write_png(out.path("picture.png"), srgb_from_linear_rgba(picture, srgb_from_linear))
        write_views(out, views, conditions=1, picture=shown, report=report)


@contextlib.contextmanager
def _compiler_cache() -> Iterator[None]:
    """Have PyTorch keep what it compiles in the user's cache folder, or where that cannot be written in one that is
    removed.

    By itself it leaves a folder in TMPDIR. TORCHINDUCTOR_CACHE_DIR, where it is set, is respected.
    """
    import os
    from pathlib import Path

    name = "TORCHINDUCTOR_CACHE_DIR"
    if name in os.environ:
        yield
        return
    with contextlib.ExitStack() as at_end:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "gdtool", "torchinductor")
        try:
            cache.mkdir(parents=True, exist_ok=True)
            if not os.access(cache, os.W_OK | os.X_OK):
                raise PermissionError
        except OSError:
            cache = at_end.enter_context(temporary_folder())
        os.environ[name] = str(cache)
        at_end.callback(os.environ.pop, name)
        yield


def _sampled(model, compiled: bool, rgba, **setting):
    """sample_images(), of the compiled network where that is asked for. Raises ResourceError where it cannot be
    compiled."""
    from gdtool.diffusion.inference.sampling import sample_images

    if not compiled:
        return sample_images(model, rgba, **setting)
    from torch._dynamo.exc import TorchDynamoException

    model.unet.compile()
    try:
        with _compiler_cache():
            return sample_images(model, rgba, **setting)
    except TorchDynamoException as failure:
        raise ResourceError(
            "--compile",
            f"PyTorch cannot compile the network here: {str(failure).strip().splitlines()[0]}",
            "leave it out, or install a C++ compiler",
        ) from None


def srgb_from_linear_rgba(image, srgb_from_linear):
    import numpy as np

    return np.concatenate([srgb_from_linear(np.clip(image[..., :3], 0, 1)), np.clip(image[..., 3:], 0, 1)], -1)


def _condition(inputs: Inputs, options: Options, config, out: Output):
    """The framed picture (size, size, 4), linear color and straight alpha, and the same as many times finer as the
    picture is.
    Raises InputError without a usable subject.
    """
    from pathlib import Path

    import numpy as np

    from gdtool.diffusion.checkpoint import wonder3d
    from gdtool.diffusion.data.framing import FRONT_EXTENT, frame, framed_side, whole_frame
    from gdtool.images.color import linear_from_srgb
    from gdtool.images.io import read_image
    from gdtool.images.mask import foreground

    image = read_image(inputs.main)
    if min(image.shape[:2]) < 32:
        raise InputError(
            inputs.main,
            f"is {image.shape[1]}x{image.shape[0]} pixels; the model needs 32 at least",
            "give a larger picture",
        )
    given = read_image(Path(options.mask)) if options.mask is not None else None
    if given is not None and given.shape[:2] != image.shape[:2]:
        raise _wrong_size(options.mask, given.shape[1::-1], image.shape[1::-1])
    alpha = foreground(image, given, inputs.main, out.warn, options.matting)
    if not (alpha > 0.5).any():
        raise InputError(inputs.main, "shows no subject: its mask is empty", "give one with --mask")
    edge = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    if options.crop and (edge > 0.5).any():
        out.warn(f"{inputs.name}: the subject touches the border of the picture and may be cut off")
    linear = image.dtype.kind == "f"
    color = (
        image[..., :3]
        if image.ndim == 3 and image.shape[2] >= 3
        else np.repeat(image.reshape(*image.shape[:2], -1)[..., :1], 3, -1)
    )
    if not linear:
        color = linear_from_srgb(color.astype(np.float32) / np.iinfo(image.dtype).max)
    rgba = np.concatenate([color, alpha[..., None]], -1).astype(np.float32)
    extent = wonder3d.EXTENT if config.convention == "wonder3d" else FRONT_EXTENT
    size = config.image_size
    finer = (framed_side(rgba, extent) if options.crop else max(rgba.shape[:2])) / size
    condition, picture = (
        frame(rgba, side, extent) if options.crop else whole_frame(rgba, side)
        for side in (size, size * min(max(round(finer), 1), FINEST))
    )
    return condition, picture


STAGE = Stage(
    name="sample-views",
    version=12,
    reads=("image-file",),
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
