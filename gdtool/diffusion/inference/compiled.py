"""Sample with a compiled network: choose PyTorch's cache folder, and report where it cannot compile."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import torch

from gdtool.core.ending import temporary_folder
from gdtool.core.errors import ResourceError
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.model import Model

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"


@contextlib.contextmanager
def compiler_cache() -> Iterator[None]:
    """Set PyTorch's cache of compiled code to a folder in the user's cache.

    Where that is not writable, the cache is a temporary folder; by default PyTorch leaves one in TMPDIR. A
    TORCHINDUCTOR_CACHE_DIR that is set already is kept.
    """
    if CACHE_VARIABLE in os.environ:
        yield
        return
    with contextlib.ExitStack() as at_end:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser(), "gdtool", "torchinductor")
        try:
            cache.mkdir(parents=True, exist_ok=True)
            if not os.access(cache, os.W_OK | os.X_OK):
                raise PermissionError
        except OSError:
            cache = at_end.enter_context(temporary_folder())
        os.environ[CACHE_VARIABLE] = str(cache)
        at_end.callback(os.environ.pop, CACHE_VARIABLE)
        yield


def sample_compiled(model: Model, rgba: torch.Tensor, options: SamplingOptions, **arguments) -> dict[str, torch.Tensor]:
    """Run sample_images() with the compiled network. Raises ResourceError where it cannot be compiled."""
    from torch._dynamo.exc import TorchDynamoException

    model.unet.compile()
    try:
        with compiler_cache():
            return sample_images(model, rgba, options, **arguments)
    except TorchDynamoException as failure:
        raise ResourceError(
            "--compile",
            f"PyTorch cannot compile the network here: {str(failure).strip().splitlines()[0]}",
            "leave it out, or install a C++ compiler",
        ) from None
