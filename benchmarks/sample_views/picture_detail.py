r"""What the picture that views were made of adds to the albedo that is baked from them.

    gdtool render-dataset \
        $ASSETS/glb/{Barrel,BoxTextured,CesiumMilkTruck,ExplodingBarrel,Fox,egyptian_cat,seagulf,target,house}.glb \
        $ASSETS/gltf/{painted_wooden_stool_1k,sofa_03_1k,tea_set_01_1k,wooden_table_02_1k}/*.gltf \
            $ASSETS/gso/aloha/*/meshes/model.obj \
        $ASSETS/gso/vima/{bull_figure,toy_train}.obj --size 512 --samples 4 --light-samples 4 --domains \
            color,albedo -o out/fine
    python -m benchmarks.sample_views.picture_detail out/fine -o docs/benchmarks

Each object's front view in 512 px is the picture and the truth. The albedo at the model's size, the bundled model's and
the true one, is enlarged (bilinear: what a bake from the views alone shows) and sharpened by gdtool.bake.picture, and
by the picture's whole detail without the local gain. PSNR in sRGB where the object covers the pixel, SSIM over white.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import gdtool.bake.picture as picture
from benchmarks.common.measure import machine, number, table
from benchmarks.train.held_out import DEFAULT_MODEL, sampled_views, views_folders
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import condition_batch
from gdtool.folders.views import read_views
from gdtool.images.color import srgb_from_linear
from gdtool.images.metrics import over_white, psnr, resized, ssim

WAYS = ("enlarged", "sharpened", "whole detail")


def straight(image: np.ndarray) -> np.ndarray:
    """(h, w, 4) weighted by its last channel -> color (h, w, 3)."""
    return (image[..., :3] / np.maximum(image[..., 3:], 1e-3)).astype(np.float32)


def errors(
    albedo: np.ndarray, mask: np.ndarray, shown: np.ndarray, truth: np.ndarray, camera
) -> dict[str, tuple[float, float]]:
    """PSNR and SSIM of each way to show a coarse albedo (h, w, 3), mask (h, w), as fine as the picture shown (H, W,
    4)."""
    size, cover = shown.shape[:2], shown[..., 3]
    large = straight(resized(np.concatenate([albedo * mask[..., None], mask[..., None]], -1), *size))
    local, whole = (
        picture.picture_of(shown, camera, albedo).factor,
        picture.picture_of(
            shown,
            camera,
            straight(
                resized(
                    # Of itself the gain is 1.
                    np.concatenate([shown[..., :3] * cover[..., None], cover[..., None]], -1),
                    *albedo.shape[:2],
                )
            ),
        ).factor,
    )
    found = {}
    for way, result in zip(WAYS, (large, large * local, large * whole), strict=True):
        stored = [np.clip(srgb_from_linear(np.clip(x, 0, 1)), 0, 1) for x in (result, truth)]
        found[way] = (
            psnr(*stored, cover > 0.99),
            ssim(over_white(np.clip(result, 0, 1), cover), over_white(truth, cover)),
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fine", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    model = load_model(given.model)
    size, lines, every = model.config.image_size, [], []
    for folder in views_folders(given.fine):
        views = read_views(folder, ("color", "albedo"))
        k = views.names.index("front")
        shown, truth = (
            np.concatenate([views.images["color"][k], views.mask[k][..., None]], -1),
            views.images["albedo"][k],
        )
        camera = replace(views.cameras[k], width=size, height=size)
        cover = views.mask[k][..., None]
        small = resized(np.concatenate([shown[..., :3] * cover, truth * cover, cover], -1), size, size)
        condition, own = (
            straight(np.concatenate([small[..., part], small[..., 6:]], -1)) for part in (slice(0, 3), slice(3, 6))
        )
        made = sampled_views(
            model, condition_batch(np.concatenate([condition, small[..., 6:]], -1).astype(np.float32)), 0, steps=1
        )
        front = made.names.index("front")
        rows = [
            errors(made.images["albedo"][front], made.mask[front], shown, truth, camera),
            errors(own, small[..., 6], shown, truth, camera),
        ]
        every.append([[row[way] for way in WAYS] for row in rows])
        lines.append(
            [
                folder.path.parent.name.removesuffix(".asset"),
                *(f"{number(row[way][0])} / {row[way][1]:.3f}" for row in rows for way in WAYS),
            ]
        )
        print(lines[-1], flush=True)
    mean = np.mean(every, 0)
    lines.append(["mean", *(f"{number(one[0])} / {one[1]:.3f}" for row in mean for one in row)])
    text = "\n".join(
        [
            "# What the picture adds to the views",
            "",
            f"By `benchmarks/sample_views/picture_detail.py`, {machine()}: "
            f"albedo of the front view in {shown.shape[1]} px, made from "
            f"{size} px; PSNR in dB where the object "
            "covers the pixel / SSIM over white. A true albedo of one color is exact as it is (100 dB), and stays "
            "so: its gain is 0.",
            "",
            table(["", *(f"{whose}, {way}" for whose in ("model", "true") for way in WAYS)], lines),
            "",
        ]
    )
    print(text)
    if given.output:
        (given.output / "picture.md").write_text(text)


if __name__ == "__main__":
    with torch.no_grad():
        main()
