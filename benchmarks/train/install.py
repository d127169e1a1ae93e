"""Make a model the bundled one, with a table in its card: python -m benchmarks.train.install MODEL --table TABLE.md"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import msgspec

from benchmarks.train.held_out import DEFAULT_MODEL
from gdtool.core.folder import open_folder
from gdtool.core.manifest import MANIFEST, encode, list_files
from gdtool.diffusion.inference import familiarity


def install(source: Path, table: str, note: str) -> None:
    """Copy a model folder into the package: weights, configuration, loss curve and card; its inputs are not shipped."""
    folder = open_folder(source, ("model",))
    if source.resolve() != DEFAULT_MODEL.resolve():
        DEFAULT_MODEL.mkdir(exist_ok=True)
        for name in ("config.json", "model.safetensors", "loss.csv", "loss.png", "card.md", familiarity.RANGES_FILE):
            shutil.copyfile(source / name, DEFAULT_MODEL / name)
    table = "\n".join(line for line in table.splitlines() if not line.startswith("# ")).strip() + "\n"
    card = (DEFAULT_MODEL / "card.md").read_text().split("## Measured quality")[0].rstrip()
    (DEFAULT_MODEL / "card.md").write_text(f"{card}\n\n## Measured quality\n\n{note}\n\n{table}")
    (DEFAULT_MODEL / MANIFEST).unlink(missing_ok=True)
    manifest = msgspec.structs.replace(folder.manifest, inputs=(), name="default", files=list_files(DEFAULT_MODEL))
    (DEFAULT_MODEL / MANIFEST).write_bytes(encode(manifest))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--table", type=Path, required=True, help="Markdown that goes into the card")
    parser.add_argument("--note", default="", help="a line for the card: what the data were, how long it took")
    arguments = parser.parse_args()
    install(arguments.model, arguments.table.read_text(), arguments.note)


if __name__ == "__main__":
    main()
