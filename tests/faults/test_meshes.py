"""Read faulty models: refuse them in one line with the file and the fact, or repair them with a warning."""

import json

import numpy as np
import pytest

from gdtool.core.folder import open_folder
from gdtool.folders.mesh import read_mesh
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder
from tests.faults.files import CUBE, QUADS, leftovers, lines_of

TRIANGLES = np.concatenate([QUADS[:, :3], QUADS[:, [0, 2, 3]]])


def obj(vertices, faces) -> str:
    """Write OBJ text."""
    return "".join("v {!r} {!r} {!r}\n".format(*map(float, p)) for p in vertices) + "".join(
        "f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces
    )


def glb(**document) -> bytes:
    """Make the GLB of a quad with changes to its document."""
    builder = Builder()
    builder.primitive({"POSITION": builder.add(QUAD)}, builder.add(QUAD_FACES))
    builder.document |= document
    return builder.glb()


REFUSED = {
    "empty.obj": ("", "no faces"),
    "points.obj": (obj(CUBE, []), "no faces"),
    "nan.obj": (obj(np.where(np.arange(24).reshape(8, 3) == 4, np.nan, CUBE), TRIANGLES), "finite"),
    "infinite.obj": (obj(np.where(np.arange(24).reshape(8, 3) == 4, np.inf, CUBE), TRIANGLES), "finite"),
    "range.obj": (obj(CUBE, [[0, 1, 99]]), "a face refers to"),
    "flat.obj": (obj(CUBE, [[0, 1, 1], [2, 2, 2]]), "area"),
    "words.obj": ("v 0 0 zero\n", "line 1"),
    "cut.ply": ("ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "cut.ply"),
    "empty.stl": ("", "empty.stl"),
    "text.glb": ("hello", "glTF"),
    "length.glb": (glb()[:-8], "says it has"),
    "extension.glb": (glb(extensionsRequired=["VENDOR_unknown"]), "VENDOR_unknown"),
    "cycle.glb": (glb(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]), "cycle"),
    "http.glb": (
        glb(
            images=[{"uri": "http://example.com/a.png"}],
            textures=[{"source": 0}],
            materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        ),
        "http",
    ),
    "json.gltf": ('{"asset": {"version": "2.0"},,}', "json.gltf"),
    "outside.gltf": (
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "buffers": [{"uri": "/etc/hostname", "byteLength": 4}],
                "bufferViews": [{"buffer": 0, "byteLength": 4}],
                "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "nodes": [{"mesh": 0}],
                "scenes": [{"nodes": [0]}],
                "scene": 0,
            }
        ),
        "hostname",
    ),
    "what.xyz": ("1 2 3\n", "what.xyz"),
}


@pytest.fixture
def faulty(tmp_path):
    """Write the files of REFUSED; returns their names."""
    for name, (content, _) in REFUSED.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return list(REFUSED)


@pytest.mark.parametrize(
    "command", [("remesh", "--faces", 100), ("render-dataset", "--size", 16, "--domains", "normal")], ids=lambda c: c[0]
)
def test_each_faulty_model_is_refused_in_one_line(gdtool, faulty, tmp_path, command):
    done = gdtool(*command, *faulty, "missing.obj", "-q")
    errors = lines_of(done.stderr)
    for name in [*faulty, "missing.obj"]:
        about = [line for line in errors if line.removeprefix("gdtool: ").startswith(name)]
        fact = REFUSED[name][1] if name in REFUSED else "does not exist"
        assert len(about) == 1, (name, about, done.stderr)
        assert fact in about[0], (name, about, done.stderr)
    assert done.returncode == 3
    assert done.stdout == ""
    assert len(errors) == len(REFUSED) + 1
    assert leftovers(tmp_path) == []
    assert not list(tmp_path.glob("*.asset/*"))


def closed():
    """Make a cube of enough triangles for a remeshing engine to work on."""
    import trimesh

    mesh = trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_repairable_meshes_are_repaired_with_a_warning(gdtool, tmp_path):
    vertices, faces = closed()
    far = np.concatenate([vertices, 0.4 * vertices])
    wing = np.concatenate([vertices, [[2.0, 0, 0]]])
    cases = {
        "double": (vertices, np.concatenate([faces, faces[:7]])),
        "wing": (wing, np.concatenate([faces, [[faces[0][0], faces[0][1], len(vertices)]]])),
        "mixed": (vertices, np.where(np.arange(len(faces))[:, None] % 3 == 0, faces[:, ::-1], faces)),
        "inside_out": (vertices, faces[:, ::-1]),
        "open": (vertices, faces[9:]),
        "shell": (far, np.concatenate([faces, faces + len(vertices)])),
        "huge": (vertices * 1e20, faces),
        "tiny": (vertices * 1e-20, faces),
    }
    for name, (points, triangles) in cases.items():
        (tmp_path / f"{name}.obj").write_text(obj(points, triangles))
    done = gdtool("remesh", *(f"{name}.obj" for name in cases), "--engine", "split", "--faces", 400)
    assert lines_of(done.stderr) == [], done.stderr
    assert done.returncode == 0, done.stderr
    for name in ("double", "wing", "mixed", "open"):
        assert f"warning: {name}: " in done.stderr, name
    for name in cases:
        mesh = read_mesh(open_folder(tmp_path / f"{name}.asset/mesh"))
        assert len(mesh.faces) > 50, name
        if name != "wing":  # a lone triangle far out may go: what it carried was no body
            assert np.abs(np.ptp(mesh.vertices, axis=0).max() - 1) < 0.05, name
    for name in ("double", "mixed", "inside_out", "huge", "tiny"):
        assert open_folder(tmp_path / f"{name}.asset/mesh").content.watertight, name
