"""What all tests share: the command line as a subprocess, in a folder of its own."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line has it; before any test imports torch
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
        return subprocess.run(
            [sys.executable, "-m", "gdtool", *map(str, arguments)],
            input=stdin,
            capture_output=True,
            text=True,
            timeout=timeout,
            cwd=tmp_path,
            env={**os.environ, "OMP_NUM_THREADS": "2", **(env or {})},
            **kwargs,
        )

    return run


@pytest.fixture
def gdtool_here(tmp_path, monkeypatch):
    """As gdtool, but within this process: no second import of torch, so a tenth of the time for small work."""

    def run(*arguments, stdin=""):
        from gdtool.commands._exit import guarded
        from gdtool.commands._group import cli

        out, err = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True), io.StringIO()
        before = signal.getsignal(signal.SIGTERM)
        code = 0
        with monkeypatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            patch.setattr(sys, "argv", ["gdtool", *map(str, arguments)])
            patch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin.encode())))
            try:
                guarded(cli)
            except SystemExit as ended:
                code = ended.code or 0
            finally:
                signal.signal(signal.SIGTERM, before)
        return subprocess.CompletedProcess(arguments, code, out.buffer.getvalue().decode(), err.getvalue())

    return run
