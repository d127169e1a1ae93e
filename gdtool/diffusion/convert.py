"""Convert pickled weights to safetensors: python -m gdtool.diffusion.convert FILE_OR_FOLDER …

A pickle can run code. So torch.load reads tensors alone (weights_only), in a child process with limits on time and
memory. The child writes one safetensors file beside the pickle. The pickle stays.
"""

from __future__ import annotations

import sys
from pathlib import Path

PICKLES = (".bin", ".pt", ".pth", ".ckpt")
NAMES = {"pytorch_model.bin": "model.safetensors"}  # transformers names the two differently


def convert(source: str, target: str) -> int:
    """Write the tensors of a pickle as safetensors and return their number. Runs in the child process."""
    import torch
    from safetensors.torch import save_file

    tensors = torch.load(source, map_location="cpu", weights_only=True)
    tensors = tensors.get("state_dict", tensors)
    weights = {name: x.detach().clone().contiguous() for name, x in tensors.items() if isinstance(x, torch.Tensor)}
    if not weights:
        raise ValueError("holds no tensors")
    partial = partial_of(target)
    save_file(weights, partial, metadata={"format": "pt"})
    partial.chmod(0o644)
    partial.replace(target)
    return len(weights)


def partial_of(target: str | Path) -> Path:
    """Return the path that the child process writes to until the file is complete."""
    return Path(f"{target}.partial")


def main(arguments: list[str]) -> int:
    """Convert every pickle among files and folders; returns the exit code."""
    from gdtool.core.child import ChildFailed, call

    paths = [
        p
        for a in arguments
        for p in (sorted(Path(a).rglob("*")) if Path(a).is_dir() else [Path(a)])
        if p.suffix in PICKLES
    ]
    if not paths:
        print("convert: names no .bin, .pt, .pth or .ckpt file", file=sys.stderr)
        return 2
    for path in paths:
        target = path.with_name(NAMES.get(path.name, path.stem + ".safetensors"))
        try:
            count = call(convert, str(path), str(target), seconds=600, memory_mb=20000)
        except ChildFailed as error:
            print(
                f"convert: {path}: is not a pickle of tensors alone ({str(error).splitlines()[-1][:200]})",
                file=sys.stderr,
            )
            return 3
        finally:
            partial_of(target).unlink(missing_ok=True)  # of a child that was killed
        print(f"{target}: {count} tensors", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
