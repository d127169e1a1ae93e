"""How well sampled views fit one another, and what surface comes of them, on held-out objects.

    python benchmarks/consistency.py held_out --model my-model -o docs/benchmarks

For each object: gdtool sample-views of its condition picture, the figures of gdtool.diffusion.consistency for the sampled and for
the true views (what a perfect model would get), then reconstruct and evaluate against the true model in both protocols. Rows are written as they
come; a second run goes on after them. About half a minute an object on two quiet cores.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from measure import Failed, busy, evaluate, gdtool, machine, number, say, table
from model_quality import DEFAULT_MODEL, views_folders

from gdtool.core.folder import open_folder
from gdtool.diffusion.consistency import consistency
from gdtool.folders.views import read_views

CONSISTENCY = ("rerendered_psnr", "slope_degrees", "reprojection_depth", "reprojection_share")
SURFACE = ("chamfer", "iou", "syncdreamer_chamfer", "syncdreamer_iou")


def measured(folder, model: Path, work: Path) -> dict:
    """The record of one object. Raises Failed."""
    picture = folder.path / "condition" / "000.png"
    gdtool("sample-views", picture, "--model", model, "-o", work / "views", "--quiet")
    record = {"sampled": consistency(read_views(open_folder(work / "views"))), "true": consistency(read_views(folder))}
    gdtool("reconstruct", work / "views", "-o", work / "surface", "--quiet")
    report = evaluate(work / "surface", "--reference", folder.path / "source.glb" if (folder.path / "source.glb").is_file() else folder.path)
    record["surface"] = {k: v for k, v in report.items() if isinstance(v, (int, float))}
    return record


def markdown(records: dict[str, dict], model: Path, remark: str) -> str:
    """The report: means over the objects."""
    good = [r for r in records.values() if "failed" not in r]
    if not good:
        return "no object was measured\n"
    rows = [[name.replace("_", " "), *(number(float(np.nanmean([r[side][name] for r in good]))) for side in ("sampled", "true"))] for name in CONSISTENCY]
    names = sorted({name for r in good for name in r["surface"]})
    surface = [[name.replace("_", " "), number(float(np.nanmean([r["surface"][name] for r in good if name in r["surface"]])))] for name in names]
    return "\n".join([
        "# Consistency of sampled views", "", f"{len(good)} held-out objects, model {model.name}, on {machine()}. {remark}",
        "`gdtool/diffusion/consistency.py` and `docs/metrics.md` say what each figure is.", "",
        table(["mean", "sampled views", "true views"], rows), "", "Reconstructed from the sampled views:", "", table(["mean", "value"], surface), "",
        *(f"- failed: {name}: {r['failed']}" for name, r in records.items() if "failed" in r), ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--limit", type=int, default=20, help="objects at most")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    log, remark = arguments.output / "consistency.json", busy()
    identity = open_folder(arguments.model, ("model",)).manifest.digest
    stored = json.loads(log.read_text()) if log.is_file() else {}
    records = stored.get("objects", {}) if stored.get("model") == identity else {}
    for folder in views_folders(arguments.held_out)[: arguments.limit]:
        if folder.name in records:
            continue
        with tempfile.TemporaryDirectory() as work:
            try:
                records[folder.name] = measured(folder, arguments.model, Path(work))
            except Failed as error:
                records[folder.name] = {"failed": str(error)}
        say(f"  {folder.name}")
        log.write_text(json.dumps({"model": identity, "objects": records}, indent=1) + "\n")
        (arguments.output / "consistency.md").write_text(markdown(records, arguments.model, remark))
    print(markdown(records, arguments.model, remark))


if __name__ == "__main__":
    main()
