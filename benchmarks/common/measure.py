"""Run gdtool commands as a user does, and measure what each costs: seconds of wall clock and peak memory."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]  # of the checkout


class Failed(Exception):
    """Report that a command failed; str() has its exit code and its last line of stderr."""


@dataclass(frozen=True)
class Cost:
    """Hold what one command took, and its stdout.

    seconds: wall clock. peak_mb: largest resident set of the process or of one of its children. cpu_seconds: of the
    process and its children, user and system, over all threads.
    """

    seconds: float
    peak_mb: float
    stdout: str
    cpu_seconds: float = 0.0


def command() -> str:
    """Return the path of the gdtool of this environment, else of the one on PATH."""
    beside = Path(sys.executable).with_name("gdtool")
    path = str(beside) if beside.exists() else shutil.which("gdtool")
    if path is None:
        sys.exit("gdtool is not installed; run make venv")
    return path


def peak_mb(process: int | str = "self") -> float:
    """Return the largest resident set that a process has had so far, in MB; 0 where it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def gdtool(*arguments: str | Path, limit_seconds: float = 1800) -> Cost:
    """Run `gdtool arguments` and return its cost. Raises Failed."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        start, high = time.perf_counter(), 0.0
        process = subprocess.Popen([command(), *map(str, arguments)], stdout=out, stderr=err)
        while True:  # wait4 is the only call that tells one child's memory, of its own children too
            high = peak_mb(process.pid) or high
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            seconds = time.perf_counter() - start
            if pid:
                break
            if seconds > limit_seconds:
                process.kill()
            time.sleep(0.01)
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    if process.returncode:
        last = texts[1].strip().splitlines()[-1:] or ["no message"]
        late = f" after {limit_seconds:.0f} s" if seconds > limit_seconds else ""
        raise Failed(f"{arguments[0]} exited with {process.returncode}{late}: {last[0]}")
    # A child's account begins with what this process held when it started it; below that only the child itself can
    # tell.
    account = usage.ru_maxrss / 1024
    return Cost(seconds, account if account > peak_mb() else high, texts[0], usage.ru_utime + usage.ru_stime)


def evaluate(result: Path, *arguments: str | Path) -> dict:
    """Run `gdtool evaluate result arguments` and return its report. Raises Failed."""
    return json.loads(gdtool("evaluate", result, "--json", "--quiet", *arguments).stdout)


def machine() -> str:
    """Name the processor and the number of cores, for the head of a report."""
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        "?",
    )
    return f"{model}, {len(os.sched_getaffinity(0))} cores visible"


def busy() -> str:
    """Return a sentence for the report where the machine had other work as the benchmark began, else ""."""
    working, cores = _cores_at_work(), len(os.sched_getaffinity(0))
    return (
        f"Other work ran meanwhile ({working:.1f} of {cores} cores as it began): the times are upper bounds."
        if working > 0.3 * cores
        else ""
    )


def _cores_at_work(seconds: float = 1.0) -> float:
    """Measure how many cores work right now, over `seconds`.

    Where the kernel has no /proc/stat, returns the load average of the last minute, which also counts processes that
    ended since.
    """
    if not Path("/proc/stat").exists():
        return os.getloadavg()[0]

    def used() -> float:
        ticks = [int(text) for text in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        return (sum(ticks) - sum(ticks[3:5])) / os.sysconf("SC_CLK_TCK")  # without idle and waiting

    before = used()
    time.sleep(seconds)
    return (used() - before) / seconds


def say(text: str) -> None:
    """Print progress to stderr."""
    print(text, file=sys.stderr, flush=True)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Format a Markdown table; the first column is left aligned, the others right."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|---" + "|--:" * (len(head) - 1) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def number(value: object, digits: int = 3) -> str:
    """Format a figure for a table; None becomes a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def seconds_axis(axis) -> None:
    """Make the x axis of a matplotlib plot logarithmic in seconds, labelled 1, 2, 5, 10, …"""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    axis.set(xscale="log", xlabel="seconds")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
