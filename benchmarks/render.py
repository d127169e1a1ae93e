"""Six views, time against error: the buffers and the lit color of render-dataset by samples.

  python benchmarks/render.py MODEL.glb ENV.hdr [-o docs/benchmarks] [--size 512]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from measure import say
from shading import errors, in_child, write

VIEWS = "front,front_right,right,back,left,front_left"
DOMAINS = ["normal", "depth", "albedo", "roughness", "metallic"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("env")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--views", default=VIEWS)
    parser.add_argument("--reference", type=int, default=256, help="samples per pixel of the references")
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as place:
        truth, out = f"{place}/truth.npz", f"{place}/out.npz"
        common = ("--size", asked.size, "--views", asked.views)

        def add(method: str, samples: int, cost: dict | None) -> None:
            if cost is not None:
                found = errors(dict(np.load(out)), dict(np.load(truth)))
                rows.append({"method": method, "samples": samples, **cost, **found, "worst buffer": min(found[d] for d in DOMAINS if d in found)})
                say(str(rows[-1]))

        say("reference")
        own = (sys.executable, "shading_gdtool.py", asked.model, asked.env)
        in_child(*own, truth, *common, "--samples", asked.reference, "--light", "sampled", "--light-samples", 8, "--seed", 77, "--converged")
        for samples in (4, 8, 16, 32, 64):
            add("gdtool buffers", samples, in_child(*own, out, *common, "--samples", samples))
        for samples in (4, 16, 64):
            add("gdtool with color", samples, in_child(*own, out, *common, "--samples", samples, "--light", "sampled"))
    write(asked.output, "render", "Six views", rows, ["method", "samples", "wall s", "cpu s", *DOMAINS, "worst buffer", "color"], "cpu s", "worst buffer")


if __name__ == "__main__":
    main()
