"""One image to a finished asset, with the time and the error of each stage (`make demo`).

The image is examples/demo.png, a render of procedural object SEED that the bundled model never saw, so the truth is
known: the same object is rendered by render-dataset, and every stage is measured against it, or against what it was
given."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

SEED = 1_000_007
ROOT = Path("demo.asset")
# Stage, its options, and what its result is measured against: the truth, or the stage's own input.
STAGES = (
    ("sample-views", (), "truth"),
    ("reconstruct", (), "truth"),
    ("remesh", ("--faces", "20000"), "surface"),
    ("unwrap", (), None),
    ("bake", ("--size", "1024"), "views"),
    ("relight", ("--env", "mid", "--views", "4"), None),
)
SHOWN = (
    "color_psnr_masked",
    "albedo_psnr_masked",
    "normal_degrees",
    "seen_distance",
    "surface_distance",
    "surface_iou",
)


def gdtool(*arguments: str) -> str:
    """stdout of a gdtool command; its stderr goes to ours. Exits when it fails."""
    done = subprocess.run(["gdtool", *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"gdtool {' '.join(arguments)} failed with exit code {done.returncode}")
    return done.stdout.strip()


def error_of(folder: str, reference: str) -> str:
    """The figures of `gdtool evaluate` that a reader wants first."""
    report = json.loads(gdtool("evaluate", folder, "--reference", reference, "--json", "-q"))
    return ", ".join(f"{key} {report[key]:.4g}" for key in SHOWN if isinstance(report.get(key), (int, float)))


def main() -> None:
    image = Path(__file__).with_name("demo.png")
    references = {
        "truth": gdtool("render-dataset", f"procedural:{SEED}", "-o", str(ROOT / "truth")),
        "surface": str(ROOT / "surface"),
        "views": str(ROOT / "views"),
    }
    rows, source = [], str(image)
    for name, options, reference in STAGES:
        start = time.perf_counter()
        source = gdtool(name, source, *options)
        seconds = time.perf_counter() - start
        rows.append((name, seconds, error_of(source, references[reference]) if reference else ""))
    print(f"\n{'stage':<14}{'seconds':>8}  error")
    for name, seconds, error in rows:
        print(f"{name:<14}{seconds:8.1f}  {error}")
    print(
        f"{'in all':<14}{sum(row[1] for row in rows):8.1f}\n\nasset:  {ROOT / 'asset/asset.glb'}\nlook:   "
        + "\n        ".join(str(ROOT / kind / "contact_sheet.png") for kind in ("views", "asset", "renders"))
    )


if __name__ == "__main__":
    main()
