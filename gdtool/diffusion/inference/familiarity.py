"""Warn of pictures unlike the training data, and of results that the model is unsure of.

Figures of the picture are compared with their range over the training pictures, and figures of the result with their
usual values. The image encoder's features do not tell: photographs of anything lie among the training objects, whose
tail reaches far further. So the picture's figures are ones that a user can read and act upon. They seldom tell either;
a model's uncertainty shows in its result (docs/benchmarks/model_doubt.md). One step of sampling gives the mean of all
outlines that the model holds possible, which is a blur. It may also lose parts; then the picture fills rows of the
frame that the other views leave empty.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

FILE = "pictures.json"  # in a model folder
TAIL = 0.005  # share of the training pictures left out at each end
MARGIN = 0.1  # of the range, added at each end
# Figures of a result (result_figures) and what one of them, and the usual most of it, says to the user.
DOUBTS = {
    "outline_blur": "their outlines are blurred over {:.1f} pixels, {:.1f} at most is usual",
    "row_mismatch": "they begin or end at another height than the picture, in {:.1%} of the frame, "
    "{:.1%} at most is usual",
}


class PictureRange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the least and greatest of a figure over the training pictures, their tails left out."""

    low: float
    high: float


def picture_figures(rgba: np.ndarray) -> dict[str, float]:
    """Compute the figures of a condition (4, h, w): premultiplied encoded color and coverage in [-1, 1]."""
    alpha = 0.5 + 0.5 * rgba[3]
    inside = alpha > 0.5
    if not inside.any():
        return {"share of the frame that the subject fills": 0.0}
    rows, columns = np.nonzero(inside)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    color = 0.5 + 0.5 * rgba[:3] / np.maximum(alpha, 1e-3)
    grey = color.mean(0)
    # neighbours that are both inside: texture, and how much of the box's outline the subject has
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


def ranges(conditions) -> dict[str, PictureRange]:
    """Compute the range of each figure over an iterable of conditions (4, h, w)."""
    every = [picture_figures(np.asarray(figures, np.float32)) for figures in conditions]
    names = list(dict.fromkeys(name for figures in every for name in figures))
    columns = {name: np.array([figures[name] for figures in every if name in figures]) for name in names}
    return {name: PictureRange(*(float(np.quantile(x, q)) for q in (TAIL, 1 - TAIL))) for name, x in columns.items()}


def unfamiliar(rgba: np.ndarray, known: dict[str, PictureRange]) -> list[str]:
    """Describe the figures of a condition that lie outside the training pictures' range; empty where none does."""
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
    """Measure how unsure a model was of the views that the picture does not show: the figures in DOUBTS.

    coverage (k, h, w) in [0, 1], as the model made it. front: index of the view whose silhouette is the picture's
    coverage alpha (h, w); without it all views count, and only outline_blur is returned.

    outline_blur: width in pixels of the ramp from 0 to 1 across the outlines. A linear ramp's m (1 - m) adds up to a
    sixth of its width; the outlines' length is counted along rows and columns. row_mismatch: upright orthographic views
    side by side fill the same rows. It is the difference between each row's greatest coverage and that of the picture's
    row, mean over all rows of the frame.
    """
    unseen = np.asarray([view for k, view in enumerate(coverage) if k != front], np.float64)
    inside = unseen > 0.5
    length = sum(int(np.diff(inside, axis=a).sum()) for a in (1, 2))
    out = {"outline_blur": float(6 * (unseen * (1 - unseen)).sum() / max(length, 1))}
    if front is not None and alpha is not None:
        out["row_mismatch"] = float(np.abs(unseen.max(2) - alpha.max(1)).mean())
    return out


def limits(results: list[dict[str, float]], alarms: float) -> dict[str, PictureRange]:
    """Compute ranges of the result's figures up to a common quantile.

    It is the lowest quantile at which at most the share `alarms` of these results leaves one of the ranges.
    """
    columns = np.array([[figures[name] for name in DOUBTS] for figures in results])  # (n, figures)
    for quantile in np.linspace(1 - alarms, 1, 101):
        high = np.quantile(columns, quantile, axis=0)
        if (columns > high).any(1).mean() <= alarms:
            break
    return {name: PictureRange(0.0, float(value)) for name, value in zip(DOUBTS, high, strict=True)}


def doubts(result: dict[str, float], known: dict[str, PictureRange]) -> list[str]:
    """Describe the figures of a result that lie above the usual; empty where none does."""
    return [
        words.format(result[name], known[name].high)
        for name, words in DOUBTS.items()
        if name in result and name in known and result[name] > known[name].high
    ]


def write_ranges(path: Path, known: dict[str, PictureRange]) -> None:
    """Write ranges as JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(known), indent=1) + b"\n")


def read_ranges(folder: Path) -> dict[str, PictureRange]:
    """Read a model folder's ranges; empty where it has none. Raises InputError when damaged."""
    from gdtool.core.errors import InputError
    from gdtool.core.reading import read_json

    path = Path(folder) / FILE
    if not path.exists():
        return {}
    try:
        return msgspec.convert(read_json(path), dict[str, PictureRange])
    except msgspec.ValidationError as error:
        raise InputError(path, str(error), "copy or train the model again") from None
