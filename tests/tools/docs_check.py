"""Run the ```sh blocks of docs/cookbook.md, each in a new folder with a copy of examples/ (`make docs-check`).

  python tests/tools/docs_check.py [NUMBER ...]     only these pipelines, by the numbers of their headings

The gdtool that is run is the one on PATH. Exits with 1 when a block fails, and shows what it wrote to stderr.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COOKBOOK = ROOT / "docs" / "cookbook.md"
SECONDS = 1200  # for one block, on a busy machine
BLOCK = re.compile(r"^## (\d+)\. ([^\n]+)\n(.*?)^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(text: str) -> list[tuple[int, str, str]]:
    """Return the number, title and script of each pipeline."""
    return [(int(number), title, script) for number, title, _, script in BLOCK.findall(text)]


def run(script: str) -> tuple[bool, float, str]:
    """Run a script; returns whether it succeeded, its seconds, and its stderr. A pipe fails when any of its commands
    does.
    """
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT / "examples", Path(folder, "examples"))
        start = time.perf_counter()
        try:
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", script], cwd=folder, capture_output=True, text=True, timeout=SECONDS
            )
        except subprocess.TimeoutExpired:
            return False, SECONDS, f"took longer than {SECONDS} s"
        return done.returncode == 0, time.perf_counter() - start, done.stderr


def main(chosen: list[str]) -> int:
    failed = 0
    for number, title, script in blocks(COOKBOOK.read_text()):
        if chosen and str(number) not in chosen:
            continue
        good, seconds, errors = run(script)
        print(f"{'ok    ' if good else 'FAILED'} {seconds:6.1f} s  {number}. {title}", flush=True)
        if not good:
            failed += 1
            print("\n".join("    " + line for line in errors.splitlines()[-15:]), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
