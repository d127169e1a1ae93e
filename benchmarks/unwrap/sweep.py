"""Time against coverage of unwrap, its knobs swept, beside xatlas alone, on quad meshes that remesh made.

    python -m benchmarks.unwrap.sweep [MODEL_OR_FOLDER ...] [-o docs/benchmarks] [--faces 20000] [--peers-python PYTHON]

Writes unwrap.md, unwrap.json, unwrap.png and the layouts unwrap_sheet.png, row by row: killed, it goes on where it was.
Models that are quads already are taken as they are; others as benchmarks/remesh/sweep.py left
them, or are remeshed first. The knobs are
swept and brute force is tried on the models of --sweep. All leave two texels between charts at 1024. Every run is a
child process with a time limit, and what did not begin within --minutes is left for the next time; mirrored is a share
of the area, overlap counts texels of 4096² with more than one owner."""

from __future__ import annotations

import argparse
import os
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.common.fine_meshes import models_in, of_model, of_solid
from benchmarks.common.measure import ROOT, busy, machine, number, say, table
from benchmarks.common.mesh_runs import arguments, as_commanded, beside, blender, cost_since, plot
from benchmarks.common.resumable_rows import Rows
from benchmarks.common.wireframe import file_name, sheet
from gdtool.geometry.meshes import QuadMesh, TriMesh

SIZE, PADDING = 1024, 2
FINE = 4096  # where overlaps are looked for
WAYS = {
    "ours": {},
    "ours, stretch 1.001": {"good_stretch": 1.001},
    "ours, stretch 1.005": {"good_stretch": 1.005},
    "ours, cost 1": {"max_cost": 1.0},
    "ours, cost 4": {"max_cost": 4.0},
}
BLENDER = "Blender Smart UV"
BRUTE = "xatlas, brute force"
PEERS = {"xatlas": False, "xatlas, brute force": True}
COLUMNS = (
    "model",
    "way",
    "seconds",
    "processor",
    "charts",
    "coverage",
    "overlap",
    "stretch",
    "area_distortion",
    "angle_distortion",
    "mirrored",
    "seam_length",
)


def ours(vertices: np.ndarray, faces: np.ndarray, options: dict) -> tuple:
    """In a child: texture coordinates, faces into them, cost."""
    as_commanded()
    from gdtool.unwrap.pipeline import Request, unwrap

    start = time.perf_counter()
    out = unwrap(QuadMesh(vertices, faces), Request(size=SIZE, padding=PADDING, **options))
    return out.uv, out.face_uvs.astype(np.int64), cost_since(start)


def peer(vertices: np.ndarray, triangles: np.ndarray, brute_force: bool) -> tuple:
    """In a child: xatlas as its users call it, on triangles."""
    import xatlas

    start = time.perf_counter()
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bruteForce = SIZE, PADDING, brute_force
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack)
    _, face_uvs, uv = atlas[0]
    cost = cost_since(start)
    corners = np.concatenate([face_uvs.astype(np.int64), np.full((len(face_uvs), 1), -1)], 1)
    return np.asarray(uv, np.float64) * (1, -1) + (0, 1), corners, cost


def smart_project(vertices: np.ndarray, faces: np.ndarray, asked: argparse.Namespace) -> tuple:
    """Blender's texture coordinates, faces into them, cost."""
    found, cost = blender("smart", vertices, faces, PADDING / SIZE, asked.peers_python, asked.limit)
    return found["uv"] * (1, -1) + (0, 1), found["face_uvs"], cost


def overlapping(faces: np.ndarray, uv: np.ndarray, face_uvs: np.ndarray) -> int:
    """Texels of FINE² that more than one triangle owns."""
    from gdtool.geometry.topology import triangulated
    from gdtool.geometry.uv_raster import owner_count
    from gdtool.unwrap.pipeline import corner_triangles

    return int((owner_count(uv, corner_triangles(face_uvs, triangulated(faces)[1]), FINE) > 1).sum())


def measure(
    name: str, vertices: np.ndarray, faces: np.ndarray, ways: list[str], asked: argparse.Namespace, rows: Rows
) -> None:
    """A row for each way that has none yet; one that fails says why. faces (f, 4). Keeps pictures of the layouts."""
    from gdtool.core.child import ChildFailed, call
    from gdtool.geometry.topology import triangulated
    from gdtool.images.io import write_png
    from gdtool.unwrap.pipeline import figures, uv_islands
    from gdtool.unwrap.preview import checkerboard, layout

    triangles = triangulated(faces)[0].astype(np.int64)
    for way in ways:
        if rows.has(name, way) or time.monotonic() > asked.end:
            continue
        say(f"{name}: {way}")
        try:
            mine = faces
            if way == BLENDER:
                uv, face_uvs, cost = smart_project(vertices, faces, asked)
            elif way in PEERS:
                mine = np.concatenate([triangles, np.full((len(triangles), 1), -1)], 1)
                uv, face_uvs, cost = call(peer, vertices, triangles, PEERS[way], seconds=asked.limit, memory_mb=16000)
            else:
                uv, face_uvs, cost = call(ours, vertices, faces, WAYS[way], seconds=asked.limit, memory_mb=16000)
            row = {
                "model": name,
                "way": way,
                **cost,
                **figures(QuadMesh(vertices, mine, uv, face_uvs), SIZE),
                "overlap": overlapping(mine, uv, face_uvs),
            }
            if way in ("ours", "xatlas", BLENDER):
                chart = uv_islands(QuadMesh(vertices, mine, uv, face_uvs))[0]
                (asked.kept / "pictures").mkdir(parents=True, exist_ok=True)
                write_png(
                    asked.kept / "pictures" / file_name(name, f"{way} layout"), layout(mine, uv, face_uvs, chart, 420)
                )
                if way == "ours":
                    board = checkerboard(QuadMesh(vertices, mine, uv, face_uvs), chart)
                    write_png(
                        asked.kept / "pictures" / file_name(name, "ours checkerboard"),
                        board[::2, : board.shape[1] // 2 : 2],
                    )
        except ChildFailed as failure:
            row = {"model": name, "way": way, "failed": str(failure)}
        rows.add(row)


def quads_of(source: str | Path, faces: int, triangles: int, kept: Path) -> tuple[str, np.ndarray, np.ndarray]:
    """Name, vertices and quads (f, 4) of a solid or a model file, remeshed unless it is quads."""
    from gdtool.remesh.pipeline import remesh
    from gdtool.remesh.task import Request

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
    say(f"{name}: remeshed first")
    made, _ = remesh(TriMesh(fine.vertices, fine.faces), Request(quads=faces))
    vertices, quads = made.vertices, made.faces
    np.savez(at, vertices=vertices, faces=quads)
    return name, vertices, quads


def main() -> None:
    parser = arguments(
        __doc__, "what is unwrapped besides the solids", "a Python that has bpy; without it Blender is left out"
    )
    parser.add_argument("--input", type=int, default=1_000_000, help="triangles that remesh gets")
    parser.add_argument("--sweep", default="part,spot", help="models that the knobs are swept on")
    asked = parser.parse_args()
    if not asked.models:
        say("no models are named: the solids alone")
    settings = {name: str(value) for name, value in vars(asked).items() if name not in ("out", "kept", "minutes")}
    asked.end = time.monotonic() + 60 * asked.minutes
    os.environ["PYTHONPATH"] = str(ROOT)  # child processes import this package
    if not asked.peers_python:
        say("Blender is left out: no --peers-python")
    note = busy()
    rows = Rows(asked.out / "unwrap.json", settings)

    def ways(name: str) -> list[str]:
        swept = name in asked.sweep.split(",")
        out = [way for way in WAYS if way == "ours" or swept]
        out += [way for way in PEERS if find_spec("xatlas") and (way != BRUTE or swept)] + (
            [BLENDER] if asked.peers_python else []
        )
        return [way for way in out if not asked.only or way in asked.only.split(",")]

    def report(complete: bool) -> str:
        rows.write(complete)
        text = table(
            COLUMNS,
            (
                [
                    number(row.get(name, "failed" if name == "charts" and "failed" in row else None), 4)
                    for name in COLUMNS
                ]
                for row in rows.rows
            ),
        )
        failed = "\n".join(f"- {row['model']}, {row['way']}: {row['failed']}" for row in rows.rows if "failed" in row)
        head = f"# Unwrap: about {asked.faces} quads\n\n`make bench-assets`, {machine()}. {note}\n\n"
        (asked.out / "unwrap.md").write_text(
            head
            + beside(rows.rows, [*PEERS, BLENDER])
            + "\n\n"
            + text
            + "\n"
            + (f"\nFailed:\n\n{failed}\n" if failed else "")
            + "\n![time against coverage](unwrap.png)\n\n![layouts](unwrap_sheet.png)\n"
        )
        shares = [row | {"uncovered": 1 - row["coverage"]} for row in rows.rows if "coverage" in row]
        plot(shares, asked.out / "unwrap.png", "uncovered", "share of the texture that no chart covers", False)
        sheet(
            asked.kept / "pictures",
            list(dict.fromkeys(row["model"] for row in rows.rows)),
            ["ours layout", "ours checkerboard", "xatlas layout", f"{BLENDER} layout"],
            asked.out / "unwrap_sheet.png",
        )
        return text

    sources = [*filter(None, asked.solids.split(",")), *models_in(asked.models)]

    def finished(name: str) -> bool:
        return rows.has(name, "read") or all(rows.has(name, way) for way in ways(name))

    names = [source if isinstance(source, str) else source.stem for source in sources]
    text = ""
    for name, source in zip(names, sources, strict=True):
        if not finished(name) and time.monotonic() < asked.end:
            try:
                _, vertices, faces = quads_of(source, asked.faces, asked.input, asked.kept)
            except Exception as failure:  # a broken model is a row of the table, not the end of it
                rows.add({"model": name, "way": "read", "failed": str(failure)})
            else:
                measure(name, vertices, faces, ways(name), asked, rows)
        text = report(all(map(finished, names)))
    print(text)
    if not all(map(finished, names)):
        say(f"not all began within {asked.minutes:g} minutes: run it again and it goes on")


if __name__ == "__main__":
    main()
