"""How much of remesh's figures is the luck of the last digits: the same fine mesh, moved by a ten-millionth of its
size, again and again.

    python -m benchmarks.remesh.repeatability [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--solids part] [--draws 8] \
        [--faces 20000]

Writes remesh_draws.md and remesh_draws.json, row by row: killed, it goes on where it was. Draw 0 is the mesh as it is.
Figures are those of benchmarks/remesh/sweep.py."""

from __future__ import annotations

import os
import time

import numpy as np

from benchmarks.common.fine_meshes import models_in, of_model, of_solid
from benchmarks.common.measure import ROOT, busy, machine, number, say, table
from benchmarks.common.mesh_runs import arguments
from benchmarks.common.resumable_rows import Rows
from benchmarks.remesh.sweep import ours, score

_NOISE = 1e-7  # of the size
COLUMNS = (
    "model",
    "draw",
    "seconds",
    "processor",
    "quads",
    "watertight",
    "irregular",
    "jacobian",
    "least",
    "mean",
    "hausdorff",
    "crease mean",
    "crease recall",
)
SUMMED = {
    "irregular": max,
    "jacobian": min,
    "least": min,
    "mean": max,
    "hausdorff": max,
    "crease mean": max,
    "crease recall": min,
}


def main() -> None:
    from gdtool.core.child import ChildFailed, call

    parser = arguments(__doc__, "mesh files", "not used here")
    parser.add_argument(
        "--input", type=int, default=1_000_000, help="triangles of each solid and of each model, made solid"
    )
    parser.add_argument("--draws", type=int, default=8, help="of each model")
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = str(ROOT)  # child processes import this package
    end, note = time.monotonic() + 60 * asked.minutes, busy()
    rows = Rows(asked.out / "remesh_draws.json", {"faces": str(asked.faces), "input": str(asked.input)})

    def report(complete: bool) -> str:
        rows.write(complete)
        text = table(
            COLUMNS,
            (
                [number(row.get(name, "failed" if name == "quads" and "failed" in row else None)) for name in COLUMNS]
                for row in rows.rows
            ),
        )
        names = list(dict.fromkeys(row["model"] for row in rows.rows))
        sums = []
        for name in names:
            values = {key: [row[key] for row in rows.rows if row["model"] == name and key in row] for key in SUMMED}
            for how, pick in (("median", np.median), ("worst", None)):
                sums.append(
                    [
                        name,
                        how,
                        *(
                            number(float((pick or SUMMED[key])(found)) if found else None)
                            for key, found in values.items()
                        ),
                    ]
                )
        text = table(("model", "of its draws", *SUMMED), sums) + "\n\n" + text
        (asked.out / "remesh_draws.md").write_text(
            f"# Remesh, input by input: {asked.faces} quads from {asked.input} triangles moved by {_NOISE:g} of "
            f"their size\n\n"
            f"`python -m benchmarks.remesh.repeatability`, {machine()}. {note}\n\n{text}\n"
        )
        return text

    for source in [*filter(None, asked.solids.split(",")), *models_in(asked.models)]:
        name = source if isinstance(source, str) else source.stem
        wanted = [draw for draw in range(asked.draws) if not rows.has(name, str(draw))]
        if not wanted or time.monotonic() > end:
            continue
        fine = (
            of_solid(source, asked.input, asked.kept)
            if isinstance(source, str)
            else of_model(source, asked.input, asked.kept)
        )
        for draw in wanted:
            if time.monotonic() > end:
                break
            say(f"{name}: draw {draw}")
            rng = np.random.default_rng(draw)
            moved = fine.vertices + (_NOISE if draw else 0.0) * np.ptp(fine.vertices, 0).max() * rng.uniform(
                -1, 1, fine.vertices.shape
            )
            try:
                found = call(ours, moved, fine.faces, asked.faces, {}, seconds=asked.limit, memory_mb=16000)
                row = {**found[2], **score(fine, *found[:2])}
            except ChildFailed as failure:
                row = {"failed": str(failure)}
            rows.add({"model": name, "way": str(draw), "draw": draw, **row})
        report(False)
    print(report(time.monotonic() < end))
    if time.monotonic() > end:
        say(f"not all began within {asked.minutes:g} minutes: run it again and it goes on")


if __name__ == "__main__":
    main()
