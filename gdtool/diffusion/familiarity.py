"""Whether a framed picture is like those a model was trained on: a few plain figures of it against their range there.

The image encoder's own features do not tell (photographs of anything lie among the training objects, whose own tail reaches
far further), so the figures are ones that a user can read and act upon.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

FILE = "pictures.json"  # in a model folder
TAIL = 0.005  # share of the training pictures left out at each end
MARGIN = 0.1  # of the range, added at each end


class PictureRange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Least and greatest of a figure over the training pictures, their tails left out."""

    low: float
    high: float


def picture_figures(rgba: np.ndarray) -> dict[str, float]:
    """Figures of a condition (4, h, w): premultiplied encoded color and coverage in [-1, 1] (data.condition_plane)."""
    alpha = 0.5 + 0.5 * rgba[3]
    inside = alpha > 0.5
    if not inside.any():
        return {"share of the frame that the subject fills": 0.0}
    rows, columns = np.nonzero(inside)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    color = 0.5 + 0.5 * rgba[:3] / np.maximum(alpha, 1e-3)
    grey = color.mean(0)
    # neighbours that are both inside: texture, and how much of the box's outline the subject has
    steps = [(np.abs(np.diff(grey, axis=a)), np.take(inside, range(1, inside.shape[a]), a) & np.take(inside, range(inside.shape[a] - 1), a)) for a in (0, 1)]
    texture = np.concatenate([step[both] for step, both in steps]) if any(both.any() for _, both in steps) else np.zeros(1)
    outline = sum(int(np.diff(inside, axis=a).sum()) for a in (0, 1))
    return {"share of the frame that the subject fills": float(inside.mean()), "share of its bounding box that the subject fills": float(inside.sum() / (height * width)),
            "width over height of the subject": float(width / height), "length of the outline over that of the bounding box": float(outline / (2 * (height + width))),
            "mean brightness": float(grey[inside].mean()), "spread of the brightness": float(grey[inside].std()),
            "difference between neighbouring pixels": float(texture.mean())}


def ranges(conditions) -> dict[str, PictureRange]:
    """The range of each figure over an iterable of conditions (4, h, w)."""
    every = [picture_figures(np.asarray(one, np.float32)) for one in conditions]
    names = list(dict.fromkeys(name for one in every for name in one))
    columns = {name: np.array([one[name] for one in every if name in one]) for name in names}
    return {name: PictureRange(*(float(np.quantile(x, q)) for q in (TAIL, 1 - TAIL))) for name, x in columns.items()}


def unfamiliar(rgba: np.ndarray, known: dict[str, PictureRange]) -> list[str]:
    """What of a condition lies outside the training pictures' range, in words; empty where nothing does."""
    found = []
    for name, value in picture_figures(rgba).items():
        if name not in known:
            continue
        low, high = known[name].low, known[name].high
        margin = MARGIN * (high - low)
        if not low - margin <= value <= high + margin:
            found.append(f"{name} is {value:.3g}, in training {low:.3g} to {high:.3g}")
    return found


def write_ranges(path: Path, known: dict[str, PictureRange]) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(known), indent=1) + b"\n")


def read_ranges(folder: Path) -> dict[str, PictureRange]:
    """What a model folder says of its training pictures; nothing for one that does not. Raises InputError when damaged."""
    from gdtool.core.errors import InputError

    path = Path(folder) / FILE
    if not path.is_file():
        return {}
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, PictureRange])
    except msgspec.DecodeError as error:
        raise InputError(path, str(error), "copy or train the model again") from None
