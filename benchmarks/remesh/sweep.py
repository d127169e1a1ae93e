"""Time against error of remesh, its knobs swept, beside the engines alone, from marching-cubes meshes of a million
faces.

    python -m benchmarks.remesh.sweep [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--faces 20000] [--input 1000000] \
        [--peers-python PYTHON]

Writes remesh.md, remesh.json, remesh.png and the wireframes remesh_sheet.png, row by row: killed, it goes on where it
was. The knobs are swept on the solids of --sweep, pyQuadriFlow runs on the models of --slow-on; everything else, with
Blender's QuadriFlow through a Python that has bpy, on everything. Every run is a child process with a time limit;
seconds are of its wall clock and of the processor, from arrays in memory to arrays in memory, for ours and Instant
Meshes of the quickest of --runs: a shared machine takes longer now and then, by up to a half. "of a file": positions in
single precision, as files have them, which repair.clean gets first, as in the command. Lengths are shares of the
bounding box' diagonal. A crease of the truth is recalled where a sharp edge (30 degrees) of the result is within 0.2 %
of the diagonal."""

from __future__ import annotations

import argparse
import os
import time
from importlib.util import find_spec

import numpy as np

from benchmarks.common.fine_meshes import Fine, models_in, of_model, of_solid
from benchmarks.common.measure import ROOT, busy, machine, number, say, table
from benchmarks.common.mesh_runs import arguments, as_commanded, beside, blender, cost_since, plot
from benchmarks.common.resumable_rows import Rows
from benchmarks.common.wireframe import file_name, sheet, wireframe
from gdtool.geometry.meshes import QuadMesh, TriMesh

OF_A_FILE = "ours, of a file"
WAYS = {
    "ours": {},
    OF_A_FILE: {},
    "ours, not restored": {"restore_creases": False},
    "ours, not smoothed": {"smooth_iterations": 0},
    "ours, smoothed 20": {"smooth_iterations": 20},
    "ours, no engine": {"engine": "split"},
}
BLENDER = "Blender QuadriFlow"
SLOW = "QuadriFlow"
EVERYWHERE, REPEATED = ("ours", OF_A_FILE), ("ours", OF_A_FILE, "Instant Meshes")
PEERS = {"Instant Meshes": "pynanoinstantmeshes", "QuadriFlow": "pyQuadriFlow"}
COLUMNS = (
    "model",
    "way",
    "seconds",
    "processor",
    "peak MB",
    "quads",
    "watertight",
    "irregular",
    "jacobian",
    "least",
    "zero area",
    "mean",
    "hausdorff",
    "crease mean",
    "crease recall",
)


def ours(vertices: np.ndarray, faces: np.ndarray, quads: int, options: dict, of_a_file: bool = False) -> tuple:
    """In a child: vertices, quads, cost, the engine taken."""
    as_commanded()
    from gdtool.geometry.repair import clean
    from gdtool.remesh.pipeline import remesh
    from gdtool.remesh.task import Request

    if of_a_file:
        vertices = vertices.astype(np.float32)
    start = time.perf_counter()
    if of_a_file:
        cleaned = clean(TriMesh(vertices, faces)).mesh
        vertices, faces = cleaned.vertices, cleaned.faces
    made, record = remesh(TriMesh(vertices, faces), Request(quads=quads, **options))
    out, found = made.vertices, made.faces
    return out, found, cost_since(start), record.engine


def peer(vertices: np.ndarray, faces: np.ndarray, quads: int, name: str) -> tuple:
    """In a child: an engine as its users call it."""
    from gdtool.remesh.engines import adapters

    start = time.perf_counter()
    run = adapters.run_instant_meshes if name == "Instant Meshes" else adapters.run_quadriflow
    made = run(TriMesh(vertices.astype(np.float32), faces.astype(np.int32)), quads, 30.0)
    return made.vertices, made.faces, cost_since(start), name


def float32_zero_area(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """Triangles without area once their corners are rounded as a .glb rounds them."""
    p = vertices.astype(np.float32).astype(np.float64)[triangles]
    return int((np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) < 1e-14).sum())


def crease_figures(
    creases: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, diagonal: float
) -> dict[str, float]:
    """Mean distance of the true creases to the nearest sharp edge of the result, and the share of them within 0.2 %."""
    from scipy.spatial import cKDTree

    from gdtool.geometry.sharpen import dihedral_degrees

    ends, _, angle = dihedral_degrees(TriMesh(vertices, triangles))
    sharp = ends[angle > 30]
    if not len(sharp):
        return {"crease mean": float("nan"), "crease recall": 0.0}
    share = np.linspace(0, 1, 25)[None, :, None]
    points = vertices[sharp[:, :1]] * (1 - share) + vertices[sharp[:, 1:]] * share
    distance = cKDTree(points.reshape(-1, 3)).query(creases.mean(1))[0] / diagonal
    length = np.linalg.norm(creases[:, 0] - creases[:, 1], axis=1)
    return {
        "crease mean": float((distance * length).sum() / length.sum()),
        "crease recall": float(length[distance < 0.002].sum() / length.sum()),
    }


def score(fine: Fine, vertices: np.ndarray, quads: np.ndarray) -> dict:
    """Figures of one result against its input."""
    from gdtool.geometry.mesh_quality import distance_figures, shape_figures, topology_figures
    from gdtool.geometry.topology import triangulated

    triangles = triangulated(quads)[0]
    diagonal = float(np.linalg.norm(np.ptp(fine.vertices, 0)))
    top, shape = topology_figures(QuadMesh(vertices, quads)), shape_figures(QuadMesh(vertices, quads))
    far = distance_figures(TriMesh(vertices, triangles), TriMesh(fine.vertices, fine.faces), 50_000)
    out = {
        "quads": len(quads),
        "watertight": top["watertight"],
        "irregular": top["irregular_share"],
        "jacobian": shape["jacobian_mean"],
        "least": shape["jacobian_min"],
        "zero area": float32_zero_area(vertices, triangles),
        "mean": far["distance_mean"] / diagonal,
        "hausdorff": far["hausdorff"] / diagonal,
    }
    return out | ({} if fine.creases is None else crease_figures(fine.creases, vertices, triangles, diagonal))


def measure(fine: Fine, ways: list[str], asked: argparse.Namespace, rows: Rows) -> None:
    """A row for each way that has none yet; one that fails says why.

    Keeps a wireframe, and our quads for benchmarks/unwrap/sweep.py.
    """
    from gdtool.core.child import ChildFailed, call
    from gdtool.images.io import write_png

    for way in ways:
        if rows.has(fine.name, way) or time.monotonic() > asked.end:
            continue
        say(f"{fine.name}: {way}")
        try:
            if way == BLENDER:
                triangles = np.concatenate([fine.faces, np.full((len(fine.faces), 1), -1)], 1)
                made, cost = blender(
                    "quadriflow", fine.vertices, triangles, asked.faces, asked.peers_python, asked.limit
                )
                found = made["vertices"], made["faces"], cost, BLENDER
            else:
                run, *given = (peer, way) if way in PEERS else (ours, WAYS[way], way == OF_A_FILE)
                found = min(
                    (
                        call(run, fine.vertices, fine.faces, asked.faces, *given, seconds=asked.limit, memory_mb=16000)
                        for _ in range(asked.runs if way in REPEATED else 1)
                    ),
                    key=lambda one: one[2]["seconds"],
                )
            row = {"model": fine.name, "way": way, "engine": found[3], **found[2], **score(fine, *found[:2])}
            if way == "ours":
                np.savez(asked.kept / f"{fine.name}_{asked.faces}_quads.npz", vertices=found[0], faces=found[1])
            if way in ("ours", "Instant Meshes", BLENDER):
                (asked.kept / "pictures").mkdir(parents=True, exist_ok=True)
                write_png(asked.kept / "pictures" / file_name(fine.name, way), wireframe(found[0], found[1]))
        except ChildFailed as failure:
            row = {"model": fine.name, "way": way, "failed": str(failure)}
        rows.add(row)


def main() -> None:
    parser = arguments(__doc__, "mesh files", "a Python that has bpy; without it Blender is left out")
    parser.add_argument(
        "--input", type=int, default=1_000_000, help="triangles of each solid and of each model, made solid"
    )
    parser.add_argument("--sweep", default="part,knobs", help="solids that the knobs are swept on")
    parser.add_argument("--runs", type=int, default=3, help="of ours and of Instant Meshes on each model")
    parser.add_argument("--slow-on", default="part,knobs", help="models that pyQuadriFlow runs on")
    asked = parser.parse_args()
    if not asked.models:
        say("no models are named: the solids alone")
    asked.end = time.monotonic() + 60 * asked.minutes
    os.environ["PYTHONPATH"] = str(ROOT)  # child processes import this package
    if not asked.peers_python:
        say("Blender is left out: no --peers-python")
    note = busy()
    rows = Rows(
        asked.out / "remesh.json",
        {name: str(value) for name, value in vars(asked).items() if name not in ("out", "kept", "minutes", "end")},
    )

    def ways(name: str) -> list[str]:
        out = [way for way in WAYS if way in EVERYWHERE or name in asked.sweep.split(",")]
        out += [
            way
            for way, package in PEERS.items()
            if find_spec(package) and (way != SLOW or name in asked.slow_on.split(","))
        ]
        out += [BLENDER] if asked.peers_python else []
        return [way for way in out if not asked.only or way in asked.only.split(",")]

    def report(complete: bool) -> str:
        rows.write(complete)
        text = table(
            COLUMNS,
            (
                [number(row.get(name, "failed" if name == "quads" and "failed" in row else None)) for name in COLUMNS]
                for row in rows.rows
            ),
        )
        failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows.rows if "failed" in row)
        head = (
            f"# Remesh: {asked.faces} quads from {asked.input} triangles\n\n"
            f"`make bench-assets`, {machine()}. {note}\n\nSeconds of {'; '.join(REPEATED)} are the least of "
            f"{asked.runs} runs, the others' of one.\n\n"
        )
        foot = f"\nFailed:\n\n{failed}\n" if failed else ""
        (asked.out / "remesh.md").write_text(
            head
            + beside(rows.rows, [*PEERS, BLENDER], (OF_A_FILE,))
            + "\n\n"
            + text
            + "\n"
            + foot
            + "\n![time against error](remesh.png)\n\n![wireframes](remesh_sheet.png)\n"
        )
        plot(rows.rows, asked.out / "remesh.png", "mean", "mean distance, share of the diagonal", True)
        sheet(
            asked.kept / "pictures",
            list(dict.fromkeys(row["model"] for row in rows.rows)),
            ["ours", "Instant Meshes", BLENDER],
            asked.out / "remesh_sheet.png",
        )
        return text

    sources = [*filter(None, asked.solids.split(",")), *models_in(asked.models)]
    text = ""
    for source in sources:
        if time.monotonic() > asked.end:
            break
        name = source if isinstance(source, str) else source.stem
        if not all(rows.has(name, way) for way in ways(name)) and not rows.has(name, "read"):
            try:
                fine = (
                    of_solid(source, asked.input, asked.kept)
                    if isinstance(source, str)
                    else of_model(source, asked.input, asked.kept)
                )
            except Exception as failure:  # a broken model is a row of the table, not the end of it
                rows.add({"model": name, "way": "read", "failed": str(failure)})
            else:
                measure(fine, ways(name), asked, rows)
        text = report(source is sources[-1] and time.monotonic() < asked.end)
    print(text)
    if time.monotonic() > asked.end:
        say(f"not all began within {asked.minutes:g} minutes: run it again and it goes on")


if __name__ == "__main__":
    main()
