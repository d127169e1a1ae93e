"""Kill a run at sixty-one moments: the output must be the old result or the new one, whole (part of `make fuzz`).

    python -m tests.faults.kills [RANDOM] [EXACT] [SEED]

RANDOM kills come at random times. EXACT kills come just before a chosen operation on the file system: the first, the
last, and others spread over making, writing, renaming and removing what belongs to the output, the manifest and the
swap among them. After each kill the output must open and nothing beside it may have changed. At the end an undisturbed
run must give the same files as one that was never killed.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from gdtool.core.folder import open_folder
from tests.faults.files import leftovers, quad_cube

CELLS = 24
COMMAND = ["remesh", "cube.obj", "--faces", str(6 * CELLS**2), "-o", "out", "--force", "-q"]
EVENTS = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.chmod", "os.utime", "shutil.rmtree", "open")


def watched(act) -> None:
    """Call act(operation) before each operation on the file system that touches an output, and before the swap."""
    here = Path.cwd()

    def hook(event: str, arguments: tuple) -> None:
        if event not in EVENTS:
            return
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        name = os.fsdecode(arguments[0]) if isinstance(arguments[0], (str, bytes, os.PathLike)) else ""
        place = Path(os.path.relpath(here / name, here))
        if place.parts[:1] and place.parts[0].lstrip(".").split(".")[0] == "out":
            act(f"{event} {name}")

    sys.addaudithook(hook)
    # The swap of two folders is a call into the C library, which audit hooks do not see.
    from gdtool.core import publish

    swap = publish._exchange

    def watched_swap(a: Path, b: Path) -> bool:
        act(f"swap {a} {b}")
        done = swap(a, b)
        act(f"swapped {a} {b}")
        return done

    publish._exchange = watched_swap


def inside(stop_before: int) -> None:
    """Run gdtool, and kill this process before operation `stop_before`; with -1, only print the operations."""
    count = 0

    def act(what: str) -> None:
        nonlocal count
        if count == stop_before:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        if stop_before < 0:
            os.write(2, f"operation {what}\n".encode())

    watched(act)
    sys.argv = ["gdtool", *COMMAND]
    from gdtool.commands import main

    main()


def start(folder: Path, stop_before: int | None = None) -> subprocess.Popen:
    """Start the run, to its end or to be killed before an operation."""
    words = (
        ["-m", "gdtool", *COMMAND]
        if stop_before is None
        else ["-m", "tests.faults.kills", "--inside", str(stop_before)]
    )
    root = str(Path(__file__).resolve().parents[2])
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
    )


def spread(operations: list[str], count: int) -> list[int]:
    """Choose `count` operations to stop before: first, last, those near the manifest and the swap, others evenly."""
    important = [
        i for i, what in enumerate(operations) if "manifest.json" in what or what.startswith(("swap", "os.rename"))
    ]
    chosen = list(dict.fromkeys([0, len(operations) - 1, *important]))[:count]
    even = (round(k * (len(operations) - 1) / max(count - 1, 1)) for k in range(count))
    for operation in even:
        if len(chosen) < count and operation not in chosen:
            chosen.append(operation)
    rest = (i for i in range(len(operations)) if i not in chosen)
    return sorted(chosen + [i for i, _ in zip(rest, range(count - len(chosen)), strict=False)])


def main(random_kills: int = 50, exact_kills: int = 11, seed: int = 0) -> int:
    """Run all kills; returns how many left something wrong."""
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="gdtool-kills-") as top:
        folder = Path(top)
        quad_cube(folder / "cube.obj", 4)
        done = subprocess.run(
            [sys.executable, "-m", "gdtool", "remesh", "cube.obj", "--faces", "96", "-o", "out", "-q"],
            cwd=folder,
            stdout=subprocess.DEVNULL,
        )
        assert done.returncode == 0
        old = open_folder(folder / "out").manifest.digest
        quad_cube(folder / "cube.obj", CELLS)
        (folder / ".out.v2.000000000000.work").mkdir()
        (folder / ".out.v2.000000000000.work/checkpoint").write_text("another output's")
        begin = time.perf_counter()
        process = start(folder, -1)
        _, errors = process.communicate()
        usual = time.perf_counter() - begin
        assert process.returncode == 0, errors
        operations = [line.removeprefix("operation ") for line in errors.splitlines() if line.startswith("operation ")]
        new = open_folder(folder / "out").manifest.digest
        assert old != new
        rng = random.Random(seed)
        moments: list[tuple[str, int | None, float]] = [
            (f"before {operations[i]}", i, 0.0) for i in spread(operations, exact_kills)
        ]
        moments += [
            (f"after {share:.2f} of a run", None, share * usual)
            for share in (rng.uniform(0.1, 1.1) for _ in range(random_kills))
        ]
        for name, stop, seconds in moments:
            if stop is not None:  # or the sweep of what the kill before has left would be counted with the operations
                start(folder).communicate()
            process = start(folder, stop)
            if stop is None:
                time.sleep(seconds)
                process.kill()
            process.communicate()
            faults = []
            if stop is not None and process.returncode != -signal.SIGKILL:
                faults.append(f"it was not killed (exit {process.returncode})")
            try:
                if open_folder(folder / "out").manifest.digest not in (old, new):
                    faults.append("the output is neither the old nor the new result")
            except Exception as error:
                faults.append(f"the output does not open: {error}")
            if (folder / ".out.v2.000000000000.work/checkpoint").read_text() != "another output's":
                faults.append("another output's checkpoint was touched")
            wrong += bool(faults)
            print(f"killed {name}: " + ("; ".join(faults) or "whole"), flush=True)
        process = start(folder)
        _, errors = process.communicate()
        left = [path for path in leftovers(folder) if ".out.v2." not in path]
        if process.returncode or open_folder(folder / "out").manifest.digest != new or left:
            print(f"the run after the kills: exit {process.returncode}, left {left}, {errors}")
            wrong += 1
    print(f"{len(moments)} kills, {wrong} with a fault")
    return wrong


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        inside(int(sys.argv[2]))
    else:
        sys.exit(1 if main(*map(int, sys.argv[1:])) else 0)
