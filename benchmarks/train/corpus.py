"""Unpack the objects of a part of a corpus, and print their paths for render-dataset.

    python -m benchmarks.train.corpus CORPUS validation -o out/corpus | gdtool render-dataset -o out/validation

CORPUS holds SOURCES.tsv (columns archive, object, split) and ARCHIVE.tar.xz, which hold OBJECT, or ARCHIVE/OBJECT.
"""

from __future__ import annotations

import argparse
import csv
import tarfile
from pathlib import Path


def unpacked(corpus: Path, part: str, output: Path) -> list[Path]:
    """Return the paths of the objects whose split is `part`, unpacked to output/ARCHIVE/OBJECT where they are not."""
    with (corpus / "SOURCES.tsv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file, delimiter="\t") if row["split"] == part]
    found = []
    for archive in dict.fromkeys(row["archive"] for row in rows):
        names = [row["object"] for row in rows if row["archive"] == archive]
        folder = (corpus if (corpus / archive).is_dir() else output) / archive
        missing = {name for name in names if not (folder / name).exists()}
        if missing:
            with tarfile.open(corpus / f"{archive}.tar.xz") as tar:
                for member in tar:
                    if member.name.removeprefix("./") in missing:
                        tar.extract(member, folder, filter="data")
        found += [folder / name for name in names]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corpus", type=Path)
    parser.add_argument("part", choices=("train", "validation"))
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    print(*unpacked(arguments.corpus, arguments.part, arguments.output), sep="\n")


if __name__ == "__main__":
    main()
