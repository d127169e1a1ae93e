r"""Whether the warnings of sample-views tell which pictures a model does badly, and the limits above which it warns.

    DOMAINS=color,normal,depth,albedo,roughness,metallic
    gdtool render-dataset procedural:950000..950299 --size 128 --samples 4 --light-samples 4 --domains $DOMAINS -o \
        validation
    python -m benchmarks.sample_views.doubt held_out --model my-model --calibrate validation --real real --photographs \
        $ASSETS/images -o docs/benchmarks

held_out and real are those of benchmarks/train/quality.py; photographs are pictures with alpha, whose truth nobody
knows. --calibrate: objects that the model was neither trained nor is measured on. The limits that one in twenty of them
passes are written to the model's pictures.json, beside the ranges of its training pictures that gdtool train wrote
(both familiarity.py), before anything is measured; without it, those that are there are measured. So do it before
benchmarks.train.install.

A warning is worth something when the results that it is given for are bad ones. For each figure: its rank correlation
(Spearman) with the errors of the five unseen views, over held-out and real objects; and how often it is higher for a
real model, a photograph, or a result with an error above a limit than for a held-out object or a result below it (area
under the curve, 0.5: no better than chance). For each warning: whom it is given to, and the errors with and without it.
Twelve minutes on one quiet core, half of them for --calibrate."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec
import numpy as np
import torch
from scipy.stats import rankdata, spearmanr

from benchmarks.sample_views.sheets import photograph
from benchmarks.train.figures import figures
from benchmarks.train.held_out import DEFAULT_MODEL, true_views, views_folders
from gdtool.cameras import rig
from gdtool.core.folder import open_folder
from gdtool.core.manifest import MANIFEST, encode, list_files
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object
from gdtool.diffusion.inference.familiarity import (
    DOUBTS,
    RANGES_FILE,
    describe_doubts,
    describe_unfamiliar,
    read_ranges,
    usual_ranges,
    write_ranges,
)
from gdtool.diffusion.inference.result import views_from_images
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.encoding import BACKGROUND
from gdtool.folders.views import Views
from gdtool.images.io import read_image

ALARMS = 0.05  # share of the objects like those in training that may be warned of
ERRORS = ("normal_degrees", "depth_error", "color_psnr_frame", "silhouette_overlap")
BAD = {
    "normals 25 degrees off": ("normal_degrees", 25.0),
    "depth .08 off": ("depth_error", 0.08),
    "overlap below .8": ("silhouette_overlap", 0.8),
}


def result_of(model, condition: np.ndarray) -> tuple[Views, dict[str, float]]:
    """What sample-views makes of a condition (4, h, w) without options, and its report."""
    config = model.config
    cameras = {camera.name: camera for camera in rig("six", config.image_size)}
    rgba = torch.from_numpy(np.ascontiguousarray(condition, np.float32))[None]
    images = sample_images(model, rgba, SamplingOptions(domains=config.domains, steps=config.sampling_steps))
    return views_from_images(
        {d: x[0] for d, x in images.items()},
        [cameras[n] for n in config.views],
        BACKGROUND[config.backgrounds[0]],
        config.domains,
        0.5 + 0.5 * condition[3],
    )


def measured(model, folders: list[Path]) -> list[dict]:
    """Each object's condition, report and errors."""
    out = []
    for folder in views_folders(folders):
        condition = decode_object(folder, model.config)[1][0]
        views, report = result_of(model, condition)
        out.append(
            {
                "condition": condition,
                "report": report,
                "errors": figures(views, true_views(folder, model.config.image_size)),
            }
        )
        print(f"{len(out)}: {folder.path}", flush=True)
    return out


def calibrate(model, path: Path, folders: list[Path]) -> None:
    """Write the limits that the share ALARMS of these objects passes to a model folder."""
    reports = [result_of(model, decode_object(folder, model.config)[1][0])[1] for folder in views_folders(folders)]
    folder = open_folder(path, ("model",))
    write_ranges(path / RANGES_FILE, read_ranges(path) | usual_ranges(reports, ALARMS))
    (path / MANIFEST).unlink()
    (path / MANIFEST).write_bytes(encode(msgspec.structs.replace(folder.manifest, files=list_files(path))))


def higher(low: np.ndarray, high: np.ndarray) -> float:
    """How often a value of the second is above one of the first, ties counted half: the area under the curve (Mann and
    Whitney)."""
    ranks = rankdata(np.concatenate([low, high]))[len(low) :]
    return (
        float((ranks.sum() - len(high) * (len(high) + 1) / 2) / (len(low) * len(high)))
        if len(low) and len(high)
        else float("nan")
    )


def tables(held: list[dict], real: list[dict], photographs: list[dict], known: dict) -> str:
    """The two tables as Markdown."""
    both = held + real
    error = {name: np.array([one["errors"][name] for one in both]) for name in ERRORS}
    lines = [
        f"{len(held)} held-out procedural objects, {len(real)} real models, {len(photographs)} photographs.",
        "",
        "| figure | "
        + " | ".join(f"rank correlation with {name.replace('_', ' ')}: all, held out" for name in ERRORS)
        + " | above for real models | above for photographs | "
        + " | ".join(f"above for {name}" for name in BAD)
        + " |",
        "|---" * (len(ERRORS) + len(BAD) + 3) + "|",
    ]
    for name in DOUBTS:
        values, own, others = (np.array([one["report"][name] for one in rows]) for rows in (both, held, photographs))
        cells = [
            f"{spearmanr(values, e, nan_policy='omit')[0]:.2f}, "
            f"{spearmanr(own, e[: len(held)], nan_policy='omit')[0]:.2f}"
            for e in error.values()
        ]
        cells += [f"{higher(own, x):.2f}" for x in (values[len(held) :], others)]
        for figure, limit in BAD.values():
            bad = error[figure] < limit if figure == "silhouette_overlap" else error[figure] > limit
            cells.append(f"{higher(values[~bad], values[bad]):.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "| warning | held out | real models | photographs | "
        + " | ".join(f"{name.replace('_', ' ')}, with and without" for name in ERRORS)
        + " |",
        "|---" * (len(ERRORS) + 4) + "|",
    ]
    warnings = {"the picture is unlike those in training": lambda one: describe_unfamiliar(one["condition"], known)}
    warnings |= {
        f"{name} above {known[name].high:.3g}": lambda one, name=name: describe_doubts(
            {name: one["report"][name]}, known
        )
        for name in DOUBTS
        if name in known
    }
    warnings["the model is unsure: any of these"] = lambda one: describe_doubts(one["report"], known)
    for name, says in warnings.items():
        told = np.array([bool(says(one)) for one in both])
        cells = [
            f"{np.mean([bool(says(one)) for one in rows]):.2f}" if rows else "" for rows in (held, real, photographs)
        ]
        cells += [
            f"{np.nanmean(e[told]):.3g}, {np.nanmean(e[~told]):.3g}" if told.any() else f", {np.nanmean(e):.3g}"
            for e in error.values()
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--calibrate", nargs="+", type=Path, default=[], help="objects to set the limits by")
    parser.add_argument(
        "--real", nargs="+", type=Path, default=[], help="objects of another kind than those in training"
    )
    parser.add_argument("--photographs", type=Path, help="folder with pictures")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for model_doubt.md")
    arguments = parser.parse_args()
    model = load_model(arguments.model)
    if arguments.calibrate:
        calibrate(model, arguments.model, arguments.calibrate)
    paths = sorted(arguments.photographs.rglob("*.png")) if arguments.photographs else []
    pictures = [photograph(path, model.config.image_size) for path in paths if read_image(path).shape[-1] == 4]
    photographs = [{"condition": one, "report": result_of(model, one)[1]} for one in pictures]
    text = tables(
        measured(model, arguments.held_out),
        measured(model, arguments.real) if arguments.real else [],
        photographs,
        read_ranges(arguments.model),
    )
    print(text)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "model_doubt.md").write_text(text)


if __name__ == "__main__":
    main()
