"""Write a training run's validation images, validation.csv and model card."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.data.objects import Objects, from_bytes
from gdtool.diffusion.data.volumes import unit_picture, unpack_volume
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.inference.shape import predict_volume
from gdtool.diffusion.network.encoding import BACKGROUND, encode
from gdtool.diffusion.shape.render import render_volume


@contextmanager
def averaged_weights(state) -> Iterator[None]:
    """Give the model its averaged weights, in evaluation mode, inside the context."""
    model = state.model
    current = {name: p.detach().clone() for name, p in model.named_parameters()}
    model.load_state_dict({**model.state_dict(), **state.average})
    model.eval()
    try:
        yield
    finally:
        model.load_state_dict({**model.state_dict(), **current})
        model.train()


def view_validation(state, objects: Objects, precision: str) -> tuple[np.ndarray, dict[str, float]]:
    """Sample the validation objects; returns a picture (h, w, 3) in [0, 1] and the PSNR in dB by domain.

    The picture has, for each object, the condition on the left and a row for each domain: the true views, then the
    sampled ones. PSNR compares encoded images, in which 0 is grey. It is the mean over objects and all views but the
    front one. The averaged weights are used, in as many steps as the model is sampled with by default, four at most.
    """
    model, config = state.model, state.model.config
    device = next(model.parameters()).device
    rows, errors = [], []
    unseen = [k for k, name in enumerate(config.views) if name != "front"]
    indices = tuple(DOMAINS.index(d) for d in config.domains)
    background = BACKGROUND[config.backgrounds[0]]
    for i in range(len(objects)):
        rgba = from_bytes(objects.conditions[i, i % objects.conditions.shape[1]])[None]
        with averaged_weights(state):
            images = sample_images(
                model,
                rgba.to(device),
                SamplingOptions(steps=min(config.sampling_steps, 4), seed=i, precision=precision),
            )
        truth = encode(from_bytes(objects.planes[i])[None], indices, torch.tensor([background]))[0]
        sampled = torch.stack([images[d][0].float().cpu() for d in config.domains])
        errors.append(((sampled - truth)[:, unseen] / 2).square().mean((2, 3, 4)))
        blocks = [_tile(truth), _tile(sampled)]
        condition_column = np.full((blocks[0].shape[0], config.image_size, 3), 0.5, np.float32)
        condition_column[: config.image_size] = (0.5 + 0.5 * rgba[0, :3].permute(1, 2, 0)).numpy()
        rows.append(np.concatenate([condition_column, *blocks], 1))
    psnr = -10 * torch.stack(errors).clamp(min=1e-10).log10().mean((0, 2))
    return np.clip(np.concatenate(rows, 0), 0, 1), dict(zip(config.domains, psnr.tolist(), strict=True))


def shape_validation(state, objects: Objects) -> tuple[np.ndarray, dict[str, float]]:
    """Predict the validation objects' volumes from their front views; returns a picture (h, w) in [0, 1] and figures.

    The picture has a row for each object: its coverage, the true silhouettes of all views, then the predicted ones. The
    figures are intersections over union, means over the objects: all, of the silhouettes of the views but the front
    one; side, of right and left alone; volume, of the voxels. Computed in float32.
    """
    model, config = state.model, state.model.config
    assert objects.volumes is not None
    rows, figures = [], []
    unseen = [k for k, name in enumerate(config.views) if name != "front"]
    side = [k for k, name in enumerate(config.views) if name in ("right", "left")]
    for i in range(len(objects)):
        volume = torch.from_numpy(unpack_volume(objects.volumes[i], config.image_size)).float()[None]
        rgba = unit_picture(from_bytes(objects.conditions[i, 0]).numpy())
        with averaged_weights(state):
            guess = predict_volume(model, torch.from_numpy(rgba)).cpu()
        truth, own = (render_volume(v, config.views, config.image_size).mask[0] for v in (volume, guess))
        figures.append(
            [
                *(float(np.mean([overlap(own[k], truth[k]) for k in ks])) for ks in (unseen, side)),
                overlap(guess, volume),
            ]
        )
        rows.append(torch.cat([torch.from_numpy(rgba[3]), *truth, *own], 1).numpy())
    means = np.mean(figures, 0)
    return np.concatenate(rows, 0).clip(0, 1), dict(zip(("all", "side", "volume"), means.tolist(), strict=True))


def overlap(a: torch.Tensor, b: torch.Tensor) -> float:
    """Compute the intersection over union of two coverages or volumes, at one half; 1 where both are empty."""
    a, b = a > 0.5, b > 0.5
    return float((a & b).sum() / (a | b).sum()) if bool((a | b).any()) else 1.0


def append_validation(path: Path, step: int, seconds: float, figures: dict[str, float]) -> None:
    """Add a row to validation.csv, with the figures by name.

    Rows of this step and later ones are removed first, because a resumed run writes them again.
    """
    head = ["step", "seconds", *figures]
    earlier_rows = []
    if path.is_file():
        with path.open(newline="") as file:
            earlier_rows = [row for row in csv.DictReader(file) if int(row["step"]) < step]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, head)
        writer.writeheader()
        writer.writerows(earlier_rows)
        writer.writerow(
            {"step": step, "seconds": f"{seconds:.1f}"} | {name: f"{value:.4f}" for name, value in figures.items()}
        )


def _tile(images: torch.Tensor) -> np.ndarray:
    """Arrange images (d, k, 3, h, w) in [-1, 1] as one picture (d h, k w, 3) in [0, 1]."""
    d, k, c, h, w = images.shape
    return (0.5 + 0.5 * images).permute(0, 3, 1, 4, 2).reshape(d * h, k * w, c).numpy()


def machine() -> str:
    """Name the processor and count its cores."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return f"{model or platform.processor()}, {os.cpu_count()} cores"


def model_card(preset: str, model: ModelConfig, train: TrainConfig, facts: dict) -> str:
    """Write the model card in Markdown: purpose, training data and procedure, and the whole configuration."""
    configuration = msgspec.json.format(msgspec.json.encode({"model": model, "train": train}), indent=1).decode()
    table = "\n".join(f"| {name.replace('_', ' ')} | {value} |" for name, value in facts.items())
    return f"""# Multi-view PBR diffusion model, preset {preset}

One picture to {len(model.views)} orthographic views of {model.image_size} x {model.image_size} pixels in \
{len(model.domains)} domains
({", ".join(model.domains)}). Trained by `gdtool train`; load it with `gdtool sample-views --model`.

| | |
|---|---|
{table}
| machine | {machine()} |

Weights are the exponential average, stored in half precision. `python -m benchmarks.train.quality --install` \
measures the
model on held-out objects, adds the table below and makes it the bundled one.

## Configuration

```json
{configuration}
```
"""
