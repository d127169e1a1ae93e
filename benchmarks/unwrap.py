"""Time against coverage of unwrap, its knobs swept, beside xatlas alone, on quad meshes that remesh made.

    python benchmarks/unwrap.py [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--solids part,bracket,knobs,rings] [--faces 20000]

Writes unwrap.md, unwrap.json and unwrap.png. Models that are quads already are taken as they are; others are remeshed
first. All leave two texels between charts at 1024. Every run is a child process with a time limit; mirrored is a share of
the area, overlap a share of what is covered.
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
from fine_meshes import SOLIDS, models_in, of_model, of_solid
from measure import busy, machine, number, say, table

SIZE, PADDING = 1024, 2
WAYS = {"ours": {}, "ours, stretch 1.005": {"good_stretch": 1.005}, "ours, cost 1": {"max_cost": 1.0}, "ours, cost 4": {"max_cost": 4.0}}
PEERS = {"xatlas": False, "xatlas, brute force": True}
COLUMNS = ("model", "way", "seconds", "processor", "charts", "coverage", "overlap", "stretch", "area_distortion", "angle_distortion", "mirrored",
           "seam_length")


def ours(vertices: np.ndarray, faces: np.ndarray, options: dict) -> tuple:
    """In a child: texture coordinates, faces into them, cost."""
    from gdtool.texture.unwrap import Request, unwrap

    start = time.perf_counter()
    out = unwrap(vertices, faces, Request(size=SIZE, padding=PADDING, **options))
    return out.uv, out.face_uvs.astype(np.int64), _cost(start)


def peer(vertices: np.ndarray, triangles: np.ndarray, brute_force: bool) -> tuple:
    """In a child: xatlas as its users call it, on triangles."""
    import xatlas

    start = time.perf_counter()
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bruteForce = SIZE, PADDING, brute_force
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack)
    _, face_uvs, uv = atlas[0]
    cost = _cost(start)
    corners = np.concatenate([face_uvs.astype(np.int64), np.full((len(face_uvs), 1), -1)], 1)
    return np.asarray(uv, np.float64) * (1, -1) + (0, 1), corners, cost


def _cost(start: float) -> dict[str, float]:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"seconds": time.perf_counter() - start, "processor": sum(u.ru_utime + u.ru_stime for u in both)}


def measure(name: str, vertices: np.ndarray, faces: np.ndarray, limit: float, ways: list[str]) -> list[dict]:
    """A row for each way; one that fails says why. faces (f, 4)."""
    from gdtool.core.child import ChildFailed, call
    from gdtool.folders.mesh import triangulated
    from gdtool.texture.unwrap import figures

    rows = []
    triangles = triangulated(faces)[0].astype(np.int64)
    for way in ways:
        say(f"{name}: {way}")
        try:
            if way in PEERS:
                uv, face_uvs, cost = call("unwrap:peer", vertices, triangles, PEERS[way], seconds=limit, memory_mb=16000)
                found = figures(vertices, np.concatenate([triangles, np.full((len(triangles), 1), -1)], 1), uv, face_uvs, SIZE)
            else:
                uv, face_uvs, cost = call("unwrap:ours", vertices, faces, WAYS[way], seconds=limit, memory_mb=16000)
                found = figures(vertices, faces, uv, face_uvs, SIZE)
            rows.append({"model": name, "way": way, **cost, **found})
        except ChildFailed as failure:
            rows.append({"model": name, "way": way, "failed": str(failure)})
    return rows


def quads_of(source: str | Path, faces: int, triangles: int, kept: Path) -> tuple[str, np.ndarray, np.ndarray]:
    """Name, vertices and quads (f, 4) of a solid or a model file, remeshed unless it is quads."""
    from gdtool.geometry.quads import Request, remesh

    if isinstance(source, Path) and source.suffix.lower() == ".obj":
        from gdtool.folders.mesh import read_obj

        mesh = read_obj(source)
        if (mesh.faces >= 0).all():
            return source.stem, mesh.vertices, mesh.faces.astype(np.int64)
    name = source if isinstance(source, str) else source.stem
    at = kept / f"{name}_{faces}_quads.npz"
    if at.exists():
        with np.load(at) as found:
            return name, found["vertices"], found["faces"]
    fine = of_solid(source, triangles, kept) if isinstance(source, str) else of_model(source, triangles, kept)
    vertices, quads, _ = remesh(fine.vertices, fine.faces, Request(quads=faces))
    np.savez(at, vertices=vertices, faces=quads)
    return name, vertices, quads


def plot(rows: list[dict], path: Path) -> None:
    """Processor seconds against coverage, a colour per way."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), dpi=110)
    for way in dict.fromkeys(row["way"] for row in rows):
        mine = [row for row in rows if row["way"] == way and "coverage" in row]
        axes.scatter([row["processor"] for row in mine], [1 - row["coverage"] for row in mine], label=way, s=22)
    axes.set(xscale="log", xlabel="seconds of the processor", ylabel="share of the texture that no chart covers")
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
    parser.add_argument("--input", type=int, default=200_000, help="triangles that remesh gets")
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"), help="folder for the inputs once made")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for one run")
    parser.add_argument("--only", default="", help="comma list of ways; all of them when empty")
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # the children import this file
    ways = [way for way in (*WAYS, *(PEERS if find_spec("xatlas") else ())) if not asked.only or way in asked.only.split(",")]
    note, rows = busy(), []
    for source in [*filter(None, asked.solids.split(",")), *models_in(asked.models)]:
        try:
            name, vertices, faces = quads_of(source, asked.faces, asked.input, asked.kept)
        except Exception as failure:  # a broken model is a row of the table, not the end of it
            rows.append({"model": str(getattr(source, "name", source)), "way": "read", "failed": str(failure)})
            continue
        rows += measure(name, vertices, faces, asked.limit, ways)
    asked.out.mkdir(parents=True, exist_ok=True)
    text = table(COLUMNS, ([number(row.get(name, "failed" if name == "charts" and "failed" in row else None), 4) for name in COLUMNS] for row in rows))
    failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows if "failed" in row)
    head = f"# Unwrap: about {asked.faces} quads\n\n`python benchmarks/unwrap.py`, {machine()}. {note}\n\n"
    (asked.out / "unwrap.md").write_text(head + text + "\n" + (f"\nFailed:\n\n{failed}\n" if failed else "") + "\n![time against coverage](unwrap.png)\n")
    (asked.out / "unwrap.json").write_text(json.dumps({"machine": machine(), "faces": asked.faces, "rows": rows}, indent=1) + "\n")
    plot(rows, asked.out / "unwrap.png")
    print(text)


if __name__ == "__main__":
    main()
