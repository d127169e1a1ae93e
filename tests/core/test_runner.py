"""Run a toy stage: where results go, when they are up to date, and that no half-written folder is ever visible."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gdtool.core.errors import InputError, UsageError
from gdtool.core.folder import open_folder
from gdtool.core.manifest import read_manifest
from gdtool.core.provenance import find_source
from gdtool.core.runner import Settings, run_all
from tests.conftest import ROOT
from tests.core.toy import STAGE, Options


def toy(*arguments, stdin=None, **kwargs):
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "tests.core.toy", *map(str, arguments)],
        input=stdin,
        capture_output=True,
        text=True,
        env=env,
        timeout=60,
        **kwargs,
    )


def run(*arguments, options=None, **settings):
    return list(run_all(STAGE, arguments, options or Options(), {}, Settings(**settings)))


def listen_to_interrupts():
    """Restore SIGINT, which a shell ignores in background jobs, such as these tests may be."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def leftovers(folder="."):
    return [p.name for p in Path(folder).rglob(".*")]


def test_a_result_is_complete_and_its_manifest_describes_it():
    Path("cat.png").write_bytes(b"cat")
    (result,) = run("cat.png")
    assert str(result.path) == "cat.asset/renders"
    assert result.status == "done"
    folder = open_folder(result.path)
    assert folder.name == "cat"
    assert folder.manifest.stage == "toy"
    assert [f.path for f in folder.manifest.files] == ["000.png"]
    assert folder.manifest.inputs[0].path == "../../cat.png"
    assert folder.manifest.skipped[0].reason == "nothing to polish"
    assert str(Path.cwd()) not in (result.path / "manifest.json").read_text()
    assert Path(find_source(folder, "make it again")).read_bytes() == b"cat"
    assert leftovers() == []


def test_second_run_does_nothing_and_says_so(capsys):
    Path("cat.png").write_bytes(b"cat")
    run("cat.png")
    os.utime("cat.asset/renders/manifest.json", (1, 1))
    assert run("cat.png")[0].status == "up to date"
    assert "up to date" in capsys.readouterr().err
    assert Path("cat.asset/renders/manifest.json").stat().st_mtime > 1  # make must be content as well


@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda: Path("cat.png").write_bytes(b"dog"), "source changed"),
        (lambda: Path("cat.asset/renders/000.png").unlink(), "damaged"),
    ],
)
def test_stale_results_are_made_again_with_the_reason(change, reason, capsys):
    Path("cat.png").write_bytes(b"cat")
    run("cat.png")
    change()
    assert run("cat.png")[0].status == "done"
    assert reason in capsys.readouterr().err


def test_changed_option_is_named(capsys):
    Path("cat.png").write_bytes(b"cat")
    run("cat.png")
    assert run("cat.png", options=Options(repeat=3))[0].status == "done"
    assert "repeat 1 → 3" in capsys.readouterr().err
    assert len(read_manifest(Path("cat.asset/renders")).files) == 3


def test_file_options_enter_the_key_by_content():
    Path("cat.png").write_bytes(b"cat")
    Path("extra").write_bytes(b"1")
    options = Options(extra="extra")
    assert [run("cat.png", options=options)[0].status for _ in range(2)] == ["done", "up to date"]
    Path("extra").write_bytes(b"2")
    assert run("cat.png", options=options)[0].status == "done"


def test_equal_runs_have_equal_digests():
    Path("cat.png").write_bytes(b"cat")
    first, second = (run("cat.png", output=Path(name))[0] for name in "ab")
    assert read_manifest(first.path).digest == read_manifest(second.path).digest
    assert read_manifest(first.path).key == read_manifest(second.path).key


def test_another_source_of_the_same_name_needs_the_output_option():
    Path("a").mkdir()
    Path("cat.png").write_bytes(b"cat")
    Path("a/cat.png").write_bytes(b"cat")
    run("cat.png")
    (error,) = run("a/cat.png")
    assert isinstance(error, UsageError)
    assert "-o" in str(error)
    assert run("a/cat.png", output=Path("other"))[0].status == "done"


def test_output_option_is_the_folder_of_one_source_and_the_parent_of_several():
    for name in "ab":
        Path(f"{name}.png").write_bytes(name.encode())
    assert run("a.png", output=Path("x"))[0].path == Path("x")
    assert [r.path for r in run("a.png", "b.png", output=Path("y"), several=True)] == [
        Path("y/a.asset/renders"),
        Path("y/b.asset/renders"),
    ]


def test_one_bad_source_among_many():
    Path("good.png").write_bytes(b"good")
    Path("bad.png").write_bytes(b"bad")
    done = toy("bad.png", "good.png")
    assert done.returncode == 1
    assert done.stdout == "good.asset/renders\n"
    assert "gdtool: bad.png: is bad; give a good one" in done.stderr.splitlines()
    assert "Traceback" not in done.stderr
    assert toy("bad.png").returncode == 3
    assert not Path("bad.asset").exists()
    assert toy("bad.png", "--debug").stderr.count("Traceback") == 1


def test_failed_run_keeps_the_old_result():
    Path("cat.png").write_bytes(b"cat")
    run("cat.png")
    before = Path("cat.asset/renders/manifest.json").read_bytes()
    Path("cat.png").write_bytes(b"bad")
    assert isinstance(run("cat.png")[0], InputError)
    assert Path("cat.asset/renders/manifest.json").read_bytes() == before
    assert leftovers() == []


def test_stdin_json_dry_run_and_exit_codes():
    Path("cat.png").write_bytes(b"cat")
    assert toy(stdin="").returncode == 2
    assert toy(stdin="cat.png\n").stdout == "cat.asset/renders\n"
    record = json.loads(toy("--json", stdin='{"folder": "cat.png"}\n').stdout)
    assert record["status"] == "up to date"
    assert record["folder"] == "cat.asset/renders"
    assert toy("-n", "nothing.png").stdout == "nothing.asset/renders\n"
    assert not Path("nothing.asset").exists()
    assert toy("nothing.png").returncode == 3
    assert toy("cat.png", "-o", "cat.png").returncode == 2
    assert toy("cat.png", "--repeat", "0").returncode == 2


def test_read_only_folder_exits_4_and_missing_reader_141():
    Path("cat.png").write_bytes(b"cat")
    Path("file").write_text("")
    assert toy("cat.png", "-o", "file/x").returncode == 4
    names = [f"{i}.png" for i in range(30)]
    for name in names:
        Path(name).write_bytes(b"x")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.Popen(
        [sys.executable, "-m", "tests.core.toy", *names], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=env
    )
    pipe.stdout.readline()
    pipe.stdout.close()
    errors = pipe.stderr.read().decode()
    assert pipe.wait() == 141
    assert "Traceback" not in errors
    assert "Broken" not in errors


def test_streams_a_source_as_soon_as_its_line_arrives():
    for name in "ab":
        Path(f"{name}.png").write_bytes(b"x")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.core.toy"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, text=True
    )
    for name in "ab":
        process.stdin.write(f"{name}.png\n")
        process.stdin.flush()
        assert process.stdout.readline() == f"{name}.asset/renders\n"
    process.stdin.close()
    assert process.wait() == 0


@pytest.mark.parametrize("sign, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_leaves_nothing(sign, code):
    Path("cat.png").write_bytes(b"cat")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.core.toy", "cat.png", "--repeat", "500", "--pause", "0.02"],
        env=env,
        stderr=subprocess.PIPE,
        preexec_fn=listen_to_interrupts,
    )
    while not list(Path().glob("cat.asset/.renders.*.partial/000.png")):
        time.sleep(0.01)
    process.send_signal(sign)
    assert process.wait() == code
    assert b"Traceback" not in process.stderr.read()
    assert leftovers() == []
    assert not Path("cat.asset/renders").exists()


def test_killed_at_random_moments_the_old_or_the_new_result_is_complete():
    Path("cat.png").write_bytes(b"old")
    run("cat.png", options=Options(repeat=2))
    old = read_manifest(Path("cat.asset/renders")).digest
    Path("cat.png").write_bytes(b"new")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    rng = random.Random(0)
    for _ in range(8):
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.core.toy", "cat.png", "--repeat", "20", "--pause", "0.01", "--force"],
            env=env,
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        time.sleep(0.25 + 0.5 * rng.random())
        process.kill()
        process.wait()
        folder = open_folder(Path("cat.asset/renders"))  # raises when a file is missing or cut
        assert folder.manifest.digest == old or len(folder.manifest.files) == 20
    assert toy("cat.png", "--repeat", "20").returncode == 0
    assert len(open_folder(Path("cat.asset/renders")).manifest.files) == 20
    assert leftovers() == []


def test_two_processes_on_one_output_do_not_mix():
    Path("cat.png").write_bytes(b"cat")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    both = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.core.toy", "cat.png", "--repeat", "20", "--pause", "0.01"],
            env=env,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    errors = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert sum("up to date" in text for text in errors) == 1
    assert len(open_folder(Path("cat.asset/renders")).manifest.files) == 20
    assert leftovers() == []


def test_a_folder_that_ships_with_gdtool_is_an_input_like_any_other():
    """A new bundled model makes old views stale, since its digest is part of the key."""
    from gdtool.core.second_inputs import second_inputs
    from gdtool.stages.sample_views import STAGE as sample_views

    model = second_inputs(sample_views, Path("cat.png"), {"model": None}).by_flag["model"]
    assert model.kind == "model"
    assert model.name == "default"
