"""Warn of pictures that are unlike the training data, and of results that the model is unsure of.

Figures of the picture are compared with their range over the training pictures. Figures of the result are compared with
their usual values. Both are quantities that a user can read and act upon. Features of the image encoder would not
serve: photographs of anything lie among those of the training objects, which spread far wider. Figures of the picture
seldom show a problem either; the model's uncertainty shows in its result (docs/benchmarks/model_doubt.md). One step of
sampling gives the mean of all outlines that the model holds possible, which is a blur. It may also lose parts. The
picture then fills rows of the frame that the other views leave empty.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

RANGES_FILE = "pictures.json"  # in a model folder
TAIL = 0.005  # share of the training pictures left out at each end
MARGIN = 0.1  # of the range, added at each end
# Figures of a result (result_figures), and the text of a warning with its value and its usual maximum.
DOUBTS = {
    "outline_blur": "their outlines are blurred over {:.1f} pixels, {:.1f} at most is usual",
    "row_mismatch": "they begin or end at another height than the picture, in {:.1%} of the frame, "
    "{:.1%} at most is usual",
}


class PictureRange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the range of a figure over the training pictures, without the share TAIL of them at each end."""

    low: float
    high: float


def picture_figures(rgba: np.ndarray) -> dict[str, float]:
    """Measure how a subject fills its frame, its outline, brightness and texture; returns figures by name.

    rgba (4, h, w): condition in [-1, 1], sRGB color times coverage, then coverage.
    """
    alpha = 0.5 + 0.5 * rgba[3]
    inside = alpha > 0.5
    if not inside.any():
        return {"share of the frame that the subject fills": 0.0}
    rows, columns = np.nonzero(inside)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    color = 0.5 + 0.5 * rgba[:3] / np.maximum(alpha, 1e-3)
    grey = color.mean(0)
    # differences of neighbouring pixels, and whether both are inside
    steps = [
        (
            np.abs(np.diff(grey, axis=a)),
            np.take(inside, range(1, inside.shape[a]), a) & np.take(inside, range(inside.shape[a] - 1), a),
        )
        for a in (0, 1)
    ]
    texture = (
        np.concatenate([step[both] for step, both in steps]) if any(both.any() for _, both in steps) else np.zeros(1)
    )
    outline = sum(int(np.diff(inside, axis=a).sum()) for a in (0, 1))
    return {
        "share of the frame that the subject fills": float(inside.mean()),
        "share of its bounding box that the subject fills": float(inside.sum() / (height * width)),
        "width over height of the subject": float(width / height),
        "length of the outline over that of the bounding box": float(outline / (2 * (height + width))),
        "mean brightness": float(grey[inside].mean()),
        "spread of the brightness": float(grey[inside].std()),
        "difference between neighbouring pixels": float(texture.mean()),
    }


def figure_ranges(conditions) -> dict[str, PictureRange]:
    """Compute the range of each figure of picture_figures() over an iterable of conditions (4, h, w)."""
    every = [picture_figures(np.asarray(figures, np.float32)) for figures in conditions]
    names = list(dict.fromkeys(name for figures in every for name in figures))
    columns = {name: np.array([figures[name] for figures in every if name in figures]) for name in names}
    return {name: PictureRange(*(float(np.quantile(x, q)) for q in (TAIL, 1 - TAIL))) for name, x in columns.items()}


def describe_unfamiliar(rgba: np.ndarray, known: dict[str, PictureRange]) -> list[str]:
    """List descriptions of the figures of a condition (4, h, w) that lie outside their range in training.

    known: the range of each figure by name. A figure without a range is not checked.
    """
    descriptions = []
    for name, value in picture_figures(rgba).items():
        if name not in known:
            continue
        low, high = known[name].low, known[name].high
        margin = MARGIN * (high - low)
        if not low - margin <= value <= high + margin:
            descriptions.append(f"{name} is {value:.3g}, in training {low:.3g} to {high:.3g}")
    return descriptions


def result_figures(coverage: np.ndarray, front: int | None = None, alpha: np.ndarray | None = None) -> dict[str, float]:
    """Measure the blur of sampled outlines, and the rows in which they differ from the picture.

    Args:
        coverage: (k, h, w) in [0, 1], as the model sampled it.
        front: index of the view that shows the picture's side; None counts all views and leaves row_mismatch out.
        alpha: (h, w), the picture's coverage, which is that view's silhouette.

    Returns:
        outline_blur: mean width in pixels of the ramp from 0 to 1 across the outlines of the other views. A linear
            ramp's m (1 - m) adds up to a sixth of its width. The outlines' length is counted along rows and columns.
        row_mismatch: mean over rows of the difference between the greatest coverage in the other views and in the
            picture, 0 to 1. Upright orthographic views side by side fill the same rows.
    """
    unseen = np.asarray([view for k, view in enumerate(coverage) if k != front], np.float64)
    inside = unseen > 0.5
    length = sum(int(np.diff(inside, axis=a).sum()) for a in (1, 2))
    out = {"outline_blur": float(6 * (unseen * (1 - unseen)).sum() / max(length, 1))}
    if front is not None and alpha is not None:
        out["row_mismatch"] = float(np.abs(unseen.max(2) - alpha.max(1)).mean())
    return out


def usual_ranges(results: list[dict[str, float]], alarms: float) -> dict[str, PictureRange]:
    """Compute the usual range of each figure of result_figures() from the figures of many results.

    The upper end of a range is a quantile of its figure. The quantile is common to all figures: the lowest for which at
    most the share `alarms` of the results, 0 to 1, lies outside any range.
    """
    columns = np.array([[figures[name] for name in DOUBTS] for figures in results])  # (n, figures)
    for quantile in np.linspace(1 - alarms, 1, 101):
        high = np.quantile(columns, quantile, axis=0)
        if (columns > high).any(1).mean() <= alarms:
            break
    return {name: PictureRange(0.0, float(value)) for name, value in zip(DOUBTS, high, strict=True)}


def describe_doubts(result: dict[str, float], known: dict[str, PictureRange]) -> list[str]:
    """List descriptions of the figures of a result that lie above their usual range, by name in `known`."""
    return [
        words.format(result[name], known[name].high)
        for name, words in DOUBTS.items()
        if name in result and name in known and result[name] > known[name].high
    ]


def write_ranges(path: Path, known: dict[str, PictureRange]) -> None:
    """Write the range of each figure, by name, as JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(known), indent=1) + b"\n")


def read_ranges(folder: Path) -> dict[str, PictureRange]:
    """Read the ranges of a model folder, by figure; empty where it has none. Raises InputError for a damaged file."""
    from gdtool.core.errors import InputError
    from gdtool.core.reading import read_json

    path = Path(folder) / RANGES_FILE
    if not path.exists():
        return {}
    try:
        return msgspec.convert(read_json(path), dict[str, PictureRange])
    except msgspec.ValidationError as error:
        raise InputError(path, str(error), "copy or train the model again") from None
