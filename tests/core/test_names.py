"""Turn names inside files into paths below their folder, and refuse all others."""

import pytest

from gdtool.core.errors import InputError
from gdtool.core.names import checked_name, name_from_path, path_inside, relative_parts, uri_path

OUTSIDE = ["../x", "a/../../x", "/etc/passwd", "\\\\host\\x", "C:/x", "c:x", "..", "a\\..\\..\\x"]
UNFIT = ["", ".", "a\0b", "a\nb", "\ud800", "a\x7f", "x" * 256, "a/" * 2048 + "x"]


@pytest.mark.parametrize("name", OUTSIDE + UNFIT)
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    with pytest.raises(InputError) as caught:
        path_inside(tmp_path, name, "m.json", "file")
    assert caught.value.cure
    assert "\n" not in str(caught.value)
    assert "\0" not in str(caught.value)


@pytest.mark.parametrize("name", ["a/b", "a\\b", *OUTSIDE, *UNFIT[:-1]])
def test_text_that_cannot_be_a_name_is_refused(name):
    with pytest.raises(InputError):
        checked_name(name, "m.json", "object")


def test_valid_names_and_paths_are_accepted(tmp_path):
    assert checked_name("Straße 3 (copy).v2", "m.json", "object") == "Straße 3 (copy).v2"
    assert path_inside(tmp_path, "./color/front.png", "m.json", "file") == tmp_path / "color/front.png"
    assert relative_parts("../../cat.png", "m.json", "input", levels_up=None) == ("..", "..", "cat.png")


def test_links_out_of_the_folder_are_refused(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret").write_text("x")
    (inside / "out").symlink_to(tmp_path)
    (inside / "loop").symlink_to(inside / "loop")
    (inside / "near").symlink_to(inside / "file")
    for name in ("out/secret", "out", "loop"):
        with pytest.raises(InputError, match="link"):
            path_inside(inside, name, "m.json", "file")
    assert path_inside(inside, "near", "m.json", "file") == inside / "near"


def test_a_name_may_lead_up_one_level_but_not_two(tmp_path):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    assert uri_path(folder, "../textures/x.png", "m.obj", "map_Kd", levels_up=1) == folder / "../textures/x.png"
    for uri in (
        "../../x.png",
        "%2e%2e/%2e%2e/x.png",
        "%2Fetc%2Fpasswd",
        "file:///etc/passwd",
        "http://host/x",
        "%66ile:/etc/passwd",
        "..%5C..%5Cx",
    ):
        with pytest.raises(InputError):
            uri_path(folder, uri, "m.obj", "map_Kd", levels_up=1)


def test_a_file_named_like_the_undecoded_uri_comes_first(tmp_path):
    (tmp_path / "big%20ball.png").write_text("x")
    assert uri_path(tmp_path, "big%20ball.png", "m.gltf", "image").name == "big%20ball.png"
    assert uri_path(tmp_path, "small%20ball.png", "m.gltf", "image").name == "small ball.png"
    assert uri_path(tmp_path, "maps%5Cball.png", "m.gltf", "image") == tmp_path / "maps/ball.png"


def test_names_of_files_that_are_not_utf8_or_hold_line_breaks():
    assert name_from_path("caf\udce9") == "café"
    assert name_from_path("a\nb") == "a_b"
