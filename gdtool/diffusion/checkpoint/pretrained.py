"""Start the paper's configuration from Stable Diffusion Image Variations."""

from __future__ import annotations

from gdtool.diffusion.checkpoint.weights import load_stable_diffusion
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import pretrained_part, read_tensors


def start_from_pretrained(model: Model) -> list[str]:
    """Load the UNet weights of config.pretrained, a local folder or a hub id, into the model.

    Returns the names of the parameters that Stable Diffusion lacks; they add nothing to its answer at first. Raises
    InputError and ResourceError as pretrained_part() and load_stable_diffusion() do.
    """
    tensors, _ = read_tensors(pretrained_part(model.config, "unet") / "diffusion_pytorch_model.safetensors")
    return load_stable_diffusion(model.unet, tensors)
