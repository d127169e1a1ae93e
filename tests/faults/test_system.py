"""Run under a full disk, unwritable folders, signals, a second process, a closed pipe."""

import os
import resource
import signal
import subprocess
import sys
import time

import pytest

from gdtool.core.folder import open_folder
from tests.faults import kills
from tests.faults.files import leftovers, lines_of, quad_cube

CELLS = 60
FACES = 6 * CELLS**2  # what quad_cube has: remesh passes it through, so its run is reading, checking and writing
REMESH = [sys.executable, "-m", "gdtool", "remesh", "--faces", str(FACES)]


def listen_to_interrupts():
    """Reset SIGINT, which a shell ignores in background jobs, perhaps the tests."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(*arguments, **kwargs):
    """Start a remesh run."""
    kwargs.setdefault("preexec_fn", listen_to_interrupts)
    return subprocess.Popen(
        [*REMESH, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **kwargs
    )


@pytest.fixture
def cube(tmp_path):
    """Write a cube that remesh copies."""
    return quad_cube(tmp_path / "cube.obj", CELLS).name


def tree(folder):
    """Read all files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def small_files():
    """Limit files to 20 kB, which looks like a full disk."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


def test_a_full_disk_exits_4_and_keeps_the_old_result(tmp_path, cube):
    quad_cube(tmp_path / "old.obj", 4)
    old = subprocess.run([*REMESH[:-1], "96", "old.obj", "-o", "out", "-q"], capture_output=True, text=True)
    assert old.returncode == 0, old.stderr
    before = tree(tmp_path / "out")
    process = start(cube, "-o", "out", preexec_fn=small_files)
    out, errors = process.communicate()
    assert process.returncode == 4, errors
    assert out == "", errors
    (error,) = lines_of(errors)
    assert "too large" in error
    assert "; " in error
    assert tree(tmp_path / "out") == before
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize(
    "command",
    [
        ["render-dataset", "cube.obj", "--size", "64", "--samples", "1", "--domains", "normal,depth"],
        ["evaluate", "cube.obj", "--reference", "cube.obj", "--samples", "200", "--no-syncdreamer"],
    ],
)
def test_a_full_disk_exits_4_for_every_writing_command(tmp_path, cube, command):
    """A command that writes no files is not affected."""
    done = subprocess.run(
        [sys.executable, "-m", "gdtool", *command, "-q"],
        capture_output=True,
        text=True,
        preexec_fn=lambda: (
            resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600)) or signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        ),
    )
    if command[0] == "evaluate":
        assert done.returncode == 0, done.stderr
    else:
        assert done.returncode == 4, done.stderr
        assert len(lines_of(done.stderr)) == 1, done.stderr
        assert leftovers(tmp_path) == [], done.stderr
        assert not (tmp_path / "cube.asset/views").exists()


def test_output_paths_that_cannot_be_written_are_refused(tmp_path, cube):
    """A file is where a folder must be; permissions are tried only by users other than root, who may write anywhere."""
    (tmp_path / "file").write_text("mine")
    for output, code in (("file", 2), ("file/below", 4)):
        process = start(cube, "-o", output, "-q")
        errors = process.communicate()[1]
        assert process.returncode == code, errors
        assert len(lines_of(errors)) == 1, errors
    assert (tmp_path / "file").read_text() == "mine"
    done = subprocess.run([*REMESH, cube, "-o", "/proc/gdtool", "-q"], capture_output=True, text=True)
    assert done.returncode == 4, done.stderr
    assert len(lines_of(done.stderr)) == 1, done.stderr
    if os.geteuid():
        (tmp_path / "locked").mkdir(mode=0o500)
        done = subprocess.run([*REMESH, cube, "-o", "locked/out", "-q"], capture_output=True, text=True)
        assert done.returncode == 4, done.stderr
        assert "permission" in done.stderr, done.stderr


def test_an_output_that_is_the_source_is_refused(tmp_path, cube, gdtool):
    assert gdtool("remesh", cube, "--faces", FACES, "-q").returncode == 0
    before = tree(tmp_path / "cube.asset/mesh")
    done = gdtool("unwrap", "cube.asset/mesh", "-o", "cube.asset/mesh", "-q")
    assert done.returncode == 2
    assert "both source and output" in done.stderr
    assert tree(tmp_path / "cube.asset/mesh") == before


@pytest.mark.parametrize("sign, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_leaves_nothing_and_can_be_repeated(tmp_path, cube, sign, code):
    process = start(cube)
    while not list(tmp_path.glob("cube.asset/.mesh.*.partial")):
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(sign)
    errors = process.communicate()[1]
    assert process.returncode == code, errors
    assert lines_of(errors) == [], errors
    assert leftovers(tmp_path) == []
    assert not (tmp_path / "cube.asset/mesh").exists()
    process = start(cube, "-q")
    assert process.communicate()[0] == "cube.asset/mesh\n"
    assert process.returncode == 0


def test_a_run_killed_at_eleven_moments_leaves_a_whole_result():
    assert kills.main(random_kills=1, exact_kills=11) == 0


@pytest.mark.slow
def test_a_run_killed_at_fifty_random_moments_leaves_a_whole_result():
    assert kills.main(random_kills=50, exact_kills=11, seed=1) == 0


def test_two_processes_share_one_output(tmp_path, cube):
    both = [start(cube), start(cube)]
    ends = [process.communicate() for process in both]
    assert [process.returncode for process in both] == [0, 0], ends
    assert [out for out, _ in ends] == ["cube.asset/mesh\n"] * 2
    assert sum("up to date" in errors for _, errors in ends) == 1
    open_folder(tmp_path / "cube.asset/mesh")
    assert leftovers(tmp_path) == []


def test_empty_stdin_exits_2_in_every_command(gdtool):
    for command in (
        "render-dataset",
        "sample-views",
        "import-views",
        "reconstruct",
        "remesh",
        "unwrap",
        "bake",
        "relight",
        "evaluate",
        "validate",
    ):
        done = gdtool(command)
        assert done.returncode == 2, command
        assert len(lines_of(done.stderr)) == 1, command
        assert done.stdout == "", command
    pipe = (
        f"{sys.executable} -m gdtool reconstruct nothing | {sys.executable} -m gdtool remesh | {sys.executable} -m "
        f"gdtool unwrap"
    )
    done = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


def test_a_closed_pipe_ends_a_command_quietly_with_141(tmp_path, cube):
    """As in `gdtool … | head -1`."""
    for i in range(4):
        quad_cube(tmp_path / f"c{i}.obj", 4)
    names = " ".join(f"c{i}.obj" for i in range(4))
    pipe = f"{' '.join(REMESH[:-1])} 96 -q {names} | head -1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True)
    first, code = done.stdout.split()
    # When head is slow to leave, all four lines fit into the pipe: then nothing broke.
    assert first == "c0.asset/mesh", done.stderr
    assert code in ("141", "0"), done.stderr
    assert done.stderr == "", done.stderr
    process = start("c3.obj", cube, "--force", "-q")
    process.stdout.readline()
    process.stdout.close()
    assert process.wait() == 141
    assert process.stderr.read() == ""
    assert leftovers(tmp_path) == []


def test_commands_work_without_home_and_temporary_folder(tmp_path, cube):
    bare = {"PATH": os.environ.get("PATH", ""), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*REMESH, cube], capture_output=True, text=True, env=bare)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "cube.asset/mesh\n", done.stderr
    done = subprocess.run(
        [sys.executable, "-m", "gdtool", "render-dataset", cube, "--size", "32", "--domains", "normal", "-o", "views"],
        capture_output=True,
        text=True,
        env={**bare, "HOME": "/nowhere", "TMPDIR": "/nowhere"},
    )
    assert done.returncode == 0, done.stderr


def test_an_address_space_limit_exits_5(tmp_path, cube):
    """Python and numpy fit in the limit, ten million samples do not."""
    limit = 1_500 * 2**20
    command = [
        sys.executable,
        "-m",
        "gdtool",
        "evaluate",
        cube,
        "--reference",
        cube,
        "--samples",
        "10000000",
        "--no-syncdreamer",
        "-q",
    ]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.returncode == 5, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    assert "memory" in done.stderr, done.stderr
