r"""How good models are beside guesses without one, on held-out objects: figures of the views, and of surfaces.

    python -m benchmarks.train.quality --set procedural=out/sets/procedural --set real=out/sets/real \
        --set validation=out/sets/validation --model today=gdtool/models/default --model "new=out/new --steps 2" \
        --train out/objects --split benchmarks/train/split.tsv --surfaces 10 -o docs/benchmarks

Each set is a dataset of `render-dataset --size 128 --condition-views 3`. The picture is an object's true front view,
and what is measured are the five views that it does not show. `make model-bench` renders three sets and runs this.

Ways to make views: each --model (NAME=FOLDER, and options of sample-views); the *inflated silhouette* (inflate.py);
and with --train the nearest training object by its picture, the best constant of each domain in the picture's
silhouette, and the mean training object (baselines.py). --split leaves out of --train what is not marked `train` in
that list.

Figures of an object are means over its five unseen views. color and albedo PSNR and SSIM: sRGB over white, the whole
frame ("frame"), and over the true foreground ("foreground"). Overlap: intersection over union of silhouettes, of all
five and of right and left ("side"). Normals in degrees and depth in units of the object's size: where truth and result
are on the object, and ("shared") over the pixels that are on it in the truth and in all results but the mean object.
Roughness and metallic: mean absolute error on the true foreground, only for objects whose source has them as a texture
on at least half of its area, or that the generator made. LPIPS and FLIP: color over white, at the views' size. Seconds:
of `sample-views`, start-up shared by 25 pictures.

A table has means with standard errors, and what each way has more than the first model on the same objects, with the
standard error of that. Rows are kept in --work, one for each object and way, by the digests of the model and of the
views: a later run measures only what is new.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.measure import Failed, say
from benchmarks.common.resumable_rows import KeyedRows
from benchmarks.train.authored import is_authored
from benchmarks.train.figures import PerceptualTruth, figures, on_shared_pixels
from benchmarks.train.held_out import DEFAULT_MODEL, object_name, views_folders
from benchmarks.train.makers import Held, Maker, ModelMaker, baselines, model_maker
from benchmarks.train.quality_report import write_report
from benchmarks.train.split import read_split
from benchmarks.train.surfaces import chosen, surface_row
from gdtool.core.folder import Folder

_VERSION = "1"  # of the figures: raise it when they change


@dataclass
class Bench:
    """Measure ways to make views on objects, and keep the rows."""

    makers: list[Maker]
    rows: KeyedRows

    def key(self, held: Held, what: str) -> str:
        """Return the key of a row."""
        text = f"{_VERSION} {held.set_name} {held.name} {held.folder.manifest.key} {what}"
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def authored(self, held: Held) -> bool:
        """Tell whether roughness and metallic count for an object."""
        key = self.key(held, "authored")
        row = self.rows.get(key)
        if row is None:
            row = {"key": key, "object": held.name, "authored": is_authored(held.folder)}
            self.rows.add(row)
        return row["authored"]

    def measure(self, held: Held) -> None:
        """Measure what has no row yet of an object."""
        shapes = [maker for maker in self.makers if maker.has_shape]
        shared_key = self.shared_key(held)
        todo = [maker for maker in self.makers if self.rows.get(self.key(held, maker.key)) is None]
        if not todo and self.rows.get(shared_key) is not None:
            return
        truth = held.views()
        made = {}
        for maker in shapes if self.rows.get(shared_key) is None else []:
            try:
                made[maker.key] = maker.views(held, truth)
            except Failed as error:
                say(f"  {error}")
        perceptual = PerceptualTruth(truth) if todo else None
        for maker in todo:
            row = {"key": self.key(held, maker.key), "object": held.name, "way": maker.name}
            try:
                views = made[maker.key] if maker.key in made else maker.views(held, truth)
                found = figures(views, truth) | (perceptual.figures(views) if perceptual else {}) | maker.cost(held)
                row["figures"] = {name: round(value, 5) for name, value in found.items() if np.isfinite(value)}
            except Failed as error:
                row["failed"] = str(error)
            self.rows.add(row)
        if self.rows.get(shared_key) is None:
            shared = on_shared_pixels(list(made.values()), truth)
            by_way = {
                key: {name: round(value, 5) for name, value in found.items() if np.isfinite(value)}
                for key, found in zip(made, shared, strict=True)
            }
            self.rows.add({"key": shared_key, "object": held.name, "shared": by_way})

    def shared_key(self, held: Held) -> str:
        """Return the key of the row of shared pixels, which depends on all ways."""
        return self.key(held, "shared " + " ".join(maker.key for maker in self.makers if maker.has_shape))

    def figures_of(self, held: Held, maker: Maker) -> dict[str, float]:
        """Return all figures of an object and way that were measured."""
        row, shared = self.rows.get(self.key(held, maker.key)), self.rows.get(self.shared_key(held))
        found = dict(row.get("figures", {})) if row else {}
        if not self.authored(held):
            found = {name: value for name, value in found.items() if name not in ("roughness_error", "metallic_error")}
        surface = self.rows.get(self.key(held, f"surface {maker.key}"))
        return found | (shared["shared"].get(maker.key, {}) if shared else {}) | (surface or {}).get("figures", {})

    def measure_surfaces(self, objects: list[Held]) -> None:
        """Measure the surfaces of models' views, and of the inflated silhouettes themselves, of some objects."""
        for held in objects:
            for maker in self.makers:
                key = self.key(held, f"surface {maker.key}")
                if self.rows.get(key) is None and (row := surface_row(maker, held)) is not None:
                    self.rows.add({"key": key, "object": held.name, "way": maker.name, **row})
                    say(f"  surface of {held.name}, {maker.name}: {row}")


def archives_of(sources: Path | None) -> dict[str, str]:
    """Read the archive of each object, by its name without suffix, from a corpus's SOURCES.tsv."""
    if sources is None:
        return {}
    with sources.open(newline="") as file:
        return {Path(row["object"]).stem: row["archive"] for row in csv.DictReader(file, delimiter="\t")}


def training_folders(paths: list[Path], split: Path | None) -> list[Folder]:
    """Open the views of the training objects; split: a list that must mark an object as `train`."""
    folders = views_folders(paths)
    if split is None:
        return folders
    parts = {Path(name).stem: part for name, part in read_split(split).items()}
    return [folder for folder in folders if parts.get(object_name(folder), "train") == "train"]


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=DATASET", required=True)
    parser.add_argument("--model", action="append", default=[], metavar="NAME=FOLDER", help="default: the bundled one")
    parser.add_argument("--train", nargs="*", type=Path, default=[], help="views of training objects")
    parser.add_argument("--split", type=Path, help="list of objects' parts: only `train` is taken of --train")
    parser.add_argument("--sources", type=Path, help="SOURCES.tsv of a corpus: tables by archive as well")
    parser.add_argument("--surfaces", type=int, default=0, help="objects of each set whose surfaces are measured")
    parser.add_argument("--limit", type=int, help="objects of each set at most")
    parser.add_argument("--work", type=Path, default=Path("out/model_bench"), help="where rows and views are kept")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--name", default="model", help="of the report's files")
    return parser.parse_args()


def main() -> None:
    arguments = parsed()
    models: list[ModelMaker] = [
        model_maker(text, arguments.work / "views") for text in arguments.model or [f"bundled model={DEFAULT_MODEL}"]
    ]
    guesses = baselines(training_folders(arguments.train, arguments.split), arguments.work)
    bench = Bench([*models, *guesses], KeyedRows(arguments.work / "rows.jsonl"))
    archives, sets = archives_of(arguments.sources), {}
    for text in arguments.set:
        name, _, path = text.partition("=")
        objects = [Held(name, folder) for folder in views_folders([Path(path)])][: arguments.limit]
        for maker in bench.makers:
            maker.prepare(objects)
        for number, held in enumerate(objects):
            bench.measure(held)
            if number % 10 == 9:
                say(f"  {name}: {number + 1} of {len(objects)}")
        bench.measure_surfaces(chosen(objects, arguments.surfaces))
        sets[name] = objects
    tables = {name: objects for name, objects in sets.items() if objects}
    for name, objects in sets.items():
        by_archive: dict[str, list[Held]] = {}
        for held in objects:
            by_archive.setdefault(archives.get(held.name, ""), []).append(held)
        tables |= {f"{name}, {archive}": group for archive, group in sorted(by_archive.items()) if archive}
    print(write_report(bench, tables, set(sets), arguments.output, arguments.name))


if __name__ == "__main__":
    main()
