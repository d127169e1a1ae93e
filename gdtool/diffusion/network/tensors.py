"""Read tensors from safetensors files: checked, and never unpickled."""

from __future__ import annotations

import shlex
from pathlib import Path

import torch

from gdtool.core import memory
from gdtool.core.errors import InputError, ResourceError
from gdtool.core.reading import require_regular_file
from gdtool.core.sources import hub_folder
from gdtool.diffusion.config import ModelConfig

PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
NO_MODEL = "give a model folder that gdtool train has written"


def read_tensors(path: Path, cure: str = NO_MODEL) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file, each by name.

    cure: the advice of the error for a file that does not exist. Raises InputError for a file that does not exist, is
    no regular file, is damaged, or holds NaN or infinity; ResourceError for one larger than the memory.
    """
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        pickles = [p for pattern in PICKLES for p in path.parent.glob(pattern)]
        if pickles:
            raise InputError(
                pickles[0],
                "is a pickle, which can run code and is never opened",
                f"convert it to safetensors: python -m gdtool.diffusion.convert {shlex.quote(str(pickles[0]))}",
            )
        raise InputError(path, "does not exist", cure)
    require_regular_file(path)
    require_weights_fit(path.stat().st_size, path, "its weights")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - the handle is no dict
    except (SafetensorError, OSError) as error:
        raise InputError(path, f"is not a whole safetensors file ({error})", "copy or train it again") from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(
            torch.isfinite(tensor if tensor.element_size() > 1 else tensor.float()).all()
        ):
            raise InputError(
                path,
                f"tensor {name} holds NaN or infinite weights",
                "copy the file again from where it came, or train again",
            )
    return tensors, metadata


def pretrained_part(config: ModelConfig, part: str) -> Path:
    """Find the folder of a part (unet, vae or image_encoder) in config.pretrained, a local folder or a hub id.

    Raises ResourceError for a hub id without huggingface_hub, InputError where the folder has no safetensors.
    """
    folder = Path(hub_folder(config.pretrained, config.revision))
    if not list((folder / part).glob("*.safetensors")):
        if folder == Path(config.pretrained):
            read_tensors(
                folder / part / "diffusion_pytorch_model.safetensors",  # raises, since the file is missing
                f"{config.pretrained} must hold a pipeline as diffusers saves it, with {part}/",
            )
        revision = f" --revision {config.revision}" if config.revision else ""
        raise InputError(
            config.pretrained,
            f"has no safetensors in {part}/ on the hub, and a pickle can run code and is never opened",
            f"hf download {config.pretrained}{revision} --local-dir DIR && python -m gdtool.diffusion.convert DIR, "
            'then set "pretrained" to DIR in the model configuration',
        )
    return folder / part


def require_weights_fit(size: int, subject: object, what: str) -> None:
    """Raise ResourceError when `size` bytes are more than the memory that this process may use.

    subject, what: the file and the quantity that the error names.
    """
    most = memory.max_input_bytes() / memory.SHARE
    if size > most:
        raise ResourceError(
            subject,
            f"{what} would take {size / 2**30:.1f} GiB of memory, more than the {most / 2**30:.1f} GiB that there are",
            "take a smaller model, or run it on a machine with more memory",
        )
