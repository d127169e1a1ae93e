"""Fuzz the command line: damaged folders, random options, outputs that belong to the user (part of `make fuzz`).

    python -m tests.faults.fuzz_commands [MINUTES] [SEED]

Each case is a copy of a small working folder with models, pictures and a result of every stage. Up to three places in
it are damaged; then one command runs with random sources, options and outputs. The run must

- end in time, with a documented exit code, one line for each error and no traceback;
- print nothing but paths, and publish only folders that validate;
- leave nothing behind, and change nothing that it did not make.

A case that breaks a rule is printed with its seed; `python -m tests.faults.fuzz_commands 0 SEED` repeats it.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from tests.faults.files import leftovers
from tests.faults.fuzz import mutated

SECONDS = 60.0  # a case works on a few hundred triangles and pictures of 32 pixels; what takes longer hangs
CODES = {0, 1, 2, 3, 4, 5}
ODD_TEXTS = [
    "",
    " ",
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "1e-300",
    "1e308",
    "9" * 30,
    "-" + "9" * 5000,
    "0x10",
    "1,5",
    "é",
    "a\nb",
    "x" * 300,
    "../..",
    "/",
    ".",
    "/dev/zero",
    "/dev/null",
    "/proc/self/mem",
    "~",
    "%s",
    "--",
    "-",
    "true",
    "none",
    "auto",
    "[",
    "procedural:1",
    "procedural:3..1",
    "procedural:-1",
    "procedural:" + "9" * 30,
    "{}",
    '{"folder": 3}',
    '{"folder": null}',
    "[" * 2000,
    "\udcff",
    "1/0",
    "2/1",
    "1/2",
]
ODD_VALUES: list[Any] = [
    None,
    True,
    0,
    -1,
    1.5,
    2**31,
    2**63 - 1,
    2**70,
    10**400,
    1e308,
    -1e308,
    "",
    "x",
    "../../x",
    "/etc/passwd",
    "%2Fetc%2Fpasswd",
    "a\0b",
    "\ud800",
    "x" * 5000,
    [],
    {},
    [[]],
    {"a": {}},
    [1, "a", None],
]
# What keeps a good run short; random options come after, and win.
QUICK = {
    "render-dataset": ["--size", "32", "--samples", "1", "--light-samples", "1"],
    "sample-views": ["--steps", "1"],
    "import-views": [],
    "reconstruct": ["--resolution", "24"],
    "remesh": ["--faces", "200", "--seconds", "20"],
    "unwrap": ["--size", "128", "--seconds", "20"],
    "bake": ["--size", "64", "--samples", "1", "--ao-rays", "4"],
    "relight": ["--size", "32", "--samples", "1", "--views", "1"],
    "train": ["--preset", "tiny", "--steps", "1", "--batch", "1", "--held-out", "1"],
    "evaluate": ["--samples", "100", "--no-syncdreamer", "--no-render"],
    "validate": [],
}
# The lines of stderr: errors, warnings, what a run tells of itself.
KNOWN_LINE = re.compile(r"gdtool( [a-z-]+)?: |warning: |  |.*: (running|done|up to date|what is done so far)")
# What each command reads.
FITTING = {
    "render-dataset": ["painted.obj", "cube.obj", "box.glb", "box.gltf", "procedural:1"],
    "sample-views": ["cat.png", "paint.png"],
    "import-views": ["pictures"],
    "reconstruct": ["box.asset/views"],
    "remesh": ["box.asset/surface", "cube.obj", "box.glb"],
    "unwrap": ["box.asset/mesh", "cube.obj"],
    "bake": ["box.asset/atlas"],
    "relight": ["box.asset/asset", "box.glb"],
    "train": ["box.asset/views", "box.tar"],
}
# Options that ask for more work than a fuzz has time for.
LEFT_OUT = {
    "--compile",
    "--ray",
    "--help",
    "--debug",
    "--minutes",
    "--preset",
    "--tensorboard",
    "--method",
    "--target-psnr",
}


def make_pool(pool: Path) -> None:
    """Make small sources, and a result of every stage from them by the command line."""
    from gdtool.assets.gltf.write import glb_bytes
    from gdtool.assets.scene import Material, Scene, Texture
    from gdtool.images.io import write_exr, write_png
    from tests.faults.files import CUBE, QUADS, quad_cube

    pool.mkdir(parents=True)
    quad_cube(pool / "cube.obj", 4)
    rng = np.random.default_rng(0)
    write_png(pool / "paint.png", rng.random((8, 8, 3)))
    (pool / "paint.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd paint.png\nNs 20\n")
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CUBE)
    (pool / "painted.obj").write_text(
        "mtllib paint.mtl\n"
        + corners
        + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl paint\n"
        + "".join("f " + " ".join(f"{v + 1}/{k + 1}" for k, v in enumerate(quad)) + "\n" for quad in QUADS)
    )
    triangles = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]]).astype(np.int32)
    texture = Texture(rng.integers(0, 255, (8, 8, 3), np.uint8), "srgb")
    glb = glb_bytes(
        Scene(CUBE, triangles, (Material(base_color_texture=texture),), uvs=(rng.random((len(triangles), 3, 2)),))
    )
    (pool / "box.glb").write_bytes(glb)
    size = int.from_bytes(glb[12:16], "little")
    document = json.loads(glb[20 : 20 + size])
    (pool / "box.bin").write_bytes(glb[28 + size :])
    document["buffers"][0]["uri"] = "box.bin"
    (pool / "box.gltf").write_text(json.dumps(document, indent=1))
    y, x = np.mgrid[:48, :48]
    inside = ((x - 22) ** 2 + (y - 25) ** 2 < 15**2).astype(float)
    write_png(pool / "cat.png", np.stack([x / 48, y / 48, 0.5 + 0 * x, inside], -1))
    write_exr(pool / "sky.exr", rng.random((16, 32, 3)).astype(np.float32))
    (pool / "mine").mkdir()
    (pool / "mine/diary.txt").write_text("mine")
    (pool / "link").symlink_to("mine")
    chain = (
        "render-dataset box.glb --domains "
        "color,normal,depth,albedo,roughness,metallic|reconstruct|remesh|unwrap|bake|relight"
    )
    source: list[str] = []
    for step in chain.split("|"):
        name, *words = step.split()
        done = subprocess.run(
            [sys.executable, "-m", "gdtool", name, *words, *source, *QUICK[name], "-q"],
            cwd=pool,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise RuntimeError(f"the working folder could not be made: {done.stderr}")
        source = [done.stdout.strip()]
    views = pool / "box.asset/views"
    shutil.copytree(views, pool / "pictures")
    (pool / "pictures/manifest.json").unlink()
    subprocess.run(["tar", "cf", "box.tar", "box.asset/views"], cwd=pool, check=True)


def damage_json(value: Any, rng: np.random.Generator) -> Any:
    """Replace, remove, duplicate or rename one entry somewhere in a JSON value."""
    places = []
    waiting: list[Any] = [value]
    while waiting:
        container = waiting.pop()
        items = (
            container.items()
            if isinstance(container, dict)
            else enumerate(container)
            if isinstance(container, list)
            else ()
        )
        for key, inner in list(items):
            places.append((container, key))
            waiting.append(inner)
    if not places:
        return ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    holder, key = places[int(rng.integers(len(places)))]
    kind = rng.integers(4)
    if kind == 0 and isinstance(holder, dict):
        holder["x" + str(key)] = holder.pop(key)
    elif kind == 1:
        del holder[key]
    else:
        holder[key] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    return value


def damage(folder: Path, rng: np.random.Generator) -> None:
    """Damage one file: its bytes, its JSON, or the file itself (replaced by a link, a FIFO, a folder or nothing)."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    path = files[int(rng.integers(len(files)))]
    kind = rng.integers(10)
    if path.suffix in (".json", ".gltf") and kind < 7:
        with contextlib.suppress(ValueError):
            path.write_text(json.dumps(damage_json(json.loads(path.read_bytes()), rng)))
        return
    if kind < 7:
        path.write_bytes(mutated(path.read_bytes(), rng))
        return
    path.unlink()
    if kind == 7:
        path.symlink_to("/dev/zero" if rng.integers(2) else "/etc/passwd")
    elif kind == 8:
        os.mkfifo(path)
    elif rng.integers(2):
        path.mkdir()


def options_of(command: click.Command, rng: np.random.Generator, places: list[str]) -> list[str]:
    """Draw up to three options with valid, extreme or invalid values."""
    known = [
        option for option in command.params if isinstance(option, click.Option) and not set(option.opts) & LEFT_OUT
    ]
    out: list[str] = []
    for option in rng.permutation(np.array(known, object))[: int(rng.choice([0, 0, 0, 1, 1, 2, 3]))]:
        out.append(option.opts[-1])
        if option.is_flag:
            if option.secondary_opts and rng.integers(2):
                out[-1] = option.secondary_opts[0]
            continue
        kind = rng.integers(4)
        if isinstance(option.type, click.Choice) and kind < 3:
            value = str(rng.choice(np.array(option.type.choices, object)))
        elif kind == 0 and getattr(option.type, "min", None) is not None:
            value = str(option.type.min)
        elif kind == 1 and not isinstance(option.type, (click.IntRange, click.FloatRange)):
            value = str(rng.choice(np.array(places, object)))
        elif kind in (1, 2):
            value = str(int(rng.integers(1, 40)))
        else:
            value = ODD_TEXTS[int(rng.integers(len(ODD_TEXTS)))]
        out.append(value)
    return out


def case(rng: np.random.Generator, folder: Path) -> tuple[list[str], bytes]:
    """Draw the arguments and stdin of one run in `folder`."""
    from gdtool.commands import COMMANDS
    from gdtool.commands._group import cli

    context = click.Context(cli)
    name = str(rng.choice(list(COMMANDS)))
    places = sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
    likely = [
        "cube.obj",
        "painted.obj",
        "box.glb",
        "box.gltf",
        "cat.png",
        "pictures",
        "box.tar",
        *(f"box.asset/{k}" for k in ("views", "surface", "mesh", "atlas", "asset", "renders")),
    ]
    sources = []
    for _ in range(1 if rng.integers(6) else int(rng.choice([0, 2]))):
        kind = rng.integers(12)
        fitting = np.array(FITTING.get(name, likely), object)
        sources.append(
            str(rng.choice(fitting))
            if kind < 7
            else str(rng.choice(np.array(likely, object)))
            if kind < 10
            else str(rng.choice(np.array(places, object)))
            if kind == 10
            else ODD_TEXTS[int(rng.integers(len(ODD_TEXTS)))]
        )
    outputs = [
        "out",
        "mine",
        "link",
        ".",
        "..",
        "box.asset",
        "box.asset/mesh",
        "cat.png",
        "mine/new",
        "a/b/c",
        "out\nx",
        "/proc/x",
        "x" * 300,
    ]
    output = (
        ["-o", str(rng.choice(np.array(outputs, object)))]
        if name not in ("evaluate", "validate") and rng.integers(2)
        else []
    )
    flags = (
        [flag for flag in ("--force", "--dry-run", "--json") if rng.integers(6) == 0]
        if name not in ("evaluate", "validate")
        else []
    )
    through_stdin = rng.integers(4) == 0
    words = [
        name,
        *QUICK[name],
        *options_of(cli.get_command(context, name), rng, places),
        *output,
        *flags,
        "--threads",
        "1",
    ]
    if name in ("evaluate", "validate"):
        words = words[:-2]
    stdin = b"".join(os.fsencode(source) + b"\n" for source in sources) if through_stdin else b""
    words += [] if through_stdin else ["--", *sources]
    return [word.replace("\0", "") for word in words], stdin


def state(folder: Path) -> dict[str, str]:
    """Record each file below a folder by its digest and each link by its target."""
    out = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            out[str(path)] = f"-> {path.readlink()}"
        elif path.is_file():
            out[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return out


def run_case(words: list[str], stdin: bytes, folder: Path) -> tuple[int, str, str]:
    """Run a command in a fork of this process, which has imported what commands need.

    Returns exit code (124 where it did not end in time), stdout and stderr.
    """
    files = [tempfile.TemporaryFile() for _ in range(3)]  # noqa: SIM115 - closed at the end
    files[0].write(stdin)
    files[0].seek(0)
    pid = os.fork()
    if not pid:
        code = 99
        try:
            os.setsid()
            os.chdir(folder)
            for number, file in enumerate(files):
                os.dup2(file.fileno(), number)
            sys.stdin, sys.stdout, sys.stderr = (
                os.fdopen(0),
                os.fdopen(1, "w", errors="surrogateescape"),
                os.fdopen(2, "w", errors="backslashreplace"),
            )
            sys.argv = ["gdtool", *words]
            from gdtool.commands import main

            main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
            with contextlib.suppress(Exception):
                sys.stderr.flush()
            os._exit(code)
    end, code = time.monotonic() + SECONDS, None
    while code is None:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
        elif time.monotonic() > end:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            code = 124
        else:
            time.sleep(0.01)
    for file in files[1:]:
        file.seek(0)
    return code, *(file.read().decode(errors="backslashreplace") for file in files[1:])


def broken_rules(words: list[str], code: int, out: str, err: str, folder: Path, before: dict[str, str]) -> list[str]:
    """List the rules that a run broke."""
    rules = []
    if code == 124:
        return [f"did not end within {SECONDS:g} s"]
    if code not in CODES:
        rules.append(f"exit code {code}")
    if "Traceback" in err or "internal error" in err:
        rules.append("an exception that nobody expected")
    several = [line for line in err.splitlines() if line and not KNOWN_LINE.match(line)]
    if several:
        rules.append(f"wrote lines that are no message: {several[:3]}")
    errors = [line for line in err.splitlines() if line.startswith("gdtool")]
    if code and not errors and words[0] != "validate":
        rules.append("failed without a message")
    if len(errors) > 12:
        rules.append(f"{len(errors)} lines of errors")
    paths = []
    if words[0] not in ("evaluate", "validate") and "--plan" not in words:
        for line in out.splitlines():
            place = json.loads(line)["folder"] if "--json" in words else line
            paths.append(folder / place)
        if "--dry-run" not in words:
            rules += [
                f"printed {path}, which is no whole folder" for path in paths if not (path / "manifest.json").is_file()
            ]
            from gdtool.core.errors import GdtoolError
            from gdtool.core.folder import open_folder

            for path in paths:
                with contextlib.suppress(OSError):
                    try:
                        open_folder(path)
                    except GdtoolError as error:
                        rules.append(f"published what does not open: {error}")
    if "leftovers" not in before and leftovers(folder):
        rules.append(f"left {leftovers(folder)}")
    after = state(folder.parent)
    replaced = [str(path.resolve()) + "/" for path in paths] + (
        [str(folder / "out" / "manifest.json")] if paths else []
    )
    lost = [
        name
        for name, digest in before.items()
        if after.get(name) != digest and not any(os.path.realpath(name).startswith(top) for top in replaced)
    ]
    mine = [name for name in before if "/mine/" in name and after.get(name) != before[name]]
    rules += [f"changed or removed {name}" for name in {*lost, *mine}]
    return rules


def main(arguments: list[str]) -> int:
    """Run cases until the time is over; returns 1 when a rule was broken."""
    if arguments[:1] == ["--pool"]:
        make_pool(Path(arguments[1]))
        return 0
    minutes = float(arguments[0]) if arguments else 7.0
    first = int(arguments[1]) if len(arguments) > 1 else time.time_ns() % 10**9
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    broken = count = 0
    codes: dict[int, int] = {}
    with tempfile.TemporaryDirectory(prefix="gdtool-fuzz-") as top:
        top_path = Path(top).resolve()
        # By another process: the thread pools of OpenImageIO and torch do not live on in a copy of this one.
        subprocess.run(
            [sys.executable, "-m", "tests.faults.fuzz_commands", "--pool", str(top_path / "pool")], check=True
        )
        for module in ("torch", "trimesh", "scipy.spatial", "skimage.measure", "OpenImageIO"):
            importlib.import_module(module)
        end, seed = time.monotonic() + 60 * minutes, first
        while count == 0 or time.monotonic() < end:
            rng = np.random.default_rng(seed)
            folder = top_path / "outside" / "work"
            shutil.copytree(top_path / "pool", folder, symlinks=True)
            (top_path / "outside/secret.txt").write_text("not to be touched")
            for _ in range(int(rng.choice([0, 0, 1, 1, 2, 3]))):
                damage(folder, rng)
            words, stdin = case(rng, folder)
            before = state(top_path / "outside")
            code, out, err = run_case(words, stdin, folder)
            codes[code] = codes.get(code, 0) + 1
            rules = broken_rules(words, code, out, err, folder, before)
            if rules:
                broken += 1
                print(f"seed {seed}: gdtool {' '.join(map(ascii, words))}" + (f" < {stdin!r}" if stdin else ""))
                print("".join(f"  {rule}\n" for rule in rules) + f"  exit {code}, said: {err[-600:]!r}", flush=True)
            shutil.rmtree(top_path / "outside")
            count, seed = count + 1, seed + 1
    print(
        f"{count} runs from seed {first}: {broken} broke a rule; exit codes "
        + ", ".join(f"{code}: {n}" for code, n in sorted(codes.items()))
    )
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
