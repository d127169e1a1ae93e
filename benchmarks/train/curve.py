"""Quality on held-out objects against the minutes of training that led to it: one point a model along its chain of
starts.

    python -m benchmarks.train.curve out/model/held_out --model out/model/model -o docs/benchmarks

A model that was trained with --start goes back to the one it began with, and so on: the manifests say so, and for how
long each was trained. Figures are those of quality.py (five unseen views), at each model's own size, in one step
of sampling. The straight line through PSNR over the logarithm of the minutes is drawn on to ten times the longest
training."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.measure import machine, number, say, table
from benchmarks.train.figures import figures
from benchmarks.train.held_out import DEFAULT_MODEL, sampled_views, true_views, views_folders
from benchmarks.train.mean_weights import STAGE as MEAN
from gdtool.core.folder import open_folder
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object

NOTE = (
    "Minutes are of the clock, of runs on one core or two, alone or beside other work, as the card says; the first "
    "rows are at 64 px, where views are "
    "easier to match. The line in the picture goes through all of them and is drawn on to ten times the training: "
    "what a faster machine would add "
    "is an estimate by it, not a measurement."
)
SHOWN = (
    "color_psnr_frame",
    "color_ssim_frame",
    "albedo_psnr_frame",
    "normal_degrees",
    "depth_error",
    "silhouette_overlap",
)


def chain(path: Path) -> list[tuple[Path, float]]:
    """Model folders from the first that was trained from nothing to this one, with the minutes of training up to each.

    A mean of models stands for the last of them, which went on from the others.
    """
    folder = open_folder(path, ("model",), check=False)
    if folder.manifest.stage == MEAN.name and folder.manifest.inputs:
        last = chain(Path(path, folder.manifest.inputs[-1].path))
        return [*last[:-1], (path, last[-1][1])]
    start = next((Path(path, entry.path) for entry in folder.manifest.inputs if entry.role == "start"), None)
    before = chain(start) if start is not None and start.exists() else []
    return [*before, (path, (before[-1][1] if before else 0.0) + float(folder.content.report["training_minutes"]))]


def quality(path: Path, folders: list) -> dict[str, float]:
    """Mean figures of a model over held-out objects, and its size."""
    model = load_model(path)
    config, rows = model.config, []
    for seed, folder in enumerate(folders):
        truth = true_views(folder, config.image_size)
        rgba = torch.from_numpy(decode_object(folder, config)[1][0])[None]
        rows.append(figures(sampled_views(model, rgba, seed, steps=1, mirror=False), truth))
    return {"size": config.image_size, **{key: float(np.nanmean([row[key] for row in rows])) for key in SHOWN}}


def draw(path: Path, points: list[dict]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(6, 4))
    minutes, psnr = (np.array([point[key] for point in points]) for key in ("minutes", "color_psnr_frame"))
    axis.plot(minutes, psnr, "o")
    for point in points:
        axis.annotate(
            f"{point['size']} px",
            (point["minutes"], point["color_psnr_frame"]),
            textcoords="offset points",
            xytext=(6, -10),
            fontsize=8,
        )
    if len(points) > 1:
        slope, offset = np.polyfit(np.log10(minutes), psnr, 1)
        on = np.array([minutes.min(), 10 * minutes.max()])
        axis.plot(
            on, slope * np.log10(on) + offset, "--", linewidth=0.8, label=f"{slope:.2f} dB for ten times the training"
        )
        axis.legend()
    axis.set(xscale="log", xlabel="minutes of training", ylabel="color PSNR, five unseen views, dB")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--limit", type=int, default=100, help="held-out objects at most")
    parser.add_argument(
        "--after",
        type=float,
        metavar="MINUTES",
        help=(
            "the model went on from one of so many minutes that is not here any more: its row, and those before, are "
            "kept"
        ),
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    folders, points = views_folders(arguments.held_out)[: arguments.limit], []
    models = chain(arguments.model)
    if arguments.after is not None:
        kept = json.loads((arguments.output / "model_curve.json").read_text())
        points = [point for point in kept if point["minutes"] < arguments.after + 0.1]
        models = [(arguments.model, arguments.after + models[-1][1] - (models[-2][1] if len(models) > 1 else 0.0))]
    for path, minutes in models:
        points.append({"minutes": minutes, **quality(path, folders)})
        say(f"  {path}: {minutes:.0f} minutes")
    rows = [[number(point["minutes"]), *(number(point[key]) for key in ("size", *SHOWN))] for point in points]
    text = "\n".join(
        [
            "# Quality against minutes of training",
            "",
            f"{len(folders)} held-out objects, one step of sampling of the picture alone, trained and measured on "
            f"{machine()}.",
            "",
            table(["minutes", "px", *(key.replace("_", " ") for key in SHOWN)], rows),
            "",
            NOTE,
            "",
            "![PSNR against minutes](model_curve.png)",
            "",
        ]
    )
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "model_curve.json").write_text(json.dumps(points, indent=1) + "\n")
    (arguments.output / "model_curve.md").write_text(text)
    draw(arguments.output / "model_curve.png", points)
    print(text)


if __name__ == "__main__":
    main()
