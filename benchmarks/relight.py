"""Relighting, time against error: gdtool's three kinds of light and their knobs.

  python benchmarks/relight.py MODEL.glb ENV.hdr [-o docs/benchmarks] [--size 512]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from measure import say
from shading import errors, in_child, write

SETTINGS = [("sg", 4, 0), *(("prefiltered", s, k) for s, k in ((4, 0), (4, 2), (16, 4))),
            *(("sampled", s, k) for s, k in ((4, 4), (16, 4), (64, 4), (256, 4)))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("env")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--reference", type=int, default=256, help="samples per pixel of the references")
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as place:
        truth, out = f"{place}/truth.npz", f"{place}/out.npz"
        common = ("--size", asked.size)

        def add(method: str, samples: int, directions: int | None, cost: dict | None) -> None:
            if cost is not None:
                rows.append({"method": method, "samples": samples, "directions": directions, **cost, **errors(dict(np.load(out)), dict(np.load(truth)))})
                say(str(rows[-1]))

        say("reference")
        in_child(sys.executable, "shading_gdtool.py", asked.model, asked.env, truth, *common, "--samples", asked.reference, "--light", "sampled",
                 "--light-samples", 16, "--seed", 77, "--converged")
        for light, samples, directions in SETTINGS:
            add(f"gdtool {light}", samples, directions, in_child(sys.executable, "shading_gdtool.py", asked.model, asked.env, out, *common,
                                                                 "--samples", samples, "--light", light, "--light-samples", directions))
    write(asked.output, "relight", "Relighting", rows, ["method", "samples", "directions", "wall s", "cpu s", "color"], "cpu s", "color")


if __name__ == "__main__":
    main()
