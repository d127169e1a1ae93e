"""Write the tables of benchmarks/train/quality.py: means, and differences to the first way on the same objects."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.common.measure import machine, number, table
from benchmarks.train.makers import Held, Maker

if TYPE_CHECKING:
    from benchmarks.train.quality import Bench

NAMES = {
    "silhouette_overlap": "silhouette overlap",
    "side_overlap": "side overlap",
    "color_psnr_frame": "color frame, dB",
    "color_psnr_foreground": "color foreground, dB",
    "color_ssim_frame": "color SSIM",
    "albedo_psnr_frame": "albedo frame, dB",
    "albedo_psnr_foreground": "albedo foreground, dB",
    "lpips_alex": "LPIPS, AlexNet ↓",
    "lpips_vgg": "LPIPS, VGG16 ↓",
    "flip": "FLIP ↓",
    "normal_degrees": "normals, ° ↓",
    "normal_degrees_shared": "normals, shared, ° ↓",
    "depth_error": "depth ↓",
    "depth_error_shared": "depth, shared ↓",
    "roughness_error": "roughness ↓",
    "metallic_error": "metallic ↓",
    "cpu_seconds": "processor seconds ↓",
    "seconds": "seconds ↓",
    "surface_distance": "surface distance ↓",
    "surface_f_score": "surface F-score",
    "surface_iou": "surface IoU",
    "surface_normal_degrees": "surface normals, ° ↓",
}
# What a part of a set, an archive, is shown by.
SHORT = (
    "silhouette_overlap",
    "side_overlap",
    "color_psnr_frame",
    "albedo_psnr_frame",
    "lpips_alex",
    "lpips_vgg",
    "normal_degrees_shared",
    "depth_error_shared",
)

Summary = dict[str, dict[str, dict[str, float]]]  # by way, figure, and statistic


def summary(bench: Bench, objects: list[Held]) -> Summary:
    """Summarise the figures of each way over objects.

    mean and error: the mean over the objects that have the figure, and its standard error. count: their number. more
    and more_error: the mean of what the way has more than the first one on the same objects, and its standard error.
    """
    first = {held.name: bench.figures_of(held, bench.makers[0]) for held in objects}
    return {
        maker.name: _statistics({held.name: bench.figures_of(held, maker) for held in objects}, first, maker, bench)
        for maker in bench.makers
    }


def _statistics(
    own: dict[str, dict[str, float]], first: dict[str, dict[str, float]], maker: Maker, bench: Bench
) -> dict[str, dict[str, float]]:
    """Return the statistics of each figure. own, first: figures by object."""
    out = {}
    for key in NAMES:
        values = [found[key] for found in own.values() if key in found]
        if not values:
            continue
        out[key] = dict(zip(("mean", "error"), mean_and_error(values), strict=True)) | {"count": len(values)}
        pairs = [found[key] - first[name][key] for name, found in own.items() if key in found and key in first[name]]
        if pairs and maker is not bench.makers[0]:
            out[key] |= dict(zip(("more", "more_error"), mean_and_error(pairs), strict=True))
    return out


def mean_and_error(values: Iterable[float]) -> tuple[float, float]:
    """Return the mean of values and its standard error, which is NaN for a single value."""
    array = np.array(list(values))
    error = array.std(ddof=1) / len(array) ** 0.5 if len(array) > 1 else float("nan")
    return float(array.mean()), float(error)


def markdown(found: Summary, keys: Iterable[str]) -> str:
    """Format the means of a set, then the differences to the first way."""
    shown = [key for key in keys if any(key in figures for figures in found.values())]
    first, *others = found
    means = [[NAMES[key], *(_cell(figures.get(key), "mean", "error") for figures in found.values())] for key in shown]
    more = [
        [NAMES[key], *(_cell(found[way].get(key), "more", "more_error") for way in others)]
        for key in shown
        if any("more" in found[way].get(key, {}) for way in others)
    ]
    text = table(["", *found], means)
    return f"{text}\n\nMore than {first}, on the same objects:\n\n{table(['', *others], more)}" if more else text


def _cell(figure: dict[str, float] | None, value: str, error: str) -> str:
    """Format a value with its standard error."""
    if figure is None or value not in figure:
        return "–"
    sign = "+" if value == "more" and figure[value] > 0 else ""
    text = f"{sign}{_digits(figure[value])}"
    return f"{text} ± {_digits(figure[error])}" if np.isfinite(figure[error]) else text


def _digits(value: float) -> str:
    """Format a number with two digits after the point where it is ten or more, three below."""
    return f"{value:.2f}" if abs(value) >= 10 else f"{value:.3f}"


def write_report(bench: Bench, tables: dict[str, list[Held]], whole: set[str], output: Path, name: str) -> str:
    """Write NAME.md and NAME.json, and return the Markdown. whole: names of the tables with all figures."""
    lines = [
        "# Models beside guesses without one",
        "",
        f"By `python -m benchmarks.train.quality` on {machine()}; the head of that file defines the figures. Five "
        "unseen views of each object, made of its true front view; mean ± standard error over the objects; ↓: less is "
        "better. Roughness and metallic are measured on objects where they are authored, surfaces on some of each set.",
    ]
    record: dict[str, object] = {}
    for title, objects in tables.items():
        found = summary(bench, objects)
        counts = {
            key: figure["count"]
            for key, figure in next(iter(found.values())).items()
            if figure["count"] != len(objects) and key in ("roughness_error", "surface_distance", "surface_iou")
        }
        few = "; ".join(f"{NAMES[key].removesuffix(' ↓')} on {number(count)}" for key, count in counts.items())
        lines += ["", f"## {title[0].upper()}{title[1:]}: {len(objects)} objects{f' ({few})' if few else ''}", ""]
        lines += [markdown(found, NAMES if title in whole else SHORT)]
        if title in whole:
            lines += ["", _as_the_paper(bench, objects)]
        record[title] = {"objects": len(objects), "ways": _rounded(found)}
    text = "\n".join(lines) + "\n"
    output.mkdir(parents=True, exist_ok=True)
    (output / f"{name}.md").write_text(text)
    (output / f"{name}.json").write_text(_json(record) + "\n")
    return text


def _json(record: dict[str, object]) -> str:
    """Format the record with a line for each figure."""
    return re.sub(r"\{\s+(\"[a-z_]+\": [^{}]*?)\s+\}", _on_one_line, json.dumps(record, indent=1))


def _on_one_line(found: re.Match) -> str:
    return "{" + re.sub(r"\s*\n\s*", " ", found[1]) + "}"


def _as_the_paper(bench: Bench, objects: list[Held]) -> str:
    """Say what the first way has by the protocol of the paper, which takes the front view in."""
    found = [bench.figures_of(held, bench.makers[0]) for held in objects]
    psnr, ssim = (np.mean([one[key] for one in found if key in one]) for key in ("color_psnr_six", "color_ssim_six"))
    return (
        f"Over all six views, as the paper measures, the color of {bench.makers[0].name} has {psnr:.2f} dB and SSIM "
        f"{ssim:.3f}; the paper has 27.93 dB and 0.937, on other objects, with a model a hundred times as large."
    )


def _rounded(found: Summary) -> Summary:
    """Round to five digits, and leave out what is not a number."""
    return {
        way: {
            key: {name: float(f"{value:.5g}") for name, value in figure.items() if np.isfinite(value)}
            for key, figure in figures.items()
        }
        for way, figures in found.items()
    }
