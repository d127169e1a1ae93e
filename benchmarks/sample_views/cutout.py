"""Cutting subjects out of backgrounds that are not plain: GrabCut's overlap with the truth, and how well its own check
tells.

    python -m benchmarks.sample_views.cutout $ASSETS/images $ASSETS/hdr -o docs/benchmarks

Pictures with alpha (first folder) are laid over crops of photographed environments (second folder, three each), so the
truth is known. Two minutes on two quiet cores. Written as it goes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from skimage.transform import resize

from benchmarks.common.measure import machine, say, table
from gdtool.images import cutout
from gdtool.images.color import srgb_from_linear
from gdtool.images.io import read_image

SIDE, SUBJECT = 320, 256  # pixels of the picture, and of the square that the subject's picture fills
ENVIRONMENTS = ("kiara_1_dawn_1k.hdr", "lebombo_1k.hdr", "courtyard.exr")


def background(path: Path, rng: np.random.Generator) -> np.ndarray:
    """A square crop about the horizon (SIDE, SIDE, 3), sRGB, exposed so that one pixel in twenty is clipped."""
    image = read_image(path)[..., :3].astype(np.float32)
    image = srgb_from_linear(np.clip(image / np.percentile(image.mean(-1), 95), 0, 1))
    side = image.shape[0] // 3
    top, left = rng.integers(image.shape[0] // 3, image.shape[0] // 2), rng.integers(0, image.shape[1] - side)
    return resize(image[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def markdown(rows: list[dict]) -> str:
    accepted = [r for r in rows if r["agreement"] >= cutout.AGREEMENT]
    good = [r for r in rows if r["overlap"] >= 0.9]
    return "\n".join(
        [
            "# Subjects on busy backgrounds",
            "",
            f"{len(rows)} pictures with known alpha over photographed environments, on {machine()}.",
            f"Accepted (the two frames agree by {cutout.AGREEMENT} or more): {len(accepted)}, mean overlap with the "
            f"truth "
            f"{np.mean([r['overlap'] for r in accepted]) if accepted else float('nan'):.3f}, below 0.9 in "
            f"{sum(r['overlap'] < 0.9 for r in accepted)}. "
            f"Refused though good: {sum(r['agreement'] < cutout.AGREEMENT for r in good)}.",
            "",
            table(
                ["picture", "background", "overlap", "agreement"],
                [[r["picture"], r["background"], f"{r['overlap']:.3f}", f"{r['agreement']:.3f}"] for r in rows],
            ),
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path, help="folder of PNGs with alpha")
    parser.add_argument("environments", type=Path, help="folder of lat-long pictures")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    grounds = [path for name in ENVIRONMENTS for path in arguments.environments.rglob(name)]
    rng, rows = np.random.default_rng(0), []
    for path in sorted(arguments.pictures.rglob("*.png")):
        image = read_image(path)
        if image.ndim != 3 or image.shape[2] != 4:
            continue
        image = resize(image.astype(np.float32) / np.iinfo(image.dtype).max, (SUBJECT, SUBJECT), anti_aliasing=True)
        margin = (SIDE - SUBJECT) // 2
        alpha = np.pad(image[..., 3], margin)
        color = np.pad(image[..., :3] * image[..., 3:], ((margin, margin), (margin, margin), (0, 0)))
        for ground in grounds:
            _, wide, agreement = cutout.both_frames(color + background(ground, rng) * (1 - alpha[..., None]))
            rows.append(
                {
                    "picture": path.stem,
                    "background": ground.stem,
                    "overlap": overlap(wide, alpha > 0.5),
                    "agreement": agreement,
                }
            )
        say(f"  {path.name}")
        (arguments.output / "cutout.md").write_text(markdown(rows))
    print(markdown(rows))


if __name__ == "__main__":
    main()
