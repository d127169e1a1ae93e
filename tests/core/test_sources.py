"""Check which files the digest of a source covers."""

import pytest

from gdtool.core.references import TEXTURE_PLACES
from gdtool.core.sources import digest


@pytest.mark.parametrize("place", TEXTURE_PLACES)
def test_an_objs_digest_follows_its_library_and_textures_wherever_they_lie(tmp_path, place):
    folder = tmp_path / "model" / "mesh"
    texture = (folder / place / "a b.png").resolve()
    texture.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(exist_ok=True)
    (folder / "x.obj").write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "x.mtl").write_text("newmtl m\nmap_Kd a b.png\n")
    seen = [digest(folder / "x.obj")]
    texture.write_bytes(b"one")
    seen.append(digest(folder / "x.obj"))
    texture.write_bytes(b"two")
    seen.append(digest(folder / "x.obj"))
    (folder / "x.mtl").write_text("newmtl n\nmap_Kd a b.png\n")
    seen.append(digest(folder / "x.obj"))
    assert len(set(seen)) == 4
    assert digest(folder / "x.obj") == seen[-1]
