"""Starting the paper's configuration from Stable Diffusion Image Variations."""

from __future__ import annotations

from pathlib import Path

from gdtool.core.errors import ResourceError
from gdtool.diffusion.model import Model
from gdtool.diffusion.weights import load_stable_diffusion, read_tensors


def start_from_pretrained(model: Model) -> list[str]:
    """Load the UNet of config.pretrained, a local folder or a hub id; returns the names of the new parts.

    Raises ResourceError when a hub id is given without huggingface_hub installed.
    """
    source = Path(model.config.pretrained)
    name = "unet/diffusion_pytorch_model.safetensors"
    if source.is_dir():
        path = source / name
    else:
        try:
            from huggingface_hub import hf_hub_download
        except ImportError:
            raise ResourceError("huggingface_hub", "is not installed, and the weights are named by a hub id",
                                "pip install 'gdtool[hub]', or give a local folder") from None
        path = Path(hf_hub_download(model.config.pretrained, name))
    tensors, _ = read_tensors(path)
    return load_stable_diffusion(model.unet, tensors)
