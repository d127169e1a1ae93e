"""Configure the diffusion model and its training; the presets `paper`, `small` and `tiny` run the same code.

ModelConfig is a model folder's config.json: what is needed to build the network again. TrainConfig is what a training
run needs in addition.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.cameras.camera import SIX_VIEWS
from gdtool.core.kinds import DOMAINS
from gdtool.core.names import text_fault

# Of a class label: sine and cosine of [elevation of the condition, view's elevation, view's azimuth, one-hot domain].
CLASS_WIDTH = 2 * (3 + len(DOMAINS))


# Bounds of a configuration file's values: far above any model that was trained, and low enough that a network is built
# on the meta device in a second, so that its memory is known before it is allocated.
Pixels = Annotated[int, Meta(ge=1, le=4096)]
Width = Annotated[int, Meta(ge=1, le=16384)]  # channels
Layers = Annotated[int, Meta(ge=1, le=64)]
Rate = Annotated[float, Meta(ge=0, le=10)]  # learning rate
Share = Annotated[float, Meta(ge=0, le=1)]
Weight = Annotated[float, Meta(ge=0, le=1e6)]  # of a part of the loss
MAX_LEVELS = 8  # resolutions of the UNet
MOST_STEPS = 10**9  # of a training
ENCODER_HEAD_WIDTH = 64  # channels of each attention head of the patch encoder


class ShapeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe the network that predicts a volume of occupancies from the picture (gdtool/diffusion/shape)."""

    channels: Annotated[tuple[Width, ...], Meta(min_length=1, max_length=MAX_LEVELS)] = (64, 128, 192)
    layers_per_block: Layers = 2
    attention_side: Pixels = 12  # levels whose features have this side at most have attention
    head_width: Width = 64
    norm_groups: Width = 16
    embedding: Width = 128  # channels of the embedding of the code
    code: Annotated[int, Meta(ge=1, le=1024)] = 16  # numbers that tell which of the possible shapes is meant
    prior_width: Width = 256  # of the hidden layers of the diffusion model of codes


class ModelConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe the network, its inputs and its noise. Sizes are in pixels unless a comment says otherwise."""

    image_size: Pixels = 64
    views: Annotated[tuple[str, ...], Meta(min_length=1)] = (
        "front",
        "front_right",
        "right",
        "back",
        "left",
        "front_left",
    )
    domains: Annotated[tuple[str, ...], Meta(min_length=1)] = DOMAINS
    # codec: "vae" is Stable Diffusion's (factor 8, 4 channels), "patch" is space-to-depth of the pixels.
    codec: Literal["vae", "patch"] = "patch"
    patch: Pixels = 4
    condition_alpha: bool = True  # the mask as fourth channel of the condition latent; patch codec only
    mirror_back: bool = True  # the back view gets the mirrored condition latent, which has its silhouette
    # UNet, in Stable Diffusion's structure and key names.
    channels: Annotated[tuple[Width, ...], Meta(min_length=1, max_length=MAX_LEVELS)] = (48, 128, 128)
    attention_levels: tuple[bool, ...] = (False, True, True)
    layers_per_block: Layers = 1
    heads: Annotated[int, Meta(ge=0, le=1024)] = 0  # heads per attention; 0: width / head_width
    head_width: Width = 32
    norm_groups: Width = 16
    feed_forward: Annotated[int, Meta(ge=1, le=64)] = 2  # width of the gated feed-forward in units of the token's width
    time_scale_shift: bool = True  # the time embedding scales and shifts (True) or only shifts (Stable Diffusion)
    position_embedding: bool = True  # learned, in front of each transformer
    condition_skip: bool = True  # prediction += learned gate(domain, view) * condition's pixels; x-prediction only
    gradient_checkpointing: bool = False
    # attention across the images of an object
    multi_view: bool = True
    row_attention: tuple[bool, ...] = ()  # levels with attention along the rows that the views share; (): none
    # "images": each domain of a view is an image of its own, as in the paper, and attention joins them. "channels": the
    # domains of a view are channels of one image, at a sixth of the cost; patch codec only.
    domain_layout: Literal["images", "channels"] = "images"
    # attention in a star around color, or Wonder3D's over all domains of a view, in the middle or at the end of a block
    cross_domain: Literal["none", "one_way", "two_way", "joint", "joint_last"] = "two_way"
    # class labels and cameras: gdtool's, or Wonder3D's published numbers
    convention: Literal["gdtool", "wonder3d"] = "gdtool"
    # image encoder: "clip" is one projected embedding as one token, "patch" a small transformer over the image's
    # patches
    encoder: Literal["clip", "patch"] = "patch"
    encoder_width: Width = 192
    encoder_layers: Annotated[int, Meta(ge=0, le=64)] = 4
    encoder_patch: Pixels = 8
    # noise
    prediction: Literal["epsilon", "v", "x"] = "x"
    # the network's noisy input: "unit" has variance 1; "shrunk" is the linear estimate of x_0 from it, which is 0 for
    # pure noise (x-prediction only)
    noisy_input: Literal["unit", "shrunk"] = "unit"
    timesteps: Annotated[int, Meta(ge=2, le=100_000)] = 1000
    noise_schedule: Literal["scaled_linear", "cosine"] = "cosine"
    # default denoising steps of sample-views: the number that measured best for this model
    sampling_steps: Annotated[int, Meta(ge=1, le=1000)] = 50
    # average the predictions for the picture and for its mirror image, in twice the time; patch codec and convention
    # "gdtool" only
    sampling_mirrored: bool = False
    # further defaults of sample-views: factor of classifier-free guidance, and noise that each step of DDIM renews
    sampling_guidance: Annotated[float, Meta(ge=0, le=30)] = 1.0
    sampling_eta: Share = 0.0
    # timesteps that sampling visits: from the last one down to x_0 ("trailing", Lin et al. 2024), or multiples of
    # timesteps // steps plus an offset ("leading"), as the schedulers of Stable Diffusion 1 have them
    sampling_spacing: Literal["trailing", "leading"] = "trailing"
    sampling_offset: Annotated[int, Meta(ge=0, le=100_000)] = 0  # of leading timesteps
    sampling_ends_clean: bool = True  # at x_0; otherwise at the noise of timestep 0, which the codec then decodes
    # encoded background of color and albedo while training; sampling uses the first
    backgrounds: Annotated[tuple[Literal["white", "grey", "black"], ...], Meta(min_length=1)] = ("grey",)
    # Network that predicts the shape first; the views are then painted onto its renderings. None: no such network.
    shape: ShapeConfig | None = None
    # source of the pretrained parts of the paper's configuration: a local folder or a hub id
    pretrained: str = ""
    revision: str = ""  # branch, tag or commit of a hub id; "": its main branch

    def __post_init__(self) -> None:
        """Raise ValueError where the fields do not fit one another; msgspec reports it as its ValidationError."""
        fault = _fault(self)
        if fault:
            raise ValueError(fault)


def _fault(config: ModelConfig) -> str | None:
    """Describe the first field from which no network can be built, and its bound. Returns None where all fields fit."""
    known = [name for name, _ in SIX_VIEWS]
    for field, values, names in (("views", config.views, known), ("domains", config.domains, DOMAINS)):
        unknown = [value for value in values if value not in names]
        if unknown:
            return f"{field} names {unknown[0]!r}, which is none of {', '.join(names)}"
        if len(set(values)) < len(values):
            return f"{field} names a value twice"
    levels = len(config.channels)
    for field, values in (("attention_levels", config.attention_levels), ("row_attention", config.row_attention)):
        if len(values) != levels and (values or field == "attention_levels"):
            return f"{field} has {len(values)} entries, channels has {levels}"
    for field, text in (("pretrained", config.pretrained), ("revision", config.revision)):
        fault = text_fault(text)
        if fault:
            return f"{field} {fault}"
    patch, field = (8, "8 (the vae's factor)") if config.codec == "vae" else (config.patch, f"patch {config.patch}")
    if config.image_size % patch:
        return f"image_size is {config.image_size}, not a multiple of {field}"
    if (config.image_size // patch) % 2 ** (levels - 1):
        return (
            f"image_size / {field} is {config.image_size // patch}, which cannot be halved {levels - 1} times "
            f"for {levels} levels of channels"
        )
    if config.channels[0] % 2:
        return f"channels[0] is {config.channels[0]}, which has to be even"
    for i, width in enumerate(config.channels):
        if width % config.norm_groups:
            return f"channels[{i}] is {width}, not a multiple of norm_groups {config.norm_groups}"
        attends = config.attention_levels[i] or any(config.row_attention[i : i + 1]) or i == levels - 1
        heads = config.heads or max(width // config.head_width, 1)
        if attends and width % heads:
            return f"channels[{i}] is {width}, not a multiple of its {heads} heads (heads, head_width)"
    if config.domain_layout == "channels" and (config.codec != "patch" or config.convention != "gdtool"):
        return 'domain_layout "channels" needs codec "patch" and convention "gdtool"'
    if config.encoder == "patch":
        if config.image_size % config.encoder_patch:
            return f"image_size is {config.image_size}, not a multiple of encoder_patch {config.encoder_patch}"
        heads = max(config.encoder_width // ENCODER_HEAD_WIDTH, 1)
        if config.encoder_width % heads:
            return (
                f"encoder_width is {config.encoder_width}, not a multiple of its {heads} heads "
                f"of {ENCODER_HEAD_WIDTH} channels"
            )
    return _shape_fault(config.shape, config) if config.shape is not None else None


def _shape_fault(shape: ShapeConfig, config: ModelConfig) -> str | None:
    """Describe the first field of a shape network that does not fit the model; None where all fit."""
    if config.domain_layout != "channels":
        return 'a shape network needs domain_layout "channels"'
    if "front" not in config.views:
        return "a shape network needs the view front"
    levels = len(shape.channels)
    multiple = 2 ** (levels + 2)  # three quarters of the image, folded by two, halved from level to level
    if config.image_size % multiple:
        return f"image_size is {config.image_size}, not a multiple of {multiple} for {levels} levels of shape"
    for i, width in enumerate(shape.channels):
        if width % shape.norm_groups:
            return f"shape.channels[{i}] is {width}, not a multiple of norm_groups {shape.norm_groups}"
        if width % max(width // shape.head_width, 1):
            return f"shape.channels[{i}] is {width}, not a multiple of its heads of {shape.head_width} channels"
    if shape.embedding % 2:
        return f"shape.embedding is {shape.embedding}, which has to be even"
    return None


class Phase(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe a part of the training.

    The phase lasts until `share` of the run is over, 0 to 1. Each of its steps trains on `domains` of the domains and
    `views` of the views of an object.
    """

    share: Share = 1.0
    domains: Annotated[int, Meta(ge=1, le=6)] = 6
    views: Annotated[int, Meta(ge=1, le=6)] = 6
    learning_rate: Rate = 1e-3
    batch: Annotated[int, Meta(ge=0, le=1_000_000)] = 0  # objects per step of this phase; 0: the run's


class TrainConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe how a model is trained.

    `steps` are optimiser steps; `batch` counts objects per step over all accumulations.
    """

    part: Literal["views", "shape"] = "views"  # of the model that is trained; the other part stays as it is
    batch: Annotated[int, Meta(ge=1, le=1_000_000)] = 8
    accumulate: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    steps: Annotated[int, Meta(ge=1, le=MOST_STEPS)] = 4000
    # The last phase has all images at once, as sampling does, and few objects, so that a step costs about the same.
    phases: Annotated[tuple[Phase, ...], Meta(min_length=1, max_length=100)] = (
        Phase(share=0.6, domains=3, views=3),
        Phase(share=0.8, domains=6, views=3, batch=4),
        Phase(share=1.0, domains=6, views=6, batch=2),
    )
    optimizer: Literal["adamw", "muon"] = "adamw"  # muon: for the matrices inside the network
    warmup: Annotated[int, Meta(ge=1, le=10**9)] = 50
    decay: bool = True  # cosine to a twentieth of the learning rate over the run
    weight_decay: Share = 1e-2
    betas: tuple[Annotated[float, Meta(ge=0, lt=1)], Annotated[float, Meta(ge=0, lt=1)]] = (0.9, 0.999)
    clip: Annotated[float, Meta(gt=0, le=1e6)] = 1.0
    class_rate: Weight = 1.0  # learning rate of the class embedding in units of the others'
    ema: Share = 0.999
    snr_gamma: Weight = 5.0  # min-SNR: a clean image's error is weighted by min(SNR, gamma) …
    snr_floor: Weight = 1.0  # … and at least by this, or a model that samples in few steps never learns the first one
    # weights of each domain's values in the error, in the order of DOMAINS; coverage always has weight 1.
    # Depth's spread inside an object is a tenth of the others', so at 1 it is not learned. Patch codec only.
    domain_weights: tuple[Weight, Weight, Weight, Weight, Weight, Weight] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    # domains whose values are compared by distance instead of its square. One step of sampling then gives their median,
    # which is sharper than their mean and nearer on average. Patch codec only.
    absolute_domains: tuple[Literal[DOMAINS], ...] = ()
    pure_noise: Share = 0.6  # share of objects at the last timestep
    drop_embedding: Share = 0.05
    drop_both: Share = 0.05
    drop_latent: Share = 0.05
    # Share of condition images from a random elevation, or in perspective, where the data have them.
    tilted: Share = 0.5
    mirror: bool = True
    hue: bool = True
    disturb: bool = False  # change the pictures as photographs differ from renders (data/disturb.py)
    pbr_weight: Weight = 0.1
    pbr_snr: Weight = 1.0  # the rendering loss applies where the SNR is above this
    pbr_pixels: Annotated[int, Meta(ge=1, le=10**9)] = 768  # shaded for each object by the rendering loss
    # Number format of the network and of the optimiser's matrix products. "auto" chooses the one that is faster on the
    # machine (training/arithmetic.py). Weights, moments, lighting and geometry are float32 in any case.
    precision: Literal["auto", "float32", "bfloat16"] = "auto"


PRESETS: dict[str, tuple[ModelConfig, TrainConfig]] = {
    # a few thousand weights: what the tests train
    "tiny": (
        ModelConfig(
            sampling_steps=2,
            image_size=32,
            patch=4,
            channels=(16, 32),
            attention_levels=(False, True),
            head_width=16,
            norm_groups=4,
            encoder_width=32,
            encoder_layers=1,
            row_attention=(True, False),
            noisy_input="shrunk",
        ),
        TrainConfig(
            batch=2,
            steps=20,
            warmup=2,
            pbr_pixels=64,
            ema=0.9,
            phases=(Phase(share=0.5, domains=2, views=2), Phase(share=1.0)),
        ),
    ),
    # small enough to train on a laptop; the bundled model has it. After minutes of training instead of days, one
    # denoising step is better than several (docs/benchmarks/model_quality.md).
    "small": (
        ModelConfig(sampling_steps=1, sampling_mirrored=True, row_attention=(True, False, False), noisy_input="shrunk"),
        TrainConfig(),
    ),
    # The shape first, then the views painted onto its renderings: what the bundled model is. `--part shape` trains its
    # shape network by SHAPE_TRAINING.
    "volume": (
        ModelConfig(
            image_size=128,
            patch=4,
            encoder_patch=16,
            sampling_steps=1,
            row_attention=(True, False, False),
            noisy_input="shrunk",
            encoder_width=96,
            encoder_layers=2,
            domain_layout="channels",
            channels=(96, 128, 128),
            cross_domain="none",
            condition_skip=True,
            shape=ShapeConfig(),
        ),
        TrainConfig(
            batch=8,
            phases=(Phase(),),
            optimizer="muon",
            betas=(0.9, 0.99),
            pure_noise=1.0,
            pbr_weight=0.0,
            drop_embedding=0.0,
            drop_latent=0.0,
            drop_both=0.05,
            disturb=True,
            absolute_domains=("normal", "depth", "roughness", "metallic"),
        ),
    ),
    # The paper's training: Stable Diffusion Image Variations grown to six domains; 30,000 multi-view steps, then 20,000
    # with attention across the domains, batch 512
    "paper": (
        ModelConfig(
            image_size=256,
            codec="vae",
            condition_alpha=False,
            mirror_back=False,
            channels=(320, 640, 1280, 1280),
            attention_levels=(True, True, True, False),
            layers_per_block=2,
            heads=8,
            norm_groups=32,
            feed_forward=4,
            time_scale_shift=False,
            position_embedding=False,
            condition_skip=False,
            gradient_checkpointing=True,
            encoder="clip",
            encoder_width=768,
            prediction="epsilon",
            noise_schedule="scaled_linear",
            backgrounds=("white", "black", "grey"),
            pretrained="lambdalabs/sd-image-variations-diffusers",
            revision="v2.0",
        ),
        TrainConfig(
            batch=512,
            accumulate=64,
            steps=50_000,
            warmup=100,
            decay=False,
            class_rate=10.0,
            ema=0.9999,
            snr_floor=0.0,
            pure_noise=0.0,
            hue=False,
            mirror=False,
            phases=(
                Phase(share=0.6, domains=1, views=6, learning_rate=1e-4),
                Phase(share=1.0, domains=6, views=6, learning_rate=5e-5),
            ),
        ),
    ),
}

# Training of a preset's shape network.
SHAPE_TRAINING = TrainConfig(
    part="shape",
    batch=16,
    steps=20_000,
    phases=(Phase(learning_rate=8e-4),),
    optimizer="muon",
    clip=100.0,  # both optimisers take the gradient's direction alone; its length is some tens
    warmup=100,
    betas=(0.9, 0.99),
    weight_decay=0.02,
    tilted=0.4,
)

# Variants that the paper's claims are compared with, as changes of the model's and the training's configuration.
ABLATIONS: dict[str, tuple[dict, dict]] = {
    "none": ({}, {}),
    "no_cross_domain": ({"cross_domain": "none"}, {}),  # each domain is sampled without the others
    "one_way": ({"cross_domain": "one_way"}, {}),  # color attends to the other domains, not they to color
    "two_way": ({"cross_domain": "two_way"}, {}),
    "no_pbr": ({}, {"pbr_weight": 0.0}),  # no rendering loss
    "color_normal": ({"domains": ("color", "normal")}, {"pbr_weight": 0.0}),  # Wonder3D's domains, too few to render
}
