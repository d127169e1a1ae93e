"""Six views, time against error: the buffers and the lit color of render-dataset by samples, beside Cycles and Mitsuba.

  python -m benchmarks.render_dataset.sweep MODEL.glb ENV.hdr [--peers-python PYTHON] [-o docs/benchmarks] [--size 512]

PYTHON is one that can import bpy, mitsuba or both; what it lacks is left out. All views are timed; errors are of the
views of --scored, since references are slow. Cycles' buffers are measured twice: alone, without any light, and from the
one picture that has its color too. About 15 minutes on two quiet cores. A killed run goes on where it was."""

from __future__ import annotations

import sys

from benchmarks.common.measure import say
from benchmarks.common.render.comparison import HERE, Job, arguments, comparison, has, run, write
from benchmarks.common.render.scene import exported

VIEWS = "front,front_right,right,back,left,front_left"
BUFFERS = ("normal", "albedo", "roughness", "metallic")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--views", default=VIEWS)
    parser.add_argument("--scored", default="front_right", help="views that errors are taken of")
    asked = parser.parse_args()
    scene = exported(asked.model, asked.env, asked.output / ".render")
    own = (
        sys.executable,
        "-m",
        "benchmarks.common.render.in_gdtool",
        asked.model,
        asked.env,
        "{out}",
        "--size",
        str(asked.size),
    )
    references, jobs = {}, []

    def views(of: str, azimuths: bool = False) -> tuple[str, ...]:
        return ("--views", ",".join(f"{v}={scene['azimuths'][v]:g}" if azimuths else v for v in of.split(",")))

    references["gdtool"] = (
        *own,
        *views(asked.scored),
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
    jobs += [
        Job("gdtool buffers", s, (*own, *views(asked.views), "--samples", str(s)), "gdtool")
        for s in (4, 8, 16, 24, 32, 64)
    ]
    jobs += [
        Job(
            "gdtool color",
            s,
            (*own, *views(asked.views), "--samples", str(s), "--light", "sampled", "--light-samples", str(k)),
            "gdtool",
            {"directions": k},
        )
        for s, k in ((4, 4), (4, 8), (8, 4), (8, 8), (16, 8))
    ]
    python = asked.peers_python
    if has(python, "mitsuba"):
        mitsuba = (str(python), str(HERE / "in_mitsuba.py"), scene["scene"], "{out}", "--size", str(asked.size))
        references["Mitsuba"] = (*mitsuba, *views(asked.scored), "--samples", "2048", "--seed", "77")
        jobs += [
            Job("Mitsuba color", s, (*mitsuba, *views(asked.views), "--samples", str(s)), "Mitsuba")
            for s in (4, 16, 64, 256)
        ]
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
        )
        everything = views(asked.views, True)
        references["Cycles buffers"] = (
            *cycles,
            *views(asked.scored, True),
            "--samples",
            str(asked.reference),
            "--seed",
            "77",
            "--buffers",
        )
        references["Cycles color"] = (
            *cycles,
            *views(asked.scored, True),
            "--samples",
            "512",
            "--seed",
            "77",
            "--light",
            "--buffers",
        )
        jobs += [
            Job("Cycles buffers", s, (*cycles, *everything, "--samples", str(s), "--buffers"), "Cycles buffers")
            for s in (4, 16, 64)
        ]
        jobs += [
            Job(
                "Cycles buffers and color",
                s,
                (*cycles, *everything, "--samples", str(s), "--light", "--buffers"),
                "Cycles color",
            )
            for s in (4, 16, 64)
        ]
        jobs += [
            Job(
                "Cycles color, denoised",
                s,
                (*cycles, *everything, "--samples", str(s), "--light", "--denoise"),
                "Cycles color",
            )
            for s in (4, 16)
        ]
    missing = [name for name, module in (("Mitsuba", "mitsuba"), ("Cycles", "bpy")) if not has(python, module)]
    if missing:
        say(f"without {' and '.join(missing)}: see --peers-python")

    def finish(rows: list[dict], head: list[str]) -> None:
        for row in rows:
            row["worst buffer"] = min((row[d] for d in BUFFERS if d in row), default=None)
        note = [f"Without {' and '.join(missing)}."] if missing else []
        findings = [
            *note,
            f"Model {asked.model} ({scene['faces']} triangles) under {asked.env}, {len(asked.views.split(','))} "
            f"views of {asked.size}²; errors of {asked.scored}.",
            "",
            *comparison(rows, "worst buffer", 45, ["gdtool buffers"], ["Cycles buffers"]),
            *comparison(rows, "worst buffer", 45, ["gdtool buffers"], ["Cycles buffers and color"]),
            *comparison(
                rows,
                "color",
                40,
                ["gdtool color"],
                ["Mitsuba color", "Cycles buffers and color", "Cycles color, denoised"],
            ),
        ]
        write(
            asked.output,
            "render",
            "Six views",
            rows,
            head,
            [
                "method",
                "samples",
                "directions",
                "wall s",
                "cpu s",
                *BUFFERS,
                "depth",
                "worst buffer",
                "color",
                "color inside",
                "runs",
            ],
            [("buffers, the worst one", "worst buffer"), ("lit color", "color")],
            findings,
        )

    key = {
        "model": asked.model,
        "env": asked.env,
        "size": asked.size,
        "views": asked.views,
        "scored": asked.scored,
        "reference": asked.reference,
        "jobs": [" ".join(job.command) for job in jobs],
    }
    run(asked.output, "render", references, jobs, key, finish, asked.repeats)


if __name__ == "__main__":
    main()
