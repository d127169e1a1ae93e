"""What supervision by rendering and attention across the domains are worth: the same training without them, over seeds.

    python -m benchmarks.train.ablations out/model/small_objects --held-out out/model/held_out -o docs/benchmarks

Every variant is `gdtool train --ablation` at 64 px on the same objects in the same number of steps, for each seed, as
benchmarks/train/training.json says but that all steps see all six domains, since supervision by rendering needs the
maps together, that fewer of them are of pure noise, where it does not act, and that the network is half as wide: it
learns more in the minutes there are. Each model samples the held-out objects' pictures (front view) in one step and in
eight; consistency (gdtool/diffusion/reports/consistency.py: no truth needed) and the error over the five unseen views
(quality.py) are means over the objects, then mean ± standard deviation over the seeds. The last columns are
paired: the variant's figure less the whole method's of the same seed. Trainings are kept in --work and go on where they
were; they may share the machine, only their seconds suffer. Some seven minutes a training on a core."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.measure import gdtool, machine, say, table
from benchmarks.train.figures import figures
from benchmarks.train.held_out import sampled_views, true_views, views_folders
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object
from gdtool.diffusion.reports.consistency import consistency

VARIANTS = {
    "none": "the whole method",
    "no_cross_domain": "no attention across domains",
    "no_pbr": "no supervision by rendering",
}
SIZE = 64
NETWORK = {"channels": [32, 64, 64], "encoder_width": 96}
PHASES = [{"share": 0.5, "domains": 6, "views": 3, "batch": 4}, {"share": 1.0, "domains": 6, "views": 6, "batch": 2}]
STEPS = (1, 8)  # of sampling
SHOWN = {
    "rerendered_psnr": "re-rendered PSNR, dB",
    "slope_degrees": "normals to depth's slopes, °",
    "reprojection_depth": "reprojection",
    "color_psnr_frame": "color PSNR, dB",
    "albedo_psnr_frame": "albedo PSNR, dB",
    "normal_degrees": "normals, °",
    "depth_error": "depth",
}


def trained(variant: str, seed: int, arguments: argparse.Namespace) -> Path:
    """The model folder of one training, trained unless it is there."""
    arguments.work.mkdir(parents=True, exist_ok=True)
    config = arguments.work / "training.json"
    common = json.loads(Path(__file__).with_name("training.json").read_text())["train"]
    config.write_text(
        json.dumps({"model": NETWORK, "train": common | {"phases": PHASES, "pure_noise": 0.4, "ema": 0.99}})
    )
    model = arguments.work / f"{variant}-{seed}"
    gdtool(
        "train",
        *arguments.train,
        "--ablation",
        variant,
        "--size",
        str(SIZE),
        "--steps",
        str(arguments.steps),
        "--seed",
        str(seed),
        "--config",
        config,
        "--held-out",
        "0",
        "--threads",
        "1",
        "-o",
        model,
        "--quiet",
        limit_seconds=24 * 3600,
    )
    return model


def measured(path: Path, held_out: list) -> dict[str, dict[str, float]]:
    """Figures of one model by steps of sampling, means over the held-out objects."""
    model = load_model(path)
    config, found = model.config, {}
    for steps in STEPS:
        rows = []
        for number, folder in enumerate(held_out):
            truth = true_views(folder, SIZE)
            rgba = torch.from_numpy(decode_object(folder, config)[1][0])[None]
            views = sampled_views(model, rgba, number, steps=steps)
            rows.append(consistency(views) | figures(views, truth))
        found[str(steps)] = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
    return found


def spread(values: list[float]) -> str:
    return f"{np.mean(values):.3g} ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else f"{values[0]:.3g}"


def markdown(record: dict) -> str:
    """A table for each number of sampling steps: figures as rows, variants and their paired differences as columns."""
    runs, lines = record["runs"], []
    for steps in map(str, STEPS):
        rows = []
        for key, name in SHOWN.items():
            by_seed = {
                variant: {seed: run[steps][key] for seed, run in runs.get(variant, {}).items()} for variant in VARIANTS
            }
            cells = [spread(list(values.values())) if values else "–" for values in by_seed.values()]
            for variant in list(VARIANTS)[1:]:
                pairs = [
                    by_seed[variant][seed] - value
                    for seed, value in by_seed["none"].items()
                    if seed in by_seed[variant]
                ]
                cells.append(spread(pairs) if pairs else "–")
            rows.append([name, *cells])
        lines += [
            f"Sampled in {steps} step{'s' * (steps != '1')}:",
            "",
            table(["", *VARIANTS.values(), *(f"{name}, less the whole" for name in list(VARIANTS.values())[1:])], rows),
            "",
        ]
    return "\n".join(
        [
            "# What supervision by rendering and attention across the domains are worth",
            "",
            f"{record['steps']} steps of training at {SIZE} px over {record['objects']} objects, seeds "
            f"{', '.join(next(iter(runs.values()), {}))}; "
            f"{record['held_out']} held-out objects, on {machine()}. Mean ± standard deviation over the seeds.",
            "",
            *lines,
            "Higher is better for PSNR, lower for the others. Re-rendered PSNR, slopes and reprojection need no "
            "truth: they say how the "
            "sampled domains and views fit one another.",
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", nargs="+", type=Path, help="objects to train on, as for gdtool train")
    parser.add_argument("--held-out", nargs="+", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=400, help="of each training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=int, default=40, help="held-out objects at most")
    parser.add_argument("--work", type=Path, default=Path("out/ablations"), help="where the trained models are kept")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    held_out = views_folders(arguments.held_out)[: arguments.limit]
    record: dict = {"steps": arguments.steps, "objects": 0, "held_out": len(held_out), "runs": {}}
    arguments.output.mkdir(parents=True, exist_ok=True)
    for seed in range(arguments.seeds):
        for variant in VARIANTS:
            model = trained(variant, seed, arguments)
            kept = model.with_name(f"{model.name}.json")  # figures of this very training, of as many objects
            identity = json.loads((model / "manifest.json").read_text())
            done = json.loads(kept.read_text()) if kept.exists() else {}
            if done.get("of") != [identity["content"]["report"], len(held_out)]:
                done = {"of": [identity["content"]["report"], len(held_out)], "figures": measured(model, held_out)}
                kept.write_text(json.dumps(done))
            record["objects"] = identity["content"]["report"]["objects"]
            record["runs"].setdefault(variant, {})[str(seed)] = done["figures"]
            say(f"  {variant}, seed {seed}")
            (arguments.output / "ablations.json").write_text(json.dumps(record, indent=1) + "\n")
            (arguments.output / "ablations.md").write_text(markdown(record))
    print(markdown(record))


if __name__ == "__main__":
    main()
