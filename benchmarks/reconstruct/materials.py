"""Which albedo, roughness and metallic `gdtool reconstruct` finds, from material views and from lit color alone.

    python -m benchmarks.reconstruct.materials                              three procedural objects: a few minutes
    python -m benchmarks.reconstruct.materials cat.glb --procedural 6 -o /tmp/report

Every object is rendered by `gdtool render-dataset` and its shape found by the grid method from clean views. Its
materials are then found in several ways and compared with the truth at four cameras that were not among the views,
relit by a light that was not either (appearance.py). From color alone the recorded light is
withheld, and the albedo is compared after one scale per channel: light and albedo are known only up to that. Rows are
kept as they are measured: a run that was stopped goes on where it was, --fresh begins anew."""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common.measure import ROOT, Failed, busy, gdtool, machine, number, say, table
from benchmarks.common.resumable_rows import Rows
from benchmarks.reconstruct.appearance import looks
from gdtool.geometry.meshes import TriMesh

FIRST_SEED = 3_000_000  # procedural objects that the bundled model has not seen
MATERIAL_VIEWS, SOLVED = "material views", "color: PBR, visibility"
WAYS = (MATERIAL_VIEWS, SOLVED, "color: PBR, no visibility", "color taken for albedo")
FIGURES = (
    ("albedo_psnr", "albedo dB"),
    ("scaled_albedo_psnr", "albedo dB, scaled"),
    ("light_share", "light in albedo"),
    ("roughness_error", "roughness"),
    ("metallic_error", "metallic"),
    ("relit_psnr", "relit dB"),
    ("seconds", "s"),
)


def true_albedo(vertices: np.ndarray, truth) -> np.ndarray:
    """Linear albedo (v, 3) of the true scene at the points of its surface nearest to the vertices."""
    from gdtool.geometry.distance import barycentric_of, closest_points
    from gdtool.shading.render.surface_points import surface_attributes

    _, face_idx, points = closest_points(vertices, TriMesh(truth.vertices, truth.faces))
    share = barycentric_of(points, truth.vertices[truth.faces[face_idx]])
    return np.asarray(surface_attributes(truth, face_idx, share)["albedo"])


def scaled(found: np.ndarray, true: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """found (v, 3) times the factor of each channel that brings it nearest to true (v, 3) under weight (v,)."""
    factor = (weight[:, None] * found * true).sum(0) / np.maximum((weight[:, None] * found**2).sum(0), 1e-12)
    return np.clip(found * factor, 0, 1)


def light_share(found: np.ndarray, true: np.ndarray, color: np.ndarray, weight: np.ndarray) -> float:
    """How far the albedo's error follows the light: the correlation over vertices of log(found / true) with log(color /
    true).

    color (v, 3): what the lit views show there. 0: nothing of the light is left in the albedo; 1: all the error is
    light."""
    good = (weight > 0.05) & (true.min(1) > 0.02)
    error, lit = (np.log(np.maximum(x[good].mean(1), 1e-3) / true[good].mean(1)) for x in (found, color))
    if error.std() < 1e-6 or lit.std() < 1e-6:
        return 0.0
    return float(np.corrcoef(error, lit)[0, 1])


def found_materials(way: str, views, surface, normals: np.ndarray, step: float):
    """The surface with the materials that way finds, and the processor's seconds it took."""
    from gdtool.fields.appearance.appearance import AppearanceOptions, appearance

    images, light = views.images, views.light
    if way != MATERIAL_VIEWS:
        images, light = {"color": views.images["color"]}, None
    began = time.process_time()
    look = appearance(
        views.cameras,
        views.mask,
        images,
        TriMesh(surface.vertices, surface.faces),
        normals,
        AppearanceOptions(step=step, light=light, seed=0, shadows="no visibility" not in way),
    )
    albedo = look.albedo if "PBR" in way or way == MATERIAL_VIEWS else fused_color(views, surface, normals, step)[0]
    seconds = time.process_time() - began
    return replace(surface, albedo=albedo, roughness=look.roughness, metallic=look.metallic, normals=normals), seconds


def fused_color(views, surface, normals: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Lit linear color (v, 3) that the views show on the surface, and the weight (v,) of the views that show it."""
    from gdtool.fields.appearance.materials import fuse, observe, spread

    seen = observe(views.cameras, views.mask, TriMesh(surface.vertices, surface.faces), normals, 0.5 * step)
    value, weight, _ = fuse(views.images["color"], views.mask, seen)
    return np.clip(spread(value, weight, surface.faces), 0, 1), weight


def measure(name: str, source: str, folder: Path, given: argparse.Namespace, ways: list[str]):
    """Yield a row for each of ways."""
    from gdtool.assets.load import load_scene
    from gdtool.core.folder import open_folder
    from gdtool.folders.surface import read_surface
    from gdtool.folders.views import read_views
    from gdtool.geometry.frames import invert_similarity, transform_points
    from gdtool.geometry.normals import vertex_normals

    gdtool(
        "render-dataset",
        source,
        "-o",
        folder / "views",
        "--size",
        str(given.size),
        "--samples",
        "8",
        "--light-samples",
        "8",
        "--quiet",
    )
    gdtool("reconstruct", folder / "views", "-o", folder / "surface", "--quiet")
    opened, shape = open_folder(folder / "views"), open_folder(folder / "surface")
    views, surface, truth = read_views(opened), read_surface(shape), load_scene(source)
    to_views = invert_similarity(np.array(opened.content.source_from_world).reshape(4, 4))
    truth = replace(truth, vertices=transform_points(to_views, truth.vertices))
    step, normals = shape.content.report["grid_step"], vertex_normals(TriMesh(surface.vertices, surface.faces))
    true, (color, weight) = true_albedo(surface.vertices, truth), fused_color(views, surface, normals, step)
    for way in ways:
        found, seconds = found_materials(way, views, surface, normals, step)
        row = {
            "model": name,
            "way": way,
            "seconds": seconds,
            "light_share": light_share(found.albedo, true, color, weight),
        } | looks(found, truth)
        row["scaled_albedo_psnr"] = looks(replace(found, albedo=scaled(found.albedo, true, weight)), truth)[
            "albedo_psnr"
        ]
        yield row


def markdown(rows: list[dict], size: int, remark: str) -> str:
    """The report: medians, then every object."""

    def line(label: str, group: list[dict]) -> list[str]:
        return [label, *(number(float(np.median([r[key] for r in group]))) for key, _ in FIGURES)]

    names = list(dict.fromkeys(r["model"] for r in rows))
    parts = [
        "# Materials of reconstructed surfaces",
        f"By `make bench-materials`, on {machine()}, views of {size}². {remark}",
        "At held-out cameras, relit by a held-out light. *Scaled*: after one factor per channel, which color alone "
        "cannot tell. *Light in albedo*: "
        "correlation of the albedo's error with the shading that the views show. *s*: processor seconds of the "
        "materials alone.",
        f"## Median of {len(names)} objects",
        table(
            ["from", *(title for _, title in FIGURES)],
            [line(w, [r for r in rows if r["way"] == w]) for w in WAYS if any(r["way"] == w for r in rows)],
        ),
    ]
    for name in names:
        parts += [
            f"## {name}",
            table(
                ["from", *(title for _, title in FIGURES)], [line(r["way"], [r]) for r in rows if r["model"] == name]
            ),
        ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("models", nargs="*", help="models with materials, beside the procedural ones")
    parser.add_argument("--procedural", type=int, default=3, help="number of procedural objects (default 3)")
    parser.add_argument("--size", type=int, default=256, help="width and height of the views (default 256)")
    parser.add_argument("--fresh", action="store_true", help="measure every row anew")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=ROOT / "docs" / "benchmarks",
        help="folder of the report",
    )
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    path = given.output / "materials.json"
    if given.fresh:
        path.unlink(missing_ok=True)
    kept, remark = Rows(path, {"size": given.size}), busy()
    named = [(f"procedural:{FIRST_SEED + i}",) * 2 for i in range(given.procedural)] + [
        (Path(m).stem, m) for m in given.models
    ]

    for name, source in named:
        ways = [way for way in WAYS if not kept.has(name, way)]
        if not ways:
            continue
        say(name)
        with tempfile.TemporaryDirectory() as folder:
            try:
                for row in measure(name, source, Path(folder), given, ways):
                    kept.add(row)
                    say(f"    {row['way']:<28}" + "  ".join(f"{title} {number(row[key])}" for key, title in FIGURES))
                    (given.output / "materials.md").write_text(markdown(kept.rows, given.size, remark))
            except Failed as error:
                say(f"{name}: left out: {error}")
    kept.write(True)
    print(markdown(kept.rows, given.size, remark))


if __name__ == "__main__":
    main()
