"""Models under lights as gdtool, Cycles and Mitsuba render them, side by side, to look at.

  python -m benchmarks.relight.contact_sheets MODEL... --lights mid,a.hdr,b.hdr --peers-python PYTHON -o out/sheets

Writes a sheet a light: a row a model, and the PSNR of gdtool's picture against each peer's. The renderers' scenes are
close and not the same: Mitsuba has neither emission nor alpha, and vertex colors in place of a texture, not over it;
Blender poses rigged models as their animation begins. Pictures that are there already are kept, so a killed run goes
on. Do not publish sheets of models whose licence does not allow it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from benchmarks.common.measure import say
from benchmarks.common.render.comparison import HERE, has, in_child
from benchmarks.common.render.scene import exported


def pictures(model: str, light: str, place: Path, size: int, view: str, python: Path | None) -> dict[str, np.ndarray]:
    """Premultiplied linear (h, w, 3) by renderer."""
    done = {name: place / f"{name}.npz" for name in ("gdtool", "Cycles", "Mitsuba")}
    if not all(path.exists() for path in done.values()):
        scene = exported(model, light, place)
        common = ("--size", str(size), "--views")
        commands = {
            "gdtool": (
                sys.executable,
                "-m",
                "benchmarks.common.render.in_gdtool",
                model,
                light,
                str(done["gdtool"]),
                *common,
                view,
                "--samples",
                "64",
                "--light",
                "sampled",
            )
        }
        if has(python, "bpy"):
            commands["Cycles"] = (
                str(python),
                str(HERE / "in_blender.py"),
                scene["model"],
                scene["light"],
                str(done["Cycles"]),
                *common,
                f"{view}={scene['azimuths'][view]:g}",
                "--half-width",
                str(scene["half_width"]),
                "--samples",
                "32",
                "--light",
                "--denoise",
            )
        if has(python, "mitsuba"):
            commands["Mitsuba"] = (
                str(python),
                str(HERE / "in_mitsuba.py"),
                scene["scene"],
                str(done["Mitsuba"]),
                *common,
                view,
                "--samples",
                "64",
            )
        for name, command in commands.items():
            if not done[name].exists():
                in_child(command)
    return {name: np.load(path)["color"][0] for name, path in done.items() if path.exists()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--lights", default="dark,mid,bright", help="bundled lights or lat-long files, by commas")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/sheets"))
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--view", default="front_right")
    parser.add_argument("--peers-python", type=Path)
    asked = parser.parse_args()
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_png
    from gdtool.images.metrics import psnr

    names, rows_of_all = ("gdtool", "Cycles", "Mitsuba"), []
    for light in asked.lights.split(","):
        rows = []
        for model in asked.models:
            title = Path(model).stem.replace(":", "-")
            found = pictures(
                model,
                light,
                asked.output / "work" / Path(light).stem / title,
                asked.size,
                asked.view,
                asked.peers_python,
            )
            shown = {name: srgb_from_linear(np.clip(image, 0, 1)) for name, image in found.items()}
            rows.append([shown.get(name) for name in names])
            if "gdtool" in shown:
                whole = np.ones(shown["gdtool"].shape[:2], bool)
                rows_of_all.append(
                    {
                        "light": light,
                        "model": title,
                        **{
                            f"against {n}": round(psnr(shown["gdtool"], shown[n], whole), 1)
                            for n in names[1:]
                            if n in shown
                        },
                    }
                )
                say(str(rows_of_all[-1]))
            write_png(
                asked.output / f"{Path(light).stem}.png",
                contact_sheet(rows, list(names), [Path(m).stem[:16] for m in asked.models[: len(rows)]]),
            )
    (asked.output / "agreement.json").write_text(json.dumps(rows_of_all, indent=1) + "\n")


if __name__ == "__main__":
    main()
