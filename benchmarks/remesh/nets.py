"""Remesh on nets of many handles: what the limits on quads for each handle leave untried, beside all that was tried
without them.

    python -m benchmarks.remesh.nets [-o docs/benchmarks] [--grid 140]

Struts and Schwarz' P surface, marched. "as they are": the limits _MIN_QUADS_PER_HANDLE of remesh.pipeline and
remesh.engines.search, and _MIN_TRIANGLES_PER_HANDLE of remesh.fallback.pair_and_split; "without": all of them zero.
"handles": as many as in the net, or what is made of them. Seconds are of remesh() alone. Writes remesh_nets.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.common.measure import busy, machine, number, say, table
from gdtool.geometry.meshes import TriMesh

COLUMNS = (
    "net",
    "handles of the net",
    "quads for each",
    "limits",
    "seconds",
    "quads",
    "handles",
    "jacobian",
    "least",
    "irregular",
    "hausdorff",
    "as",
)
NETS = (
    ("struts", 3),
    ("struts", 5),
    ("thin struts", 3),
    ("thin struts", 4),
    ("Schwarz P", 3),
    ("Schwarz P", 4),
    ("Schwarz P", 5),
    ("Schwarz P", 6),
)
COUNTS = (20000, 10000)


def net(kind: str, cells: int, grid: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward triangles of a cube full of so many cells along an edge, in a unit box."""
    from skimage.measure import marching_cubes

    from gdtool.geometry import repair

    line = np.linspace(-0.04, 1.04, grid)
    places = np.meshgrid(line, line, line, indexing="ij")
    out = np.max([abs(axis - 0.5) for axis in places], 0) - 0.5
    if kind == "Schwarz P":
        field = np.maximum(sum(np.cos(2 * np.pi * cells * axis) for axis in places), 6 * out)
    else:
        radius = (0.12 if kind.startswith("thin") else 0.2) / cells
        x, y, z = (abs(cells * axis - np.round(cells * axis)) / cells for axis in places)
        field = np.maximum(np.min([np.hypot(x, y), np.hypot(y, z), np.hypot(x, z)], 0) - radius, out - 0.9 * radius)
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    low, high = vertices.min(0), vertices.max(0)
    unit = TriMesh((vertices - (low + high) / 2) / (high - low).max(), faces[:, ::-1].astype(np.int64))
    mesh = repair.clean(unit).mesh
    return mesh.vertices, mesh.faces


def measured(vertices: np.ndarray, faces: np.ndarray, count: int) -> dict:
    from gdtool.geometry import mesh_quality, topology
    from gdtool.remesh.pipeline import remesh
    from gdtool.remesh.task import Request

    start = time.perf_counter()
    made, record = remesh(TriMesh(vertices, faces), Request(quads=count))
    quads = made.faces
    seconds = time.perf_counter() - start
    shape = mesh_quality.shape_figures(made)
    return {
        "seconds": seconds,
        "quads": len(quads),
        "handles": topology.handles(quads, topology.components(quads)[0]),
        "jacobian": shape["jacobian_mean"],
        "least": shape["jacobian_min"],
        "irregular": mesh_quality.topology_figures(made)["irregular_share"],
        "hausdorff": mesh_quality.distance_figures(made.triangles, TriMesh(vertices, faces), 20000)["hausdorff"],
        "as": record.engine,
    }


def main() -> None:
    from gdtool.geometry import topology
    from gdtool.remesh import pipeline as quads
    from gdtool.remesh.engines import search
    from gdtool.remesh.fallback import pair_and_split

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--grid", type=int, default=140, help="points along an edge that the nets are marched on")
    given = parser.parse_args()
    head, rows = busy(), []
    limits = {
        (module, name): getattr(module, name)
        for module, name in (
            (quads, "_MIN_QUADS_PER_HANDLE"),
            (search, "_MIN_QUADS_PER_HANDLE"),
            (pair_and_split, "_MIN_TRIANGLES_PER_HANDLE"),
        )
    }
    for kind, cells in NETS:
        vertices, faces = net(kind, cells, given.grid)
        handles = topology.handles(faces, topology.components(faces)[0])
        for count in COUNTS:
            for name in ("as they are", "without"):
                for (module, constant), limit in limits.items():
                    setattr(module, constant, limit if name == "as they are" else 0)
                say(f"{kind} {cells}: {count}, limits {name}")
                rows.append(
                    {
                        "net": f"{kind} {cells}",
                        "handles of the net": handles,
                        "quads for each": round(count / handles),
                        "limits": name,
                    }
                    | measured(vertices, faces, count)
                )
    text = table(
        COLUMNS,
        ([row[name] if isinstance(row[name], str) else number(row[name], 3) for name in COLUMNS] for row in rows),
    )
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "remesh_nets.md").write_text(
        f"# Remesh on nets of many handles\n\nBy `benchmarks/remesh/nets.py` on {machine()}. {head}\n\n{text}\n"
    )
    print(text)


if __name__ == "__main__":
    main()
