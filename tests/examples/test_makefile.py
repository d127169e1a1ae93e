"""examples/Makefile drives the stages; here by a stand-in for gdtool that writes manifests and keeps a log."""

import os
import re
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).parents[2] / "examples" / "Makefile"
STAND_IN = r"""#!/bin/sh
# gdtool's part in this: write the manifest last, print the folder
echo "$@" >> "$LOG"
if [ "$1" = evaluate ]; then echo '{"distance": 0.001}'; exit 0; fi
case "$*" in *"$FAIL"*) exit 3;; esac
while [ $# -gt 0 ]; do [ "$1" = -o ] && out=$2; shift; done
mkdir -p "$out" && echo '{}' > "$out/manifest.json" && echo "$out"
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with two images and a model, and make with the stand-in: run(*arguments) -> (result, calls)."""
    gdtool = tmp_path / "bin" / "gdtool"
    gdtool.parent.mkdir()
    gdtool.write_text(STAND_IN)
    gdtool.chmod(0o755)
    work = tmp_path / "work"
    work.mkdir()
    for name in ("cat.png", "owl.jpg", "chair.glb"):
        (work / name).write_bytes(b"x")

    def run(*arguments, fail="no such text", cwd=work):
        log = tmp_path / "log"
        log.write_text("")
        environment = {**os.environ, "LOG": str(log), "FAIL": fail}
        result = subprocess.run(
            ["make", "-f", str(MAKEFILE), f"GDTOOL={gdtool}", *arguments],
            cwd=cwd,
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
        )
        return result, log.read_text().splitlines()

    return work, run


def stages(calls, name):
    return [call.split()[0] for call in calls if name in call]


def touch(path):
    """The file as if written a minute after everything else."""
    new = path.stat().st_mtime_ns + 60_000_000_000
    os.utime(path, ns=(new, new))


FROM_IMAGE = ["sample-views", "reconstruct", "remesh", "unwrap", "bake"]
FROM_MODEL = ["render-dataset", "reconstruct", "remesh", "unwrap", "bake"]


def test_images_and_models_become_assets_in_parallel(folder):
    work, run = folder
    result, calls = run("-j3")
    assert result.returncode == 0, result.stderr
    assert stages(calls, "cat.") == stages(calls, "owl.") == FROM_IMAGE
    assert stages(calls, "chair.") == FROM_MODEL
    assert all((work / f"{name}.asset" / "asset" / "manifest.json").is_file() for name in ("cat", "owl", "chair"))


def test_running_again_runs_nothing(folder):
    _, run = folder
    run("-j3")
    result, calls = run("-j3")
    assert result.returncode == 0
    assert calls == []


def test_a_failed_stage_is_resumed_where_it_stopped(folder):
    work, run = folder
    result, calls = run("-k", fail="remesh --quiet --threads 1 -o owl.asset")
    assert result.returncode == 2
    assert stages(calls, "owl.") == FROM_IMAGE[:3]
    assert stages(calls, "cat.") == FROM_IMAGE
    assert (work / "owl.asset" / "surface" / "manifest.json").is_file()
    result, calls = run()
    assert result.returncode == 0
    assert stages(calls, "owl.") == FROM_IMAGE[2:]
    assert stages(calls, "cat.") == []


@pytest.mark.parametrize(
    ("changed", "again"),
    [
        ("cat.asset/mesh/manifest.json", ["unwrap", "bake"]),
        ("cat.png", FROM_IMAGE),
        ("chair.glb", FROM_MODEL),
    ],
)
def test_what_follows_from_a_new_source_or_result_runs_again(folder, changed, again):
    work, run = folder
    run()
    touch(work / changed)
    _, calls = run()
    assert [call.split()[0] for call in calls] == again
    assert all(changed.split(".")[0] in call for call in calls)


def test_sources_elsewhere_options_and_single_targets(folder, tmp_path):
    work, run = folder
    other = tmp_path / "other"
    other.mkdir()
    result, calls = run(f"SOURCES={work}", "REMESH=--faces 5000", "cat.asset/renders/manifest.json", cwd=other)
    assert result.returncode == 0
    assert [call.split()[0] for call in calls] == [*FROM_IMAGE, "relight"]
    assert "remesh --faces 5000 --quiet" in calls[2]
    assert not (other / "owl.asset").exists()


def test_reports_hold_the_error_of_each_model(folder):
    work, run = folder
    result, calls = run("reports")
    assert result.returncode == 0
    assert calls[-1] == "evaluate chair.asset/asset --reference chair.glb --json"
    assert (work / "chair.asset" / "report.json").read_text() == '{"distance": 0.001}\n'
    assert not (work / "cat.asset").exists()


def test_the_commands_it_calls_exist():
    from gdtool.commands import COMMANDS

    called = set(re.findall(r"call RUN,([a-z-]+)", MAKEFILE.read_text())) | {"evaluate"}
    assert called == set(COMMANDS) - {"train", "validate", "import-views"}
