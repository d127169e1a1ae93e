"""What benchmarks/render.py and benchmarks/relight.py share: gdtool's knobs in a child each, table, JSON and plot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from measure import machine, number, say, table

HERE = Path(__file__).resolve().parent


def in_child(python: str, script: str, *arguments: object, limit_seconds: float = 3600) -> dict | None:
    """The JSON object that a script beside this one prints last, run by python; None, with the reason told, if it fails."""
    done = subprocess.run([python, str(HERE / script), *map(str, arguments)], capture_output=True, text=True, timeout=limit_seconds)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        say(f"{script} {' '.join(map(str, arguments))}: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
        return None
    return json.loads(lines[-1])


def stored(name: str, image: np.ndarray) -> np.ndarray:
    """A domain's image as a picture stores it: sRGB for colors, (n + 1) / 2 for normals."""
    from gdtool.images.color import srgb_from_linear

    if name in ("color", "albedo"):
        return srgb_from_linear(np.clip(image, 0, 1))
    return 0.5 * image + 0.5 if name == "normal" else image


def errors(images: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """PSNR in dB of each domain over pixels (v, h, w) that the reference covers wholly."""
    from gdtool.images.metrics import psnr

    inside = reference["mask"] > 0.99
    return {name: psnr(stored(name, images[name]), stored(name, reference[name]), inside)
            for name in reference if name in images and name != "mask" and images[name].shape == reference[name].shape}


def write(folder: Path, name: str, title: str, rows: list[dict], shown: list[str], x: str, y: str) -> None:
    """name.json, name.md and name.png (y against x, a curve a method) in folder."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps({"machine": machine(), "command": " ".join(sys.argv), "rows": rows}, indent=1) + "\n")
    body = table(shown, [[number(row.get(key), 4) for key in shown] for row in rows])
    (folder / f"{name}.md").write_text(f"# {title}\n\n{machine()}. `{' '.join(sys.argv)}`. {errors_text()}\n\n{body}\n")
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for method in dict.fromkeys(row["method"] for row in rows):
        points = sorted((row[x], row[y]) for row in rows if row["method"] == method and row.get(y) is not None)
        axes.plot(*zip(*points, strict=True), "o-", label=method) if points else None
    axes.set(xscale="log", xlabel=f"{x} (processor seconds)" if x == "cpu s" else x, ylabel=f"{y}, PSNR in dB")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(folder / f"{name}.png", dpi=130)


def errors_text() -> str:
    """How the figures are to be read."""
    return ("PSNR of the stored pictures over wholly covered pixels against a converged reference of the same renderer; "
            "seconds without start and reading, `cpu s` summed over threads.")
