"""Refuse folders that another program, an interrupted copy or an edit has left, in one line."""

import json
import shutil

import pytest

from gdtool.core.manifest import MANIFEST, list_files
from tests.faults.files import leftovers, lines_of
from tests.fields.shapes import torus, views_folder, views_of


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Make a valid views folder."""
    return views_folder(tmp_path_factory.mktemp("good") / "ring.asset" / "views", *views_of(torus, 32)).absolute()


def edit(path, change):
    """Change the JSON of a file."""
    raw = json.loads(path.read_text())
    change(raw)
    path.write_text(json.dumps(raw))


def resealed(folder):
    """List the files in the manifest as they are now, as a program that writes its own folders would."""
    entries = [{"path": f.path, "size": f.size, "sha256": f.sha256} for f in list_files(folder)]
    edit(folder / MANIFEST, lambda m: m.update(files=entries))


def camera(change):
    """Make a damage that changes the cameras and lists the new file."""

    def damage(folder):
        edit(folder / "cameras.json", lambda c: change(c["cameras"]))
        resealed(folder)

    return damage


def manifest(change):
    """Make a damage that changes the manifest."""
    return lambda folder: edit(folder / MANIFEST, change)


def text(old, new):
    """Make a damage that replaces text of the manifest."""

    def damage(folder):
        path = folder / MANIFEST
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))

    return damage


def outside(folder):
    """Replace a mask by a link to a file outside the folder."""
    link = folder / "mask/front.png"
    shutil.move(link, folder.parent / "elsewhere.png")
    link.symlink_to(folder.parent / "elsewhere.png")


def stretched(cameras):
    """Make a camera's matrix not rigid."""
    cameras[0]["world_from_camera"][0] *= 2


def other_size(cameras):
    """Give one view another size than the others."""
    cameras[2].update(width=64, height=64)


DAMAGE = {
    "bare": (lambda f: (f / MANIFEST).unlink(), "no manifest"),
    "json": (text(",\n", "\n"), "line "),
    "newer": (manifest(lambda m: m.update(format=99)), "upgrade gdtool"),
    "unknown_key": (manifest(lambda m: m.update(contents=1)), "'content'"),
    "unknown_content": (manifest(lambda m: m["content"].update(view=1)), "'views'"),
    "twice": (text('"kind":', '"kind": "views", "kind":'), "twice"),
    "kind": (manifest(lambda m: m.update(kind="picture")), "picture"),
    "missing": (lambda f: (f / "mask/back.png").unlink(), "missing"),
    "changed": (lambda f: (f / "mask/back.png").write_bytes((f / "mask/front.png").read_bytes()[::-1]), "hash"),
    "parent": (manifest(lambda m: m["files"].append({"path": "../../x", "size": 1, "sha256": "0" * 64})), "leaves"),
    "absolute": (
        manifest(lambda m: m["files"].append({"path": "/etc/hostname", "size": 1, "sha256": "0" * 64})),
        "is absolute",
    ),
    "link": (outside, "leaves"),
    "fewer_cameras": (camera(lambda c: c.pop()), "views that the manifest lists"),
    "no_camera": (camera(lambda c: c.clear()), "cameras.json"),
    "not_rigid": (camera(stretched), "rigid"),
    "near_far": (camera(lambda c: c[1].update(near=3.0, far=1.0)), "near"),
    "no_width": (camera(lambda c: c[1].pop("half_width")), "half_width"),
    "two_names": (camera(lambda c: c[1].update(name=c[0]["name"])), "one name"),
    "sizes": (camera(other_size), "sizes"),
}


@pytest.fixture
def damaged(good, tmp_path):
    """Make a copy of the good folder for each damage."""
    for name, (damage, _) in DAMAGE.items():
        shutil.copytree(good, tmp_path / f"{name}.asset/views")
        damage(tmp_path / f"{name}.asset/views")
    return [f"{name}.asset/views" for name in DAMAGE]


@pytest.mark.parametrize("command", ["reconstruct", "validate", "evaluate"])
def test_each_damaged_folder_is_refused_in_one_line(gdtool, good, damaged, tmp_path, command):
    extra = ("--reference", good) if command == "evaluate" else ()
    done = gdtool(command, *damaged, *extra, "-q")
    errors = lines_of(done.stderr)
    for name, (_, fact) in DAMAGE.items():
        about = [line for line in errors if f"{name}.asset/views" in line]
        assert len(about) == 1, (name, about, done.stderr)
        assert fact in about[0], (name, about, done.stderr)
    assert done.returncode == 3
    assert done.stdout == ""
    assert leftovers(tmp_path) == []
    assert not list(tmp_path.glob("*.asset/surface"))


def test_a_folder_of_the_wrong_kind_names_the_stage_that_makes_the_right_one(gdtool, good):
    for command, cure in (
        ("remesh", "gdtool reconstruct"),
        ("unwrap", "gdtool remesh"),
        ("bake", "gdtool unwrap"),
        ("relight", "gdtool bake"),
    ):
        done = gdtool(command, good)
        (error,) = lines_of(done.stderr)
        assert done.returncode == 3, error
        assert "holds views" in error, error
        assert cure in error, error


def test_views_from_inside_the_object_are_refused(gdtool, good, tmp_path):
    """Depths there are negative or missing; the result must not be a crash or an empty surface."""
    shutil.copytree(good, tmp_path / "in.asset/views")

    def move(cameras):
        for camera_record in cameras:
            for i in (3, 7, 11):
                camera_record["world_from_camera"][i] = 0.0

    camera(move)(tmp_path / "in.asset/views")
    done = gdtool("reconstruct", "in.asset/views")
    (error,) = lines_of(done.stderr)
    assert done.returncode == 3
    assert "camera" in error
    assert not (tmp_path / "in.asset/surface").exists()
