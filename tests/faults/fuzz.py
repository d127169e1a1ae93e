"""Fuzz the readers with damaged files: each must return a value or raise one of gdtool's errors (`make fuzz`).

    python -m tests.faults.fuzz [MINUTES] [READER ...]

Prints how many files each reader read and refused. A file that makes one do anything else is written to
tests/faults/crashes/, where tests/faults/test_fuzz.py reads it from then on. Each reader runs in a child process, so
that a crash ends only that.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gdtool.core.errors import GdtoolError

CRASHES = Path(__file__).parent / "crashes"
SLOW_SECONDS = 20.0  # a file of a few kilobytes that takes longer is a hang


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Change a few bytes, set numbers to their limits, or cut, duplicate or move pieces."""
    out = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        if not out:
            break
        at = int(rng.integers(len(out)))
        kind = rng.integers(6)
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            out[at] = int(rng.choice([0, 1, 34, 44, 45, 58, 91, 123, 127, 128, 255]))
        elif kind == 2:
            out[at : at + 4] = rng.choice(
                [b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f"]
            )
        elif kind == 3:
            del out[at : at + int(rng.integers(1, 40))]
        elif kind == 4:
            out[at:at] = out[at : at + int(rng.integers(1, 40))]
        else:
            del out[at:]
    return bytes(out)


def read_picture(path: Path) -> None:
    """Read an image."""
    from gdtool.images.io import read_image

    read_image(path)


def read_model(path: Path) -> None:
    """Read a model."""
    from gdtool.assets.load import load_scene

    load_scene(path)


def read_quads(path: Path) -> None:
    """Read a mesh folder's OBJ."""
    from gdtool.folders.mesh import read_obj

    read_obj(path)


def read_points(path: Path) -> None:
    """Read a surface folder's PLY."""
    from gdtool.assets.ply_stl.binary_ply import read_binary_ply
    from gdtool.core.errors import InputError

    try:
        read_binary_ply(path.read_bytes())
    except ValueError as error:
        raise InputError(path, str(error), "export it again") from None


def read_record(path: Path) -> None:
    """Read a manifest."""
    from gdtool.core.manifest import decode
    from gdtool.core.reading import read_json

    decode(read_json(path), path)


def read_cameras(path: Path) -> None:
    """Read cameras."""
    from gdtool.folders.records import read_cameras

    read_cameras(path)


def read_weights(path: Path) -> None:
    """Read a network's weights."""
    from gdtool.diffusion.network.tensors import read_tensors

    read_tensors(path)


def picture_seed(name: str) -> bytes:
    """Make an image; the name's suffix chooses its format."""
    from gdtool.images.io import write_exr, write_png

    with tempfile.TemporaryDirectory() as folder:
        image = np.random.default_rng(0).random((9, 7, 4)).astype(np.float32)
        path = Path(folder, name)
        write_png(path, image) if name.endswith("png") else write_exr(path, image)
        return path.read_bytes()


def glb_seed() -> bytes:
    """Make a triangle with a texture."""
    from gdtool.assets.gltf.write import glb_bytes
    from gdtool.assets.scene import Material, Scene, Texture

    image = np.full((4, 4, 3), 200, np.uint8)
    return glb_bytes(
        Scene(
            np.eye(3),
            np.array([[0, 1, 2]], np.int32),
            (Material(base_color_texture=Texture(image, "srgb")),),
            uvs=(np.array([[0, 0], [1, 0], [0, 1.0]]),),
        )
    )


def text_seed(kind: str) -> bytes:
    """Make an OBJ, a manifest (json) or a cameras.json (cameras)."""
    from gdtool.cameras import rig
    from gdtool.core.kinds import MeshContent
    from gdtool.core.manifest import FileEntry, InputEntry, Manifest, encode
    from gdtool.folders.records import write_cameras

    if kind == "obj":
        return (
            b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3 4/1\nf -1/1 "
            b"-2/2 -3/3\n"
        )
    if kind == "json":
        content = MeshContent(vertices=8, quads=6, triangles=0, watertight=True)
        return encode(
            Manifest(
                kind="mesh",
                name="x",
                stage="remesh",
                content=content,
                inputs=(InputEntry("source", "../a.obj", "0" * 64),),
                files=(FileEntry("mesh.obj", 3, "1" * 64),),
            )
        )
    with tempfile.TemporaryDirectory() as folder:
        write_cameras(Path(folder, "c.json"), rig("six", 8)[:2])
        return Path(folder, "c.json").read_bytes()


def ply_seed() -> bytes:
    """Make a binary PLY of a triangle."""
    vertex = np.eye(3, dtype="<f4").tobytes()
    face = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    )
    return (header + "element face 1\nproperty list uchar int vertex_indices\nend_header\n").encode() + vertex + face


def weights_seed() -> bytes:
    """Make a safetensors file."""
    from safetensors.numpy import save

    return save({"a.weight": np.ones((2, 3), np.float32), "b.bias": np.zeros(4, np.float32)})


class Reader(NamedTuple):
    """A file suffix, the function that reads such a file, and one that makes a valid one."""

    suffix: str
    read: Callable[[Path], None]
    make: Callable[[], bytes]


READERS = {
    "png": Reader(".png", read_picture, lambda: picture_seed("x.png")),
    "exr": Reader(".exr", read_picture, lambda: picture_seed("x.exr")),
    "glb": Reader(".glb", read_model, glb_seed),
    "obj": Reader(".obj", read_model, lambda: text_seed("obj")),
    "ply": Reader(".ply", read_model, ply_seed),
    "quads": Reader(".obj", read_quads, lambda: text_seed("obj")),
    "surface": Reader(".ply", read_points, ply_seed),
    "manifest": Reader(".json", read_record, lambda: text_seed("json")),
    "cameras": Reader(".json", read_cameras, lambda: text_seed("cameras")),
    "weights": Reader(".safetensors", read_weights, weights_seed),
}


def attempt(name: str, path: Path) -> str:
    """Read a file and tell what happened: "read", "refused", or the exception that is a bug."""
    try:
        READERS[name].read(path)
    except GdtoolError:
        return "refused"
    except Exception as error:  # the bugs that fuzzing looks for
        return f"{type(error).__name__}: {error}"
    return "read"


def child(name: str, seed: int, seconds: float, rounds: int, folder: str) -> None:
    """Mutate and read files in this process; `folder` holds the current one, for the parent to find after a crash."""
    rng = np.random.default_rng(seed)
    good = READERS[name].make()
    path = Path(folder, name + READERS[name].suffix)
    path.write_bytes(good)
    assert attempt(name, path) == "read", f"{name}: the good file is not read: {attempt(name, path)}"
    end, count = time.monotonic() + seconds, {"read": 0, "refused": 0}
    for _ in range(rounds):
        if time.monotonic() > end:
            break
        path.write_bytes(mutated(good, rng))
        start = time.monotonic()
        what = attempt(name, path)
        if what not in count or time.monotonic() - start > SLOW_SECONDS:
            print(what if what not in count else f"took {time.monotonic() - start:.0f} s", flush=True)
            sys.exit(3)
        count[what] += 1
    print(f"{count['read']} read, {count['refused']} refused")


def fuzz(name: str, seed: int, seconds: float, rounds: int = 10**9) -> tuple[str, bytes | None]:
    """Run a child process; return what became of it, and the file that broke it or None."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "tests.faults.fuzz",
            "--child",
            name,
            str(seed),
            str(seconds),
            str(rounds),
            folder,
        ]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=seconds + 120, cwd=Path(__file__).parents[2]
            )
            outcome, code = (done.stdout + done.stderr[-400:]).strip(), done.returncode
        except subprocess.TimeoutExpired:
            outcome, code = "hangs", -1
        if code == 0:
            return outcome, None
        file = Path(folder, name + READERS[name].suffix)
        return f"exit {code}: {outcome}", file.read_bytes() if file.exists() else b""


def main(arguments: list[str]) -> int:
    """Fuzz the readers in turn; returns 1 when a file broke one."""
    minutes = float(arguments[0]) if arguments else 10.0
    names = arguments[1:] or list(READERS)
    broken = 0
    for i, name in enumerate(names):
        end = time.monotonic() + 60 * minutes / len(names)
        seed = time.time_ns() + i
        while time.monotonic() < end:
            outcome, file = fuzz(name, seed, end - time.monotonic())
            print(f"{name}: {outcome}", flush=True)
            if file is not None:
                CRASHES.mkdir(exist_ok=True)
                (CRASHES / f"{name}-{seed}{READERS[name].suffix}").write_bytes(file)
                broken += 1
            seed += 1
    return 1 if broken else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]), sys.argv[6])
    else:
        sys.exit(main(sys.argv[1:]))
