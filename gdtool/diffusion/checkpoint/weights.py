"""Read and write model folders: config.json and model.safetensors. Nothing is ever unpickled."""

from __future__ import annotations

from pathlib import Path

import msgspec
import torch

from gdtool.core.errors import InputError
from gdtool.core.reading import read_json
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.model import Model, parameter_count, structure
from gdtool.diffusion.network.tensors import NO_MODEL, read_tensors, require_weights_fit

WEIGHTS = "model.safetensors"
BYTES_TO_LOAD = 10  # held for each weight while a model is read: 2 in the file, 4 of the float32 copy, 4 of the network
OTHER_WEIGHTS = "give the config.json that these weights were trained with"
OTHER_START = (
    'set "pretrained" to a Stable Diffusion 1 of that structure, such as lambdalabs/sd-image-variations-diffusers'
)
# last layers of the parts that Stable Diffusion's UNet lacks
NEW_OUTPUTS = (
    "class_embedding.linear_2.",
    "attn_cross_domain.to_out.0.",
    "attn_joint_mid.to_out.0.",
    "attn_joint_last.to_out.0.",
)


def check_shapes(path: Path, tensors: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> None:
    """Compare the tensors of a file with the parameters of a network, by name.

    path: the file that errors name. wanted: the network's state_dict, on any device. Raises InputError for the first
    tensor that is missing, unknown, of another shape or not of a floating-point type.
    """
    for name, tensor in wanted.items():
        if name not in tensors:
            raise InputError(path, f"lacks tensor {name}", OTHER_WEIGHTS)
        if tensors[name].shape != tensor.shape:
            raise InputError(
                path,
                f"tensor {name} has shape {tuple(tensors[name].shape)}, the configuration needs {tuple(tensor.shape)}",
                OTHER_WEIGHTS,
            )
        if not tensors[name].is_floating_point():
            raise InputError(
                path,
                f"tensor {name} holds {str(tensors[name].dtype).removeprefix('torch.')}, no floating-point numbers",
                "save it as float16 or float32",
            )
    unknown = sorted(set(tensors) - set(wanted))
    if unknown:
        raise InputError(path, f"holds a tensor {unknown[0]} that the configuration does not know", OTHER_WEIGHTS)


def read_config(path: Path) -> ModelConfig:
    """Read a model folder's config.json. Raises InputError that names the wrong field and its bound."""
    if not path.exists():
        raise InputError(path, "does not exist", NO_MODEL)
    return parse_config(read_json(path), path)


def parse_config(fields: object, subject: object) -> ModelConfig:
    """Convert parsed JSON to a ModelConfig.

    subject: the file or folder that an error names. Raises InputError that names the wrong field and its bound.
    """
    try:
        return msgspec.convert(fields, ModelConfig)
    except msgspec.ValidationError as error:
        raise InputError(
            subject, str(error), "correct that field, or copy the file again from where the model came"
        ) from None


def require_model_fits(config: ModelConfig, bytes_per_weight: int, subject: object) -> Model:
    """Build the network on PyTorch's meta device, which holds shapes and no values, and check that its weights fit.

    bytes_per_weight: bytes of memory held for each weight, for example BYTES_TO_LOAD. subject: the file or folder that
    an error names. Raises ResourceError where the weights would not fit in memory.
    """
    shape = structure(config)
    weights = parameter_count(shape)
    require_weights_fit(weights * bytes_per_weight, subject, f"its network of {weights / 1e6:,.1f} million weights")
    return shape


def load_model(folder: Path) -> Model:
    """Load the Model of a folder, in evaluation mode, float32.

    Raises InputError for damaged or mismatched files, and ResourceError where the model does not fit in memory. Memory
    for the weights is allocated only after the configuration and the file have been checked against each other.
    """
    config = read_config(folder / "config.json")
    wanted = require_model_fits(config, BYTES_TO_LOAD, folder).state_dict()
    tensors, _ = read_tensors(folder / WEIGHTS)
    check_shapes(folder / WEIGHTS, tensors, wanted)
    model = Model(config)
    model.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    return model.eval().requires_grad_(False)


def save_model(path_of, config: ModelConfig, tensors: dict[str, torch.Tensor]) -> None:
    """Write config.json and model.safetensors, the weights in float16.

    path_of: function from a file's name to the path that it is written to. tensors: the model's weights by name.
    """
    from safetensors.torch import save

    Path(path_of("config.json")).write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=1) + b"\n")
    half = {name: tensor.detach().to("cpu", torch.float16).contiguous() for name, tensor in tensors.items()}
    Path(path_of(WEIGHTS)).write_bytes(save(half))  # save_file would make it readable by its owner only


def load_stable_diffusion(unet, tensors: dict[str, torch.Tensor]) -> list[str]:
    """Copy Stable Diffusion's weights, named as in diffusers, into a UNet.

    The UNet's conv_in has more input channels (for the condition), and its class embedding more inputs (for the
    domains). The added columns are zero. What the weights lack adds nothing at first: the class embedding's last layer
    and the projections after attention across domains are zero, so that a single view's answer is Stable Diffusion's in
    every domain. Returns the names of the parameters that the weights lack. Raises InputError for a tensor that the
    UNet lacks or that has another shape.
    """
    state = unet.state_dict()
    for name, tensor in tensors.items():
        if name not in state:
            raise InputError("pretrained weights", f"hold a tensor {name} that this network lacks", OTHER_START)
        target = state[name]
        if name in ("conv_in.weight", "class_embedding.linear_1.weight") and tensor.shape[1] <= target.shape[1]:
            grown = torch.zeros_like(target)
            grown[:, : tensor.shape[1]] = tensor
            tensor = grown
        if tensor.shape != target.shape:
            raise InputError(
                "pretrained weights",
                f"tensor {name} has shape {tuple(tensor.shape)}, the network needs {tuple(target.shape)}",
                OTHER_START,
            )
        state[name] = tensor
    new = sorted(set(state) - set(tensors))
    for name in new:
        if any(layer in name for layer in NEW_OUTPUTS):
            state[name] = torch.zeros_like(state[name])
    unet.load_state_dict(state)
    return new
