"""Choose the number format that a machine trains in fastest, by timing a matrix product in both."""

from __future__ import annotations

import time
from dataclasses import dataclass

import msgspec
import torch

from gdtool.diffusion.config import TrainConfig

PROBE_SIZE = 512  # rows and columns of the timed matrix product: about the widths of the bundled model's layers
PROBE_REPEATS = 5  # the quickest counts, since other work on the machine only adds time
# bfloat16 loses 16 bits of each product, so it has to be clearly faster: at .9 the noise of the probe would decide.
MAX_TIME_RATIO = 0.8
BFLOAT16_CAPABILITY = (8, 0)  # compute capability of the first NVIDIA GPUs with bfloat16 units (Ampere)


@dataclass(frozen=True)
class Arithmetic:
    """Hold the chosen format, and why.

    precision: "float32" or "bfloat16". reason: a sentence for the log. flops: floating-point operations per second of
    the probe in that format; 0 where nothing was timed.
    """

    precision: str
    reason: str
    flops: float = 0.0


def seconds_of_product(dtype: torch.dtype, size: int = PROBE_SIZE) -> float:
    """Time one product of two square matrices of this size on the processor, in seconds; the best of a few."""
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(size, size, generator=generator).to(dtype) for _ in range(2))
    best = float("inf")
    for _ in range(PROBE_REPEATS + 1):  # the first one sets the library up
        start = time.perf_counter()
        torch.mm(a, b)
        best = min(best, time.perf_counter() - start)
    return best


def choose_arithmetic(device: str) -> Arithmetic:
    """Choose the format for a device: by its generation for a GPU, by a probe of some milliseconds for a processor."""
    if device != "cpu":
        if torch.device(device).type == "cuda" and torch.cuda.get_device_capability(device) < BFLOAT16_CAPABILITY:
            return Arithmetic("float32", "this GPU has no bfloat16 units")
        return Arithmetic("bfloat16", "GPUs of this generation have bfloat16 units")
    full, half = seconds_of_product(torch.float32), seconds_of_product(torch.bfloat16)
    precision = "bfloat16" if half <= MAX_TIME_RATIO * full else "float32"
    return Arithmetic(
        precision,
        f"a product of {PROBE_SIZE}² matrices takes {1e3 * full:.2g} ms in float32, {1e3 * half:.2g} ms in bfloat16",
        2 * PROBE_SIZE**3 / (half if precision == "bfloat16" else full),
    )


def with_arithmetic(train: TrainConfig, device: str) -> tuple[TrainConfig, Arithmetic]:
    """Replace the precision "auto" by the machine's; a precision that was asked for stays."""
    if train.precision != "auto":
        return train, Arithmetic(train.precision, "asked for")
    arithmetic = choose_arithmetic(device)
    return msgspec.structs.replace(train, precision=arithmetic.precision), arithmetic
