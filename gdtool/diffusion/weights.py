"""Model folders on disk: config.json and model.safetensors. Nothing is ever unpickled."""

from __future__ import annotations

import shlex
from pathlib import Path

import msgspec
import torch

from gdtool.core.errors import InputError
from gdtool.core.sources import hub_folder
from gdtool.diffusion.config import DOMAINS, ModelConfig

WEIGHTS = "model.safetensors"
PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")


def read_tensors(path: Path, cure: str = "gdtool train writes it") -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file. Raises InputError, with the cure where it is not there, and when it is damaged or
    holds NaN or infinity."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        pickles = [p for pattern in PICKLES for p in path.parent.glob(pattern)]
        if pickles:
            raise InputError(pickles[0], "is a pickle, which can run code and is never opened",
                             f"convert it to safetensors: python -m gdtool.diffusion.convert {shlex.quote(str(pickles[0]))}")
        raise InputError(path, "does not exist", cure)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise InputError(path, f"is not a whole safetensors file ({error})", "copy or train it again") from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise InputError(path, f"tensor {name} holds NaN or infinite weights")
    return tensors, metadata


def pretrained_part(config: ModelConfig, part: str) -> Path:
    """The folder unet, vae or image_encoder of config.pretrained, a local folder or a hub id. Raises ResourceError without
    huggingface_hub for a hub id, InputError where it has no safetensors."""
    folder = Path(hub_folder(config.pretrained, config.revision))
    if not list((folder / part).glob("*.safetensors")):
        if folder == Path(config.pretrained):
            read_tensors(folder / part / "diffusion_pytorch_model.safetensors",  # names the pickle, or what is missing
                         f"{config.pretrained} is to hold a pipeline as diffusers saves it, with {part}/")
        revision = f" --revision {config.revision}" if config.revision else ""
        raise InputError(config.pretrained, f"has no safetensors in {part}/ on the hub, and a pickle can run code and is never opened",
                         f"hf download {config.pretrained}{revision} --local-dir DIR && python -m gdtool.diffusion.convert DIR, "
                         'then --config with {"model": {"pretrained": "DIR"}}')
    return folder / part


def check_shapes(path: Path, tensors: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> None:
    """Raises InputError naming the first tensor that is missing, unknown or of another shape."""
    for name, tensor in wanted.items():
        if name not in tensors:
            raise InputError(path, f"lacks tensor {name}", "its config.json belongs to other weights")
        if tensors[name].shape != tensor.shape:
            raise InputError(path, f"tensor {name} has shape {tuple(tensors[name].shape)}, the configuration needs {tuple(tensor.shape)}")
    unknown = sorted(set(tensors) - set(wanted))
    if unknown:
        raise InputError(path, f"holds a tensor {unknown[0]} that the configuration does not know")


def read_config(path: Path) -> ModelConfig:
    try:
        config = msgspec.json.decode(path.read_bytes(), type=ModelConfig)
    except FileNotFoundError:
        raise InputError(path, "does not exist", "gdtool train writes it") from None
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise InputError(path, str(error)) from None
    if not set(config.domains) <= set(DOMAINS):
        raise InputError(path, f"names an unknown domain; known: {', '.join(DOMAINS)}")
    if len(config.channels) != len(config.attention_levels):
        raise InputError(path, "channels and attention_levels differ in length")
    return config


def load_model(folder: Path):
    """The Model of a folder, in evaluation mode, float32. Raises InputError for what is wrong with its files."""
    from gdtool.diffusion.model import Model

    config = read_config(folder / "config.json")
    tensors, _ = read_tensors(folder / WEIGHTS)
    with torch.device("meta"):
        wanted = Model(config, codec=None).state_dict() if config.codec == "patch" else None
    if wanted is not None:
        check_shapes(folder / WEIGHTS, tensors, wanted)
    model = Model(config)
    if wanted is None:
        check_shapes(folder / WEIGHTS, tensors, model.state_dict())
    model.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    return model.eval().requires_grad_(False)


def save_model(path_of, config: ModelConfig, tensors: dict[str, torch.Tensor]) -> None:
    """Write config.json and model.safetensors in half precision; path_of maps a name to where it is written."""
    from safetensors.torch import save

    Path(path_of("config.json")).write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=1) + b"\n")
    half = {name: tensor.detach().to("cpu", torch.float16).contiguous() for name, tensor in tensors.items()}
    Path(path_of(WEIGHTS)).write_bytes(save(half))  # save_file would make it readable by its owner only


def load_stable_diffusion(unet, tensors: dict[str, torch.Tensor]) -> list[str]:
    """Start a UNet from Stable Diffusion's weights (diffusers names): conv_in grows by the condition's channels, class
    labels by the domains, both with zeros. Returns the names that stay as initialised (the parts that are new).

    Raises InputError for a tensor that is not known here or has another shape.
    """
    own = unet.state_dict()
    for name, tensor in tensors.items():
        if name not in own:
            raise InputError("pretrained weights", f"hold a tensor {name} that this network has not")
        target = own[name]
        if name in ("conv_in.weight", "class_embedding.linear_1.weight") and tensor.shape[1] <= target.shape[1]:
            grown = torch.zeros_like(target)
            grown[:, : tensor.shape[1]] = tensor
            tensor = grown
        if tensor.shape != target.shape:
            raise InputError("pretrained weights", f"tensor {name} has shape {tuple(tensor.shape)}, needed is {tuple(target.shape)}")
        own[name] = tensor
    unet.load_state_dict(own)
    return sorted(set(own) - set(tensors))

