"""Time and memory against error of bake, beside Blender's Cycles in the same run, on the peers' bake case and public
models.

    python -m benchmarks.bake.sweep [MODEL_OR_FOLDER ...] [--peers-python PATH] [-o docs/benchmarks] [--minutes 12] \
        [--sizes 1024,2048,4096]

Writes bake.md, bake.json and bake.jpg (the maps side by side) row by row: killed, or out of --minutes, it goes on where
it was. Models that have neither a texture nor colors are left out; those that cannot be remeshed are named. The sizes
are swept on the peers' case, the others have 2048². Errors: benchmarks/bake/score.py; along the charts' rims at the mip
level of 256 texels, which is what unwrap leaves room for: bake_mips.py. --peers-python is a Python that has bpy;
without it Blender is left out."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bake.cases import Case, case_of, read_low
from benchmarks.bake.mips import rim_error
from benchmarks.bake.score import Truth, scored
from benchmarks.common.fine_meshes import models_in
from benchmarks.common.measure import ROOT, busy, machine, number, peak_mb, say, table
from benchmarks.common.resumable_rows import Rows
from benchmarks.common.wireframe import file_name

PEER = Path(__file__).with_name("in_blender.py")
COLUMNS = (
    "model",
    "way",
    "size",
    "bake s",
    "bake cpu",
    "occlusion s",
    "png s",
    "peak MB",
    "albedo dB",
    "roughness dB",
    "metallic dB",
    "normal deg",
    "missed",
    "8-bit albedo dB",
    "8-bit roughness dB",
    "8-bit normal deg",
    "seam albedo",
    "seam roughness",
    "unfilled",
    "rim at 256 dB",
    "occlusion rms",
)
MIP = 256
KINDS = ("base color", "roughness", "normal")


def has_detail(path: Path) -> bool:
    """Whether a model can be read and has textures or colors to bake."""
    from gdtool.assets.load import load_scene
    from gdtool.core.errors import GdtoolError

    try:
        scene = load_scene(path)
    except GdtoolError as error:
        say(f"{path.name}: left out: {error}")
        return False
    return scene.colors is not None or any(m.base_color_texture is not None for m in scene.materials)


class Clock:
    """Seconds since the last question: of the wall, and of the processor."""

    def __init__(self):
        self.wall, self.processor = time.perf_counter(), time.process_time()

    def __call__(self) -> tuple[float, float]:
        before = self.wall, self.processor
        self.__init__()
        return self.wall - before[0], self.processor - before[1]


def ours(case: Case, size: int, occlusion: bool, out: str) -> dict[str, float]:
    """In a child: bake as the stage does, steps timed; the maps before they are stored go to out (.npz)."""
    from gdtool.assets.load import load_scene
    from gdtool.bake.inputs import target_of
    from gdtool.bake.maps import MapOptions, make_maps
    from gdtool.bake.occlusion import bake_occlusion
    from gdtool.bake.origin import from_scene
    from gdtool.bake.pipeline import BakeOptions, bake, occlusion_tracer
    from gdtool.bake.reproject import cage_offsets
    from gdtool.bake.target import samples_for, texel_width, texels_of
    from gdtool.images.io import encode_pngs

    threads = len(os.sched_getaffinity(0))
    scene, mesh = load_scene(case.glb), read_low(case)
    target = target_of(mesh)[0]
    width = texel_width(target, size)
    origin = from_scene(scene, np.eye(4), lambda detail: 0.5 * width / samples_for(width, detail) ** 0.5)
    cost, clock = {}, Clock()
    texels = texels_of(target, size, threads=threads)
    reach = cage_offsets(target.mesh, origin.source)
    baked = bake(
        target, texels, origin.source, origin.lookup, reach, BakeOptions(samples_for(width, origin.detail), threads)
    )
    wall, processor = clock()
    traced, trace = None, None
    clock()
    if occlusion:
        trace = occlusion_tracer(target, origin.source, reach, origin.normals, 64, 0, threads)
        traced = bake_occlusion(target, texels, trace, threads=threads)
        cost["occlusion s"], cost["occlusion cpu"] = clock()
    maps = make_maps(texels, baked.values, traced, MapOptions(normal_map="on", threads=threads))
    more = clock()
    cost |= {"bake s": wall + more[0], "bake cpu": processor + more[1]}
    images = [image for image in (maps.base_color, maps.orm, maps.normal) if image is not None]
    encode_pngs(images, threads=threads)
    cost["png s"], cost["png cpu"] = clock()
    cost["peak MB"] = peak_mb()
    cost["unfilled"] = int(
        sum((~np.isfinite(v)).reshape(len(texels), -1).any(1)[: texels.inside].sum() for v in baked.values.values())
    )
    if occlusion:
        some = np.random.default_rng(0).integers(0, texels.inside, 2000)
        many = occlusion_tracer(target, origin.source, reach, origin.normals, 1024, 9, threads)(
            texels.face_idx[some], texels.barycentric[some]
        )
        cost["occlusion rms"] = float(np.sqrt(np.mean((traced[some] - many) ** 2)))
    if out:
        np.savez(out, **with_gutters(texels, baked.values))
    return cost


def with_gutters(texels, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What texels read as the floats of maps that are filled as ours are: albedo (s, s, 3) linear, roughness, metallic,
    normal as stored."""
    from gdtool.bake.padding import fill_gutters
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    read = {name: values[name] for name in ("roughness", "metallic")} | {
        "albedo": srgb_from_linear(np.clip(values["albedo"], 0, 1)),
        "normal": values["tangent_normal"] * 0.5 + 0.5,
    }
    maps = {name: fill_gutters(texels.image(value), texels.mask()) for name, value in read.items()}
    return maps | {"albedo": linear_from_srgb(maps["albedo"])}


def blender(
    python: Path, case: Case, size: int, samples: int, occlusion: int, out: Path, limit: float
) -> dict[str, float]:
    """Cost of Blender's bake; its maps go to out (.npz). Raises RuntimeError."""
    from gdtool.bake.inputs import target_of
    from gdtool.geometry.topology import triangulated

    mesh = read_low(case)
    target, low = target_of(mesh)[0], out.with_name("low.npz")
    np.savez(
        low,
        vertices=mesh.vertices,
        triangles=triangulated(mesh.faces)[0],
        uv=target.uv[target.face_uvs] * (1, -1) + (0, 1),
    )
    done = subprocess.run(
        [
            python,
            PEER,
            case.glb,
            low,
            out,
            "--size",
            str(size),
            "--samples",
            str(samples),
            "--occlusion",
            str(occlusion),
        ],
        capture_output=True,
        text=True,
        timeout=limit,
        check=False,
    )
    said = [line for line in done.stdout.splitlines() if line.startswith("cost ")]
    if done.returncode or not said:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
    found = json.loads(said[0][5:])
    shadow = found["seconds"].pop("occlusion", (None, None))
    return {
        "bake s": sum(w for w, _ in found["seconds"].values()),
        "bake cpu": sum(c for _, c in found["seconds"].values()),
        "occlusion s": shadow[0],
        "peak MB": found["peak_mb"],
    }


def small(image: np.ndarray, width: int = 256) -> np.ndarray:
    """(h, w, 3) of a map at about the width, as a screen shows it."""
    step = max(1, image.shape[0] // width)
    image = image[: width * step, : width * step].reshape(width, step, width, step, -1).mean((1, 3))
    return np.broadcast_to(image, (width, width, 3))


def show(maps: dict[str, np.ndarray], at: Path) -> None:
    """Base color, roughness and normal of a bake side by side, small, as a picture to put the sheet together from."""
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.io import write_png

    at.parent.mkdir(parents=True, exist_ok=True)
    images = small(srgb_from_linear(np.clip(maps["albedo"], 0, 1))), small(maps["roughness"]), small(maps["normal"])
    write_png(at, np.clip(np.concatenate(images, 1), 0, 1))


def picture(name: str, way: str) -> str:
    return file_name(name, f"bake {way}")


def write(out: Path, rows: Rows, complete: bool, kept: Path, note: str) -> None:
    """The reports of what there is so far."""
    from PIL import Image

    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import read_image

    rows.write(complete)
    text = table(
        COLUMNS,
        (
            [number(row.get(name, "failed" if name == "size" and "failed" in row else None), 4) for name in COLUMNS]
            for row in rows.rows
        ),
    )
    failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows.rows if "failed" in row)
    head = (
        f"# Bake\n\n`python -m benchmarks.bake.sweep`, {machine()}. {note}\n\nbake: rasterising, reading, gutters and "
        f"storing; seconds of the wall and of the "
        "processor. Errors before storing, and after 8 bits. seam: how much more the two sides of seams "
        "differ than in the model, over the same at other edges, or over 1 where those differ less. rim: the base "
        "color along the charts' rims in the mip level of "
        f"{MIP} texels, against each chart alone.\n\n"
    )
    (out / "bake.md").write_text(
        head + text + "\n" + (f"\nFailed:\n\n{failed}\n" if failed else "") + "\n![maps](bake.jpg)\n"
    )
    names = list(dict.fromkeys(row["model"] for row in rows.rows))
    sheet = []
    for name in names:
        line: list[np.ndarray | None] = []
        for way in ("ours", "Blender"):
            at = kept / "pictures" / picture(name, way)
            line += np.split(read_image(at)[..., :3].astype(np.float32) / 255, 3, 1) if at.exists() else [None] * 3
        sheet.append(line)
    whole = [i for i, line in enumerate(sheet) if line[0] is not None]
    if whole:
        table_of_maps = contact_sheet(
            [sheet[i] for i in whole],
            labels_top=[*KINDS, *(f"{kind}, Blender" for kind in KINDS)],
            labels_left=[names[i] for i in whole],
        )
        Image.fromarray(table_of_maps).save(out / "bake.jpg", quality=85)


def run(case: Case, truth: Truth, way: str, size: int, samples: int, asked: argparse.Namespace) -> dict:
    """Cost and errors of one bake."""
    from gdtool.core.child import ChildFailed, call

    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder, "maps.npz")
        try:
            # Cost is taken without the maps kept for scoring, which need memory of their own.
            if way == "ours":
                row = call(ours, case, size, True, "", seconds=200, memory_mb=12000)
                call(ours, case, size, False, str(at), seconds=200, memory_mb=12000)
            else:
                row = blender(asked.peers_python, case, size, samples, 0, at, 200)
        except (ChildFailed, RuntimeError, subprocess.TimeoutExpired) as failure:
            return {"failed": str(failure)}
        with np.load(at) as found:
            maps = dict(found)
    corners = {name: maps.pop(name) for name in list(maps) if name.startswith("corner_")}
    row |= scored(truth, maps, corners or None) | {f"rim at {MIP} dB": rim_error(truth.target, maps["albedo"], MIP)}
    if size == 2048 and samples <= 1:
        show(maps, asked.kept / "pictures" / picture(case.name, way))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--peers-python", type=Path)
    parser.add_argument("--sizes", default="1024,2048,4096", help="of the peers' case")
    parser.add_argument("--samples", default="1,16", help="Blender's, on the peers' case")
    parser.add_argument(
        "--minutes", type=float, default=12.0, help="a run that did not begin by then is left for the next time"
    )
    parser.add_argument("--limit", type=int, default=12, help="models at most")
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"))
    asked = parser.parse_args()
    if not asked.models:
        say("no models are named: the peers' case alone")
    os.environ["PYTHONPATH"] = str(ROOT)  # child processes import this package
    end, note, left = time.monotonic() + 60 * asked.minutes, busy(), 0
    rows = Rows(
        asked.out / "bake.json",
        {name: str(value) for name, value in vars(asked).items() if name not in ("out", "kept", "minutes")},
    )
    sources = ["part", *list(filter(has_detail, models_in(asked.models)))[: asked.limit]]
    for source in sources:
        name = source if isinstance(source, str) else source.stem
        runs = [("ours", int(size), 0) for size in (asked.sizes.split(",") if source == "part" else ["2048"])]
        if asked.peers_python:
            runs += [
                ("Blender", 2048, int(samples)) for samples in (asked.samples.split(",") if source == "part" else ["1"])
            ]
        labels = [f"{way}, {samples} samples" if samples else f"{way}, {size}" for way, size, samples in runs]
        todo = [one for one in zip(runs, labels, strict=True) if not rows.has(name, one[1])]
        if not todo or rows.has(name, "prepare"):
            continue
        if time.monotonic() > end:
            left += len(todo)
            continue
        try:
            say(f"{name}: quad mesh")
            case = case_of(source, asked.kept)
            truth = Truth(case)
        except Exception as failure:  # a model that cannot be prepared is a row of the table, not the end of it
            rows.add({"model": name, "way": "prepare", "failed": str(failure)})
            continue
        for (way, size, samples), label in todo:
            if time.monotonic() > end:
                left += 1
                continue
            say(f"{name}: {label}")
            rows.add({"model": name, "way": label, "size": size} | run(case, truth, way, size, samples, asked))
            write(asked.out, rows, False, asked.kept, note)
    write(asked.out, rows, not left, asked.kept, note)
    print((asked.out / "bake.md").read_text())
    if left:
        say(f"{left} did not begin within {asked.minutes:g} minutes: run it again and it goes on")


if __name__ == "__main__":
    main()
