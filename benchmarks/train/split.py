r"""Say what each object of the corpus is for: training, choosing designs (dev), or measuring at the end (validation).

    python -m benchmarks.train.split SOURCES.tsv MODELS -o benchmarks/train/split.tsv

SOURCES.tsv names the objects, a line each, with the columns archive, object and split; MODELS holds ARCHIVE/OBJECT.
An object marked `train` is dropped where an object marked `validation` has its family, or nearly its shape. Of what is
left, whole families go to `dev`. The list has two columns: object, and part (train, dev, dropped:family, dropped:shape
or validation).
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import re
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.train.shapes import best_overlaps, occupancy

# Overlap of cells (benchmarks/train/shapes.py) from which two objects have nearly the same shape. Chosen by looking at
# the 24 pairs around .9, .85 and .8: down to .85 there are copies and variants from other packs (barrels, bridges,
# palms, walls with other windows), lower almost only unrelated boxes, balls and plates. Within a pack variants go on to
# .8 (trains with another roof).
SAME_SHAPE = 0.85
SAME_SHAPE_IN_PACK = 0.8
DEV_SHARE = 20  # one family in so many is for choosing designs
# Words that tell members of one family apart. A letter alone and a number always do.
SIZES = (
    "big double giant half high huge large long low medium mini narrow short single slim small tall thick thin tiny "
    "triple wide"
)
COLOURS = (
    "beige black blue brown color colour cyan dark golden gray green grey light magenta orange pink purple red silver "
    "white yellow"
)
NUMBERS = "first second third"
LABELS = "gltf hq level lod lq lvl mat type variant"  # of exporters and series
_LEFT_OUT = frozenset(f"{SIZES} {COLOURS} {NUMBERS} {LABELS}".split())
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def family(name: str) -> str:
    """Return "pack/words" of an object's file name SOURCE__PACK__OBJECT.glb.

    The words are those of OBJECT, in lower case, without numbers, single letters, sizes, colours and exporters' labels;
    all of its words where none would be left. "kit__wall-windowB-small.glb" and "kit__wallWindow2.glb" are one family.
    """
    pack, _, name = name.rsplit(".", 1)[0].rpartition("__")
    words = [word.lower() for word in _WORD.findall(name)]
    kept = [word for word in words if len(word) > 1 and word not in _LEFT_OUT]
    return f"{pack}/{' '.join(kept or words)}"


def is_dev(family_name: str) -> bool:
    """Tell whether a family is for choosing designs: one in DEV_SHARE, by its name's hash."""
    return int(hashlib.sha1(family_name.encode()).hexdigest(), 16) % DEV_SHARE == 0


def parts(objects: dict[str, bool], cells: dict[str, np.ndarray]) -> dict[str, str]:
    """Return each object's part. objects: whether it is marked validation, by name; cells: occupancy(), by name."""
    validation = [name for name, marked in objects.items() if marked]
    families = {family(name) for name in validation}
    out = dict.fromkeys(validation, "validation")
    rest = []
    for name, marked in objects.items():
        if not marked and family(name) in families:
            out[name] = "dropped:family"
        elif not marked:
            rest.append(name)
    overlaps = best_overlaps([cells[name] for name in validation], [cells[name] for name in rest])
    packs = np.array([pack_of(name) for name in validation])
    for name, column in zip(rest, overlaps.T, strict=True):
        limits = np.where(packs == pack_of(name), SAME_SHAPE_IN_PACK, SAME_SHAPE)
        if (column >= limits).any():
            out[name] = "dropped:shape"
        else:
            out[name] = "dev" if is_dev(family(name)) else "train"
    return out


def pack_of(name: str) -> str:
    """Return SOURCE__PACK of an object's file name."""
    return name.rpartition("__")[0]


def read_split(path: Path) -> dict[str, str]:
    """Read each object's part from the list."""
    with path.open(newline="") as file:
        return {row["object"]: row["part"] for row in csv.DictReader(file, delimiter="\t")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", type=Path, help="SOURCES.tsv")
    parser.add_argument("models", type=Path, help="folder that holds ARCHIVE/OBJECT")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmarks/train/split.tsv"))
    arguments = parser.parse_args()
    with arguments.sources.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    paths = [arguments.models / row["archive"] / row["object"] for row in rows]
    with ProcessPoolExecutor(arguments.processes) as pool:
        cells = dict(zip((path.name for path in paths), pool.map(occupancy, paths, chunksize=16), strict=True))
    found = parts({row["object"]: row["split"] == "validation" for row in rows}, cells)
    with arguments.output.open("w", newline="") as file:
        writer = csv.writer(file, delimiter="\t", lineterminator="\n")
        writer.writerow(("object", "part"))
        writer.writerows(sorted(found.items()))
    print(", ".join(f"{count} {part}" for part, count in sorted(Counter(found.values()).items())))


if __name__ == "__main__":
    main()
