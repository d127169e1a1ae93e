"""Time, memory and error of every stage and of the whole, image to asset and model to asset, at three quality settings.

    python -m benchmarks.pipeline.sweep                    two procedural objects; writes docs/benchmarks/pipeline.*
    python -m benchmarks.pipeline.sweep --seeds 5 --models DIR       more of them, and models of your own
    python -m benchmarks.pipeline.sweep --ways model --qualities default -o /tmp/report
    python -m benchmarks.pipeline.sweep --ways image --model MY_MODEL       another model than the bundled one

The procedural objects come from seeds that the bundled model is not trained on. The truth is the model itself; for the
image to asset way the image is a picture of it, from the front at a random elevation, as photographs are. Evaluation is
not part of the times. Runs are one after another: do not use the machine for anything else meanwhile.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.common.measure import ROOT, Failed, busy, evaluate, gdtool, machine, number, say, seconds_axis, table

FIRST_SEED = 3_000_000
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
WAYS = {
    "model": ("render-dataset", "reconstruct", "remesh", "unwrap", "bake", "relight"),
    "image": ("sample-views", "reconstruct", "remesh", "unwrap", "bake", "relight"),
}
QUALITIES = {
    "fast": {
        "render-dataset": ["--size", "128", "--samples", "4", "--light-samples", "4"],
        "sample-views": ["--steps", "1", "--precision", "bfloat16"],
        "remesh": ["--faces", "5000"],
        "unwrap": ["--size", "512"],
        "bake": ["--size", "512", "--ao-rays", "16"],
        "relight": ["--size", "256"],
    },
    "default": {},
    "fine": {
        "render-dataset": ["--size", "512", "--samples", "32"],
        "sample-views": ["--steps", "8"],
        "remesh": ["--faces", "50000"],
        "unwrap": ["--size", "4096"],
        "bake": ["--size", "4096", "--samples", "4"],
        "relight": ["--size", "1024"],
    },
}
# Figures of `gdtool evaluate` in the tables: name, heading, factor.
FIGURES = (
    ("surface_distance", "distance, 1e-3", 1e3),
    ("seen_distance", "seen, 1e-3", 1e3),
    ("surface_iou", "IoU", 1),
    ("albedo_psnr_masked", "albedo dB", 1),
    ("color_psnr_masked", "color dB", 1),
    ("roughness_error", "roughness", 1),
    ("metallic_error", "metallic", 1),
    ("normal_degrees", "normal °", 1),
)


def walk(way: str, quality: str, source: str, truth: str, model: list[str], folder: Path, record: dict) -> None:
    """Take one source through all stages of a way; `record` gets each stage's cost and error as they come. Raises
    Failed."""
    options, place, whole = QUALITIES[quality], source, 0.0
    for stage in WAYS[way]:
        target = folder / stage
        cost = gdtool(
            stage, place, "-o", target, "--quiet", *options.get(stage, ()), *(model if stage == "sample-views" else ())
        )
        place, whole = str(target), whole + cost.seconds
        record[stage] = {"seconds": cost.seconds, "peak_mb": cost.peak_mb, **errors(stage, way, target, truth, folder)}
        say(
            f"    {stage:<15}{cost.seconds:8.1f} s {cost.peak_mb:7.0f} MB  "
            + "  ".join(
                f"{head} {number(record[stage][name] * factor)}"
                for name, head, factor in FIGURES
                if name in record[stage]
            )
        )
    best = record["bake"]
    record["whole"] = {
        "seconds": whole,
        "peak_mb": max(step["peak_mb"] for step in record.values()),
        **{name: best[name] for name, _, _ in FIGURES if name in best},
    }


def errors(stage: str, way: str, target: Path, truth: str, folder: Path) -> dict:
    """What `gdtool evaluate` says of a stage's result against the truth."""
    if stage == "sample-views":
        size = json.loads((target / "cameras.json").read_text())["cameras"][0]["width"]
        true_views = folder / "truth"
        gdtool("render-dataset", truth, "-o", true_views, "--size", str(size), "--quiet")
        report = evaluate(target, "--reference", true_views)
    elif stage in ("reconstruct", "remesh", "bake"):
        arguments = ["--no-syncdreamer", "--samples", "50000"]
        if way == "image":  # the pictures it was made from were invented: measure against true ones
            arguments += ["--reference", truth, "--views", folder / "truth"]
        report = evaluate(target, *arguments)
    else:  # the truth itself, a mesh that only got texture coordinates, and pictures in another light
        return {}
    return {name: report[name] for name, _, _ in FIGURES if isinstance(report.get(name), (int, float))}


def picture_of(truth: str, folder: Path) -> Path:
    """A photograph-like image of a model."""
    views = folder / "picture"
    gdtool(
        "render-dataset", truth, "-o", views, "--size", "512", "--condition-views", "1", "--domains", "color", "--quiet"
    )
    return views / "condition" / "000.png"


def measure(ways: list[str], qualities: list[str], sources: list[str], model: list[str], publish) -> list[dict]:
    """One record per way, quality and source; publish(records) after each."""
    records: list[dict] = []
    for truth in sources:
        for way in ways:
            for quality in qualities:
                say(f"  {way} to asset, {quality}: {truth}")
                stages: dict = {}
                record = {"way": way, "quality": quality, "source": Path(truth).name, "stages": stages}
                with tempfile.TemporaryDirectory() as folder:
                    try:
                        source = str(picture_of(truth, Path(folder))) if way == "image" else truth
                        walk(way, quality, source, truth, model, Path(folder), stages)
                    except Failed as error:
                        record["failed"] = str(error)
                        say(f"    failed: {error}")
                records.append(record)
                publish(records)
    return records


def summary(records: list[dict]) -> list[dict]:
    """Median over sources of each figure, a row per way, quality and stage; failed runs count where they came to."""
    rows = []
    for way in WAYS:
        for quality in QUALITIES:
            group = [r for r in records if (r["way"], r["quality"]) == (way, quality)]
            for stage in (*WAYS[way], "whole"):
                steps = [r["stages"][stage] for r in group if stage in r["stages"]]
                names = {name for step in steps for name in step}
                if steps:
                    rows.append(
                        {
                            "way": way,
                            "quality": quality,
                            "stage": stage,
                            "sources": len(steps),
                            **{name: median(step[name] for step in steps if name in step) for name in sorted(names)},
                        }
                    )
    return rows


def markdown(records: list[dict], remark: str = "") -> str:
    """The report that stands in docs/benchmarks/pipeline.md."""
    rows = summary(records)
    text = [
        "# Pipeline: time against error",
        "",
        f"By `make bench` on {machine()}. Medians over the sources; peak memory is the largest process's.",
        "Distance is the mean of both directions to the true surface, largest extent 1; seen: over what the six "
        "views see;",
        "pictures are compared inside the object. The whole's errors are the baked asset's. `docs/metrics.md` "
        "defines each figure.",
        remark,
        "",
    ]
    for way in WAYS:
        for quality in QUALITIES:
            group = [row for row in rows if (row["way"], row["quality"]) == (way, quality)]
            if not group:
                continue
            flags = "; ".join(
                f"{stage} {' '.join(values)}" for stage, values in QUALITIES[quality].items() if stage in WAYS[way]
            )
            text += [
                f"## {way.capitalize()} to asset, {quality}",
                "",
                f"{group[0]['sources']} sources. {flags or 'All options at their defaults'}.",
                "",
            ]
            shown = [figure for figure in FIGURES if any(figure[0] in row for row in group)]
            text += [
                table(
                    ["stage", "seconds", "peak MB", *(head for _, head, _ in shown)],
                    [
                        [
                            row["stage"],
                            number(row["seconds"]),
                            f"{row['peak_mb']:.0f}",
                            *(number(row[name] * factor if name in row else None) for name, _, factor in shown),
                        ]
                        for row in group
                    ],
                ),
                "",
            ]
    failed = [r for r in records if "failed" in r]
    if failed:
        text += ["## Failed", "", *(f"- {r['way']}, {r['quality']}, {r['source']}: {r['failed']}" for r in failed), ""]
    text += [
        "## Sources",
        "",
        ", ".join(dict.fromkeys(r["source"] for r in records)),
        "",
        "![time against error](pipeline.png)",
        "",
    ]
    return "\n".join(text)


def plot(records: list[dict], path: Path) -> None:
    """Whole seconds against the asset's error: every source a point, medians joined over the qualities."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = [
        ("surface_distance", "distance to the true surface", True),
        ("seen_distance", "over the part that the views see", True),
        ("albedo_psnr_masked", "albedo PSNR, dB", False),
    ]
    figure, axes = plt.subplots(1, len(panels), figsize=(14, 4), layout="constrained")
    rows = summary(records)
    for axis, (name, label, logarithmic) in zip(axes, panels, strict=True):
        for color, way in (("tab:blue", "model"), ("tab:orange", "image")):
            points = [
                (r["stages"]["whole"]["seconds"], r["stages"]["whole"][name])
                for r in records
                if r["way"] == way and name in r["stages"].get("whole", {})
            ]
            middle = [
                (row["seconds"], row[name], row["quality"])
                for row in rows
                if row["way"] == way and row["stage"] == "whole" and name in row
            ]
            if not middle:
                continue
            axis.scatter(*zip(*points, strict=True), s=10, alpha=0.4, color=color)
            axis.plot([m[0] for m in middle], [m[1] for m in middle], "o-", color=color, label=f"{way} to asset")
            for seconds, value, quality in middle:
                axis.annotate(quality, (seconds, value), textcoords="offset points", xytext=(5, 5), fontsize=8)
        seconds_axis(axis)
        axis.set(yscale="log" if logarithmic else "linear", ylabel=label)
        axis.margins(0.15)
        axis.grid(alpha=0.3, which="both")
        if axis.get_legend_handles_labels()[0]:
            axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=2, help="number of procedural objects (default 2)")
    parser.add_argument(
        "--models", type=Path, action="append", default=[], metavar="DIR", help="also every model in this folder"
    )
    parser.add_argument(
        "--model", type=Path, metavar="DIR", help="model folder for sample-views (default the bundled one)"
    )
    parser.add_argument("--ways", default=",".join(WAYS), help="which of model,image (default both)")
    parser.add_argument("--qualities", default=",".join(QUALITIES), help="which of fast,default,fine (default all)")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=ROOT / "docs" / "benchmarks",
        help="folder of the report",
    )
    given = parser.parse_args()
    for name, known in (("ways", WAYS), ("qualities", QUALITIES)):
        chosen = getattr(given, name).split(",")
        if unknown := set(chosen) - set(known):
            parser.error(f"--{name}: {', '.join(sorted(unknown))} is none of {', '.join(known)}")
        setattr(given, name, chosen)
    return given


def main() -> None:
    given = arguments()
    sources = [f"procedural:{FIRST_SEED + i}" for i in range(given.seeds)]
    sources += [
        str(path)
        for folder in given.models
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in MODEL_SUFFIXES
    ]
    given.output.mkdir(parents=True, exist_ok=True)

    remark = busy()

    def publish(records: list[dict]) -> None:
        (given.output / "pipeline.json").write_text(
            json.dumps({"machine": machine(), "remark": remark, "records": records}, indent=1) + "\n"
        )
        (given.output / "pipeline.md").write_text(markdown(records, remark))

    records = measure(
        given.ways, given.qualities, sources, ["--model", str(given.model)] if given.model else [], publish
    )
    plot(records, given.output / "pipeline.png")
    say(f"{given.output / 'pipeline.md'}")


if __name__ == "__main__":
    main()
