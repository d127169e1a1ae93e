"""Make contact sheets: many small images in one picture, with labels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gdtool.images.color import unit_range

_MARGIN = 4  # pixels between cells


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray | None]], labels_top: Sequence[str] = (), labels_left: Sequence[str] = ()
) -> np.ndarray:
    """Arrange images in a table; returns (h, w, 3) uint8.

    rows: images (h, w) or (h, w, 1..4), encoded for display, float in [0, 1] or integer; None leaves its cell empty.
    Transparent pixels show white. Every cell has the size of the largest image. Labels stand above the columns and left
    of the rows, in a font of about a twelfth of that.
    """
    cells = [[None if image is None else _rgb_over_white(image) for image in row] for row in rows]
    filled = [image for row in cells for image in row if image is not None]
    if not filled:
        raise ValueError("a contact sheet needs an image")
    height, width = max(i.shape[0] for i in filled), max(i.shape[1] for i in filled)
    text = int(np.clip(height // 12, 10, 40))
    top = 2 * text if labels_top else _MARGIN
    left = max(_text_width(label, text) for label in labels_left) + 2 * _MARGIN if labels_left else _MARGIN
    columns = max(len(row) for row in cells)
    sheet = np.full((top + len(cells) * (height + _MARGIN), left + columns * (width + _MARGIN), 3), 255, np.uint8)
    for i, row in enumerate(cells):
        for j, image in enumerate(row):
            if image is not None:
                y = top + i * (height + _MARGIN) + (height - image.shape[0]) // 2
                x = left + j * (width + _MARGIN) + (width - image.shape[1]) // 2
                sheet[y : y + image.shape[0], x : x + image.shape[1]] = image
    labels = [(left + j * (width + _MARGIN), text // 3, label) for j, label in enumerate(labels_top)]
    labels += [
        (_MARGIN, top + i * (height + _MARGIN) + (height - text) // 2, label) for i, label in enumerate(labels_left)
    ]
    return _with_text(sheet, labels, text)


def square_sheet(images: Sequence[np.ndarray]) -> np.ndarray:
    """Arrange images in about as many rows as columns; returns (h, w, 3) uint8."""
    columns = math.ceil(math.sqrt(len(images)))
    return contact_sheet([images[i : i + columns] for i in range(0, len(images), columns)])


def _rgb_over_white(image: np.ndarray) -> np.ndarray:
    """Convert an image to (h, w, 3) uint8, over white."""
    x = unit_range(image).astype(np.float32)
    x = x.reshape(*x.shape[:2], -1)
    if x.shape[2] in (2, 4):
        alpha = x[..., -1:]
        x = x[..., :-1] * alpha + 1 - alpha
    if x.shape[2] == 1:
        x = np.repeat(x, 3, -1)
    return np.rint(np.clip(np.nan_to_num(x), 0, 1) * 255).astype(np.uint8)


def _text_width(label: str, size: int) -> int:
    """Measure the width of a label, pixels; guess where no font is found."""
    import OpenImageIO as oiio

    region = oiio.ImageBufAlgo.text_size(label, size)
    return int(region.width) if region.defined else size * len(label) * 2 // 3


def _with_text(sheet: np.ndarray, labels: list[tuple[int, int, str]], size: int) -> np.ndarray:
    """Draw labels (x, y of the top left corner, text) on a sheet; nothing where no font is found."""
    import OpenImageIO as oiio

    buffer = oiio.ImageBuf(sheet)
    for x, y, label in labels:
        oiio.ImageBufAlgo.render_text(buffer, x, y, label, size, "", (0.2, 0.2, 0.2, 1.0), "left", "top")
    if buffer.has_error:
        buffer.geterror()
    return np.asarray(buffer.get_pixels("uint8"), np.uint8).reshape(sheet.shape)
