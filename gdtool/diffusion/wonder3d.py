"""Wonder3D v1 (Long et al. 2023, flamehaze1115/wonder3d-v1.0): its published folder as a model of ours.

unet/ vae/ image_encoder/ scheduler/ of diffusers. The network is Stable Diffusion's with attn_joint_mid in each block;
normal and color, six views, white background, the picture's subject over 192 of 256 pixels. Facts from the repository
xxlong0/Wonder3D (mvdiffusion/models/transformer_mv2d.py, data/single_image_dataset.py, pipelines/).
"""

from __future__ import annotations

import json
from pathlib import Path

import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.config import DOMAINS, ModelConfig

# Elevation and azimuth (radians) of each view relative to the picture's, as its pipeline has them, in half precision.
ELEVATION = {"front": 0.0, "front_right": -0.2362, "right": -0.1686, "back": 0.5220, "left": 0.6904, "front_left": 0.3733}
AZIMUTH = {"front": 0.0, "front_right": 0.8125, "right": 1.6934, "back": 3.1406, "left": 4.8359, "front_left": 5.5859}
SWITCH = {"normal": (1.0, 0.0), "color": (0.0, 1.0)}
LABEL_WIDTH = 10  # sin and cos of [elevation of the condition, elevation, azimuth, switch]
EXTENT = 192 / 256
UNET = "unet/diffusion_pytorch_model.safetensors"
NEAREST_NORMAL = 3**0.5 - 1  # from white (1, 1, 1), encoded, to the nearest unit normal
LEGACY = ((".attn_joint_twice.", ".attn_joint_mid."), (".norm_joint_twice.", ".norm_joint_mid."),
          (".attn_joint.", ".attn_joint_last."), (".norm_joint.", ".norm_joint_last."))


def recognises(folder: Path) -> bool:
    return (folder / "unet" / "config.json").is_file()


def class_labels(config: ModelConfig) -> torch.Tensor:
    """(domains, views, 10): sines, then cosines. Domains that it has not get the switch (0, 0)."""
    raw = torch.tensor([[[0.0, ELEVATION[view], AZIMUTH[view], *SWITCH.get(domain, (0.0, 0.0))] for view in config.views] for domain in DOMAINS], device="cpu")
    return torch.cat([raw.sin(), raw.cos()], -1)


def renamed(name: str) -> str:
    """A key of the published weights, older spellings included, as ours."""
    for old, new in LEGACY:
        name = name.replace(old, new)
    return name


def read_config(folder: Path, tensors: dict[str, torch.Tensor]) -> ModelConfig:
    """The configuration that unet/config.json and scheduler/ describe. Raises InputError for another structure."""
    path = folder / "unet" / "config.json"
    own = _json(path)
    scheduler = _json(folder / "scheduler" / "scheduler_config.json")
    heads = own.get("attention_head_dim", 8)
    facts = {"in_channels": (own.get("in_channels"), 8), "class_embed_type": (own.get("class_embed_type"), "projection"),
             "projection_class_embeddings_input_dim": (own.get("projection_class_embeddings_input_dim"), LABEL_WIDTH),
             "beta_schedule": (scheduler.get("beta_schedule"), "scaled_linear"), "prediction_type": (scheduler.get("prediction_type", "epsilon"), "epsilon")}
    for name, (found, wanted) in facts.items():
        if found != wanted:
            raise InputError(path, f"has {name} {found!r}, Wonder3D {wanted!r}", "give a Wonder3D v1 folder, or a model folder of gdtool train")
    if not isinstance(heads, int):
        raise InputError(path, "has another number of heads at each level")
    return ModelConfig(
        image_size=8 * own.get("sample_size", 32), domains=("color", "normal"), codec="vae", condition_alpha=False, mirror_back=False,
        channels=tuple(own["block_out_channels"]), attention_levels=tuple("CrossAttn" in kind for kind in own["down_block_types"]),
        layers_per_block=own.get("layers_per_block", 2), heads=heads, norm_groups=own.get("norm_num_groups", 32), feed_forward=4,
        time_scale_shift=False, position_embedding=False, condition_skip=False, multi_view=own.get("multiview_attention", True),
        cross_domain="joint_last" if any(".attn_joint_last." in name for name in tensors) else "joint", convention="wonder3d",
        encoder="clip", encoder_width=own["cross_attention_dim"], prediction="epsilon", noise_schedule="scaled_linear",
        backgrounds=("white",), pretrained=str(folder))


def load(folder: Path):
    """The Model of a published folder, in evaluation mode, float32. Every tensor is used, and none is missing, else InputError."""
    from gdtool.diffusion.model import Model
    from gdtool.diffusion.weights import check_shapes, read_tensors

    if _json(folder / "unet" / "config.json").get("in_channels") == 4:
        raise InputError(folder, "is a Stable Diffusion that makes single pictures, such as Image Variations: a training starts from it, it has no views",
                         "give a model folder of gdtool train, or Wonder3D's; gdtool train --preset paper trains one from it")
    if not (folder / UNET).is_file() and not list((folder / "unet").glob("*.bin")):
        raise InputError(folder / UNET, "does not exist", "where the hub has pickles alone: hf download ID --local-dir DIR && "
                         "python -m gdtool.diffusion.convert DIR, then --model DIR")
    tensors, _ = read_tensors(folder / UNET)
    for part, name in (("vae", "diffusion_pytorch_model"), ("image_encoder", "model")):
        read_tensors(folder / part / f"{name}.safetensors")  # a pickle or a damaged file is named before a library opens it
    tensors = {renamed(name): tensor.float() for name, tensor in tensors.items()}
    model = Model(read_config(folder, tensors))
    check_shapes(folder / UNET, tensors, model.unet.state_dict())
    model.unet.load_state_dict(tensors)
    return model.eval().requires_grad_(False)


def premultiplied_normals(x: torch.Tensor) -> torch.Tensor:
    """Normals (…, 3, h, w) in [-1, 1] over white -> times coverage, as our models give them.

    Coverage m leaves m |n - 1| of the distance to white, at least 0.73 m for a unit normal n: what is nearer is an edge.
    """
    m = ((x - 1).norm(dim=-3, keepdim=True) / NEAREST_NORMAL).clamp(0, 1)
    n = (x - (1 - m)) / m.clamp_min(1e-3)
    return m * n / n.norm(dim=-3, keepdim=True).clamp_min(1e-6)


def _json(path: Path) -> dict:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise InputError(path, "does not exist", "copy the whole folder") from None
    except ValueError as error:
        raise InputError(path, f"is not JSON ({error})") from None
