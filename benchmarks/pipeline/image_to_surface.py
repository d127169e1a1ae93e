"""One picture to a surface, by the commands as they are: how near the surface comes to the object that was pictured.

    python -m benchmarks.pipeline.image_to_surface out/model/held_out --train out/model/objects -o docs/benchmarks

The picture is each object's front view; `sample-views --no-crop` makes the views of it, `reconstruct` the surface,
`evaluate` measures it against the object, in the frame of the views, in both protocols of docs/metrics.md. Beside it
the same object reconstructed from its true views, which is as good as the model could make it, and from the views of
the training object (--train) whose picture is the nearest. Published for comparison, on other objects: GraphicsDreamer
0.0231 and 0.5779 (syncdreamer protocol). Rows are kept: a run that was stopped goes on. Half a minute an object on two
cores."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.measure import Failed, evaluate, gdtool, machine, number, say, table
from benchmarks.common.resumable_rows import Rows
from benchmarks.train.held_out import DEFAULT_MODEL, nearest_to, views_folders
from gdtool.core.folder import Folder, open_folder
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object

KEYS = (
    "surface_distance",
    "surface_iou",
    "surface_f_score",
    "surface_normal_degrees",
    "syncdreamer_chamfer",
    "syncdreamer_iou",
    "syncdreamer_icp_chamfer",
    "syncdreamer_icp_iou",
)
WAYS = {
    "picture": "one picture, the model",
    "true": "its true views",
    "nearest": "views of the nearest training object",
}


def surface_of(way: str, truth: Folder, nearest: Path | None, model: Path, work: Path) -> Path:
    """The surface folder made in one way. Raises Failed."""
    views = {"true": truth.path, "nearest": nearest}.get(way)
    if views is None:
        views = work / "views"
        gdtool(
            "sample-views", truth.path / "color" / "front.png", "--no-crop", "--model", model, "-o", views, "--quiet"
        )
    gdtool("reconstruct", views, "-o", work / "surface", "--quiet")
    return work / "surface"


def markdown(rows: list[dict]) -> str:
    lines = []
    for way, name in WAYS.items():
        own = [row for row in rows if row["way"] == way]
        kept = [row for row in own if "failed" not in row]
        if own:
            middle = [[float(row[key]) for row in kept if key in row] for key in KEYS]
            lines.append(
                [
                    name,
                    f"{len(kept)} of {len(own)}",
                    *(f"{number(np.mean(x))} ({number(np.median(x))})" if x else "–" for x in middle),
                ]
            )
    return "\n".join(
        [
            "# One picture to a surface",
            "",
            f"Held-out procedural objects, the picture is the front view, on {machine()}; mean (median). IoU of "
            f"closed truths only.",
            "",
            table(["from", "objects", *(key.replace("_", " ") for key in KEYS)], lines),
            "",
            "Distances in the surface protocol are in units of the object's largest extent; the paper's own figures, "
            "on other objects and in "
            "the syncdreamer protocol, are 0.0231 and 0.5779.",
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument(
        "--train", nargs="*", type=Path, default=[], help="what it was trained on, for the nearest object's column"
    )
    parser.add_argument("--limit", type=int, default=25, help="objects at most")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    config = load_model(arguments.model).config
    folders = views_folders(arguments.held_out)[: arguments.limit]
    trained = views_folders(arguments.train)
    pictures = [decode_object(folder, config)[1][0].astype(np.float16) for folder in trained]
    kept = Rows(
        arguments.output / "image_to_surface.json",
        {"limit": arguments.limit, "model": open_folder(arguments.model, ("model",)).manifest.key},
    )
    for folder in folders:
        name = folder.path.parent.name
        for way in WAYS:
            if kept.has(name, way) or (way == "nearest" and not trained):
                continue
            row: dict = {"model": name, "way": way}
            with tempfile.TemporaryDirectory() as work:
                try:
                    nearest = (
                        trained[nearest_to(torch.from_numpy(decode_object(folder, config)[1][0]), pictures)].path
                        if way == "nearest"
                        else None
                    )
                    surface = surface_of(way, folder, nearest, arguments.model, Path(work))
                    found = evaluate(surface, "--reference", folder.path, "--no-render")
                    row |= {key: found[key] for key in KEYS if key in found}
                except Failed as error:
                    row["failed"] = str(error)
            kept.add(row)
        say(f"  {name}")
        (arguments.output / "image_to_surface.md").write_text(markdown(kept.rows))
    kept.write(True)
    print(markdown(kept.rows))


if __name__ == "__main__":
    main()
