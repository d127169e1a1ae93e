"""Model to asset and back: how near the finished asset is to the PBR model it was made from.

    python -m benchmarks.pipeline.roundtrip $ASSETS/glb $ASSETS/gltf -o docs/benchmarks/roundtrip.md

Every model under the given folders (or files) that has metallic-roughness textures, or every one with --all, goes
through

    gdtool render-dataset M | gdtool reconstruct | gdtool remesh --faces 20000 | gdtool unwrap | gdtool bake --size \
        2048 | gdtool relight

and the asset is measured against the model by `gdtool evaluate`. A stage that fails is named in the table.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.common.measure import Failed, busy, evaluate, gdtool, machine, number, say, table

STAGES = (
    ("render-dataset", ()),
    ("reconstruct", ()),
    ("remesh", ("--faces", "20000")),
    ("unwrap", ()),
    ("bake", ("--size", "2048")),
    ("relight", ()),
)
SEEN_LIMIT, WHOLE_LIMIT, ALBEDO_LIMIT = 0.004, 0.015, 22.0
MEASURED = {"bake": "asset", "reconstruct": "surface"}


def has_metallic_roughness_texture(path: Path) -> bool:
    """Whether a glTF model has one; what cannot be read has none."""
    from gdtool.assets.load import load_scene
    from gdtool.core.errors import GdtoolError

    try:
        return any(m.metallic_roughness_texture is not None for m in load_scene(path).materials)
    except GdtoolError as error:
        say(f"{path.name}: left out: {error}")
        return False


def models_under(places: list[Path], everything: bool) -> list[Path]:
    """The .glb and .gltf files to take, sorted."""
    found = [
        path
        for place in places
        for path in ([place] if place.is_file() else sorted([*place.rglob("*.glb"), *place.rglob("*.gltf")]))
    ]
    return found if everything else [path for path in found if has_metallic_roughness_texture(path)]


def roundtrip(model: Path, folder: Path, relight: bool) -> dict:
    """Cost and error of one model; "failed" when a stage did."""
    record: dict = {
        "model": model.parent.name + "/" + model.name if model.suffix == ".gltf" else model.name,
        "seconds": 0.0,
        "peak_mb": 0.0,
    }
    place: str | Path = model
    for stage, options in STAGES if relight else STAGES[:-1]:
        target = folder / stage
        try:
            cost = gdtool(stage, place, "-o", target, "--quiet", *options)
            record["seconds"] += cost.seconds
            record["peak_mb"] = max(record["peak_mb"], cost.peak_mb)
            if stage in MEASURED:
                record[MEASURED[stage]] = evaluate(target)
        except Failed as error:
            return record | {"failed": str(error)}
        place = target
    return record


def passes(record: dict) -> bool:
    """The limits on distance and albedo, and a closed result."""
    asset = record.get("asset", {})
    return (
        asset.get("seen_distance", 1) <= SEEN_LIMIT
        and asset.get("surface_distance", 1) <= WHOLE_LIMIT
        and asset.get("albedo_psnr_masked", 0) >= ALBEDO_LIMIT
        and bool(asset.get("watertight"))
    )


def report(records: list[dict], remark: str = "") -> str:
    """The table, with the shares that pass."""
    rows = []
    for record in records:
        asset, surface = record.get("asset", {}), record.get("surface", {})
        rows.append(
            [
                record["model"],
                number(surface.get("seen_distance")),
                number(asset.get("seen_distance")),
                number(asset.get("surface_distance")),
                number(asset.get("watertight")),
                number(asset.get("albedo_psnr_masked")),
                number(asset.get("roughness_error")),
                number(asset.get("metallic_error")),
                number(asset.get("normal_degrees")),
                number(asset.get("quads")),
                f"{record['seconds']:.0f}",
                f"{record['peak_mb']:.0f}",
                record.get("failed", ""),
            ]
        )
    count = len(records)
    near = sum(
        r.get("asset", {}).get("seen_distance", 1) <= SEEN_LIMIT
        and r["asset"].get("surface_distance", 1) <= WHOLE_LIMIT
        for r in records
    )
    closed = sum(bool(r.get("asset", {}).get("watertight")) for r in records)
    colored = sum(r.get("asset", {}).get("albedo_psnr_masked", 0) >= ALBEDO_LIMIT for r in records)
    head = [
        "model",
        "surface seen",
        "seen",
        "whole",
        "closed",
        "albedo dB",
        "roughness",
        "metallic",
        "normal °",
        "quads",
        "seconds",
        "MB",
        "failed",
    ]
    return "\n".join(
        [
            "# Round trip: model to asset, against the model",
            "",
            f"By `benchmarks/pipeline/roundtrip.py` on {machine()}. "
            "Distances: mean of both directions, largest extent of the truth 1.",
            remark,
            "",
            table(head, rows),
            "",
            f"Of {count} models: {near} within {SEEN_LIMIT} seen and {WHOLE_LIMIT} whole, {closed} closed, {colored} "
            f"with albedo ≥ {ALBEDO_LIMIT:.0f} dB, "
            f"{sum(map(passes, records))} all of it.",
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("places", nargs="+", type=Path, metavar="FOLDER_OR_MODEL")
    parser.add_argument("--all", action="store_true", help="models without metallic-roughness textures too")
    parser.add_argument("--no-relight", dest="relight", action="store_false", help="leave the last stage out")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the folders of every model here, to look at")
    parser.add_argument("-o", "--output", type=Path, help="write the table here, besides stdout")
    given = parser.parse_args()
    records, remark = [], busy()
    for model in models_under(given.places, given.all):
        with tempfile.TemporaryDirectory() as folder:
            place = given.keep / model.stem if given.keep else Path(folder)
            records.append(roundtrip(model, place, given.relight))
        asset = records[-1].get("asset", {})
        say(
            f"{records[-1]['model']}: seen {number(asset.get('seen_distance'))}, whole "
            f"{number(asset.get('surface_distance'))}, albedo "
            f"{number(asset.get('albedo_psnr_masked'))} dB, {records[-1]['seconds']:.0f} s "
            f"{records[-1].get('failed', '')}"
        )
        if given.output:
            given.output.write_text(report(records, remark))
    print(report(records, remark))


if __name__ == "__main__":
    main()
