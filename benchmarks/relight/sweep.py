"""Relighting, time against error: gdtool's three kinds of light and their knobs, beside Cycles and Mitsuba.

  python -m benchmarks.relight.sweep MODEL.glb ENV.hdr [--peers-python PYTHON] [-o docs/benchmarks] [--size 512]

PYTHON is one that can import bpy, mitsuba or both; what it lacks is left out. About 8 minutes on two quiet cores. A
killed run goes on where it was."""

from __future__ import annotations

import sys

from benchmarks.common.measure import say
from benchmarks.common.render.comparison import HERE, Job, arguments, comparison, has, run, write
from benchmarks.common.render.scene import exported

SETTINGS = [
    ("sg", 4, 0),
    *(("prefiltered", s, k) for s, k in ((4, 0), (4, 1), (4, 2), (16, 4))),
    *(("sampled", s, k) for s, k in ((4, 2), (4, 4), (4, 8), (8, 4), (8, 8), (16, 8), (64, 8))),
]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--view", default="front_right")
    asked = parser.parse_args()
    scene = exported(asked.model, asked.env, asked.output / ".relight")
    own = (
        sys.executable,
        "-m",
        "benchmarks.common.render.in_gdtool",
        asked.model,
        asked.env,
        "{out}",
        "--size",
        str(asked.size),
        "--views",
        asked.view,
    )
    references = {
        "gdtool": (
            *own,
            "--samples",
            str(asked.reference),
            "--light",
            "sampled",
            "--light-samples",
            "8",
            "--seed",
            "77",
            "--converged",
        )
    }
    jobs = [
        Job(
            f"gdtool {light}",
            s,
            (*own, "--samples", str(s), "--light", light, "--light-samples", str(k)),
            "gdtool",
            {"directions": k},
        )
        for light, s, k in SETTINGS
    ]
    python = asked.peers_python
    if has(python, "mitsuba"):
        mitsuba = (
            str(python),
            str(HERE / "in_mitsuba.py"),
            scene["scene"],
            "{out}",
            "--size",
            str(asked.size),
            "--views",
            asked.view,
        )
        references["Mitsuba"] = (*mitsuba, "--samples", "2048", "--seed", "77")
        jobs += [Job("Mitsuba", s, (*mitsuba, "--samples", str(s)), "Mitsuba") for s in (4, 16, 64, 256)]
    if has(python, "bpy"):
        cycles = (
            str(python),
            str(HERE / "in_blender.py"),
            scene["model"],
            scene["light"],
            "{out}",
            "--size",
            str(asked.size),
            "--half-width",
            str(scene["half_width"]),
            "--views",
            f"{asked.view}={scene['azimuths'][asked.view]:g}",
            "--light",
        )
        references["Cycles"] = (*cycles, "--samples", "512", "--seed", "77")
        jobs += [Job("Cycles", s, (*cycles, "--samples", str(s)), "Cycles") for s in (16, 64)]
        jobs += [Job("Cycles, denoised", s, (*cycles, "--samples", str(s), "--denoise"), "Cycles") for s in (4, 16, 64)]
    missing = [name for name, module in (("Mitsuba", "mitsuba"), ("Cycles", "bpy")) if not has(python, module)]
    if missing:
        say(f"without {' and '.join(missing)}: see --peers-python")

    def finish(rows: list[dict], head: list[str]) -> None:
        note = [f"Without {' and '.join(missing)}."] if missing else []
        peers = ["Mitsuba", "Cycles", "Cycles, denoised"]
        quick = [row for row in rows if row["method"] == "gdtool prefiltered" and row["color"] >= 30]
        best = min(quick, key=lambda row: row["wall s"], default=None)
        findings = [
            *note,
            f"Model {asked.model} ({scene['faces']} triangles) under {asked.env}, {asked.size}², {asked.view}.",
            "",
            *comparison(rows, "color", 40, ["gdtool sampled"], peers),
            *comparison(rows, "color inside", 35, ["gdtool sampled"], peers),
            "* prefiltered: "
            + (
                f"{best['color']:.1f} dB in {best['wall s']:.2f} s ({best['cpu s']:.2f} s of processor)."
                if best
                else "30 dB are not reached."
            ),
        ]
        write(
            asked.output,
            "relight",
            "Relighting",
            rows,
            head,
            ["method", "samples", "directions", "wall s", "cpu s", "color", "color inside", "runs"],
            [("whole picture", "color"), ("inside", "color inside")],
            findings,
        )

    key = {
        "model": asked.model,
        "env": asked.env,
        "size": asked.size,
        "view": asked.view,
        "reference": asked.reference,
        "jobs": [" ".join(job.command) for job in jobs],
    }
    run(asked.output, "relight", references, jobs, key, finish, asked.repeats)


if __name__ == "__main__":
    main()
