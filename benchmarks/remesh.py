"""Time against error of remesh, its knobs swept, beside the engines alone, from marching-cubes meshes of a million faces.

    python benchmarks/remesh.py [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--solids part,bracket,knobs,rings] [--faces 20000] [--input 1000000]

Writes remesh.md, remesh.json and remesh.png. Every run is a child process with a time limit; seconds are of its wall clock
and of the processor, from arrays in memory to arrays in memory. Lengths are shares of the bounding box' diagonal. A crease
of the truth is recalled where a sharp edge (30 degrees) of the result is within 0.2 % of the diagonal.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from fine_meshes import SOLIDS, Fine, models_in, of_model, of_solid
from measure import busy, machine, number, say, table

WAYS = {
    "ours": {}, "ours, not restored": {"restore_creases": False}, "ours, not smoothed": {"smooth_iterations": 0},
    "ours, smoothed 20": {"smooth_iterations": 20}, "ours, no engine": {"engine": "split"},
}
PEERS = {"Instant Meshes": "pynanoinstantmeshes", "QuadriFlow": "pyQuadriFlow"}
COLUMNS = ("model", "way", "seconds", "processor", "peak MB", "quads", "watertight", "irregular", "jacobian", "least", "zero area", "mean",
           "hausdorff", "crease mean", "crease recall")


def ours(vertices: np.ndarray, faces: np.ndarray, quads: int, options: dict) -> tuple:
    """In a child: vertices, quads, cost, the engine taken."""
    from gdtool.geometry.quads import Request, remesh

    start = time.perf_counter()
    out, found, record = remesh(vertices, faces, Request(quads=quads, **options))
    return out, found, _cost(start), record.engine


def peer(vertices: np.ndarray, faces: np.ndarray, quads: int, name: str) -> tuple:
    """In a child: an engine as its users call it."""
    from gdtool.geometry import quad_engines

    start = time.perf_counter()
    run = quad_engines.run_instant_meshes if name == "Instant Meshes" else quad_engines.run_quadriflow
    out, found = run(vertices.astype(np.float32), faces.astype(np.int32), quads, 30.0)
    return out, found, _cost(start), name


def _cost(start: float) -> dict[str, float]:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"seconds": time.perf_counter() - start, "processor": sum(u.ru_utime + u.ru_stime for u in both),
            "peak MB": max(u.ru_maxrss for u in both) / 1024}


def float32_zero_area(vertices: np.ndarray, triangles: np.ndarray) -> int:
    """Triangles without area once their corners are rounded as a .glb rounds them."""
    p = vertices.astype(np.float32).astype(np.float64)[triangles]
    return int((np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) < 1e-14).sum())


def crease_figures(creases: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, diagonal: float) -> dict[str, float]:
    """Mean distance of the true creases to the nearest sharp edge of the result, and the share of them within 0.2 %."""
    from scipy.spatial import cKDTree

    from gdtool.geometry.sharpen import dihedral_degrees

    ends, _, angle = dihedral_degrees(vertices, triangles)
    sharp = ends[angle > 30]
    if not len(sharp):
        return {"crease mean": float("nan"), "crease recall": 0.0}
    share = np.linspace(0, 1, 25)[None, :, None]
    points = vertices[sharp[:, :1]] * (1 - share) + vertices[sharp[:, 1:]] * share
    distance = cKDTree(points.reshape(-1, 3)).query(creases.mean(1))[0] / diagonal
    length = np.linalg.norm(creases[:, 0] - creases[:, 1], axis=1)
    return {"crease mean": float((distance * length).sum() / length.sum()), "crease recall": float(length[distance < 0.002].sum() / length.sum())}


def score(fine: Fine, vertices: np.ndarray, quads: np.ndarray) -> dict:
    """Figures of one result against its input."""
    from gdtool.folders.mesh import triangulated
    from gdtool.geometry.mesh_quality import distance_figures, shape_figures, topology_figures

    triangles = triangulated(quads)[0]
    diagonal = float(np.linalg.norm(np.ptp(fine.vertices, 0)))
    top, shape = topology_figures(vertices, quads), shape_figures(vertices, quads)
    far = distance_figures(vertices, triangles, fine.vertices, fine.faces, 50_000)
    out = {"quads": len(quads), "watertight": top["watertight"], "irregular": top["irregular_share"], "jacobian": shape["jacobian_mean"],
           "least": shape["jacobian_min"], "zero area": float32_zero_area(vertices, triangles), "mean": far["distance_mean"] / diagonal,
           "hausdorff": far["hausdorff"] / diagonal}
    return out | ({} if fine.creases is None else crease_figures(fine.creases, vertices, triangles, diagonal))


def measure(fine: Fine, quads: int, limit: float, ways: list[str]) -> list[dict]:
    """A row for each way; one that fails says why."""
    from gdtool.core.child import ChildFailed, call

    rows = []
    for way in ways:
        say(f"{fine.name}: {way}")
        try:
            if way in PEERS:
                found = call("remesh:peer", fine.vertices, fine.faces, quads, way, seconds=limit, memory_mb=16000)
            else:
                found = call("remesh:ours", fine.vertices, fine.faces, quads, WAYS[way], seconds=limit, memory_mb=16000)
            rows.append({"model": fine.name, "way": way, "engine": found[3], **found[2], **score(fine, *found[:2])})
        except ChildFailed as failure:
            rows.append({"model": fine.name, "way": way, "failed": str(failure)})
    return rows


def plot(rows: list[dict], path: Path) -> None:
    """Processor seconds against mean distance, a mark per model, a colour per way."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), dpi=110)
    for way in dict.fromkeys(row["way"] for row in rows):
        mine = [row for row in rows if row["way"] == way and "mean" in row]
        axes.scatter([row["processor"] for row in mine], [row["mean"] for row in mine], label=way, s=22)
    axes.set(xscale="log", yscale="log", xlabel="seconds of the processor", ylabel="mean distance, share of the diagonal")
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--solids", default=",".join(SOLIDS))
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--input", type=int, default=1_000_000, help="triangles of each input")
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"), help="folder for the inputs once made")
    parser.add_argument("--limit", type=float, default=180.0, help="seconds for one run")
    parser.add_argument("--only", default="", help="comma list of ways; all of them when empty")
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # the children import this file
    ways = [way for way in (*WAYS, *(name for name, package in PEERS.items() if find_spec(package)))
            if not asked.only or way in asked.only.split(",")]
    note, rows = busy(), []
    for name in filter(None, asked.solids.split(",")):
        rows += measure(of_solid(name, asked.input, asked.kept), asked.faces, asked.limit, ways)
    for path in models_in(asked.models):
        try:
            fine = of_model(path, asked.input, asked.kept)
        except Exception as failure:  # a broken model is a row of the table, not the end of it
            rows.append({"model": path.name, "way": "read", "failed": str(failure)})
            continue
        rows += measure(fine, asked.faces, asked.limit, ways)
    asked.out.mkdir(parents=True, exist_ok=True)
    text = table(COLUMNS, ([number(row.get(name, "failed" if name == "quads" and "failed" in row else None)) for name in COLUMNS] for row in rows))
    failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows if "failed" in row)
    head = f"# Remesh: {asked.faces} quads from {asked.input} triangles\n\n`python benchmarks/remesh.py`, {machine()}. {note}\n\n"
    (asked.out / "remesh.md").write_text(head + text + "\n" + (f"\nFailed:\n\n{failed}\n" if failed else "") + "\n![time against error](remesh.png)\n")
    (asked.out / "remesh.json").write_text(json.dumps({"machine": machine(), "faces": asked.faces, "input": asked.input, "rows": rows}, indent=1) + "\n")
    plot(rows, asked.out / "remesh.png")
    print(text)


if __name__ == "__main__":
    main()
