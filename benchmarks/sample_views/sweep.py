"""Sampling: time against error over scheduler, steps, the mirrored picture, guidance, precision and domains, on
held-out objects.

    python -m benchmarks.sample_views.sweep --model my-model -o docs/benchmarks

Without held-out folders it renders its own once (procedural:900000 and on, beside the cache of the last run). Timed by
wall clock and by processor seconds, because other work may run meanwhile. Two errors: PSNR against the images that 50
steps of DDIM give from the same noise (over white, all six views), and those of benchmarks/train/quality.py against the
truth, over the five unseen views. Every object goes through all settings before the next one starts. Start-up is a
whole command on one picture, its sampling and writing taken off. Consistency is that of the model's default sampling
beside the true views (gdtool/diffusion/reports/consistency.py says what each figure is). Written as it goes; ten
minutes on two quiet cores at 128 px."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.measure import busy, gdtool, machine, number, say, seconds_axis, table
from benchmarks.train.figures import figures
from benchmarks.train.held_out import DEFAULT_MODEL, sampled_views, true_views, views_folders
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object
from gdtool.diffusion.reports.consistency import consistency
from gdtool.folders.views import Views
from gdtool.images.metrics import over_white, psnr

REFERENCE = {"steps": 50, "mirror": False}
SETTINGS = [
    REFERENCE,
    *({"steps": steps, "mirror": False} for steps in (1, 2, 4, 8, 20)),
    *({"steps": steps, "mirror": True} for steps in (1, 2, 4)),
    *({"steps": steps, "scheduler": "dpm", "mirror": False} for steps in (4, 8, 20)),
    *({"steps": steps, "precision": "bfloat16", "mirror": False} for steps in (1, 8)),
    *({"steps": 8, "guidance": guidance, "mirror": False} for guidance in (1.5, 3.0)),
    *({"steps": 1, "domains": domains, "mirror": False} for domains in (("color", "normal"), ("color",))),
]
TRUE = (
    "color_psnr_frame",
    "color_ssim_frame",
    "albedo_psnr_frame",
    "normal_degrees",
    "depth_error",
    "silhouette_overlap",
)
SHOWN = ("seconds", "cpu_seconds", "reference_psnr", *TRUE)


def label(setting: dict) -> str:
    domains = setting.get("domains")
    return ", ".join(
        [
            f"{setting.get('scheduler', 'ddim')} {setting['steps']}",
            *([f"guidance {setting['guidance']:g}"] if "guidance" in setting else []),
            *([setting["precision"]] if "precision" in setting else []),
            *(["+".join(domains)] if domains else []),
            *(["and mirrored"] if setting["mirror"] else []),
        ]
    )


def held_out_data(folder: Path, size: int, count: int) -> Path:
    """Rendered once into folder."""
    gdtool(
        "render-dataset",
        f"procedural:900000..{900000 + count - 1}",
        "--size",
        str(size),
        "--condition-views",
        "1",
        "-o",
        folder,
        "--quiet",
    )
    return folder


def sampled(model, rgba: torch.Tensor, setting: dict, seed: int) -> tuple[Views, dict]:
    """The views of one object in one setting, and their seconds and processor seconds."""
    start, before = time.perf_counter(), sum(os.times()[:2])
    views = sampled_views(model, rgba, seed, **setting)
    return views, {"seconds": time.perf_counter() - start, "cpu_seconds": sum(os.times()[:2]) - before}


def start_up(model: Path, picture: Path) -> dict[str, float]:
    """Seconds and peak memory of the whole command on one picture, and what of it is not sampling or writing."""
    with tempfile.TemporaryDirectory() as work:
        cost = gdtool("sample-views", picture, "--model", model, "-o", Path(work) / "views", "--quiet")
        steps = json.loads((Path(work) / "views" / "manifest.json").read_text())["run"]["seconds"]
    return {
        "whole_seconds": cost.seconds,
        "peak_mb": cost.peak_mb,
        "start_up_seconds": cost.seconds - sum(v for k, v in steps.items() if k in ("sample", "write", "condition")),
    }


def mean_of(group: list[dict], key: str) -> float | None:
    values = [r[key] for r in group if key in r]
    return float(np.nanmean(values)) if values else None


def markdown(record: dict) -> str:
    rows = [[name, *(number(mean_of(group, key)) for key in SHOWN)] for name, group in record["rows"].items()]
    start, agreement = record["start_up"], record["consistency"]
    fits = [
        [key.replace("_", " "), *(number(mean_of(agreement[side], key)) for side in ("sampled", "true"))]
        for key in agreement["true"][0]
    ]
    return "\n".join(
        [
            "# Sampling: time against error",
            "",
            f"{len(agreement['true'])} held-out objects of `procedural:900000` and on, {record['image_size']} px, "
            f"two threads, on {machine()}. {record['remark']}",
            f"Start-up (imports, weights) {start['start_up_seconds']:.1f} s, the whole command on one picture "
            f"{start['whole_seconds']:.1f} s and {start['peak_mb']:.0f} MB.",
            "",
            table(["sampler", *(name.replace("_", " ") for name in SHOWN)], rows),
            "",
            "reference psnr: color against 50 steps of DDIM. ![time against error](sample.png)",
            "",
            "## Consistency",
            "",
            table(["", "sampled", "true views"], fits),
            "",
        ]
    )


def draw(path: Path, record: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7, 4.5))
    for name, group in record["rows"].items():
        x, y = mean_of(group, "cpu_seconds"), mean_of(group, "color_psnr_frame")
        if y is not None:
            axis.plot(x, y, "o")
            axis.annotate(name, (x, y), textcoords="offset points", xytext=(5, 3), fontsize=7)
    seconds_axis(axis)
    axis.set(ylabel="color PSNR, five unseen views, dB", xlabel="processor seconds, 36 images")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="*", type=Path, help="rendered objects; without any it renders its own")
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--limit", type=int, default=8, help="objects at most")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gdtool-held-out")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    torch.set_num_threads(2)
    model = load_model(arguments.model)
    size = model.config.image_size
    folders = views_folders(arguments.held_out or [held_out_data(arguments.cache / str(size), size, arguments.limit)])[
        : arguments.limit
    ]
    record: dict = {
        "image_size": size,
        "remark": busy(),
        "start_up": start_up(arguments.model, folders[0].path / "condition" / "000.png"),
        "rows": {},
        "consistency": {"sampled": [], "true": []},
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    for seed, folder in enumerate(folders):
        truth = true_views(folder, size)
        rgba = torch.from_numpy(decode_object(folder, model.config)[1][0])[None]
        reference = None
        for setting in SETTINGS:
            views, row = sampled(model, rgba, setting, seed)
            reference = reference or views
            shown, wanted = (over_white(v.images["color"], v.mask) for v in (views, reference))
            row["reference_psnr"] = min(psnr(shown, wanted), 99.0)  # the reference itself is equal
            if set(views.images) == set(model.config.domains):
                row |= {key: value for key, value in figures(views, truth).items() if key in TRUE}
            if setting == {"steps": model.config.sampling_steps, "mirror": model.config.sampling_mirrored}:
                record["consistency"]["sampled"].append(consistency(views))
                record["consistency"]["true"].append(consistency(truth))
            record["rows"].setdefault(label(setting), []).append(row)
        say(f"  {folder.name}")
        (arguments.output / "sample.json").write_text(json.dumps(record, indent=1) + "\n")
        (arguments.output / "sample.md").write_text(markdown(record))
        draw(arguments.output / "sample.png", record)
    print(markdown(record))


if __name__ == "__main__":
    main()
