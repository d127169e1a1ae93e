"""Compare how three.js and Blender show an asset with gdtool: python compare_shown.py ASSET.glb [--peers-python PATH]

Runs the show_in_* scripts of this folder and prints the PSNR in dB over the pixels that both pictures cover in full.
The pictures show the base color without light, and in three.js also the asset lit by an environment
(benchmarks/bake/asset.py has Blender's). three.js needs what show_in_three.mjs says; Blender needs a Python that has
bpy. What is not installed is named and left out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SIZE = 512


def picture(command: list, out: Path, mode: str | Path) -> np.ndarray | str:
    """Return the (h, w, 4) picture in [0, 1] that a command writes to out, or the reason why there is none."""
    from gdtool.images.io import read_image

    try:
        done = subprocess.run(
            [*map(str, command), str(out), str(mode)], capture_output=True, text=True, timeout=300, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode or not out.exists():
        return (done.stderr.strip().splitlines() or ["no picture"])[-1]
    return averaged(read_image(out).astype(np.float64) / 255)


def averaged(image: np.ndarray) -> np.ndarray:
    """Reduce an image (s, s, 4), sRGB with straight alpha, to (SIZE, SIZE, 4): averages of square blocks in linear
    light.
    """
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    step = image.shape[0] // SIZE
    if step == 1:
        return image
    alpha = image[..., 3:]
    sums = (
        np.concatenate([linear_from_srgb(image[..., :3]) * alpha, alpha], -1)
        .reshape(SIZE, step, SIZE, step, 4)
        .mean((1, 3))
    )
    return np.concatenate([srgb_from_linear(sums[..., :3] / np.maximum(sums[..., 3:], 1e-9)), sums[..., 3:]], -1)


def inner(coverage: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: pixels that are covered in full, as are their neighbours.

    Multisampling may report a pixel at the edge as fully covered.
    """
    from scipy.ndimage import binary_erosion

    return binary_erosion(coverage > 0.999, iterations=2)


def main() -> None:
    from gdtool.images.io import write_exr
    from gdtool.images.metrics import psnr
    from gdtool.shading.lights.studio import studio

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--peers-python", type=Path)
    parser.add_argument("--env", default="mid")
    parser.add_argument("--keep", type=Path, help="folder for the pictures")
    arguments = parser.parse_args()
    asset = arguments.asset.resolve()
    with tempfile.TemporaryDirectory() as folder:
        place = arguments.keep or Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        place = place.resolve()
        light = place / "light.exr"
        write_exr(light, studio(arguments.env, 0, fit=False)[0].image.astype(np.float32))
        gdtool_command, three = (
            [sys.executable, HERE / "show_in_gdtool.py", asset],
            ["node", HERE / "show_in_three.mjs", asset],
        )
        pairs = {"three.js, base color": (three, "unlit", "unlit"), "three.js, lit": (three, light, arguments.env)}
        if arguments.peers_python:
            pairs["Blender, base color"] = (
                [arguments.peers_python, HERE / "show_in_blender.py", asset],
                "unlit",
                "unlit",
            )
        figures: dict[str, float | str] = {}
        for name, (command, mode, own_mode) in pairs.items():
            ours, theirs = (
                picture(gdtool_command, place / f"gdtool_{own_mode}.png", own_mode),
                picture(command, place / f"{name}.png", mode),
            )
            if isinstance(ours, str) or isinstance(theirs, str):
                figures[name] = ours if isinstance(ours, str) else theirs
                continue
            where = inner(ours[..., 3]) & inner(theirs[..., 3])
            figures[name] = round(psnr(theirs[..., :3], ours[..., :3], where), 2)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
