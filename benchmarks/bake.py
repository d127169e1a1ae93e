"""Time and memory against error of bake, beside Blender's Cycles in the same run, on the peers' bake case and public models.

    python benchmarks/bake.py [MODEL_OR_FOLDER ...] [--peers-python PATH] [-o docs/benchmarks] [--minutes 10] [--sizes 1024,2048,4096]

Writes bake.md, bake.json and bake.png (the maps side by side) after every row. Models that have
neither a texture nor colors are left out; those that cannot be remeshed are named. The sizes are swept on the peers' case, the others have
2048². Errors: benchmarks/bake_score.py. --peers-python is a Python that has bpy; without it Blender is left out. What does
not start within --minutes is named, not run; the quad meshes are made before the clock starts, and kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from bake_cases import Case, case_of, read_low
from bake_score import Truth, scored
from fine_meshes import models_in
from measure import busy, machine, number, say, table

PEER = Path(__file__).with_name("bake_blender.py")
COLUMNS = ("model", "way", "size", "bake s", "bake cpu", "occlusion s", "png s", "peak MB", "albedo dB", "roughness dB", "metallic dB", "normal deg", "missed",
           "8-bit albedo dB", "8-bit roughness dB", "8-bit normal deg", "seam albedo", "seam roughness", "unfilled", "occlusion rms")


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


def peak_mb() -> float:
    """The largest this process has been."""
    return next(int(line.split()[1]) / 1024 for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))


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
    from gdtool.images.io import encode_pngs
    from gdtool.stages.bake import target_of
    from gdtool.texture.bake import bake, occlusion_tracer
    from gdtool.texture.maps import make_maps
    from gdtool.texture.occlusion import bake_occlusion
    from gdtool.texture.origin import from_scene
    from gdtool.texture.reproject import vertex_reach
    from gdtool.texture.target import texel_width, texels_of

    threads = len(os.sched_getaffinity(0))
    scene, mesh = load_scene(case.glb), read_low(case)
    target = target_of(mesh)[0]
    origin = from_scene(scene, np.eye(4), lambda detail: texel_width(target, size))
    cost, clock = {}, Clock()
    texels = texels_of(target, size, threads=threads)
    reach = vertex_reach(target.vertices, target.faces, origin.source)
    baked = bake(target, texels, origin.source, origin.lookup, reach, threads=threads)
    wall, processor = clock()
    kept = {name: texels.image(baked.values[name]) for name in ("albedo", "roughness", "metallic", "tangent_normal")} if out else {}
    traced, trace = None, None
    clock()
    if occlusion:
        trace = occlusion_tracer(target, origin.source, reach, origin.normals, 64, 0, threads)
        traced = bake_occlusion(target, texels, trace, threads=threads)
        cost["occlusion s"], cost["occlusion cpu"] = clock()
    maps = make_maps(texels, baked.values, occlusion=traced, normal_map="on", threads=threads)
    more = clock()
    cost |= {"bake s": wall + more[0], "bake cpu": processor + more[1]}
    images = [image for image in (maps.base_color, maps.orm, maps.normal) if image is not None]
    encode_pngs(images, threads=threads)
    cost["png s"], cost["png cpu"] = clock()
    cost["peak MB"] = peak_mb()
    cost["unfilled"] = int(sum((~np.isfinite(v)).reshape(len(texels), -1).any(1)[:texels.inside].sum() for v in baked.values.values()))
    if occlusion:
        some = np.random.default_rng(0).integers(0, texels.inside, 2000)
        many = occlusion_tracer(target, origin.source, reach, origin.normals, 1024, 9, threads)(texels.face_idx[some], texels.barycentric[some])
        cost["occlusion rms"] = float(np.sqrt(np.mean((traced[some] - many) ** 2)))
    if out:
        np.savez(out, **{name: image for name, image in kept.items() if name != "tangent_normal"}, normal=kept["tangent_normal"] * 0.5 + 0.5)
    return cost


def blender(python: Path, case: Case, size: int, samples: int, occlusion: int, out: Path, limit: float) -> dict[str, float]:
    """Cost of Blender's bake; its maps go to out (.npz). Raises RuntimeError."""
    from gdtool.folders.mesh import triangulated
    from gdtool.stages.bake import target_of

    mesh = read_low(case)
    target, low = target_of(mesh)[0], out.with_name("low.npz")
    np.savez(low, vertices=mesh.vertices, triangles=triangulated(mesh.faces)[0], uv=target.uv[target.face_uvs] * (1, -1) + (0, 1))
    done = subprocess.run([python, PEER, case.glb, low, out, "--size", str(size), "--samples", str(samples), "--occlusion", str(occlusion)],
                          capture_output=True, text=True, timeout=limit, check=False)
    said = [line for line in done.stdout.splitlines() if line.startswith("cost ")]
    if done.returncode or not said:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
    found = json.loads(said[0][5:])
    shadow = found["seconds"].pop("occlusion", (None, None))
    return {"bake s": sum(w for w, _ in found["seconds"].values()), "bake cpu": sum(c for _, c in found["seconds"].values()),
            "occlusion s": shadow[0], "peak MB": found["peak_mb"]}


def small(image: np.ndarray, width: int = 256) -> np.ndarray:
    """(h, w, 3) of a map at about the width, as a screen shows it."""
    step = max(1, image.shape[0] // width)
    image = image[: width * step, : width * step].reshape(width, step, width, step, -1).mean((1, 3))
    return np.broadcast_to(image, (width, width, 3))


def shown(maps: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Base color, roughness and normal of a bake, small."""
    from gdtool.images.color import srgb_from_linear

    return [small(srgb_from_linear(np.clip(maps["albedo"], 0, 1))), small(maps["roughness"]), small(maps["normal"])]


def write(out: Path, rows: list[dict], sheet: list, names: list[str], note: str) -> None:
    """The reports of what there is so far."""
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_png

    out.mkdir(parents=True, exist_ok=True)
    text = table(COLUMNS, ([number(row.get(name, "failed" if name == "size" and "failed" in row else None), 4) for name in COLUMNS] for row in rows))
    failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows if "failed" in row)
    head = f"# Bake\n\n`python benchmarks/bake.py`, {machine()}. {note}\n\nbake: rasterising, reading, gutters and storing; seconds of the wall and of the " \
        "processor. Errors before storing, and after 8 bits. seam: how much more the two sides of seams " \
        "differ than in the model, over the same at other edges.\n\n"
    (out / "bake.md").write_text(head + text + "\n" + (f"\nFailed:\n\n{failed}\n" if failed else "") + "\n![maps](bake.png)\n")
    (out / "bake.json").write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
    if sheet:
        kinds = ["base color", "roughness", "normal"]
        write_png(out / "bake.png", contact_sheet(sheet, labels_top=kinds + ([f"{kind}, Blender" for kind in kinds] if len(sheet[0]) > 3 else []),
                                                  labels_left=names))


def main() -> None:
    from gdtool.core.child import ChildFailed, call

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--peers-python", type=Path)
    parser.add_argument("--sizes", default="1024,2048,4096", help="of the peers' case")
    parser.add_argument("--samples", default="1,16", help="Blender's, on the peers' case")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--limit", type=int, default=12, help="models at most")
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"))
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # the children import this file
    note, rows, sheet, names, cases = busy(), [], [], [], []
    for source in ["part", *filter(has_detail, models_in(asked.models))]:
        if len(cases) > asked.limit:
            break
        try:
            say(f"{source}: quad mesh")
            cases.append(case_of(source, asked.kept))
        except Exception as failure:  # a model that cannot be prepared is a row of the table, not the end of it
            rows.append({"model": str(getattr(source, "name", source)), "way": "prepare", "failed": str(failure)})
    end = time.monotonic() + 60 * asked.minutes
    for case in cases:
        part = case.name == "part"
        runs = [("ours", int(size), 0) for size in (asked.sizes.split(",") if part else ["2048"])]
        if asked.peers_python:
            runs += [("Blender", 2048, int(samples)) for samples in (asked.samples.split(",") if part else ["1"])]
        truth, pictures = Truth(case), {}
        for way, size, samples in runs:
            row = {"model": case.name, "way": way + (f", {samples} samples" if samples else ""), "size": size}
            rows.append(row)
            if time.monotonic() > end:
                row["failed"] = f"not started within {asked.minutes:g} minutes"
                continue
            say(f"{case.name}: {row['way']} at {size}")
            with tempfile.TemporaryDirectory() as folder:
                at = Path(folder, "maps.npz")
                try:
                    # Cost is taken without the maps kept for scoring, which need memory of their own.
                    if way == "ours":
                        row |= call("bake:ours", case, size, True, "", seconds=200, memory_mb=12000)
                        call("bake:ours", case, size, False, str(at), seconds=200, memory_mb=12000)
                    else:
                        row |= blender(asked.peers_python, case, size, samples, 0, at, 200)
                    with np.load(at) as found:
                        maps = dict(found)
                    corners = {name: maps.pop(name) for name in list(maps) if name.startswith("corner_")}
                    row |= scored(truth, maps, corners or None)
                    if size == 2048:
                        pictures.setdefault(way, shown(maps))
                except (ChildFailed, RuntimeError, subprocess.TimeoutExpired) as failure:
                    row["failed"] = str(failure)
            write(asked.out, rows, [*sheet, sum(pictures.values(), [])] if pictures else sheet, [*names, case.name], note)
        if pictures:
            sheet.append(sum(pictures.values(), []) + [None] * (3 * (1 + bool(asked.peers_python)) - 3 * len(pictures)))
            names.append(case.name)
    write(asked.out, rows, sheet, names, note)
    print((asked.out / "bake.md").read_text())


if __name__ == "__main__":
    main()
