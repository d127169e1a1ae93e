"""Share what the sweeps of remesh and unwrap need: costs of children, Blender's operators, arguments, the plot."""

from __future__ import annotations

import argparse
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.common.fine_meshes import SOLIDS
from benchmarks.common.measure import number, table


def cost_since(start: float) -> dict[str, float]:
    """Measure what this child process took since `start` (a time.perf_counter): seconds, processor seconds, peak
    memory.

    The peak memory in MB is that of the larger of this process and its largest child.
    """
    process, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    # A process' own ru_maxrss begins with that of the one that started it; VmHWM is its own.
    status = Path("/proc/self/status").read_text() if Path("/proc/self/status").exists() else ""
    peak = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")), process.ru_maxrss)
    seconds = time.perf_counter() - start
    return {
        "seconds": seconds,
        "processor": sum(u.ru_utime + u.ru_stime for u in (process, children)),
        "peak MB": max(peak / 1024, children.ru_maxrss / 1024),
    }


def as_commanded() -> None:
    """Prepare the children that a command would have prepared by the time it has read its mesh; called in a child
    process.

    Their start-up then counts as it does in a command.
    """
    from gdtool.core import child
    from gdtool.geometry.simplify import CHILD_MODULES, collapse_in_child

    child.end_waiting()
    child.prepare(collapse_in_child, CHILD_MODULES)


def blender(
    way: str, vertices: np.ndarray, faces: np.ndarray, argument: object, python: Path, limit: float
) -> tuple[dict[str, np.ndarray], dict]:
    """Run blender_meshing.py on vertices (v, 3) and faces (f, 4); returns the arrays it writes, and its cost.

    way: "quadriflow" or "smart". argument: the number of quads or the margin. python: an interpreter with bpy. limit:
    seconds. Raises ChildFailed.
    """
    from gdtool.core.child import ChildFailed

    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(source, vertices=vertices, faces=faces)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        try:
            done = subprocess.run(
                [python, Path(__file__).with_name("blender_meshing.py"), way, source, target, str(argument)],
                capture_output=True,
                text=True,
                timeout=limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ChildFailed(f"took longer than {limit:g} s") from None
        if not target.exists():
            raise ChildFailed((done.stderr.strip() or done.stdout.strip() or "no result").splitlines()[-1][:120])
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        with np.load(target) as arrays:
            out = dict(arrays)
        return out, {
            "seconds": float(out.pop("seconds")),
            "processor": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        }


def arguments(text: str, models: str, peers: str) -> argparse.ArgumentParser:
    """Make the parser of the options that the sweeps of remesh and unwrap share.

    text: the description. models, peers: help texts of the models and of --peers-python.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path, help=models)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--solids", default=",".join(SOLIDS))
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--kept", type=Path, default=Path("out/bench_meshes"), help="folder for the inputs once made")
    parser.add_argument("--peers-python", type=Path, help=peers)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for one run")
    parser.add_argument(
        "--minutes", type=float, default=12.0, help="a run that did not begin by then is left for the next time"
    )
    parser.add_argument("--only", default="", help="comma list of ways; all of them when empty")
    return parser


def beside(rows: list[dict], peers: list[str], also: tuple[str, ...] = ()) -> str:
    """Format a table of gdtool's seconds on each model, those of its other methods, and its ratio to each peer.

    rows: dicts with "model", "way" (method) and "seconds". peers: methods of other programs. also: further methods of
    gdtool. The ratios compare runs on the same machine: seconds differ much between machines, ratios less.
    """
    seconds_of = {(row["model"], row["way"]): row["seconds"] for row in rows if "seconds" in row}
    peers = [peer for peer in peers if any(way == peer for _, way in seconds_of)]
    ours = {model: seconds for (model, way), seconds in seconds_of.items() if way == "ours"}
    lines = [
        [
            model,
            number(seconds),
            *(number(seconds_of.get((model, way))) for way in also),
            *(number(seconds / seconds_of[model, peer] if (model, peer) in seconds_of else None, 2) for peer in peers),
        ]
        for model, seconds in ours.items()
    ]
    return table(["model", "our seconds", *also, *(f"ratio to {peer}" for peer in peers)], lines)


def plot(rows: list[dict], path: Path, error: str, label: str, logarithmic: bool) -> None:
    """Plot processor seconds against an error, with a colour for each method; rows without that error are left out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), dpi=110)
    for way in dict.fromkeys(row["way"] for row in rows):
        measured = [row for row in rows if row["way"] == way and error in row]
        axes.scatter([row["processor"] for row in measured], [row[error] for row in measured], label=way, s=22)
    axes.set(xscale="log", yscale="log" if logarithmic else "linear", xlabel="seconds of the processor", ylabel=label)
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
