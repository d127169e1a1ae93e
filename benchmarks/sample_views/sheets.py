r"""What a model makes of twelve held-out objects and of twelve pictures of other things, to look at: one sheet each.

    gdtool render-dataset MODELS --domains color --condition-views 1 --light LIGHT.hdr -o out/pictures
    python -m benchmarks.sample_views.sheets out/model/held_out out/pictures --sources $ASSETS/SOURCES.tsv \
        -o docs/benchmarks

Each block is one picture: the picture as the model is shown it, then its six views (columns) in color, normal, depth,
albedo, roughness and metallic (rows) over white. Pictures need alpha. A minute on two quiet cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks.train.held_out import DEFAULT_MODEL, views_folders
from gdtool.cameras import rig
from gdtool.cameras.camera import DISTANCE
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.framing import frame
from gdtool.diffusion.data.objects import condition_plane, decode_object
from gdtool.diffusion.inference.result import views_from_images
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.encoding import BACKGROUND, SLAB
from gdtool.images.color import linear_from_srgb
from gdtool.images.io import read_image, write_png
from gdtool.images.metrics import over_white

COUNT, COLUMNS, GAP = 12, 3, 12
MOST_BYTES = 300_000  # of a picture in docs/


def photograph(path: Path, size: int) -> np.ndarray:
    """A picture with alpha, framed, as a condition (4, size, size)."""
    image = read_image(path)
    image = image.astype(np.float32) / np.iinfo(image.dtype).max
    return condition_plane(frame(np.concatenate([linear_from_srgb(image[..., :3]), image[..., 3:]], -1), size))


def shown(domain: str, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """One view of a domain as (h, w, 3) in [0, 1] over white."""
    if domain in ("color", "albedo"):
        return over_white(image, mask)
    grey = {"depth": 0.5 + 0.5 * (DISTANCE - image) / SLAB, "normal": 0.5 + 0.5 * image}.get(domain, image)
    grey = np.repeat(grey[..., None], 3, -1) if grey.ndim == 2 else grey
    return grey * mask[..., None] + 1 - mask[..., None]


def block(model, condition: np.ndarray) -> np.ndarray:
    """(6 h, 7 w, 3): the picture in the first column, the sampled views beside it."""
    config, h = model.config, model.config.image_size
    cameras = {camera.name: camera for camera in rig("six", h)}
    rgba = torch.from_numpy(np.ascontiguousarray(condition, np.float32))[None]
    sampled = sample_images(model, rgba, SamplingOptions(steps=config.sampling_steps))
    alpha = 0.5 + 0.5 * condition[3]
    views, _ = views_from_images(
        {d: x[0] for d, x in sampled.items()},
        [cameras[n] for n in config.views],
        BACKGROUND[config.backgrounds[0]],
        config.domains,
        alpha,
    )
    out = np.ones((len(config.domains) * h, (len(config.views) + 1) * h, 3), np.float32)
    out[:h, :h] = np.moveaxis(0.5 * (condition[:3] + alpha) + 1 - alpha, 0, -1)  # premultiplied, over white
    for row, domain in enumerate(config.domains):
        for k in range(len(config.views)):
            out[row * h : (row + 1) * h, (k + 1) * h : (k + 2) * h] = shown(
                domain, views.images[domain][k], views.mask[k]
            )
    return np.clip(out, 0, 1)


def sheet(blocks: list[np.ndarray]) -> np.ndarray:
    height, width, _ = blocks[0].shape
    rows = -(-len(blocks) // COLUMNS)
    out = np.full((rows * (height + GAP), COLUMNS * (width + GAP), 3), 0.6, np.float32)
    for i, one in enumerate(blocks):
        top, left = i // COLUMNS * (height + GAP), i % COLUMNS * (width + GAP)
        out[top : top + height, left : left + width] = one
    return out


def name_of(picture: Path) -> str:
    """What a picture shows: the object of its views folder, else the name of its file."""
    return picture.parents[2].stem if picture.parent.name == "condition" else picture.stem


def credit(name: str, sources: Path | None) -> str:
    """Where the model of that name comes from and under what licence, as a table (path, repository, path there,
    licence) says."""
    for line in sources.read_text().splitlines() if sources else []:
        path, repository, _, licence = (line.split("\t") + 4 * [""])[:4]
        if Path(path).stem == name and Path(path).suffix in (".glb", ".gltf", ".obj"):
            return f" ({repository}, {licence})"
    return ""


def write_jpeg(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3) in 0..1 at half its size, in no more than MOST_BYTES."""
    from PIL import Image

    image = Image.fromarray((picture * 255 + 0.5).astype(np.uint8)).reduce(2)
    for quality in (90, 80, 70, 60, 50, 40):
        image.save(path, quality=quality)
        if path.stat().st_size <= MOST_BYTES:
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", type=Path)
    parser.add_argument(
        "pictures", type=Path, help="folder with pictures, or with views folders, whose condition/ holds them"
    )
    parser.add_argument("--sources", type=Path, help="table of models, their repositories and licences, to credit")
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    model = load_model(arguments.model)
    size = model.config.image_size
    found = sorted(arguments.pictures.rglob("condition/000.png")) or sorted(arguments.pictures.rglob("*.png"))
    pictures = [path for path in found if read_image(path).shape[-1] == 4]
    write_jpeg(
        arguments.output / "model_pictures.jpg",
        sheet([block(model, photograph(path, size)) for path in pictures[:COUNT]]),
    )
    folders = views_folders([arguments.held_out])[:COUNT]
    names = [name_of(path) for path in pictures[:COUNT]]
    lines = [f"{i + 1}. {name}{credit(name, arguments.sources)}" for i, name in enumerate(names)]
    (arguments.output / "model_sheets.md").write_text(
        "\n".join(
            [
                "# What the bundled model makes of twelve pictures and of twelve held-out objects",
                "",
                "A block a picture: as the model is shown it, then its six views in color, normal, depth, albedo, "
                "roughness and metallic.",
                "",
                "![twelve pictures](model_pictures.jpg)",
                "",
                "The pictures, row by row:",
                "",
                *lines,
                "",
                "![twelve held-out objects](model_held_out.png)",
                "",
            ]
        )
    )
    write_png(
        arguments.output / "model_held_out.png",
        sheet([block(model, decode_object(folder, model.config)[1][0]) for folder in folders]),
    )


if __name__ == "__main__":
    main()
