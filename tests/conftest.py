"""What all tests share: the command line as a subprocess, in a folder of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def in_own_folder(tmp_path, monkeypatch):
    """Every test works in its own empty folder: default outputs land in the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def gdtool(tmp_path):
    """gdtool("remesh", "x.obj", stdin="…") -> CompletedProcess with text stdout and stderr, in the test's folder."""

    def run(*arguments, stdin="", timeout=300, env=None, **kwargs):
        return subprocess.run([sys.executable, "-m", "gdtool", *map(str, arguments)], input=stdin, capture_output=True, text=True,
                              timeout=timeout, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "2", **(env or {})}, **kwargs)

    return run
