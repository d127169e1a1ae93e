r"""How good a model is on objects it was not trained on, beside two baselines; a Markdown table for its card.

    gdtool render-dataset procedural:900000..900099 --size 128 --condition-views 3 -o held_out
    python -m benchmarks.train.quality held_out --model my-model --train objects -o docs/benchmarks --install
    gdtool render-dataset $ASSETS/glb/*.glb $ASSETS/gltf/*/*.gltf $(find $ASSETS/gso -name '*.obj' | grep -v _col) \
        --size 128 --samples 8 --light-samples 4 --condition-views 3 -o real
    python -m benchmarks.train.quality real --train objects --steps 1 --name model_quality_real --objects "real \
        models" -o docs/benchmarks
    gdtool render-dataset procedural:900000..900099 --turn 45 --size 128 --condition-views 3 -o turned
    python -m benchmarks.train.quality turned --steps 1 --name model_quality_turned -o docs/benchmarks
    gdtool render-dataset procedural:900100..900399 --size 128 --condition-views 3 -o more
    python -m benchmarks.train.quality held_out more --train objects --steps 1 --name model_quality_400 -o \
        docs/benchmarks

--install puts the model, with the table in its card, where the package finds its bundled model.

Each object's front view is the picture. Figures are means over the five views the model has not seen, each picture
weighing the same: color and albedo PSNR over white, full frame ("frame") and over the true foreground only
("foreground"), in the stored encoding; SSIM of color over white; normals in degrees, depth as a share of the object's
size, both where truth and result are foreground; roughness and metallic mean absolute error over the true foreground;
overlap (intersection over union) of the silhouettes. "six" takes the front view in, as the paper's protocol does.
Baselines: the mean of the training objects' views, and the training object whose front view is nearest (squared error
of the picture over grey). The last columns compare the model's first number of steps with the nearest object by object:
how far it is ahead on average, the standard error of that, the share on which it is. """

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

import msgspec
import numpy as np
import torch

import gdtool.models
from gdtool.cameras import rig
from gdtool.core.folder import open_folder
from gdtool.core.manifest import MANIFEST, list_files
from gdtool.core.manifest import encode as encode_manifest
from gdtool.diffusion.checkpoint.weights import load_model
from gdtool.diffusion.data.objects import decode_object
from gdtool.diffusion.inference import familiarity
from gdtool.diffusion.inference.result import views_from_images
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.encoding import BACKGROUND, encode
from gdtool.folders.views import Views, read_views
from gdtool.images.color import srgb_from_linear
from gdtool.images.metrics import normal_degrees, over_white, psnr, resized_views, scalar_error, ssim

DEFAULT_MODEL = Path(gdtool.models.__file__).parent / "default"


def views_folders(paths: list[Path]) -> list:
    """The views folders among paths and in the datasets among them."""
    found = []
    for path in paths:
        folder = open_folder(path, ("dataset", "views"), "model_quality", check=False)
        if folder.kind == "dataset":
            found += [open_folder(folder.file(one.path), ("views",), check=False) for one in folder.content.objects]
        else:
            found.append(folder)
    return found


def figures(result: Views, truth: Views) -> dict[str, float]:
    """Errors of one object over the views that are not the front one."""
    unseen = [k for k, name in enumerate(truth.names) if name != "front"]
    order = [result.names.index(truth.names[k]) for k in unseen]
    six = [
        (
            over_white(result.images["color"][result.names.index(name)], result.mask[result.names.index(name)]),
            over_white(truth.images["color"][k], truth.mask[k]),
        )
        for k, name in enumerate(truth.names)
    ]
    true, mask = {d: x[unseen] for d, x in truth.images.items()}, truth.mask[unseen]
    own, own_mask = {d: x[order] for d, x in result.images.items()}, result.mask[order]
    out: dict[str, list[float]] = {}
    for k in range(len(unseen)):
        full = mask[k] > 0.99
        for domain in ("color", "albedo"):
            a, b = over_white(own[domain][k], own_mask[k]), over_white(true[domain][k], mask[k])
            out.setdefault(f"{domain}_psnr_frame", []).append(psnr(a, b))
            if full.any():
                a, b = (np.clip(srgb_from_linear(x[domain][k]), 0, 1) for x in (own, true))
                out.setdefault(f"{domain}_psnr_foreground", []).append(psnr(a, b, full))
            if domain == "color":
                out.setdefault("color_ssim_frame", []).append(
                    ssim(over_white(own[domain][k], own_mask[k]), over_white(true[domain][k], mask[k]))
                )
        a, b = own_mask[k] > 0.5, mask[k] > 0.5
        out.setdefault("silhouette_overlap", []).append(float((a & b).sum() / max((a | b).sum(), 1)))
    single = {name: float(np.mean(values)) for name, values in out.items()}
    single["color_psnr_six"], single["color_ssim_six"] = (
        float(np.mean([measure(a, b) for a, b in six])) for measure in (psnr, ssim)
    )
    single["normal_degrees"] = normal_degrees(own["normal"], own_mask, true["normal"], mask)
    both = (own_mask > 0.5) & (mask > 0.99)
    single["depth_error"] = float(np.abs(own["depth"] - true["depth"])[both].mean()) if both.any() else float("nan")
    for domain in ("roughness", "metallic"):
        single[f"{domain}_error"] = scalar_error(own[domain], true[domain], mask)
    return single


def on_shared_pixels(results: list[Views], truth: Views) -> list[dict[str, float]]:
    """Normals' and depth's errors of several results over the same pixels: those that lie on the object in all of them.

    Each result's own figures are taken where it overlaps with the truth; one that leaves out what is hard fares better
    there."""
    unseen = [k for k, name in enumerate(truth.names) if name != "front"]
    order = [[result.names.index(truth.names[k]) for k in unseen] for result in results]
    mask = np.min(
        [truth.mask[unseen], *(result.mask[places] for result, places in zip(results, order, strict=True))], 0
    )
    both = (mask > 0.5) & (truth.mask[unseen] > 0.99)
    return [
        {
            "normal_degrees_shared": normal_degrees(
                result.images["normal"][places], mask, truth.images["normal"][unseen], mask
            ),
            "depth_error_shared": float(
                np.abs(result.images["depth"][places] - truth.images["depth"][unseen])[both].mean()
            )
            if both.any()
            else float("nan"),
        }
        for result, places in zip(results, order, strict=True)
    ]


def decoded(planes: torch.Tensor, config) -> Views:
    """Views of one object from its encoded planes (k, 13, h, w)."""
    indices = tuple(range(6))
    images = encode(planes[None], indices, torch.zeros(1))[0]
    cameras = {camera.name: camera for camera in rig("six", config.image_size)}
    return views_from_images(
        {d: images[i] for i, d in enumerate(config.domains)}, [cameras[n] for n in config.views], 0.0, config.domains
    )[0]


def true_views(folder, size: int) -> Views:
    """The views of a folder at another size, with the cameras of that size."""
    truth, cameras = read_views(folder), {camera.name: camera for camera in rig("six", size)}
    return Views([cameras[name] for name in truth.names], *resized_views(truth.images, truth.mask, size, size))


def sampled_views(model, rgba: torch.Tensor, seed: int, **setting) -> Views:
    """What a model makes of one condition (1, 4, h, w); setting: of SamplingOptions."""
    config = model.config
    cameras = {camera.name: camera for camera in rig("six", config.image_size)}
    images = sample_images(model, rgba, SamplingOptions(seed=seed, **setting))
    return views_from_images(
        {d: x[0].float() for d, x in images.items()},
        [cameras[n] for n in config.views],
        BACKGROUND[config.backgrounds[0]],
        setting.get("domains", config.domains),
        (0.5 + 0.5 * rgba[0, 3]).numpy(),
    )[0]


def nearest_to(condition: torch.Tensor, pictures: list[np.ndarray]) -> int:
    """Which of the pictures (4, h, w) has the least squared error beside a condition of the same shape."""
    return int(np.argmin([float(np.square(p.astype(np.float32) - condition.numpy()).mean()) for p in pictures]))


def leads(own: list[dict[str, float]], other: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """How far one way is ahead of another on the same objects: by how much on average (errors and angles are better
    small), the standard error of that, and the share of the objects on which it is ahead."""
    out: dict[str, dict[str, float]] = {"lead over the nearest": {}, "its standard error": {}, "ahead on": {}}
    for key in own[0]:
        lead = _sign(key) * np.array([a[key] - b[key] for a, b in zip(own, other, strict=True)])
        lead = lead[np.isfinite(lead)]
        values = lead.mean(), lead.std(ddof=1) / len(lead) ** 0.5 if len(lead) > 1 else float("nan"), (lead > 0).mean()
        for column, value in zip(out.values(), values, strict=True):
            column[key] = float(value)
    return out


def report(means: dict[str, dict[str, float]], count: int, size: int, objects: str) -> str:
    """The table as Markdown, with what the paper has beside it, and where the model is not ahead."""
    lines = [
        f"{count} {objects}, the five unseen views, {size} px:",
        "",
        "| | " + " | ".join(means) + " |",
        "|---" * (len(means) + 1) + "|",
    ]
    keys = list(dict.fromkeys(key for row in means.values() for key in row))
    lines += [
        f"| {key.replace('_', ' ')} | "
        + " | ".join(f"{row[key]:.3f}" if key in row else "" for row in means.values())
        + " |"
        for key in keys
    ]
    own = next(iter(means.values()))
    lines += [
        "",
        f'By the paper\'s protocol, which takes the front view in ("six"), color has {own["color_psnr_six"]:.2f} dB '
        f"and SSIM "
        f"{own['color_ssim_six']:.3f}; the paper has 27.93 dB and 0.937, on other objects, with a model a hundred "
        f"times as large.",
    ]
    behind = [
        f"{key.replace('_', ' ')} ({own[key]:.3f} against {means[name][key]:.3f} of the {name})"
        for name in ("nearest training object", "mean training object")
        for key in own
        if key in means.get(name, {}) and _sign(key) * (own[key] - means[name][key]) < 0
    ]
    if behind:
        lines += ["", "Behind: " + "; ".join(behind) + "."]
    return "\n".join(lines) + "\n"


def _sign(key: str) -> int:
    """Errors and angles are better small."""
    return -1 if "error" in key or "degrees" in key else 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--train", nargs="*", type=Path, default=[], help="what it was trained on, for the baselines")
    parser.add_argument("--steps", default="1,4", help="denoising steps to measure")
    parser.add_argument("--scheduler", default="ddim", choices=["ddim", "dpm"])
    parser.add_argument("-o", "--output", type=Path, help="folder for NAME.json and NAME.md")
    parser.add_argument("--name", default="model_quality")
    parser.add_argument(
        "--objects", default="held-out procedural objects", help="what they are, for the table's heading"
    )
    parser.add_argument("--install", action="store_true", help="make it the bundled model")
    parser.add_argument("--note", default="", help="a line for the card: what the data were, how long it took")
    arguments = parser.parse_args()
    model = load_model(arguments.model)
    config = model.config
    table: dict[str, list[dict[str, float]]] = {}
    seconds: dict[str, float] = {}
    trained, pictures, mean = views_folders(arguments.train), [], 0.0  # all their views would not fit into memory
    for folder in trained:
        one, conditions, _ = decode_object(folder, config)
        mean = mean + torch.from_numpy(one) / len(trained)
        pictures.append(conditions[0].astype(np.float16))
    for number, folder in enumerate(views_folders(arguments.held_out)):
        truth = true_views(folder, config.image_size)
        rgba, sampled = torch.from_numpy(decode_object(folder, config)[1][0])[None], []
        for steps in (int(s) for s in arguments.steps.split(",")):
            start = time.perf_counter()
            result = sampled_views(model, rgba, number, steps=steps, scheduler=arguments.scheduler)
            sampled.append(result)
            name = f"model, {steps} step{'s' * (steps > 1)}"
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
            table.setdefault(name, []).append(figures(result, truth))
        if trained:
            nearest = torch.from_numpy(decode_object(trained[nearest_to(rgba[0], pictures)], config)[0])
            sampled.append(decoded(nearest, config))
            table.setdefault("nearest training object", []).append(figures(sampled[-1], truth))
            for rows, shared in zip(table.values(), on_shared_pixels(sampled, truth), strict=False):
                rows[-1] |= shared
            table.setdefault("mean training object", []).append(figures(decoded(mean, config), truth))
        print(f"{number + 1}: {folder.name}", flush=True)
    count = len(next(iter(table.values())))
    means = {
        name: {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]} for name, rows in table.items()
    }
    if trained:
        means |= leads(next(iter(table.values())), table["nearest training object"])
    for name in seconds:
        means[name]["seconds"] = seconds[name] / count
    text = report(means, count, config.image_size, arguments.objects)
    print(text)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / f"{arguments.name}.md").write_text(text)
        (arguments.output / f"{arguments.name}.json").write_text(json.dumps(means, indent=1) + "\n")
    if arguments.install:
        install(arguments.model, text, arguments.note)


def install(source: Path, table: str, note: str) -> None:
    """Copy a model folder into the package: weights, configuration, loss curve and card; its inputs are not shipped."""
    folder = open_folder(source, ("model",))
    if source.resolve() != DEFAULT_MODEL.resolve():
        DEFAULT_MODEL.mkdir(exist_ok=True)
        for name in ("config.json", "model.safetensors", "loss.csv", "loss.png", "card.md", familiarity.RANGES_FILE):
            shutil.copyfile(source / name, DEFAULT_MODEL / name)
    card = (DEFAULT_MODEL / "card.md").read_text().split("## Measured quality")[0].rstrip()
    (DEFAULT_MODEL / "card.md").write_text(f"{card}\n\n## Measured quality\n\n{note}\n\n{table}")
    (DEFAULT_MODEL / MANIFEST).unlink(missing_ok=True)
    manifest = msgspec.structs.replace(folder.manifest, inputs=(), name="default", files=list_files(DEFAULT_MODEL))
    (DEFAULT_MODEL / MANIFEST).write_bytes(encode_manifest(manifest))


if __name__ == "__main__":
    main()
