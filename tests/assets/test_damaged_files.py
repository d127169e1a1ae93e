"""Read damaged files: each reader returns a scene or an image, or raises one of gdtool's one-line errors."""

import random
import struct

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.core.errors import GdtoolError
from gdtool.images.io import encode_png, read_image, write_exr
from tests.assets.gltf.files import quad
from tests.assets.test_load import FACES, ply, stl

OBJ = (
    b"v 0 0 0 1 0 0\nv 1 0 0 1 1 1\nv 1 1 0 0 0 1\nv 0 1 0 0 0 0\nvt 0 0\nvt 1 0\nvn 0 0 1\nusemtl a\nf 1/1/1 2/2/1 "
    b"3/1/1 4/1/1\nf -1//1 -2//1 -3//1\n"
)


def textured_quad() -> bytes:
    """Make a GLB with an embedded texture."""
    builder = quad(pbrMetallicRoughness={"baseColorTexture": {"index": 0}}, normalTexture={"index": 0})
    builder.document["images"] = [{"bufferView": builder.view(encode_png(np.zeros((4, 4, 3))))}]
    builder.document["textures"] = [{"source": 0}]
    return builder.glb()


def exr(tmp_path) -> bytes:
    """Make an EXR image."""
    write_exr(tmp_path / "whole.exr", np.random.default_rng(0).random((24, 24, 3)))
    return (tmp_path / "whole.exr").read_bytes()


def damaged(whole: bytes, rng: random.Random) -> bytes:
    """Flip, insert or delete a few bytes of a file, or cut it short."""
    out = bytearray(whole)
    for _ in range(rng.choice([1, 1, 2, 4])):
        if not out:
            break
        i = rng.randrange(min(len(out), rng.choice([200, len(out)])))
        kind = rng.random()
        if kind < 0.4:
            out[i] ^= 1 << rng.randrange(8)
        elif kind < 0.6:
            out[i] = rng.choice(b'0123456789-.[]{}",\x00\xff')
        elif kind < 0.75:
            del out[i : i + rng.randrange(1, 9)]
        elif kind < 0.9:
            out[i:i] = rng.choice([b"1e999", b"-1", b"99999999999", b"null", b"\n", b'"x"', b"[]"])
        else:
            del out[i:]
    if whole[:4] == b"glTF" and rng.random() < 0.9 and len(out) > 20:
        # lengths put right again, so that the damage reaches beyond the container
        struct.pack_into("<I", out, 8, len(out))
        binary = bytes(out).find(b"BIN\0")
        if binary > 24:
            struct.pack_into("<I", out, 12, binary - 24)
            struct.pack_into("<I", out, binary - 4, len(out) - binary - 4)
    return bytes(out)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "stl", "png", "exr"])
def test_a_damaged_file_is_read_or_refused(tmp_path, kind, capfd):
    whole = {
        "glb": textured_quad,
        "obj": lambda: OBJ,
        "ply": lambda: ply().encode(),
        "stl": lambda: stl(FACES),
        "png": lambda: encode_png(np.random.default_rng(0).random((16, 16, 4))),
        "exr": lambda: exr(tmp_path),
    }[kind]()
    rng, path, read = random.Random(kind), tmp_path / f"x.{kind}", read_image if kind in ("png", "exr") else load_scene
    refused = 0
    for _ in range(150):
        path.write_bytes(damaged(whole, rng))
        try:
            read(path)
        except GdtoolError as error:
            refused += 1
            assert "\n" not in str(error)
            assert str(path) in str(error)
    assert refused > 30  # the damage does reach the reader
    assert capfd.readouterr().err == ""
