"""Read PLY and STL files, and check models of every format."""

import struct

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.assets.ply_stl import read as ply_stl_read
from gdtool.core.errors import InputError
from gdtool.geometry.meshes import TriMesh

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def volume(scene) -> float:
    """Compute the volume inside the faces."""
    a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def stl(faces: np.ndarray) -> bytes:
    """Make a binary STL of faces of the tetrahedron."""
    rows = b"".join(struct.pack("<3f", 0, 0, 0) + CORNERS[face].tobytes() + b"\0\0" for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + rows


def ply(extra: str = "", rows: list[str] | None = None) -> str:
    """Make an ASCII PLY of the tetrahedron; extra: further property lines, rows: the vertex lines."""
    rows = rows or [" ".join(map(str, p)) for p in CORNERS]
    faces = "\n".join("3 " + " ".join(map(str, face)) for face in FACES)
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"{extra}"
        f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join(rows)
        + "\n"
        + faces
        + "\n"
    )


def test_equal_vertices_of_an_stl_are_welded(tmp_path):
    (tmp_path / "x.STL").write_bytes(stl(FACES))
    scene = load_scene(tmp_path / "x.STL")
    assert len(scene.vertices) == 4
    assert volume(scene) == pytest.approx(1 / 6)
    assert scene.materials[0].roughness == 0.5
    assert scene.materials[0].metallic == 0


def test_an_ascii_ply_is_read_with_colours_and_normals(tmp_path):
    extra = (
        "property float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty "
        "uchar blue\n"
    )
    rows = [" ".join(map(str, p)) + " 0 0 2 255 188 0" for p in CORNERS]
    (tmp_path / "x.ply").write_text(ply(extra, rows))
    scene = load_scene(tmp_path / "x.ply")
    assert volume(scene) == pytest.approx(1 / 6)
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(scene.colors, [[1, 0.5028865, 0, 1]] * 4, atol=1e-6)
    assert scene.materials[0].base_color == (1, 1, 1, 1)


def test_an_ascii_ply_without_colours_gets_the_default_material(tmp_path):
    (tmp_path / "x.ply").write_text(ply())
    scene = load_scene(tmp_path / "x.ply")
    assert scene.colors is None
    assert scene.normals is None
    assert any("roughness 0.5" in note for note in scene.notes)


def binary(order: str = "<", colors: bool = False, wide: bool = False, faces: np.ndarray = FACES) -> bytes:
    """Make a binary PLY of the tetrahedron with normals that are not unit vectors."""
    kind, place = ("double", order + "f8") if wide else ("float", order + "f4")
    names = ["x", "y", "z", "nx", "ny", "nz"]
    vertex = np.empty(
        len(CORNERS), [(name, place) for name in names] + [(name, "u1") for name in ("red", "green", "blue") if colors]
    )
    for i, name in enumerate(names):
        vertex[name] = np.concatenate([CORNERS / 3, CORNERS + 0.5], 1)[:, i]
    for name in vertex.dtype.names[6:]:
        vertex[name] = np.arange(len(CORNERS)) * 60
    face = np.empty(len(faces), [("count", "u1"), ("idx", order + "i4", 3)])
    face["count"], face["idx"] = 3, faces
    lines = [
        "ply",
        f"format binary_{'little' if order == '<' else 'big'}_endian 1.0",
        "comment made here",
        f"element vertex {len(vertex)}",
    ]
    lines += [f"property {kind} {name}" for name in names] + [
        f"property uchar {name}" for name in vertex.dtype.names[6:]
    ]
    lines += [f"element face {len(face)}", "property list uchar int vertex_index", "end_header", ""]
    return "\n".join(lines).encode() + vertex.tobytes() + face.tobytes()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.ply", binary()),
        ("x.ply", binary(">")),
        ("x.ply", binary(colors=True)),
        ("x.ply", binary(wide=True)),
        ("x.stl", stl(FACES)),
    ],
    ids=["little", "big", "colors", "double", "stl"],
)
def test_binary_files_read_directly_equal_those_read_with_trimesh(tmp_path, monkeypatch, name, content):
    (tmp_path / name).write_bytes(content)
    with monkeypatch.context() as patch:
        patch.setattr(ply_stl_read, "read_with_trimesh", None)  # must not be called
        direct = load_scene(tmp_path / name)
    for reader in ("read_plain_ply", "read_plain_stl"):
        monkeypatch.setattr(ply_stl_read, reader, lambda data: None)
    by_trimesh = load_scene(tmp_path / name)
    assert direct.notes == by_trimesh.notes
    assert direct.materials == by_trimesh.materials
    if name == "x.ply":
        assert by_trimesh.normals is not None
    for key in ("vertices", "faces", "normals", "colors"):
        ours, theirs = getattr(direct, key), getattr(by_trimesh, key)
        if theirs is None:
            assert ours is None, key
        else:
            assert ours.dtype == theirs.dtype, key
            np.testing.assert_array_equal(ours, theirs, key)


@pytest.mark.parametrize(
    ("content", "fact"),
    [(binary()[:-1], "PLY"), (binary() + b"x", "PLY"), (binary(faces=FACES + 1), "out of range")],
    ids=["cut", "more", "index"],
)
def test_binary_plys_of_wrong_length_or_index_are_refused(tmp_path, content, fact):
    (tmp_path / "x.ply").write_bytes(content)
    with pytest.raises(InputError, match=fact):
        load_scene(tmp_path / "x.ply")


@pytest.mark.parametrize(
    ("name", "content", "fact"),
    [
        ("x.stl", b"", "has no faces"),
        ("x.stl", stl(FACES)[:100], "STL|has no faces"),
        ("x.stl", stl(FACES[:0]), "has no faces"),
        ("x.ply", b"ply\nformat nonsense\n", "PLY"),
        ("x.ply", b"not a ply at all", "PLY"),
        ("x.ply", ply().replace("3 0 2 1", "3 0 2 9").encode(), "out of range"),
        ("x.ply", ply().replace("1.0 0.0 0.0", "nan 0.0 0.0").encode(), "not finite"),
        ("x.fbx", b"Kaydara", "not a model that gdtool reads"),
    ],
    ids=["empty", "cut", "no triangles", "header", "no ply", "index", "nan", "unknown"],
)
def test_a_fault_is_named_in_one_line_with_the_file(tmp_path, name, content, fact):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=fact) as caught:
        load_scene(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    (tmp_path / "d.glb").mkdir()
    for name, fact in (("none.ply", "does not exist"), ("none.glb", "does not exist"), ("d.glb", "is a folder")):
        with pytest.raises(InputError, match=fact):
            load_scene(tmp_path / name)


def test_faces_with_coincident_corners_are_removed_and_collinear_ones_stay(tmp_path):
    from gdtool.geometry.metrics import is_closed

    # A tetrahedron with a vertex (5) in the middle of edge 1-2, which only one of the edge's two faces uses. Face 1 2 5
    # has no area but closes the mesh. Vertices 2 and 6 coincide.
    faces = ["1 5 4", "5 2 4", "1 3 2", "2 3 4", "1 4 3", "1 2 5"]
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv .5 0 0\nv 1 0 0\n"
    (tmp_path / "x.obj").write_text(vertices + "".join(f"f {face}\n" for face in [*faces, "2 6 4"]))
    scene = load_scene(tmp_path / "x.obj")
    assert len(scene.faces) == len(scene.material_idx) == 6
    assert any("two corners in one place" in note for note in scene.notes)
    assert is_closed(TriMesh(scene.vertices, scene.faces))
    assert not is_closed(TriMesh(scene.vertices, scene.faces[:-1]))


def test_zero_normals_are_replaced_by_those_of_the_faces(tmp_path):
    (tmp_path / "x.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nvn 0 0 3\nf 1//1 2//2 3//2\n")
    scene = load_scene(tmp_path / "x.obj")
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * 3)
    assert any("without a direction" in note for note in scene.notes)


def test_textures_of_a_mesh_without_texture_coordinates_are_left_out(tmp_path):
    from gdtool.images.io import write_png

    write_png(tmp_path / "c.png", np.ones((4, 4, 3)))
    (tmp_path / "x.mtl").write_text("newmtl a\nmap_Kd c.png\n")
    (tmp_path / "x.obj").write_text("mtllib x.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scene = load_scene(tmp_path / "x.obj")
    assert scene.materials[0].base_color_texture is None
    assert any("no texture coordinates" in note for note in scene.notes)


def test_procedural_objects_are_named_by_their_seed():
    first, second = load_scene("procedural:7"), load_scene("procedural:7")
    assert first.name == "procedural-000007"
    np.testing.assert_array_equal(first.vertices, second.vertices)
    with pytest.raises(InputError, match="name it like procedural:7"):
        load_scene("procedural:seven")
