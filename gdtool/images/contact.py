"""Contact sheets: many small pictures in one, for the eye."""

from __future__ import annotations

import numpy as np

MARGIN = 4


def contact_sheet(rows, labels_top=(), labels_left=()) -> np.ndarray:
    """One picture (h, w, 3) uint8 of rows of pictures, each (h, w), (h, w, 1 or 3) float in [0, 1] or uint8, or None."""
    from PIL import Image, ImageDraw

    cells = [[None if image is None else _rgb(image) for image in row] for row in rows]
    height = max(c.shape[0] for row in cells for c in row if c is not None)
    width = max(c.shape[1] for row in cells for c in row if c is not None)
    left, top = (70 if labels_left else 0), (16 if labels_top else 0)
    columns = max(map(len, cells))
    sheet = Image.new("RGB", (left + columns * (width + MARGIN), top + len(cells) * (height + MARGIN)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, text in enumerate(labels_top):
        draw.text((left + i * (width + MARGIN) + 2, 2), str(text), fill="black")
    for j, row in enumerate(cells):
        if j < len(labels_left):
            draw.text((2, top + j * (height + MARGIN) + 2), str(labels_left[j]), fill="black")
        for i, cell in enumerate(row):
            if cell is not None:
                sheet.paste(Image.fromarray(cell), (left + i * (width + MARGIN), top + j * (height + MARGIN)))
    return np.asarray(sheet)


def _rgb(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8:
        image = np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    if image.ndim == 2:
        image = image[..., None]
    return np.broadcast_to(image[..., :3], (*image.shape[:2], 3)).copy()
