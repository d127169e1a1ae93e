"""Refuse faulty manifests, and name the place and the fault."""

import json
import shutil
from pathlib import Path

import pytest

from gdtool.core.errors import InputError
from gdtool.core.folder import open_folder
from gdtool.core.provenance import find_ancestor
from gdtool.core.runner import Settings, run_all
from tests.core.toy import STAGE, Options


@pytest.fixture
def folder():
    Path("cat.png").write_bytes(b"cat")
    (result,) = run_all(STAGE, ("cat.png",), Options(), {}, Settings())
    return result.path


def edited(folder, change):
    path = folder / "manifest.json"
    raw = json.loads(path.read_text())
    change(raw)
    path.write_text(json.dumps(raw))
    return folder


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda m: m.update(format=2), "upgrade gdtool"),
        (lambda m: m.update(kind="picture"), "unknown kind"),
        (lambda m: m.update(conten=1), "did you mean 'content'?"),
        (lambda m: m["content"].update(frame=1), "did you mean 'frames'?"),
        (lambda m: m["content"].pop("frames"), "frames"),
        (lambda m: m["files"].append({"path": "../x", "size": 1, "sha256": "0" * 64}), "leaves its folder"),
        (lambda m: m["files"].append({"path": "/x", "size": 1, "sha256": "0" * 64}), "is absolute"),
        (lambda m: m.update(name="../../x"), "separator"),
        (lambda m: m.update(name="a\nb"), "control character"),
        (lambda m: m.update(name="x" * 300), "longer than 255 bytes"),
        (lambda m: m["inputs"][0].update(path="/etc/passwd"), "is absolute"),
        (lambda m: m["files"].append({"path": "x", "size": 1, "sha256": "0" * 64}), "missing"),
        (lambda m: m["files"][0].update(sha256="0" * 64), "hash"),
    ],
)
def test_faulty_manifests_are_refused(folder, change, words):
    with pytest.raises(InputError, match=words.replace("?", r"\?")):
        open_folder(edited(folder, change))


def test_duplicate_keys_bad_json_and_missing_manifests(folder):
    path = folder / "manifest.json"
    good = path.read_text()
    path.write_text(good.replace('"kind":', '"kind": "views", "kind":', 1))
    with pytest.raises(InputError, match="'kind' appears twice"):
        open_folder(folder)
    path.write_text(good.replace(",\n", "\n", 1))
    with pytest.raises(InputError, match="line 3"):
        open_folder(folder)
    path.unlink()
    with pytest.raises(InputError, match="no manifest"):
        open_folder(folder)


def test_links_out_of_the_folder_are_refused_in_manifests(folder):
    shutil.move(folder / "000.png", "outside.png")
    (folder / "000.png").symlink_to(Path("outside.png").absolute())
    with pytest.raises(InputError, match="link that leaves"):
        open_folder(folder)


def test_wrong_kind_names_the_stage_that_makes_the_right_one(folder):
    with pytest.raises(InputError, match="holds renders, but remesh reads surface; run gdtool reconstruct first"):
        open_folder(folder, ("surface",), "remesh")


def test_the_folder_itself_is_its_own_nearest_ancestor(folder):
    assert find_ancestor(open_folder(folder), "renders", "make it again").path == folder
    assert find_ancestor(open_folder(folder), "views", "make it again") is None
