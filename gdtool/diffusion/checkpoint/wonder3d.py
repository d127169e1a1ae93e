"""Load a published Wonder3D v1 folder (Long et al. 2023, flamehaze1115/wonder3d-v1.0) as a Model.

The folder holds unet/ vae/ image_encoder/ scheduler/ of diffusers. The network is Stable Diffusion's with
attn_joint_mid in each block. It makes normal and color in six views over white. Facts are from the repository
xxlong0/Wonder3D (mvdiffusion/models/transformer_mv2d.py, pipelines/, configs/mvdiffusion-joint-ortho-6views.yaml).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeVar

import msgspec
import torch
from msgspec import Meta

from gdtool.core.errors import InputError
from gdtool.core.reading import read_json
from gdtool.diffusion.checkpoint.weights import BYTES_TO_LOAD, check_shapes, parse_config, require_model_fits
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.labels import WONDER3D_LABEL_WIDTH
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import read_tensors

STEPS, GUIDANCE, ETA = 50, 3.0, 1.0  # of sampling, in the original's configuration and pipeline
UNET = "unet/diffusion_pytorch_model.safetensors"
NEAREST_NORMAL = 3**0.5 - 1  # from white (1, 1, 1), encoded, to the nearest unit normal
OLDER_KEYS = (
    (".attn_joint_twice.", ".attn_joint_mid."),
    (".norm_joint_twice.", ".norm_joint_mid."),
    (".attn_joint.", ".attn_joint_last."),
    (".norm_joint.", ".norm_joint_last."),
)


OTHER_FOLDER = "give a Wonder3D v1 folder, or a model folder of gdtool train"


class _UNet(msgspec.Struct):
    """Hold the fields that are read from unet/config.json, with diffusers' defaults."""

    block_out_channels: tuple[int, ...] = ()
    down_block_types: tuple[str, ...] = ()
    cross_attention_dim: int = 768
    attention_head_dim: int | tuple[int, ...] = 8
    sample_size: Annotated[int, Meta(ge=1, le=512)] = 32  # of the latents: an eighth of the pixels
    layers_per_block: int = 2
    norm_num_groups: int = 32
    multiview_attention: bool = True
    in_channels: int = 0
    class_embed_type: str | None = None
    projection_class_embeddings_input_dim: int | None = None


class _Scheduler(msgspec.Struct):
    """Hold the fields that are read from scheduler/scheduler_config.json, with DDIMScheduler's defaults.

    Fields that older versions of diffusers did not write have the values of Wonder3D's own file.
    """

    beta_schedule: str | None = None
    beta_start: float = 0.00085
    beta_end: float = 0.012
    num_train_timesteps: int = 1000
    prediction_type: str = "epsilon"
    clip_sample: bool = False
    thresholding: bool = False
    rescale_betas_zero_snr: bool = False
    trained_betas: list[float] | None = None
    timestep_spacing: Literal["leading", "trailing"] = "leading"
    steps_offset: Annotated[int, Meta(ge=0, le=1000)] = 0
    set_alpha_to_one: bool = True


def recognises(folder: Path) -> bool:
    """Check whether a folder has the layout of a diffusers pipeline."""
    return (folder / "unet" / "config.json").is_file()


def translate_key(name: str) -> str:
    """Translate a key of the published weights, in the older spelling or the newer one, to a key of this network."""
    for old, new in OLDER_KEYS:
        name = name.replace(old, new)
    return name


def read_config(folder: Path, tensors: dict[str, torch.Tensor]) -> ModelConfig:
    """Derive the configuration from unet/config.json and scheduler/scheduler_config.json.

    tensors: the UNet's weights by name; they show where in a block the attention across domains stands. Raises
    InputError for a structure other than Wonder3D's.
    """
    path = folder / "unet" / "config.json"
    unet = _read(path, _UNet)
    _require(
        path,
        {
            "in_channels": (unet.in_channels, 8),
            "class_embed_type": (unet.class_embed_type, "projection"),
            "projection_class_embeddings_input_dim": (unet.projection_class_embeddings_input_dim, WONDER3D_LABEL_WIDTH),
        },
    )
    scheduler = _read_scheduler(folder / "scheduler" / "scheduler_config.json")
    if not isinstance(unet.attention_head_dim, int):
        raise InputError(path, "has a different number of heads at each level, and Wonder3D the same", OTHER_FOLDER)
    return parse_config(
        {
            "image_size": 8 * unet.sample_size,
            "domains": ("color", "normal"),
            "codec": "vae",
            "condition_alpha": False,
            "mirror_back": False,
            "channels": unet.block_out_channels,
            "attention_levels": ["CrossAttn" in kind for kind in unet.down_block_types],
            "layers_per_block": unet.layers_per_block,
            "heads": unet.attention_head_dim,
            "norm_groups": unet.norm_num_groups,
            "feed_forward": 4,
            "time_scale_shift": False,
            "position_embedding": False,
            "condition_skip": False,
            "multi_view": unet.multiview_attention,
            "cross_domain": "joint_last" if any(".attn_joint_last." in name for name in tensors) else "joint",
            "convention": "wonder3d",
            "encoder": "clip",
            "encoder_width": unet.cross_attention_dim,
            "prediction": "epsilon",
            "noise_schedule": "scaled_linear",
            "sampling_steps": STEPS,
            "sampling_guidance": GUIDANCE,
            "sampling_eta": ETA,
            "sampling_spacing": scheduler.timestep_spacing,
            "sampling_offset": scheduler.steps_offset,
            "sampling_ends_clean": scheduler.set_alpha_to_one,
            "backgrounds": ("white",),
            "pretrained": str(folder),
        },
        path,
    )


def _read_scheduler(path: Path) -> _Scheduler:
    """Read a scheduler's configuration. Raises InputError for noise or predictions other than Wonder3D's."""
    scheduler = _read(path, _Scheduler)
    wanted = {
        "beta_schedule": "scaled_linear",
        "beta_start": 0.00085,
        "beta_end": 0.012,
        "num_train_timesteps": 1000,
        "prediction_type": "epsilon",
        "clip_sample": False,
        "thresholding": False,
        "rescale_betas_zero_snr": False,
        "trained_betas": None,
    }
    _require(path, {name: (getattr(scheduler, name), value) for name, value in wanted.items()})
    return scheduler


def _require(path: Path, facts: dict[str, tuple[object, object]]) -> None:
    """Raise InputError for the first field of a file whose value differs; facts: value and Wonder3D's, by name."""
    for name, (value, wanted) in facts.items():
        if value != wanted:
            raise InputError(path, f"has {name} {value!r}, Wonder3D {wanted!r}", OTHER_FOLDER)


def load(folder: Path):
    """Load a published folder as a Model, in evaluation mode, float32.

    Raises InputError for a missing or unused tensor.
    """
    if _read(folder / "unet" / "config.json", _UNet).in_channels == 4:
        raise InputError(
            folder,
            "is a Stable Diffusion that makes single pictures, such as Image Variations: a training can start from it, "
            "but it samples no views",
            "give a model folder of gdtool train, or Wonder3D's; gdtool train --preset paper trains one from it",
        )
    if not (folder / UNET).is_file() and not list((folder / "unet").glob("*.bin")):
        raise InputError(
            folder / UNET,
            "does not exist",
            "where the hub has pickles alone: hf download ID --local-dir DIR && "
            "python -m gdtool.diffusion.convert DIR, then give DIR as the model",
        )
    tensors, _ = read_tensors(folder / UNET)
    for part, name in (("vae", "diffusion_pytorch_model"), ("image_encoder", "model")):
        # Raise an error for a pickle or a damaged file before a library opens it.
        read_tensors(folder / part / f"{name}.safetensors")
    tensors = {translate_key(name): tensor.float() for name, tensor in tensors.items()}
    config = read_config(folder, tensors)
    check_shapes(folder / UNET, tensors, require_model_fits(config, BYTES_TO_LOAD, folder).unet.state_dict())
    model = Model(config)
    model.unet.load_state_dict(tensors)
    return model.eval().requires_grad_(False)


def premultiplied_normals(x: torch.Tensor) -> torch.Tensor:
    """Convert normals (…, 3, h, w) in [-1, 1] over white to normals times coverage, the encoding of gdtool's models.

    A pixel of coverage m and unit normal n lies m |n - 1| from white (1, 1, 1), which is at least 0.73 m. So a pixel
    nearer to white than 0.73 is partly covered, and its distance over 0.73 estimates m.
    """
    m = ((x - 1).norm(dim=-3, keepdim=True) / NEAREST_NORMAL).clamp(0, 1)
    n = (x - (1 - m)) / m.clamp_min(1e-3)
    return m * n / n.norm(dim=-3, keepdim=True).clamp_min(1e-6)


_Typed = TypeVar("_Typed")


def _read(path: Path, kind: type[_Typed]) -> _Typed:
    """Read a JSON file into the msgspec struct `kind`. Raises InputError that names the field that does not fit."""
    if not path.exists():
        raise InputError(path, "does not exist", "copy the whole folder")
    try:
        return msgspec.convert(read_json(path), kind)
    except msgspec.ValidationError as error:
        raise InputError(path, str(error), "copy the file again from where the model came") from None
