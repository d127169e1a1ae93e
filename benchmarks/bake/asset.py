"""The finished asset against the model it was made from, and against itself in Blender.

    python -m benchmarks.bake.asset [MODEL_OR_FOLDER ...] [--peers-python PATH] [-o docs/benchmarks] [--minutes 12]

Each case of cases.py (a model, and the quad mesh that gdtool's remesh and unwrap made of it) is baked by `gdtool
bake` as a user runs it, 2048², with three coarser levels. Source and asset are then rendered alike from twelve
azimuths under three lights, and compared: masked PSNR of the lit pictures (docs/metrics.md). With --peers-python (a
Python that has bpy) Blender loads asset.glb and renders it from two sides, its base color without light and the whole
lit; both are compared with gdtool's own pictures of the asset; so does three.js where tests/tools has its npm
packages (tests/tools/compare_shown.py). shape: how far the quad mesh lies from the model, which no map can mend.
Writes asset.md, asset.json and asset.jpg (the charts, and the pictures side by side) row by row: killed, or out of
--minutes, it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bake.cases import Case, case_of, read_low
from benchmarks.bake.sweep import has_detail
from benchmarks.common.fine_meshes import models_in
from benchmarks.common.measure import ROOT, Failed, busy, gdtool, machine, number, say, table
from benchmarks.common.resumable_rows import Rows
from benchmarks.common.wireframe import file_name
from gdtool.geometry.meshes import TriMesh

LIGHTS = ("dark", "mid", "bright")
VIEWS = 12
QUIET, MOST = 40.0, 16  # dB: pictures whose noise is more get four times the samples, and again, up to so many times
PEER_VIEWS = "front_right,back"
RENDER = ROOT / "benchmarks/common/render"
PEER = RENDER / "in_blender.py"
TOOLS = ROOT / "tests/tools"
LABELS = ["charts", *(f"{what}, {light}" for light in LIGHTS for what in ("source", "asset")), "asset", "in Blender"]
COLUMNS = (
    "model",
    "seconds",
    "peak MB",
    *LIGHTS,
    "worst view",
    "floor",
    "base color dB",
    "roughness",
    "metallic",
    "normal deg",
    "shape",
    "lod3 drift",
    "Blender base color dB",
    "Blender lit dB",
    "three.js base color dB",
    "three.js lit dB",
)
BUFFERS = ("albedo", "roughness", "metallic", "normal")


def lit(
    scene, light: str, size: int, samples: int, threads: int, views: slice = slice(None)
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Views.images of a scene under a light (color linear, and the material buffers, (k, h, w[, c])), and its
    coverage."""
    from gdtool.shading.lights.studio import studio
    from gdtool.shading.render.direct import DirectLight, LightOptions
    from gdtool.shading.render.render import Renderer
    from gdtool.shading.render.rigs import turntable

    renderer = Renderer(scene, threads)
    color = DirectLight(renderer, studio(light, 0, fit=False)[0], 8, 0, options=LightOptions("prefiltered")).color()
    frames = [renderer.buffers(camera, samples, color) for camera in turntable(VIEWS, size, 10.0)[views]]
    stacked = {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}
    return stacked, stacked.pop("mask")


def noise(scene, light: str, size: int, samples: int, threads: int) -> float:
    """PSNR in dB of one view with so many samples beside the same with four times as many."""
    from gdtool.images.metrics import color_metrics

    (one, covered), (finer, finely) = (
        lit(scene, light, size, times * samples, threads, slice(1, 2)) for times in (1, 4)
    )
    return color_metrics(one["color"], covered, finer["color"], finely)["psnr_masked"]


def relit(case: Case, asset: Path, size: int, samples: int) -> tuple[dict[str, float], list[np.ndarray]]:
    """Errors of the asset's pictures, and one picture of each for the sheet."""
    from gdtool.assets.load import load_scene
    from gdtool.images.metrics import color_metrics, over_white, views_metrics

    threads, out, pictures, worst, floor = len(os.sched_getaffinity(0)), {}, [], 100.0, 100.0
    truth, result = load_scene(case.glb), load_scene(asset / "asset.glb")
    for light in LIGHTS:
        count = samples
        while (quiet := noise(truth, light, size, count, threads)) < QUIET and count < MOST * samples:
            count *= 4
        floor = min(floor, quiet)
        (true, true_mask), (ours, mask) = (
            lit(truth, light, size, count, threads),
            lit(result, light, size, count, threads),
        )
        each = [
            color_metrics(ours["color"][k : k + 1], mask[k : k + 1], true["color"][k : k + 1], true_mask[k : k + 1])[
                "psnr_masked"
            ]
            for k in range(VIEWS)
        ]
        out[light], worst = float(np.mean(each)), min(worst, *each)
        pictures += [over_white(true["color"][1], true_mask[1]), over_white(ours["color"][1], mask[1])]
    buffers = views_metrics({k: ours[k] for k in BUFFERS}, mask, {k: true[k] for k in BUFFERS}, true_mask)
    out |= {
        "worst view": worst,
        "floor": floor,
        "base color dB": buffers["albedo_psnr_masked"],
        "roughness": buffers["roughness_error"],
        "metallic": buffers["metallic_error"],
        "normal deg": buffers["normal_degrees"],
    }
    return out, pictures


def beside_blender(
    python: Path, asset: Path, folder: Path, size: int, samples: int
) -> tuple[dict[str, float], list[np.ndarray]]:
    """How near gdtool's pictures of the asset are to Blender's, over the pixels that both see in full."""
    from benchmarks.common.render.scene import exported
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.metrics import FULL, over_white, psnr

    scene = exported(str(asset / "asset.glb"), "mid", folder)
    common = ["--size", str(size), "--samples", str(samples)]
    views = ",".join(f"{view}={scene['azimuths'][view]:g}" for view in PEER_VIEWS.split(","))
    for command in (
        [
            python,
            PEER,
            scene["model"],
            scene["light"],
            folder / "blender.npz",
            "--views",
            views,
            "--half-width",
            scene["half_width"],
            "--light",
            "--buffers",
            *common,
        ],
        [
            sys.executable,
            "-m",
            "benchmarks.common.render.in_gdtool",
            scene["model"],
            "mid",
            folder / "own.npz",
            "--views",
            PEER_VIEWS,
            "--light",
            "sampled",
            "--light-samples",
            "8",
            *common,
        ],
    ):
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=200, check=False)
        if done.returncode:
            raise Failed((done.stderr.strip().splitlines() or ["no message"])[-1])
    theirs, own = (dict(np.load(folder / name)) for name in ("blender.npz", "own.npz"))
    where = (theirs["mask"] > FULL) & (own["mask"] > FULL)
    stored = {
        name: [np.clip(srgb_from_linear(one[name]), 0, 1) for one in (theirs, own)] for name in ("albedo", "color")
    }
    pictures = [
        over_white(one["color"][0] / np.maximum(one["mask"][0], 1e-3)[..., None], one["mask"][0])
        for one in (own, theirs)
    ]
    return {
        "Blender base color dB": psnr(*stored["albedo"], where),
        "Blender lit dB": psnr(*stored["color"], where),
    }, pictures


def shape(case: Case) -> float:
    """Distance that 99 % of the model's surface keep to the quad mesh, share of the extent."""
    from gdtool.assets.load import load_scene
    from gdtool.geometry.distance import closest_points, sample_surface
    from gdtool.geometry.topology import triangulated

    scene, low = load_scene(case.glb), read_low(case)
    points = sample_surface(TriMesh(scene.vertices, scene.faces), 20_000, np.random.default_rng(0))[0]
    return float(
        np.quantile(closest_points(points, TriMesh(low.vertices, triangulated(low.faces)[0].astype(np.int64)))[0], 0.99)
    )


def beside_three(asset: Path) -> dict[str, float]:
    """How near gdtool's pictures of the asset are to three.js'. Raises Failed."""
    done = subprocess.run(
        [sys.executable, TOOLS / "compare_shown.py", asset / "asset.glb"],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    if done.returncode:
        raise Failed((done.stderr.strip().splitlines() or ["no message"])[-1])
    found = json.loads(done.stdout)
    if failed := [value for value in found.values() if isinstance(value, str)]:
        raise Failed(failed[0])
    return {"three.js base color dB": found["three.js, base color"], "three.js lit dB": found["three.js, lit"]}


def charts(case: Case, size: int) -> np.ndarray:
    """(size, size, 3) of the texture coordinates."""
    from gdtool.geometry.meshes import QuadMesh
    from gdtool.unwrap.pipeline import uv_islands
    from gdtool.unwrap.preview import layout

    low = read_low(case)
    faces, face_uvs = low.faces.astype(np.int64), low.face_uvs.astype(np.int64)
    islands, _ = uv_islands(QuadMesh(low.vertices, faces, low.uv, face_uvs))
    return layout(faces, low.uv, face_uvs, islands, size)


def baked(case: Case, folder: Path) -> tuple[Path, dict[str, float]]:
    """The asset folder, and what the command cost."""
    from gdtool.folders.mesh import write_obj

    low, out = folder / f"{case.name}.obj", folder / "asset"
    write_obj(low, read_low(case))
    cost = gdtool("bake", low, "--model", case.glb, "--size", 2048, "--lods", 4, "--source-frame", "-o", out, "--quiet")
    report = json.loads((out / "manifest.json").read_text())["content"]["report"]
    return out, {"seconds": cost.seconds, "peak MB": cost.peak_mb, "lod3 drift": report.get("lod3_drift_mean")}


def write(out: Path, rows: Rows, complete: bool, kept: Path, note: str) -> None:
    """The reports of what there is so far."""
    from PIL import Image

    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import read_image

    rows.write(complete)
    text = table(
        COLUMNS,
        (
            [number(row.get(name, "failed" if name == "seconds" and "failed" in row else None), 3) for name in COLUMNS]
            for row in rows.rows
        ),
    )
    failed = "\n".join(
        f"- {row['model']}: {row[what]}" for row in rows.rows for what in ("failed", "peer failed") if what in row
    )
    head = (
        f"# Finished asset\n\n`python -m benchmarks.bake.asset`, {machine()}. {note}\n\n"
        f"`gdtool bake --size 2048 --lods 4 "
        f"--source-frame` of the model's quad mesh: "
        f"seconds and memory of the whole command; masked PSNR of lit pictures against the model's, mean of {VIEWS} "
        f"views under "
        f"{', '.join(LIGHTS)}, and the worst; floor: the model against itself "
        f"with four times the samples, one view, under the light where they differ most (below {QUIET:g} dB all get "
        f"more); the buffers' errors; shape: how far 99 % "
        "of the model's surface lie from the quad mesh, and "
        "how far the coarsest level (an eighth) slid on its maps, shares of the extent; gdtool's pictures of the "
        "asset against Blender's and "
        "three.js'.\n\n"
    )
    (out / "asset.md").write_text(
        head + text + "\n" + (f"\nFailed:\n\n{failed}\n" if failed else "") + "\n![source and asset](asset.jpg)\n"
    )
    sheet, names = [], []
    for row in rows.rows:
        at = [kept / "pictures" / file_name(row["model"], f"asset {label}") for label in LABELS]
        if at[0].exists() and "mid" in row:
            sheet.append([read_image(path)[..., :3].astype(np.float32) / 255 if path.exists() else None for path in at])
            names.append(row["model"])
    if sheet:
        Image.fromarray(contact_sheet(sheet, labels_top=LABELS, labels_left=names)).save(out / "asset.jpg", quality=85)


def measured(source: str | Path, asked: argparse.Namespace) -> dict:
    """The row of one model."""
    from gdtool.images.io import write_png

    row: dict = {"model": source if source == "part" else source.stem, "way": "asset"}
    pictures = asked.kept / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    for label in LABELS:
        (pictures / file_name(row["model"], f"asset {label}")).unlink(missing_ok=True)
    shown = []
    with tempfile.TemporaryDirectory() as folder:
        try:
            case = case_of(source, asked.kept)
            asset, cost = baked(case, Path(folder))
            errors, found = relit(case, asset, asked.size, asked.samples)
            row |= cost | errors | {"shape": shape(case)}
            shown = [charts(case, asked.size), *found]
        except Exception as failure:  # a model that fails is a row of the table, not the end of it
            return row | {"failed": f"{type(failure).__name__}: {failure}"}
        try:
            if asked.peers_python:
                figures, found = beside_blender(
                    asked.peers_python, asset, Path(folder, "peer"), 2 * asked.size, 4 * asked.samples
                )
                row |= figures
                shown += [image[::2, ::2] for image in found]
            if (TOOLS / "node_modules/three").exists():
                row |= beside_three(asset)
        except (Failed, subprocess.TimeoutExpired) as failure:
            row["peer failed"] = str(failure)
    for label, image in zip(LABELS, shown, strict=False):
        write_png(pictures / file_name(row["model"], f"asset {label}"), np.clip(image, 0, 1))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--peers-python", type=Path)
    parser.add_argument(
        "--minutes", type=float, default=12.0, help="a model that did not begin by then is left for the next time"
    )
    parser.add_argument("--limit", type=int, default=12, help="models at most")
    parser.add_argument("--size", type=int, default=256, help="of the pictures")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"))
    asked = parser.parse_args()
    if not asked.models:
        say("no models are named: the peers' case alone")
    import torch

    torch.set_num_threads(1)  # shading runs in threads of its own
    end, note = time.monotonic() + 60 * asked.minutes, busy()
    rows = Rows(
        asked.out / "asset.json",
        {name: str(value) for name, value in vars(asked).items() if name not in ("out", "kept", "minutes")},
    )
    sources = ["part", *list(filter(has_detail, models_in(asked.models)))[: asked.limit]]
    left = []
    for source in sources:
        name = source if source == "part" else source.stem
        if rows.has(name, "asset"):
            continue
        if time.monotonic() > end:
            left.append(name)
            continue
        say(name)
        rows.add(measured(source, asked))
        write(asked.out, rows, False, asked.kept, note)
    write(asked.out, rows, not left, asked.kept, note)
    print((asked.out / "asset.md").read_text())
    if left:
        say(f"not begun within {asked.minutes:g} minutes: {', '.join(left)}; run it again and it goes on")


if __name__ == "__main__":
    main()
