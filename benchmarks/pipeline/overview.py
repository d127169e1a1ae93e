"""The picture of the README: a model and a picture, each from its source to a relit asset.

    python -m benchmarks.pipeline.overview MODEL PICTURE [-o docs/overview.jpg]

First row: a model through remesh, unwrap and bake. Second row: one picture through sample-views, reconstruct, remesh,
unwrap and bake. All commands at their defaults, but for `remesh --faces 4000`, whose quads can be told apart at this
size. Prints the seconds of each row. Two minutes on two cores.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.common.measure import ROOT, gdtool, say
from benchmarks.common.wireframe import wireframe

SIZE = 300  # pixels of a cell
LABEL_HEIGHT = 26  # pixels above each row
FACES = "4000"
MAX_BYTES = 300_000
LIGHTS = ("bright", "dark")
VIEW_GRID = ("front", "front_right", "right", "back", "left", "front_left")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "overview.jpg")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as kept:
        rows = [model_row(arguments.model, Path(kept)), picture_row(arguments.picture, Path(kept))]
    write_jpeg(arguments.output, rows)


def model_row(model: Path, work: Path) -> list[tuple[str, np.ndarray]]:
    """Labelled cells of a model that is remeshed, unwrapped and baked."""
    home = work / "model.asset"
    costs = [
        gdtool("relight", model, "--env", "bright", "--views", "8", "-o", work / "source"),
        gdtool("remesh", model, "--faces", FACES, "-o", home / "mesh"),
        gdtool("unwrap", home / "mesh"),
        gdtool("bake", home / "atlas"),
    ]
    say(f"{model.stem}: {sum(cost.seconds for cost in costs[1:]):.0f} s from the model to its asset")
    return [
        ("a model", turntable(work / "source")[1]),
        ("remesh: quads", quads(home)),
        ("unwrap: charts", read(home / "atlas" / "layout.png")),
        ("bake: base color", read(home / "asset" / "base_color.png")),
        *relit(home, work),
    ]


def picture_row(picture: Path, work: Path) -> list[tuple[str, np.ndarray]]:
    """Labelled cells of a picture from which an asset is made."""
    home = work / "picture.asset"
    costs = [
        gdtool("sample-views", picture, "-o", home / "views"),
        gdtool("reconstruct", home / "views"),
        gdtool("remesh", home / "surface", "--faces", FACES),
        gdtool("unwrap", home / "mesh"),
        gdtool("bake", home / "atlas"),
    ]
    say(f"{picture.stem}: {sum(cost.seconds for cost in costs):.0f} s from the picture to its asset")
    return [
        ("one picture", read(picture)),
        ("sample-views: color", view_grid(home / "views" / "color")),
        ("sample-views: normals", view_grid(home / "views" / "normal")),
        ("reconstruct, remesh", quads(home)),
        *relit(home, work),
    ]


def relit(home: Path, work: Path) -> list[tuple[str, np.ndarray]]:
    """The asset of a folder under each of LIGHTS, from the front right."""
    cells = []
    for light in LIGHTS:
        out = work / f"{home.stem}-{light}"
        gdtool("relight", home / "asset", "--env", light, "--views", "8", "-o", out)
        cells.append((f"relight: {light}", turntable(out)[1]))
    return cells


def turntable(renders: Path) -> list[np.ndarray]:
    """Pictures (h, w, 3) in [0, 1] of a renders folder, in its order."""
    return [read(path) for path in sorted(renders.glob("[0-9]*.png"))]


def quads(home: Path) -> np.ndarray:
    """A wireframe of the whole mesh of a folder."""
    from gdtool.folders.mesh import read_obj

    mesh = read_obj(home / "mesh" / "mesh.obj")
    return wireframe(mesh.vertices, mesh.faces, 2 * SIZE, half_widths=2.1)


def view_grid(folder: Path) -> np.ndarray:
    """Six views of one domain over white, two rows of three."""
    views = []
    for name in VIEW_GRID:
        mask = read(folder.parent / "mask" / f"{name}.png")
        views.append(read(folder / f"{name}.png") * mask + 1 - mask)
    return np.concatenate([np.concatenate(views[:3], 1), np.concatenate(views[3:], 1)], 0)


def read(path: Path) -> np.ndarray:
    """(h, w, 3) in [0, 1], over white where the file has alpha."""
    from gdtool.images.io import read_image

    image = read_image(path)
    image = image.astype(np.float32) / np.iinfo(image.dtype).max
    if image.shape[-1] == 1:
        image = np.repeat(image, 3, -1)
    if image.shape[-1] == 4:
        image = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
    return image


def write_jpeg(path: Path, rows: list[list[tuple[str, np.ndarray]]]) -> None:
    """Write labelled cells as a picture of at most MAX_BYTES, at the best quality that fits."""
    from PIL import Image, ImageDraw

    height = SIZE + LABEL_HEIGHT
    sheet = Image.new("RGB", (SIZE * max(map(len, rows)), height * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, row in enumerate(rows):
        for j, (label, cell) in enumerate(row):
            image = Image.fromarray((np.clip(cell, 0, 1) * 255 + 0.5).astype(np.uint8))
            image.thumbnail((SIZE - 8, SIZE - 8), Image.Resampling.LANCZOS)
            left, top = j * SIZE + (SIZE - image.width) // 2, i * height + LABEL_HEIGHT + (SIZE - image.height) // 2
            sheet.paste(image, (left, top))
            draw.text((j * SIZE + 8, i * height + 6), label, fill="black", font_size=15)
    path.parent.mkdir(parents=True, exist_ok=True)
    for quality in range(90, 30, -5):
        sheet.save(path, quality=quality, optimize=True)
        if path.stat().st_size <= MAX_BYTES:
            break


if __name__ == "__main__":
    main()
