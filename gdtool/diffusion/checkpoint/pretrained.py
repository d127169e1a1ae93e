"""Start the paper's configuration from Stable Diffusion Image Variations."""

from __future__ import annotations

from gdtool.diffusion.checkpoint.weights import load_stable_diffusion
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import pretrained_part, read_tensors


def start_from_pretrained(model: Model) -> list[str]:
    """Load the UNet of config.pretrained, a local folder or hub id; returns the names of the new parts."""
    tensors, _ = read_tensors(pretrained_part(model.config, "unet") / "diffusion_pytorch_model.safetensors")
    return load_stable_diffusion(model.unet, tensors)
