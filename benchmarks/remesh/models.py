"""Remesh on models as their makers left them, parts and thin walls and slivers and all, beside Instant Meshes alone.

    python -m benchmarks.remesh.models [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--faces 20000]

Writes remesh_models.md and remesh_models.json, row by row: killed, it goes on where it was. "as": what `gdtool remesh`
took, and how many ways it passed over before. Distances are shares of the longest side; seconds are of the whole
command, and of the engine's one call from arrays to arrays in a child; a peer that gives nothing in two minutes has a
row without figures."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.common.measure import Failed, busy, gdtool, machine, number, say, table
from benchmarks.common.resumable_rows import Rows
from gdtool.geometry.meshes import TriMesh

PEER = "Instant Meshes"
COLUMNS = (
    "model",
    "way",
    "seconds",
    "quads",
    "watertight",
    "irregular",
    "jacobian",
    "least",
    "folded",
    "mean",
    "hausdorff",
    "normal deg",
    "as",
)


def models_in(places: list[Path]) -> list[Path]:
    """The models in files and folders, sorted."""
    from gdtool.assets.load import SUFFIXES

    found = [path for place in places for path in ([place] if place.is_file() else sorted(place.rglob("*")))]
    return [path for path in found if path.suffix.lower() in SUFFIXES]


def ours(path: Path, faces: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        cost = gdtool("remesh", "--quiet", "--faces", str(faces), path, "-o", Path(folder) / "mesh")
        made = json.loads((Path(folder) / "mesh/manifest.json").read_text())
    content = made["content"]
    return {
        "seconds": cost.seconds,
        "quads": content["quads"],
        "as": f"{content['engine']} ({len(content['tried'])})",
    } | figures_of(content["report"])


def peer(path: Path, faces: int) -> dict:
    from gdtool.assets.load import load_scene
    from gdtool.core.child import call
    from gdtool.geometry import mesh_quality, repair, topology
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
    from gdtool.remesh.engines.adapters import run_instant_meshes

    scene = load_scene(path)
    used = topology.compact(TriMesh(scene.vertices, scene.faces.astype(np.int64)))
    vertices, triangles = used.vertices, used.faces
    in_box = TriMesh(transform_points(invert_similarity(unit_box(vertices)), vertices), triangles)
    mesh = repair.clean(in_box, path).mesh
    start = time.perf_counter()
    made = call(
        run_instant_meshes,
        TriMesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)),
        faces,
        30.0,
        seconds=120,
        memory_mb=16000,
    )
    seconds = time.perf_counter() - start
    report = mesh_quality.topology_figures(made) | mesh_quality.shape_figures(made)
    report |= mesh_quality.distance_figures(made.triangles, mesh, 20000)
    return {"seconds": seconds, "quads": len(made.faces), "as": ""} | figures_of(report)


def figures_of(report: dict) -> dict:
    return {
        "watertight": bool(report["watertight"]),
        "irregular": report["irregular_share"],
        "jacobian": report["jacobian_mean"],
        "least": report["jacobian_min"],
        "folded": report["folded_share"],
        "mean": report["distance_mean"],
        "hausdorff": report["hausdorff"],
        "normal deg": report["normal_deg"],
    }


def main() -> None:
    from gdtool.core.child import ChildFailed
    from gdtool.core.errors import GdtoolError

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", type=Path, help="without any nothing is measured")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--faces", type=int, default=20000)
    given = parser.parse_args()
    if not given.models:
        say("no models are named: nothing is measured")
        return
    head, rows = busy(), Rows(given.out / "remesh_models.json", {"faces": given.faces})
    for path in models_in(given.models):
        for way, run in (("ours", ours), (PEER, peer)):
            if rows.has(path.name, way):
                continue
            say(f"{path.name}: {way}")
            try:
                row = run(path, given.faces)
            except (Failed, GdtoolError, ChildFailed) as failure:
                say(f"  {failure}")
                row = {"as": "failed"}
            rows.add({"model": path.name, "way": way} | row)
    rows.write(True)
    own = [row for row in rows.rows if row["way"] == "ours" and "quads" in row]
    fields = sum("pair and split" not in row["as"] for row in own)
    text = (
        f"# Remesh on models as they come\n\nBy `benchmarks/remesh/models.py` on {machine()}, {given.faces} quads "
        f"asked for. {head}\n\n"
        + table(COLUMNS, [[number(row.get(name)) for name in COLUMNS] for row in rows.rows])
        + (
            f"\n\nOf {len(own)} models {fields} are field-aligned quads all over; {len(own) - fields} have parts of "
            f"paired triangles, cut in quads.\n"
        )
    )
    (given.out / "remesh_models.md").write_text(text)


if __name__ == "__main__":
    main()
