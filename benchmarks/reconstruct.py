"""How near `gdtool reconstruct` comes to the truth, on exact and on disturbed views, beside what else a user could run.

    python benchmarks/reconstruct.py                                        eight procedural objects
    python benchmarks/reconstruct.py --models ../shared/assets/gso --limit 12 --seeds 5 --wavelengths 0.0625,0.125,0.25
    python benchmarks/reconstruct.py --procedural 1 --size 128 --budgets 2,5 --keep /tmp/views -o /tmp/report

Every model is rendered by `gdtool render-dataset`; the disturbed views are benchmarks/perturbation.py's. Ours runs by the
command line, so that its seconds hold start-up, reading and writing; a peer's are the algorithm alone. Errors are the
"surface" protocol of docs/metrics.md; materials are compared where the surface is met from four held-out cameras, and
lit by a held-out light. Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import peers
from measure import Failed, busy, gdtool, machine, number, say, table
from perturbation import Perturbation, perturbed

OURS = "gdtool"
FIRST_SEED = 3_000_000  # procedural objects that the bundled model has not seen
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
LEFT_OUT = ("_col.obj",)  # collision shapes beside the models
LIMITS = {"clean": {"distance": 7e-4, "iou": 0.990, "seen_normal_degrees": 3.0, "seconds": 20.0},
          "perturbed": {"distance": 2.2e-3, "iou": 0.955, "seen_normal_degrees": 7.0, "seconds": 60.0},
          "materials": {"albedo_psnr": 30.0, "roughness_error": 0.06, "metallic_error": 0.06}}
COLUMNS = (("distance", "Chamfer, 1e-3", 1e3), ("seen_distance", "seen, 1e-3", 1e3), ("iou", "IoU", 1), ("seen_normal_degrees", "normal ° seen", 1),
           ("normal_degrees", "normal °", 1), ("seconds", "seconds", 1), ("peak_mb", "MB", 1), ("watertight", "closed", 1))
MATERIALS = (("albedo_psnr", "albedo dB", 1), ("relit_psnr", "relit dB", 1), ("roughness_error", "roughness", 1), ("metallic_error", "metallic", 1))


def models(given: argparse.Namespace) -> list[tuple[str, str]]:
    """Name and source of every model to take."""
    found = [(f"procedural:{FIRST_SEED + i}",) * 2 for i in range(given.procedural)]
    for place in given.models:
        paths = [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.suffix.lower() in MODEL_SUFFIXES)
        paths = [p for p in paths if not p.name.endswith(LEFT_OUT)][: given.limit or None]
        found += [((p.parent.parent.name if p.stem == "model" else p.stem), str(p)) for p in paths]
    return found


def publish(path: Path, views, cause: Path) -> Path:
    """Write arrays as a views folder, as any other program could."""
    import msgspec

    from gdtool.core.runner import Settings, run_one
    from gdtool.core.stage import Stage
    from gdtool.folders.views import write_views

    Options = msgspec.defstruct("Options", [], frozen=True, kw_only=True, forbid_unknown_fields=True)
    stage = Stage(name="perturb", version=1, reads=("views",), writes="views", Options=Options, run=lambda i, o, out: write_views(out, views))
    run_one(stage, [cause], Options(), {}, Settings(output=path, force=True))
    return path


def measured(vertices: np.ndarray, faces: np.ndarray, truth, cameras) -> dict:
    """Errors of one result against the true scene, in the frame of the views."""
    from gdtool.geometry.metrics import is_closed, surface_protocol

    if len(faces) == 0:
        return {"failed": "nothing came out"}
    found = surface_protocol(vertices, faces, truth.vertices, truth.faces, cameras=cameras, samples=50_000)
    return {name: float(found[name]) for name, _, _ in COLUMNS if name in found} | {"watertight": is_closed(vertices, faces)}


def looks(surface, truth, size: int = 192) -> dict:
    """Albedo dB, roughness and metallic errors and the dB of a relit picture, seen by four cameras that the result was not made from."""
    import torch

    from gdtool.cameras import camera_at, rays
    from gdtool.geometry.rays import RayCaster
    from gdtool.images.color import srgb_from_linear
    from gdtool.shading.closed_form import shade
    from gdtool.shading.sg import SphericalGaussians
    from gdtool.shading.surface_points import surface_attributes

    light = SphericalGaussians(torch.tensor([[0.48, 0.64, 0.6], [-0.8, 0.36, 0.48], [0.0, 0.6, -0.8]]), torch.tensor([20.0, 6.0, 4.0]),
                               torch.tensor([[3.0, 2.8, 2.5], [0.6, 0.8, 1.0], [0.7, 0.6, 0.6]]))
    ours, true = RayCaster(surface.vertices, surface.faces), RayCaster(truth.vertices, truth.faces)
    error = {name: [] for name, _, _ in MATERIALS}
    for i in range(4):
        camera = camera_at(22.5 + 90 * i, 20.0, name=str(i), size=size)
        origins, directions = (x.reshape(-1, 3) for x in rays(camera))
        hits, true_hits = ours.first_hit(origins, directions), true.first_hit(origins, directions)
        both = hits.found & true_hits.found
        both[both] = np.abs(hits.distance[both] - true_hits.distance[both]) < 0.01
        if not both.any():
            continue
        corner, share = surface.faces[hits.face_idx[both]], hits.barycentric[both][..., None]
        mine = {n: (np.asarray(getattr(surface, n)).reshape(len(surface.vertices), -1)[corner] * share).sum(1)
                for n in ("albedo", "roughness", "metallic", "normals")}
        found = surface_attributes(truth, true_hits.face_idx[both], true_hits.barycentric[both])
        theirs = {n: np.asarray(found[n]).reshape(both.sum(), -1) for n in ("albedo", "roughness", "metallic", "normal")}
        toward = torch.as_tensor(np.ascontiguousarray(-directions[both], np.float32))
        pictures = []
        for one, normal in ((mine, mine["normals"]), (theirs, theirs["normal"])):
            normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            lit = shade(torch.as_tensor(np.float32(normal)), toward, torch.as_tensor(np.float32(one["albedo"])), torch.as_tensor(np.float32(one["roughness"][:, 0])),
                        torch.as_tensor(np.float32(one["metallic"][:, 0])), light)
            pictures.append(srgb_from_linear(np.clip(lit.numpy(), 0, 1)))
        squares = lambda a, b: float(np.mean((np.asarray(a, np.float64) - b) ** 2))  # noqa: E731
        error["albedo_psnr"].append(squares(srgb_from_linear(np.clip(mine["albedo"], 0, 1)), srgb_from_linear(np.clip(theirs["albedo"], 0, 1))))
        error["relit_psnr"].append(squares(*pictures))
        for name in ("roughness", "metallic"):
            error[f"{name}_error"].append(float(np.abs(mine[name] - theirs[name]).mean()))
    return {name: (float(-10 * np.log10(max(np.mean(e), 1e-10))) if name.endswith("psnr") else float(np.mean(e))) for name, e in error.items() if e}


def attempt(method: str, case: str, run) -> dict:
    """A record of one run; a failure is named in it."""
    record = {"method": method, "case": case}
    try:
        record |= run()
    except (Failed, ValueError, RuntimeError) as error:
        record["failed"] = str(error)
    say(f"    {case:<22}{method:<18}" + (record.get("failed") or "  ".join(
        f"{head} {number(record[name] * factor)}" for name, head, factor in (*COLUMNS, *MATERIALS) if name in record)))
    return record


def measure(name: str, source: str, folder: Path, given: argparse.Namespace) -> list[dict]:
    """All runs on one model."""
    from gdtool.assets.load import load_scene
    from gdtool.core.folder import open_folder
    from gdtool.folders.surface import read_surface
    from gdtool.folders.views import read_views
    from gdtool.geometry.frames import invert_similarity, transform_points

    say(name)
    clean = folder / "views"
    gdtool("render-dataset", source, "-o", clean, "--size", str(given.size), "--samples", "4", "--light-samples", "4", "--quiet")
    opened = open_folder(clean)
    views, truth = read_views(opened), load_scene(source)
    to_views = invert_similarity(np.array(opened.content.source_from_world).reshape(4, 4))
    truth = replace(truth, vertices=transform_points(to_views, truth.vertices))  # a scale and a shift: its normals stay
    cases = {"clean": (clean, views)} if given.clean else {}
    for wavelength in given.wavelengths:
        for seed in range(given.seeds):
            case = f"perturbed {seed} {wavelength:g}"
            disturbed = perturbed(views, Perturbation(seed, wavelength))
            cases[case] = publish(folder / case.replace(" ", "_"), disturbed, clean), disturbed

    def ours(place: Path, *options: str, materials: bool = False) -> dict:
        target = folder / "surface"
        cost = gdtool("reconstruct", place, "-o", target, "--force", "--quiet", *options, *given.options)
        surface = read_surface(open_folder(target))
        return measured(surface.vertices, surface.faces, truth, views.cameras) | {"seconds": cost.seconds, "peak_mb": cost.peak_mb} | (
            looks(surface, truth) if materials else {})

    def peer(method, views) -> dict:
        start = time.perf_counter()
        vertices, faces = method(views)
        seconds = time.perf_counter() - start
        return measured(vertices, faces, truth, views.cameras) | {"seconds": seconds}

    records = []
    for case, (place, arrays) in cases.items():
        records.append(attempt(OURS, case, lambda place=place, case=case: ours(place, materials=case == "clean")))
        for budget in given.budgets:
            records.append(attempt(f"{OURS} {budget:g} s", case, lambda place=place, budget=budget: ours(place, "--budget", str(budget))))
        for method, function in peers.available().items() if given.peers else ():
            records.append(attempt(method, case, lambda function=function, arrays=arrays: peer(function, arrays)))
    return [{"model": name, "source": source, **record} for record in records]


def kind(record: dict) -> str:
    """clean or perturbed."""
    return record["case"].split()[0]


def middle(records: list[dict], name: str) -> float | None:
    """Median of a figure over the records that have it."""
    values = [float(r[name]) for r in records if name in r]
    return median(values) if values else None


def summary(records: list[dict], case: str) -> str:
    """Medians by method."""
    chosen = [r for r in records if kind(r) == case]
    rows = []
    for method in dict.fromkeys(r["method"] for r in chosen):
        part = [r for r in chosen if r["method"] == method]
        cells = [f"{sum(bool(r.get('watertight')) for r in part)} of {len(part)}" if name == "watertight" else
                 number(None if (value := middle(part, name)) is None else value * factor) for name, _, factor in (*COLUMNS, *MATERIALS)]
        rows.append([method, *cells, str(sum("failed" in r for r in part))])
    return table(["method", *(head for _, head, _ in (*COLUMNS, *MATERIALS)), "failed"], rows)


def by_model(records: list[dict], case: str) -> str:
    """Our median Chamfer of every model beside the best peer's, and what the worst is."""
    rows = []
    for model in dict.fromkeys(r["model"] for r in records):
        part = [r for r in records if r["model"] == model and kind(r) == case]
        mine = [r for r in part if r["method"] == OURS]
        others = {m: middle([r for r in part if r["method"] == m], "distance") for m in {r["method"] for r in part} if not m.startswith(OURS)}
        others = {m: value for m, value in others.items() if value is not None}
        best = min(others, key=others.get) if others else ""
        own = middle(mine, "distance")
        rows.append([model, *(number(None if (v := middle(mine, n)) is None else v * f) for n, _, f in COLUMNS[:6]),
                     number(others[best] * 1e3) if best else "–", best, "" if own is None or not best else "yes" if own <= others[best] else "NO"])
    return table(["model", *(head for _, head, _ in COLUMNS[:6]), "best peer, 1e-3", "which", "not worse"], rows)


def verdict(records: list[dict]) -> str:
    """A line for each limit of the issue."""
    lines = []
    for case, limits in LIMITS.items():
        mine = [r for r in records if r["method"] == OURS and kind(r) == ("clean" if case == "materials" else case)]
        for name, limit in limits.items():
            value = middle(mine, name)
            if value is not None:
                good = value >= limit if name in ("iou", "albedo_psnr") else value <= limit
                lines.append(f"- {case}: median {name} {number(value)}, wanted {'≥' if name in ('iou', 'albedo_psnr') else '≤'} {limit:g}: "
                             + ("holds" if good else "**missed**"))
    return "\n".join(lines)


def markdown(records: list[dict], given: argparse.Namespace, remark: str) -> str:
    """The report."""
    count = len({r["model"] for r in records})
    parts = ["# Reconstruction: six views to a surface", "",
             f"By `benchmarks/reconstruct.py` on {machine()}; {count} models, views of {given.size}², {given.seeds} seeds of the disturbance, "
             f"wavelengths {', '.join(f'{w:g}' for w in given.wavelengths)} of the picture. Medians. {remark}", "",
             "Chamfer: point to surface, mean of both directions, largest extent of the truth 1. IoU: closed truths only.", "", verdict(records), ""]
    for case, title in (("clean", "Exact views"), ("perturbed", "Disturbed views")):
        if any(kind(r) == case for r in records):
            parts += [f"## {title}", "", summary(records, case), "", by_model(records, case), ""]
    failed = [f"- {r['model']}, {r['case']}, {r['method']}: {r['failed']}" for r in records if "failed" in r]
    return "\n".join([*parts, *(["## Failed", "", *failed, ""] if failed else []), "![time against error](reconstruct.png)", ""])


def plot(records: list[dict], path: Path) -> None:
    """Time against Chamfer and IoU, medians by method."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cases = [case for case in ("clean", "perturbed") if any(kind(r) == case for r in records)]
    figure, axes = plt.subplots(2, len(cases), figsize=(6 * len(cases), 7), layout="constrained", squeeze=False)
    for column, case in enumerate(cases):
        for row, (name, label) in enumerate((("distance", "Chamfer"), ("iou", "IoU"))):
            axis = axes[row, column]
            for method in dict.fromkeys(r["method"] for r in records):
                part = [r for r in records if r["method"] == method and kind(r) == case]
                seconds, value = middle(part, "seconds"), middle(part, name)
                if seconds is not None and value is not None:
                    axis.plot(seconds, value, "o" if method.startswith(OURS) else "s", label=method, markersize=9)
            if name in LIMITS[case]:
                axis.axhline(LIMITS[case][name], color="grey", linestyle=":")
            axis.set(xscale="log", xlabel="seconds", ylabel=label, title=case, yscale="log" if name == "distance" else "linear")
            if axis.has_data():
                axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def arguments() -> argparse.Namespace:
    def numbers(text: str) -> list[float]:
        return [float(part) for part in text.split(",") if part]

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--procedural", type=int, default=8, help="number of procedural objects (default 8)")
    parser.add_argument("--models", type=Path, action="append", default=[], metavar="DIR", help="also every model in this folder")
    parser.add_argument("--limit", type=int, default=0, help="at most this many models of a folder")
    parser.add_argument("--size", type=int, default=256, help="width and height of the views (default 256)")
    parser.add_argument("--seeds", type=int, default=1, help="disturbances of every model and wavelength (default 1)")
    parser.add_argument("--wavelengths", type=numbers, default=[1 / 8], help="of the disturbance, shares of the picture (default 0.125)")
    parser.add_argument("--budgets", type=numbers, default=[], help="also run ours with --budget of these seconds")
    parser.add_argument("--no-clean", dest="clean", action="store_false", help="leave the exact views out")
    parser.add_argument("--no-peers", dest="peers", action="store_false", help="leave the peers out")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep (and find again) the folders of every model here")
    parser.add_argument("--option", dest="options", action="append", default=[], help="further option of gdtool reconstruct, as --option=--method=paper")
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parents[1] / "docs" / "benchmarks", help="folder of the report")
    return parser.parse_args()


def main() -> None:
    given = arguments()
    given.output.mkdir(parents=True, exist_ok=True)
    remark, records = busy(), []
    for name, source in models(given):
        with tempfile.TemporaryDirectory() as folder:
            place = given.keep / name.replace(":", "-") if given.keep else Path(folder)
            try:
                records += measure(name, source, place, given)
            except Failed as error:
                say(f"{name}: left out: {error}")
                continue
        (given.output / "reconstruct.json").write_text(json.dumps({"machine": machine(), "remark": remark, "records": records}, indent=1) + "\n")
        (given.output / "reconstruct.md").write_text(markdown(records, given, remark))
    plot(records, given.output / "reconstruct.png")
    print(markdown(records, given, remark))


if __name__ == "__main__":
    main()
