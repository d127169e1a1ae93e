"""What a training run shows of itself: validation images and the model card."""

from __future__ import annotations

import os
import platform

import msgspec
import numpy as np
import torch

from gdtool.diffusion.config import DOMAINS, ModelConfig, TrainConfig
from gdtool.diffusion.data import Objects, from_bytes
from gdtool.diffusion.encoding import BACKGROUND, encode
from gdtool.diffusion.sampling import sample_images


def validation_grid(state, objects: Objects, precision: str) -> np.ndarray:
    """Picture (h, w, 3) in [0, 1]: for each object the condition, the true views and the sampled ones, a row per domain.

    Sampled in as many steps as the model asks for, four at most. The averaged weights are what is shown, the encoded images as the network has them (0 is grey).
    """
    model, config = state.model, state.model.config
    device = next(model.parameters()).device
    own = {name: p.detach().clone() for name, p in model.named_parameters()}
    model.load_state_dict({**model.state_dict(), **state.average})
    model.eval()
    rows = []
    indices = tuple(DOMAINS.index(d) for d in config.domains)
    background = BACKGROUND[config.backgrounds[0]]
    for i in range(len(objects)):
        rgba = from_bytes(objects.conditions[i, i % objects.conditions.shape[1]])[None]
        images = sample_images(model, rgba.to(device), steps=min(config.sampling_steps, 4), seed=i, precision=precision)
        truth = encode(from_bytes(objects.planes[i])[None], indices, torch.tensor([background]))[0]
        blocks = [_tile(truth), _tile(torch.stack([images[d][0].float().cpu() for d in config.domains]))]
        shown = np.full((blocks[0].shape[0], config.image_size, 3), 0.5, np.float32)
        shown[: config.image_size] = (0.5 + 0.5 * rgba[0, :3].permute(1, 2, 0)).numpy()
        rows.append(np.concatenate([shown, *blocks], 1))
    model.load_state_dict({**model.state_dict(), **own})
    model.train()
    return np.clip(np.concatenate(rows, 0), 0, 1)


def _tile(images: torch.Tensor) -> np.ndarray:
    """(d, k, 3, h, w) in [-1, 1] -> (d h, k w, 3) in [0, 1]"""
    d, k, c, h, w = images.shape
    return (0.5 + 0.5 * images).permute(0, 3, 1, 4, 2).reshape(d * h, k * w, c).numpy()


def machine() -> str:
    model = next((line.split(":", 1)[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name")), platform.processor()) \
        if os.path.exists("/proc/cpuinfo") else platform.processor()
    return f"{model}, {os.cpu_count()} cores"


def card(preset: str, model: ModelConfig, train: TrainConfig, facts: dict) -> str:
    """Model card in Markdown: what it is, what it was trained on and how, and the whole configuration."""
    configuration = msgspec.json.format(msgspec.json.encode({"model": model, "train": train}), indent=1).decode()
    table = "\n".join(f"| {name.replace('_', ' ')} | {value} |" for name, value in facts.items())
    return f"""# Multi-view PBR diffusion model, preset {preset}

One picture to {len(model.views)} orthographic views of {model.image_size} x {model.image_size} pixels in {len(model.domains)} domains
({', '.join(model.domains)}). Trained by `gdtool train`; load it with `gdtool sample-views --model`.

| | |
|---|---|
{table}
| machine | {machine()} |

Weights are the exponential average, stored in half precision. `python benchmarks/model_quality.py --install` measures the
model on held-out objects, adds the table below and makes it the bundled one.

## Configuration

```json
{configuration}
```
"""
