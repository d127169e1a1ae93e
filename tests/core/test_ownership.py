"""Check that no run replaces a file of the user's, and that a refusal comes before any work."""

import json
import os
from pathlib import Path

import pytest

from gdtool.core.errors import OutputError, UsageError
from gdtool.core.folder import open_folder
from gdtool.core.publish import clear_stale, locked, remove_tree
from gdtool.core.runner import Settings, run_all
from tests.core.toy import STAGE, Options

FORCED = [False, True]


def run(*arguments, options=None, **settings):
    return list(run_all(STAGE, arguments, options or Options(), {}, Settings(**settings)))


def tree(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()
    }


def refused(*arguments, **settings):
    (error,) = run(*arguments, **settings)
    assert isinstance(error, UsageError), error
    assert error.cure, error
    return str(error)


@pytest.fixture
def cat():
    Path("cat.png").write_bytes(b"cat")
    return "cat.png"


@pytest.fixture
def made(cat):
    """Make a result at out/ and a source that makes it stale."""
    run(cat, output=Path("out"))
    Path("cat.png").write_bytes(b"other")
    return Path("out")


@pytest.mark.parametrize("force", FORCED)
def test_a_folder_of_the_users_is_not_replaced(cat, force):
    Path("out/notes").mkdir(parents=True)
    Path("out/notes/diary.txt").write_text("mine")
    before = tree("out")
    assert "out/notes/diary.txt" in refused(cat, output=Path("out"), force=force)
    assert tree("out") == before


def test_an_empty_folder_is_replaced(cat):
    Path("out").mkdir()
    assert run(cat, output=Path("out"))[0].status == "done"


@pytest.mark.parametrize("force", FORCED)
@pytest.mark.parametrize("name", ["mine.txt", ".hidden", "deep/er.txt"])
def test_a_file_put_beside_the_results_stays(made, name, force):
    path = made / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    before = tree(made)
    assert name in refused("cat.png", output=made, force=force)
    assert tree(made) == before


@pytest.mark.parametrize("force", FORCED)
def test_a_result_that_was_edited_stays(made, force):
    (made / "000.png").write_bytes(b"painted over")
    before = tree(made)
    assert "000.png: was changed after gdtool wrote it" in refused("cat.png", output=made, force=force)
    assert tree(made) == before


def test_a_link_put_among_the_results_stays(made):
    (made / "album").symlink_to("/")
    assert "album" in refused("cat.png", output=made)
    assert (made / "album").is_symlink()


@pytest.mark.parametrize(
    "change, said",
    [
        (
            {"kind": "mesh", "content": {"vertices": 1, "quads": 1, "triangles": 0, "watertight": True}},
            "holds mesh, not renders",
        ),
        ({"key": ""}, "was not written by a stage of gdtool"),
        ({"stage_version": 0}, "was not written by a stage of gdtool"),
        ({"anything": 1}, "is no manifest of gdtool's"),
    ],
)
def test_a_folder_that_something_else_wrote_stays(made, change, said):
    record = json.loads((made / "manifest.json").read_text())
    (made / "manifest.json").write_text(json.dumps(record | change))
    before = tree(made)
    assert said in refused("cat.png", output=made)
    assert tree(made) == before


def test_a_missing_file_of_a_result_is_made_again(made):
    (made / "000.png").unlink()
    assert run("cat.png", output=made)[0].status == "done"


def test_an_output_that_holds_the_source(cat):
    Path("in").mkdir()
    Path(cat).rename("in/cat.png")
    assert "holds the source" in refused("in/cat.png", output=Path("in"))
    assert "holds the source" in refused("in/cat.png", output=Path())
    assert Path("in/cat.png").read_bytes() == b"cat"


def test_an_output_that_is_reached_by_another_name_for_the_source(cat):
    Path("in").mkdir()
    Path(cat).rename("in/cat.png")
    Path("alias").symlink_to("in")
    assert "holds the source" in refused("in/cat.png", output=Path("alias"))


def test_a_link_as_output_stays_and_its_target_is_judged(cat):
    Path("disk").mkdir()
    Path("out").symlink_to("disk")
    (result,) = run(cat, output=Path("out"))
    assert result.path == Path("out")
    assert Path("out").is_symlink()
    assert open_folder(Path("disk")).name == "cat"
    Path("disk/mine.txt").write_text("mine")
    assert "mine.txt" in refused(cat, output=Path("out"), force=True)
    assert Path("out").is_symlink()
    assert Path("disk/mine.txt").read_text() == "mine"


def test_a_link_to_a_link_as_output(cat):
    Path("disk").mkdir()
    Path("first").symlink_to("disk")
    Path("second").symlink_to("first")
    assert "is a link to a link" in refused(cat, output=Path("second"))


def test_an_output_whose_name_holds_a_line_break(cat):
    assert "control character" in refused(cat, output=Path("out\nside"))


def test_files_that_appear_in_the_output_during_a_run_stay(made, monkeypatch):
    def run_and_meddle(inputs, options, out):
        (made / "late.txt").write_text("mine")
        return STAGE.run(inputs, options, out)

    import dataclasses

    (error,) = run_all(
        dataclasses.replace(STAGE, run=run_and_meddle), ("cat.png",), Options(), {}, Settings(output=made)
    )
    assert "late.txt" in str(error)
    assert (made / "late.txt").read_text() == "mine"


def test_clearing_removes_only_what_runs_of_this_output_left():
    key, other = "0" * 12, "a" * 12
    kept = [
        f".out.v2.{key}.work",
        f".out.v2.{key}.partial",
        ".out.mine.partial",
        ".out.old",
        f".out.{key}.work",
        f".out.{key}x.partial",
        f"out.{key}.partial",
    ]
    swept = [f".out.{key}.partial", f".out.{other}.partial"]
    for name in (*kept, *swept, "out"):
        Path(name).mkdir()
        Path(name, "file").write_text("x")
    clear_stale(Path("out"))
    assert all(Path(name, "file").exists() for name in kept)
    assert not any(Path(name).exists() for name in swept)


def test_a_workspace_of_other_options_stays_until_the_output_is_finished(cat):
    work = Path(f".out.{'b' * 12}.work")
    work.mkdir()
    Path("cat.png").write_bytes(b"bad")
    run(cat, output=Path("out"))
    assert work.is_dir()
    Path("cat.png").write_bytes(b"good")
    run(cat, output=Path("out"))
    assert not work.exists()


def test_clearing_does_not_follow_a_link():
    Path("mine").mkdir()
    Path("mine/file").write_text("x")
    name = Path(f".out.{'0' * 12}.partial")
    name.symlink_to("mine")
    clear_stale(Path("out"))
    remove_tree(name)
    assert Path("mine/file").read_text() == "x"


def test_a_users_file_with_the_name_of_the_lock_stays():
    Path(".out.lock").write_text("mine")
    with pytest.raises(OutputError, match="lock file"), locked(Path("out")):
        pass
    assert Path(".out.lock").read_text() == "mine"


def test_the_index_of_several_does_not_replace_a_manifest_of_the_users():
    import dataclasses

    stage = dataclasses.replace(STAGE, dataset=True)
    for name in "ab":
        Path(f"{name}.png").write_bytes(b"x")
    Path("out").mkdir()
    Path("out/manifest.json").write_text('{"name": "my web app"}')
    with pytest.raises(UsageError, match="no manifest of gdtool's"):
        list(run_all(stage, ("a.png", "b.png"), Options(), {}, Settings(output=Path("out"), several=True)))
    assert Path("out/manifest.json").read_text() == '{"name": "my web app"}'
    assert not Path("out/a.asset").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_an_old_output_of_another_user_stops_the_run_before_it_starts(made):
    """The replaced folder could not be removed, and would stay beside the new one."""
    os.chown(".", 65534, 65534)
    pid = os.fork()
    if not pid:
        os.setuid(65534)
        (error,) = run("cat.png", output=made)
        right = isinstance(error, OutputError) and "not writable" in str(error)
        os._exit(0 if right else 1)
    assert os.waitpid(pid, 0)[1] == 0
    assert sorted(path.name for path in Path().iterdir()) == ["cat.png", "out"]
    assert open_folder(made)


def test_a_partial_folder_without_permissions_is_removed():
    """A umask of 777 leaves such folders; root needs no permissions, others do."""
    pid = os.fork()
    if not pid:
        if os.geteuid() == 0:
            os.chown(".", 65534, 65534)
            os.setuid(65534)
        folder = Path(f".out.{'0' * 12}.partial/deep")
        folder.mkdir(parents=True)
        (folder / "file").write_text("x")
        folder.chmod(0)
        folder.parent.chmod(0)
        clear_stale(Path("out"))
        os._exit(len(list(Path().iterdir())))
    assert os.waitpid(pid, 0)[1] == 0
