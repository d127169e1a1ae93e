"""How near `gdtool reconstruct` comes to the truth, on exact and on disturbed views, beside what else a user could run.

    python -m benchmarks.reconstruct.sweep                    public models in --assets and procedural ones: an hour
    python -m benchmarks.reconstruct.sweep --all              every model with five seeds at three wavelengths: hours
    python -m benchmarks.reconstruct.sweep --models DIR --limit 12 --procedural 0
    python -m benchmarks.reconstruct.sweep --sheet /tmp/objects.png --only bunny,spot --cases clean --budgets '' -o \
        /tmp/report
    python -m benchmarks.reconstruct.sweep --assets none --procedural 1 --size 128 --budgets 2,5 -o /tmp/report

Every model is rendered by `gdtool render-dataset`; the disturbed views are perturbation.py's. Ours runs by
the command line, so that its seconds hold start-up, reading and writing; a peer's are the algorithm alone. Errors are
the "surface" protocol of docs/metrics.md; materials are compared where the surface is met from four held-out cameras,
and lit by a held-out light. Rows are kept as they are measured: a run that was stopped goes on where it was, --fresh
begins anew. Nothing else should run meanwhile."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.common.measure import ROOT, Failed, busy, gdtool, machine, number, say
from benchmarks.reconstruct import peers
from benchmarks.reconstruct.appearance import MATERIALS, keep_row, looks, sheet
from benchmarks.reconstruct.perturbation import Perturbation, perturbed
from benchmarks.reconstruct.report import COLUMNS, OURS, PAPER, kind, markdown, plot
from gdtool.geometry.meshes import TriMesh

FIRST_SEED = 3_000_000  # procedural objects that the bundled model has not seen
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
LEFT_OUT = ("_col.obj",)  # collision shapes beside the models
# Of the folder --models: ten Google Scanned Objects, then smooth, thin, flat and sharp-edged solids.
SUITE = (
    *(
        f"gso/vima/{n}.obj"
        for n in (
            "mario_figure",
            "porcelain_cup",
            "toy_train",
            "lion_figure",
            "dinosaur_figure",
            "bull_figure",
            "can_opener",
            "hammer",
        )
    ),
    "gso/aloha/Granimals_20_Wooden_ABC_Blocks_Wagon/meshes/model.obj",
    "gso/libero/glazed_rim_porcelain_ramekin/glazed_rim_porcelain_ramekin.obj",
    *(f"mesh/odedstein/{n}/{n}.obj" for n in ("bunny", "spot", "penguin", "torus")),
    *(f"mesh/trimesh/{n}" for n in ("fandisk.obj", "plate_holes.STL", "cycloidal.ply", "featuretype.STL")),
)
SEEDS, WAVELENGTHS = 5, (1 / 16, 1 / 8, 1 / 4)  # of --all; the default takes one pair a model, each in turn
DEFAULT_DISTURBED, DEFAULT_BUDGETED, DEFAULT_COLOR, DEFAULT_NORMALS = 10, 2, 4, 10  # models
IGNORED = {"normals": "depth", "color": "normal,depth,albedo,roughness,metallic"}  # domains, of the exact views
PICTURED = 10  # models on the contact sheet
# Peers run on every model; the others, which are worse, on the first of the default.
ALWAYS = ("carved hull", "capped Poisson")


def models(given: argparse.Namespace) -> list[tuple[str, str]]:
    """Name and source of every model to take, procedural ones mixed in evenly."""
    found = [given.assets / path for path in SUITE if (given.assets / path).exists()] if given.assets else []
    for place in given.models:
        paths = (
            [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.suffix.lower() in MODEL_SUFFIXES)
        )
        found += [p for p in paths if not p.name.endswith(LEFT_OUT)][: given.limit or None]
    named = [((p.parent.parent.name if p.stem == "model" else p.stem), str(p)) for p in found]
    for i in range(given.procedural):
        named.insert(4 * i, (f"procedural:{FIRST_SEED + i}",) * 2)
    return [(name, source) for name, source in named if not given.only or name in given.only]


def publish(path: Path, views, cause: Path) -> Path:
    """Write arrays as a views folder, as any other program could."""
    import msgspec

    from gdtool.core.runner import Settings, run_one
    from gdtool.core.stage import Stage
    from gdtool.folders.views import write_views

    Options = msgspec.defstruct("Options", [], frozen=True, kw_only=True, forbid_unknown_fields=True)
    stage = Stage(
        name="perturb",
        version=1,
        reads=("views",),
        writes="views",
        Options=Options,
        run=lambda i, o, out: write_views(out, views),
    )
    run_one(stage, [cause], Options(), {}, Settings(output=path, force=True))
    return path


def measured(vertices: np.ndarray, faces: np.ndarray, truth, views, surface=None) -> dict:
    """Errors of one result against the true scene, in the frame of the exact views; with surface its materials' too."""
    from gdtool.geometry.metrics import SurfaceOptions, is_closed, surface_protocol

    if len(faces) == 0:
        return {"failed": "nothing came out"}
    mesh, true_mesh = TriMesh(vertices, faces), TriMesh(truth.vertices, truth.faces)
    found = surface_protocol(mesh, true_mesh, SurfaceOptions(cameras=views.cameras, samples=40_000))
    out = {name: float(found[name]) for name, _, _ in COLUMNS if name in found} | {"watertight": is_closed(mesh)}
    out |= {"shown_normal_degrees": normals_beside(vertices, faces, views)}
    return out | (looks(surface, truth) if surface is not None else {})


def normals_beside(vertices: np.ndarray, faces: np.ndarray, views) -> float:
    """Mean degrees between a mesh's normals and the normal views (exact ones) where they are wholly covered.

    A scan's few facets are shaded by smooth normals, which the views show: these, not the facets, are what can be
    known."""
    from gdtool.cameras import rays
    from gdtool.geometry.normals import face_normals
    from gdtool.geometry.rays import RayCaster

    caster, normals, angles = RayCaster(TriMesh(vertices, faces)), face_normals(TriMesh(vertices, faces))[0], []
    for camera, cover, shown in zip(views.cameras, views.mask, views.images["normal"], strict=True):
        whole = (cover > 0.99).ravel()
        origins, directions = (x.reshape(-1, 3)[whole] for x in rays(camera))
        hits = caster.first_hit(origins, directions)
        cosine = (normals[hits.face_idx] * shown.reshape(-1, 3)[whole]).sum(1)[hits.is_hit]
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return float(np.concatenate(angles).mean())


def skips(views) -> list[dict]:
    """CPU seconds of the grid method with a step left out and done, and how far the result moves (world units)."""
    from gdtool.fields.grid.carve import carve, combined_distance
    from gdtool.fields.grid.fusion import AlignmentOptions, align_depth, align_views, grid_step, prepare_all
    from gdtool.fields.views.depth_alignment import disagreement

    depth, normal, colors = (
        views.images["depth"],
        views.images["normal"],
        [views.images[domain] for domain in ("albedo", "color")],
    )
    step = grid_step(views.cameras, 0)
    prepared = prepare_all(views.cameras, views.mask, depth, normal)

    def timed(function):
        start = time.process_time()
        return function(), time.process_time() - start

    (_, before, after), checked = timed(
        lambda: align_depth(views.cameras, views.mask, depth, normal, step, AlignmentOptions(colors=colors))
    )
    found = []
    if before == after:
        (moved, _), forced = timed(
            lambda: align_views(views.cameras, views.mask, depth, normal, prepared, AlignmentOptions(colors=colors))
        )
        found.append(
            {
                "what": "alignment of views that agree",
                "done": checked + forced,
                "skipped": checked,
                "change": abs(disagreement(moved) - before),
            }
        )
    (grid, values, _), band = timed(lambda: carve(prepared, step))
    limit = 3 * step
    points = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    (dense, _), whole = timed(lambda: combined_distance(prepared, grid.points(points), step, limit))
    found.append(
        {
            "what": "samples away from the surface",
            "done": whole,
            "skipped": band,
            "change": step * crossings_moved(dense.reshape(grid.shape), values),
        }
    )
    return found


def crossings_moved(one: np.ndarray, other: np.ndarray) -> float:
    """How far two grids' surfaces lie apart along the grid's edges, at most, in steps; 1 where only one of them crosses
    an edge."""
    farthest = 0.0
    for axis in range(3):
        place = []
        for values in (np.moveaxis(one, axis, 0), np.moveaxis(other, axis, 0)):
            a, b = values[:-1], values[1:]
            place.append(np.where((a < 0) != (b < 0), a / np.where(a == b, 1, a - b), np.nan))
        crossed = [np.isfinite(p) for p in place]
        if (crossed[0] != crossed[1]).any():
            return 1.0
        if crossed[0].any():
            farthest = max(farthest, float(np.abs(place[0] - place[1])[crossed[0]].max()))
    return farthest


def cases_of(index: int, given: argparse.Namespace) -> list[str]:
    """Which views of the index-th model are reconstructed: clean, normals (exact, without depth), color, perturbed SEED
    WAVELENGTH."""
    if given.seeds:
        disturbed = [
            f"perturbed {seed} {wavelength:g}" for wavelength in given.wavelengths for seed in range(given.seeds)
        ]
    else:
        disturbed = (
            [f"perturbed {index % SEEDS} {WAVELENGTHS[index % len(WAVELENGTHS)]:g}"]
            if index < DEFAULT_DISTURBED
            else []
        )
    fewer = [
        case for case, count in (("normals", DEFAULT_NORMALS), ("color", DEFAULT_COLOR)) if given.all or index < count
    ]
    cases = ["clean", *disturbed, *fewer]
    return [case for case in cases if kind({"case": case}) in given.cases]


class Bench:
    """The rows measured so far, in a file, and how to measure one more."""

    def __init__(self, given: argparse.Namespace):
        from gdtool.stages.reconstruct import STAGE

        self.given, self.path = given, given.output / "reconstruct.json"
        self.head = {
            "machine": machine(),
            "remark": busy(),
            "size": given.size,
            "version": STAGE.version,
            "options": given.options,
            "complete": False,
        }
        self.records: list[dict] = []
        if self.path.exists() and not given.fresh:
            kept = json.loads(self.path.read_text())
            if not kept.get("complete") and all(
                kept.get(k) == self.head[k] for k in ("machine", "size", "version", "options")
            ):
                self.records = [r for r in kept["records"] if "failed" not in r]  # what failed is tried once more
                self.head["remark"] = kept["remark"] or self.head["remark"]
                say(f"going on after {len(self.records)} rows of {self.path}")

    def has(self, model: str, case: str, method: str) -> bool:
        return any((r["model"], r["case"], r["method"]) == (model, case, method) for r in self.records)

    def save(self, complete: bool = False) -> None:
        self.head["complete"] = complete
        beside = self.path.with_suffix(".part")
        beside.write_text(json.dumps(self.head | {"records": self.records}, indent=1) + "\n")
        beside.replace(self.path)
        (self.given.output / "reconstruct.md").write_text(markdown(self.records, self.given, self.head["remark"]))


def tasks(index: int, case: str, given: argparse.Namespace) -> dict:
    """Method to the options of ours, or to the function of a peer."""
    left_out, every = IGNORED.get(case), given.all or index < DEFAULT_COLOR
    kept = ["--ignore", left_out] if left_out else []
    found: dict = {OURS: [*kept, *given.options]}
    if case == "normals" and (every or given.paper):
        found[PAPER] = [*kept, "--method", "paper"]
    if not left_out and (given.all or index < DEFAULT_BUDGETED):
        found |= {f"{OURS} {budget:g} s": [*given.options, "--budget", f"{budget:g}"] for budget in given.budgets}
    if given.peers:
        found |= {m: f for m, f in peers.available(deep=not left_out).items() if every or m in ALWAYS}
    return found


def measure(index: int, name: str, source: str, folder: Path, bench: Bench, pool) -> None:
    """All runs on one model, and pictures of them for the contact sheet."""
    from gdtool.assets.load import load_scene
    from gdtool.core.folder import open_folder
    from gdtool.folders.surface import read_surface
    from gdtool.folders.views import read_views
    from gdtool.geometry.frames import invert_similarity, transform_points

    given = bench.given
    todo = {
        case: {m: t for m, t in tasks(index, case, given).items() if not bench.has(name, case, m)}
        for case in cases_of(index, given)
    }
    todo = {case: methods for case, methods in todo.items() if methods}
    if not todo:
        return
    say(name)
    clean = folder / "views"
    gdtool("render-dataset", source, "-o", clean, "--size", str(given.size), "--light-samples", "4", "--quiet")
    opened = open_folder(clean)
    views, truth = read_views(opened), load_scene(source)
    to_views = invert_similarity(np.array(opened.content.source_from_world).reshape(4, 4))
    truth = replace(truth, vertices=transform_points(to_views, truth.vertices))  # a scale and a shift: its normals stay
    # How far the views' own normals are from the facets of the truth: nothing made from them can be much nearer.
    shown = normals_beside(truth.vertices, truth.faces, views)
    for case, methods in todo.items():
        arrays, place = views, clean
        if kind({"case": case}) == "perturbed":
            arrays = perturbed(views, Perturbation(int(case.split()[1]), float(case.split()[2])))
            place = publish(folder / case.replace(" ", "_"), arrays, clean)
        elif case in IGNORED:
            arrays = replace(views, images={d: x for d, x in views.images.items() if d not in IGNORED[case].split(",")})
        made = []
        for method, how in methods.items():
            record, mesh, surface = (
                {"model": name, "source": source, "method": method, "case": case, "views_normal_degrees": shown},
                None,
                None,
            )
            try:
                if callable(how):
                    wall, cpu = time.perf_counter(), time.process_time()
                    mesh = how(arrays)
                    record |= {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
                else:
                    cost = gdtool("reconstruct", place, "-o", folder / "surface", "--force", "--quiet", *how)
                    surface = read_surface(open_folder(folder / "surface"))
                    mesh = surface.vertices, surface.faces
                    record |= {"seconds": cost.seconds, "cpu_seconds": cost.cpu_seconds, "peak_mb": cost.peak_mb}
            except (Failed, ValueError, RuntimeError) as error:
                record["failed"] = str(error)
            if case == "clean" and method == OURS and index < DEFAULT_COLOR:
                record["skips"] = skips(arrays)
            surface = surface if case == "clean" and method == OURS else None
            made.append((record, mesh, surface))
        # After the runs, so that measuring does not slow them.
        found = [pool.submit(measured, *mesh, truth, views, surface) if mesh else None for _, mesh, surface in made]
        for (record, _, _), errors in zip(made, found, strict=True):
            record |= errors.result() if errors else {}
            say(
                f"    {case:<22}{record['method']:<18}"
                + (
                    record.get("failed")
                    or "  ".join(
                        f"{head} {number(record[n] * factor)}"
                        for n, head, factor in (*COLUMNS, *MATERIALS)
                        if n in record
                    )
                )
            )
            bench.records.append(record)
        bench.save()
        own = [m for r, m, _ in made if r["method"] == OURS]
        others = sorted(
            (r.get("distance", np.inf), i) for i, (r, _, _) in enumerate(made) if not r["method"].startswith(OURS)
        )
        if given.sheet and own and index < PICTURED and case not in IGNORED:
            keep_row(
                given.output,
                f"{name} {case}",
                [(truth.vertices, truth.faces), own[0], made[others[0][1]][1] if others else None],
            )


def arguments() -> argparse.Namespace:
    def numbers(text: str) -> list[float]:
        return [float(part) for part in text.split(",") if part]

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--assets",
        type=Path,
        help="folder that holds the models of the suite; without it they are left out",
    )
    parser.add_argument("--procedural", type=int, default=4, help="number of procedural objects (default 4)")
    parser.add_argument(
        "--models", type=Path, action="append", default=[], metavar="DIR", help="also every model in this folder"
    )
    parser.add_argument("--limit", type=int, default=0, help="at most this many models of a folder")
    parser.add_argument(
        "--only", type=lambda t: t.split(","), default=[], help="of all these, the models of these names"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="five seeds at three wavelengths, budgets, color alone and all peers on every model",
    )
    parser.add_argument("--size", type=int, default=256, help="width and height of the views (default 256)")
    parser.add_argument(
        "--seeds",
        type=int,
        default=0,
        help="disturbances of every model and wavelength (default: one of either a model, in turn)",
    )
    parser.add_argument(
        "--wavelengths",
        type=numbers,
        default=list(WAVELENGTHS),
        help="with --seeds: of the disturbance, shares of the picture",
    )
    parser.add_argument(
        "--budgets",
        type=numbers,
        default=[5, 10, 20, 40, 120],
        help="also run ours with --budget of these seconds, on the first models (default 5,10,20,40,120)",
    )
    parser.add_argument(
        "--cases",
        type=lambda t: t.split(","),
        default=["clean", "perturbed", "normals", "color"],
        help="which views: clean,perturbed,normals,color (default all)",
    )
    parser.add_argument(
        "--paper",
        action="store_true",
        help="the paper's method on all models of the case normals, minutes each (default: the first four)",
    )
    parser.add_argument("--no-peers", dest="peers", action="store_false", help="leave the peers out")
    parser.add_argument("--fresh", action="store_true", help="measure every row anew")
    parser.add_argument(
        "--sheet",
        type=Path,
        metavar="PNG",
        help="where the pictures of the truth, ours and the best peer go (default: beside the report)",
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=16,
        help="begin no model after this long; the next run goes on (default 16; 0: no end)",
    )
    parser.add_argument("--no-sheet", action="store_true", help="no pictures")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep (and find again) the folders of every model here"
    )
    parser.add_argument(
        "--option",
        dest="options",
        action="append",
        default=[],
        help="further option of gdtool reconstruct, as --option=--method=paper",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=ROOT / "docs" / "benchmarks",
        help="folder of the report",
    )
    given = parser.parse_args()
    given.sheet = None if given.no_sheet else given.sheet or given.output / "reconstruct_sheet.png"
    if given.all:
        given.minutes, given.seeds, given.budgets = 0, given.seeds or SEEDS, [5, 10, 20, 40, 60, 120]
    return given


def main() -> None:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Poisson's threads would burn a core waiting
    given = arguments()
    given.output.mkdir(parents=True, exist_ok=True)
    bench, late, began = Bench(given), [], time.monotonic()
    # A fork of a process with OpenMP threads can hang.
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for index, (name, source) in enumerate(models(given)):
            if given.minutes and time.monotonic() - began > 60 * given.minutes:
                late.append(name)
                continue
            with tempfile.TemporaryDirectory() as folder:
                try:
                    measure(
                        index,
                        name,
                        source,
                        given.keep / name.replace(":", "-") if given.keep else Path(folder),
                        bench,
                        pool,
                    )
                except Failed as error:
                    say(f"{name}: left out: {error}")
    plot(bench.records, given.output / "reconstruct.png")
    if given.sheet:
        sheet(given.output, ["truth", OURS, "best peer"], given.sheet, done=not late)
    if late:
        say(f"--minutes {given.minutes:g} are over; run again for {', '.join(late)}")
    bench.save(complete=not late)
    print(markdown(bench.records, given, bench.head["remark"]))


if __name__ == "__main__":
    main()
