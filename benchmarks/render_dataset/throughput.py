"""Objects per core-minute of render-dataset: how it grows with cores, and what memory does as objects do.

    python -m benchmarks.render_dataset.throughput [-o docs/benchmarks] [--objects 24] [--counts 10,100,1000] [--fresh]

Writes throughput.md, throughput.json and throughput.png, after every row; begun again it goes on where it was. Cores
are allowed by affinity (1, 2, 4, … all). Ways: one process with that many threads, as many processes by --shard of one
thread each, and, where the package is installed and for all cores, --ray local. Start-up is in the times. About eight
minutes of two quiet cores."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

from benchmarks.common.measure import Cost, busy, gdtool, machine, number, say, table

TYPICAL = ("--size", "64", "--samples", "8", "--light-samples", "6")  # what `make data` renders
TINY = ("--size", "32", "--samples", "4", "--domains", "normal,depth")
COLUMNS = ("way", "cores", "objects", "seconds", "cpu", "per_core_minute", "per_cpu_minute", "peak_mb")


def one_process(folder: Path, objects: int, cores: int, options: tuple[str, ...]) -> list[Cost]:
    """A process with a thread for every core."""
    return [
        gdtool("render-dataset", f"procedural:0..{objects - 1}", *options, "--threads", str(cores), "-o", folder, "-q")
    ]


def shards(folder: Path, objects: int, cores: int, options: tuple[str, ...]) -> list[Cost]:
    """A process of one thread for every core, at once."""

    def run(part: int) -> Cost:
        return gdtool(
            "render-dataset",
            f"procedural:0..{objects - 1}",
            *options,
            "--threads",
            "1",
            "--shard",
            f"{part}/{cores}",
            "-o",
            folder,
            "-q",
        )

    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(run, range(1, cores + 1)))


def on_ray(folder: Path, objects: int, cores: int, options: tuple[str, ...]) -> list[Cost]:
    """A worker process for every core; their processor time and memory are not the command's, and not known here."""
    return [gdtool("render-dataset", f"procedural:0..{objects - 1}", *options, "--ray", "local", "-o", folder, "-q")]


WAYS = {"threads": one_process, "shards": shards, "ray": on_ray}


def measured(way: str, cores: int, objects: int, options: tuple[str, ...]) -> dict:
    """One row: a run into a new folder, on the first `cores` cores that this process may use."""
    allowed = sorted(os.sched_getaffinity(0))
    folder = Path(tempfile.mkdtemp(prefix="throughput-"))
    try:
        os.sched_setaffinity(0, allowed[:cores])  # inherited by what is started
        costs = WAYS[way](folder / "data", objects, cores, options)
    finally:
        os.sched_setaffinity(0, allowed)
        shutil.rmtree(folder, ignore_errors=True)
    return row_of(way, cores, objects, costs)


def row_of(way: str, cores: int, objects: int, costs: list[Cost]) -> dict:
    """Figures of runs that went on at once. Rates are objects a minute, by the clock and core, and by processor
    time."""
    seconds, cpu = max(c.seconds for c in costs), sum(c.cpu_seconds for c in costs)
    known = way != "ray"
    return {
        "way": way,
        "cores": cores,
        "objects": objects,
        "seconds": seconds,
        "cpu": cpu if known else None,
        "per_core_minute": 60 * objects / (seconds * cores),
        "per_cpu_minute": 60 * objects / cpu if known else None,
        "peak_mb": max(c.peak_mb for c in costs) if known else None,
    }


def plan(objects: int, counts: list[int], cores: int, ray: bool) -> list[tuple[str, str, int, int, tuple[str, ...]]]:
    """All rows: table, way, cores, objects, options."""
    steps = sorted({2**k for k in range(cores.bit_length()) if 2**k <= cores} | {cores})
    out = [("cores", "threads", 1, objects, TYPICAL)]
    out += [("cores", way, k, objects, TYPICAL) for k in steps if k > 1 for way in ("threads", "shards")]
    out += [("cores", "ray", cores, objects, TYPICAL)] if ray else []
    return out + [("objects", "threads", cores, count, TINY) for count in counts]


def report(state: dict) -> str:
    """The page."""

    def rows(name: str) -> str:
        return table(
            COLUMNS,
            [[number(row.get(column)) for column in COLUMNS] for row in state["rows"].values() if row["table"] == name],
        )

    parts = [
        "# Throughput of render-dataset",
        "",
        f"`make bench-throughput`: {state['machine']}. {state['busy']}".rstrip(),
        "",
        "Start-up (about two seconds) is in every row. per_core_minute is by the clock, per_cpu_minute by the "
        "processor time taken.",
        "",
        f"## More cores: procedural objects, `{' '.join(TYPICAL)}`",
        "",
        rows("cores"),
        "",
        *([] if state["ray"] else ["No row by `--ray local`: the package ray is not installed.", ""]),
        f"## More objects: `{' '.join(TINY)}`, one process",
        "",
        rows("objects"),
        "",
        "![growth](throughput.png)",
        "",
    ]
    return "\n".join(parts)


def plot(state: dict, path: Path) -> None:
    """Objects a minute against cores, memory against objects."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    rows = list(state["rows"].values())
    start = next((r for r in rows if r["table"] == "cores" and r["cores"] == 1), None)
    for way in WAYS:
        line = [r for r in rows if r["table"] == "cores" and r["way"] == way]
        line = [start, *line] if start and way == "shards" else line
        left.plot([r["cores"] for r in line], [60 * r["objects"] / r["seconds"] for r in line], "o-", label=way)
    left.set(xlabel="cores", ylabel="objects a minute", ylim=(0, None))
    left.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(integer=True))
    left.legend()
    line = [r for r in rows if r["table"] == "objects"]
    right.plot([r["objects"] for r in line], [r["peak_mb"] for r in line], "o-")
    right.set(xlabel="objects in one run", ylabel="peak memory, MB", xscale="log", ylim=(0, None))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Measure what is not measured yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--objects", type=int, default=24)
    parser.add_argument("--counts", default="10,100,1000")
    parser.add_argument("--fresh", action="store_true", help="measure all rows again")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "throughput.json"
    state = {"machine": machine(), "busy": busy(), "ray": find_spec("ray") is not None, "rows": {}}
    if path.exists() and not options.fresh:
        before = json.loads(path.read_text())
        if before["machine"] == state["machine"]:
            state["rows"], state["busy"] = before["rows"], state["busy"] or before["busy"]
    counts = [int(x) for x in options.counts.split(",")]
    for name, way, cores, objects, flags in plan(options.objects, counts, len(os.sched_getaffinity(0)), state["ray"]):
        key = f"{name}/{way}/{cores}/{objects}"
        if key in state["rows"]:
            continue
        say(key)
        state["rows"][key] = {"table": name, **measured(way, cores, objects, flags)}
        path.write_text(json.dumps(state, indent=1) + "\n")
        (options.output / "throughput.md").write_text(report(state))
        plot(state, options.output / "throughput.png")
    print(options.output / "throughput.md")


if __name__ == "__main__":
    sys.exit(main())
