"""Share what the benchmarks of render-dataset and relight need to compare renderers.

Renderers run as child processes; their errors and their times at an error are measured; the results are a table, JSON
and a plot.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.common.measure import busy, machine, number, say, table

HERE = Path(__file__).resolve().parent
# Runs shorter than this, in seconds, are repeated if asked for: the table has the median.
SHORT = 5.0


def arguments(text: str) -> argparse.ArgumentParser:
    """Make the parser of the options that both benchmarks share."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("env")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--peers-python", type=Path)
    parser.add_argument(
        "--reference",
        type=int,
        default=256,
        help="samples per pixel of gdtool's reference; in render.py of Cycles' buffers too",
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="of rows that take less than 5 s; the table has the median"
    )
    return parser


@dataclass(frozen=True)
class Job:
    """Hold one row of the table: method, samples per pixel, command line, and the reference that its errors are
    measured against.
    """

    method: str
    samples: int
    command: tuple[str, ...]
    reference: str
    more: dict = field(default_factory=dict)

    @property
    def name(self) -> str:
        return " ".join([self.method, str(self.samples), *(str(x) for x in self.more.values())])


def peers_environment() -> dict[str, str]:
    """Return the environment variables for the peers' processes.

    The LLVM variants of drjit (Mitsuba) need a libLLVM that knows the processor: the newest one on the machine is
    named.
    """
    out = dict(os.environ)
    if "DRJIT_LIBLLVM_PATH" not in out:
        patterns = (
            (Path("/usr/lib"), "llvm-*/lib/libLLVM*.so*"),
            (Path("/usr/lib"), "*/libLLVM*.so*"),
            (Path.home(), ".rustup/toolchains/stable*/lib/libLLVM.so*"),
        )
        versions = {
            str(path): int("".join(c for c in path.name.split("libLLVM")[1].lstrip("-.so")[:2] if c.isdigit()) or 0)
            for folder, pattern in patterns
            for path in folder.glob(pattern)
        }
        if versions:
            out["DRJIT_LIBLLVM_PATH"] = max(versions, key=versions.get)
    return out


def in_child(command: tuple[str, ...], limit_seconds: float = 900) -> dict | None:
    """Run a command and return the JSON object that it prints last; None, after a message, where it fails or takes too
    long.
    """
    try:
        done = subprocess.run(
            list(command), capture_output=True, text=True, timeout=limit_seconds, env=peers_environment()
        )
    except subprocess.TimeoutExpired:
        say(f"{' '.join(command[1:3])}: not done in {limit_seconds:.0f} s")
        return None
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        say(f"{' '.join(command)}: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
        return None
    return json.loads(lines[-1])


def has(python: Path | None, module: str) -> bool:
    """Tell whether a Python interpreter can import a module."""
    if python is None or not Path(python).exists():
        return False
    return (
        subprocess.run(
            [str(python), "-c", f"import importlib.util as u, sys; sys.exit(u.find_spec({module!r}) is None)"],
            check=False,
        ).returncode
        == 0
    )


def stored(name: str, image: np.ndarray) -> np.ndarray:
    """Encode an image of a domain as gdtool's pictures store it: sRGB for colors, (n + 1) / 2 for normals."""
    from gdtool.images.color import srgb_from_linear

    if name in ("color", "albedo"):
        return srgb_from_linear(np.clip(image, 0, 1))
    return 0.5 * image + 0.5 if name == "normal" else image


def errors(images: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Measure the PSNR in dB of each domain, over the views that both renderings have.

    Each domain is measured over the pixels that the reference covers wholly ("color inside" for color). "color" is
    measured over whole pictures, with partly covered pixels and the black around the object.
    """
    from gdtool.images.metrics import psnr

    common = [name for name in reference["names"] if name in images["names"]]

    def of(frames: dict[str, np.ndarray], name: str) -> np.ndarray:
        return stored(name, frames[name][[list(frames["names"]).index(view) for view in common]])

    inside = of(reference, "mask") > 0.99
    out = {}
    for name in reference:
        if name in images and name not in ("mask", "names"):
            pair = of(images, name), of(reference, name)
            out["color inside" if name == "color" else name] = psnr(*pair, inside)
            if name == "color":
                out["color"] = psnr(*pair, np.ones_like(inside))
    return out


def run(
    folder: Path,
    name: str,
    references: dict[str, tuple[str, ...]],
    jobs: list[Job],
    key: dict,
    finish,
    repeats: int = 3,
) -> list[dict]:
    """Run all jobs and return their rows, the median of each figure; results are kept in folder/.name as they come.

    references: command lines by name; {out} in a command stands for the file that it writes its images to. The jobs
    take turns, repeat after repeat, so that slow phases of the machine hit all of them. A run that was killed goes on
    where it was, if key (what was asked for) is the same. finish(rows, head) writes the report; then folder/.name is
    removed.
    """
    kept_folder = folder / f".{name}"
    kept_folder.mkdir(parents=True, exist_ok=True)
    log = kept_folder / "rows.json"
    before = json.loads(log.read_text()) if log.exists() else {}
    runs: dict[str, list[dict]] = before["runs"] if before.get("key") == key else {}
    if not runs:
        for old in kept_folder.glob("reference-*.npz"):
            old.unlink()
    head = before.get("machine", []) if runs else []
    head = [*head, f"{machine()}. {busy()}".strip()]

    def keep() -> None:
        log.write_text(json.dumps({"key": key, "runs": runs, "machine": head}))

    keep()
    for which, command in references.items():
        path = kept_folder / f"reference-{which}.npz"
        if not path.exists():
            say(f"reference of {which}")
            in_child(tuple(part.replace("{out}", str(path)) for part in command))
    for repeat in range(repeats):
        for job in jobs:
            done, truth = runs.setdefault(job.name, []), kept_folder / f"reference-{job.reference}.npz"
            if len(done) > repeat or not truth.exists() or (done and done[0]["wall s"] > SHORT):
                continue
            out = kept_folder / "out.npz"
            cost = in_child(tuple(part.replace("{out}", str(out)) for part in job.command))
            if cost is not None:
                done.append({**cost, **errors(dict(np.load(out)), dict(np.load(truth)))})
                keep()
                say(f"{job.name}: " + ", ".join(f"{k} {number(v, 4)}" for k, v in done[-1].items()))
    rows = [
        {
            "method": job.method,
            "samples": job.samples,
            **job.more,
            **{k: statistics.median(r[k] for r in runs[job.name]) for k in runs[job.name][0]},
            "runs": len(runs[job.name]),
        }
        for job in jobs
        if runs.get(job.name)
    ]
    finish(rows, head)
    shutil.rmtree(kept_folder)
    return rows


def time_at(
    rows: list[dict], method: str, quality: str, decibels: float, seconds: str = "wall s"
) -> tuple[float, bool] | None:
    """Interpolate the seconds at which a method reaches a PSNR; also tells whether that lies inside the measured range.

    rows: of all methods. quality: the key of the PSNR. decibels: the PSNR. seconds: the key of the time. Between rows
    the PSNR is linear in the logarithm of time. Beyond the best row, halving the squared error is assumed to take twice
    the time. Returns None for a method without rows.
    """
    points = sorted(
        (row[seconds], row[quality]) for row in rows if row["method"] == method and row.get(quality) is not None
    )
    if not points:
        return None
    best: list[tuple[float, float]] = []
    for point in points:  # A slower row that is no better is nobody's choice.
        if not best or point[1] > best[-1][1]:
            best.append(point)
    t, q = np.log(np.array([p[0] for p in best])), np.array([p[1] for p in best])
    slope = np.log(2) / (10 * np.log10(2))
    if decibels <= q[0]:
        # Less than the cheapest row asks for is not cheaper.
        return float(np.exp(t[0])), True
    if decibels > q[-1]:
        return float(np.exp(t[-1] + (decibels - q[-1]) * slope)), False
    return float(np.exp(np.interp(decibels, q, t))), True


def comparison(rows: list[dict], quality: str, decibels: float, ours: list[str], peers: list[str]) -> list[str]:
    """List sentences on how long each method takes to reach a PSNR, and gdtool's share of the best peer's time."""
    lines = []
    for seconds in ("wall s", "cpu s"):
        times = {method: time_at(rows, method, quality, decibels, seconds) for method in (*ours, *peers)}
        times = {method: at for method, at in times.items() if at is not None}
        theirs = [times[method][0] for method in peers if method in times]
        for method in ours:
            if method in times and theirs:
                parts = ", ".join(
                    f"{m} {t:.2f}{'' if inside else ' (extrapolated)'}"
                    for m, (t, inside) in times.items()
                    if m in peers
                )
                at, inside = times[method]
                lines.append(
                    f"* {quality} at {decibels:g} dB, {seconds}: {method} "
                    f"{at:.2f}{'' if inside else ' (extrapolated)'}; {parts}: "
                    f"**{at / min(theirs):.2f}** of the better."
                )
    return lines


def write(
    folder: Path,
    name: str,
    title: str,
    rows: list[dict],
    head: list[str],
    shown: list[str],
    plots: list[tuple[str, str]],
    findings: list[str],
) -> None:
    """Write name.json, name.md and name.png into folder.

    plots: title and key of the PSNR of each plot, which is drawn against processor seconds with a curve for each
    method. shown: the columns of the table. head: lines about the machine. findings: sentences of comparison().
    """
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    (folder / f"{name}.json").write_text(
        json.dumps({"machine": head, "command": " ".join(sys.argv), "rows": rows}, indent=1) + "\n"
    )
    body = table(shown, [[number(row.get(key), 4) for key in shown] for row in rows])
    text = "\n\n".join(
        [
            f"# {title}",
            f"{' '.join(dict.fromkeys(head))} `{' '.join(sys.argv)}`, {time.strftime('%Y-%m-%d')}.",
            errors_text(),
            "\n".join(findings),
            body,
            f"![time against error]({name}.png)",
        ]
    )
    (folder / f"{name}.md").write_text(text + "\n")
    figure, all_axes = plt.subplots(1, len(plots), figsize=(5.5 * len(plots), 4.2), layout="constrained", squeeze=False)
    for axes, (heading, quality) in zip(all_axes[0], plots, strict=True):
        for method in dict.fromkeys(row["method"] for row in rows if row.get(quality) is not None):
            points = sorted(
                (row["cpu s"], row[quality]) for row in rows if row["method"] == method and row.get(quality) is not None
            )
            axes.plot(
                *zip(*points, strict=True), "o-" if method.startswith("gdtool") else "s--", markersize=4, label=method
            )
        axes.set(xscale="log", xlabel="processor seconds", ylabel="PSNR in dB", title=heading)
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=7)
    figure.savefig(folder / f"{name}.png", dpi=130)


def errors_text() -> str:
    """Return the paragraph of the report that says how its figures were measured."""
    return (
        "PSNR of the pictures as stored (sRGB; normals halved) against a converged reference of the same renderer "
        "with other random "
        "numbers. `color` is the whole picture with the black around the object, the others are wholly covered "
        "pixels. All use a box "
        "pixel filter and direct light only. Seconds are each renderer's own work, without imports and reading "
        "files; Mitsuba's without "
        "building its scene and with its kernels loaded, Cycles' with writing its files; `cpu s` is summed over "
        "threads."
    )
