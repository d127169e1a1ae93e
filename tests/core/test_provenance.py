"""Follow the provenance of a folder by path and by digest."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from gdtool.core.errors import InputError
from gdtool.core.folder import open_folder
from gdtool.core.kinds import RendersContent
from gdtool.core.provenance import ancestors, find_ancestor, find_source, missing_origin
from gdtool.core.runner import Settings, run_all
from gdtool.core.second_inputs import second_inputs
from gdtool.core.stage import SecondInput
from tests.core.toy import STAGE, Options

CURE = "make it again"


def copy(inputs, options, out):
    out.path("000.png").write_bytes(inputs.main.file("000.png").read_bytes() + b"+")
    out.content = RendersContent(frames=1, environment="none", light="none")


NEXT = dataclasses.replace(
    STAGE, name="next", reads=("renders",), run=copy, second_inputs={"views": SecondInput("views", required=False)}
)


def run(stage, source, output):
    (result,) = run_all(stage, (str(source),), Options(), {}, Settings(output=Path(output)))
    return open_folder(result.path)


@pytest.fixture
def chain():
    """Make cat.png -> a/first -> a/second."""
    Path("cat.png").write_bytes(b"cat")
    Path("a").mkdir()
    run(STAGE, "cat.png", "a/first")
    return run(NEXT, "a/first", "a/second")


def test_the_chain_is_found_and_paths_stay_readable(chain):
    assert [folder.path for folder in ancestors(chain, CURE)] == [Path("a/first")]
    assert Path(find_source(chain, CURE)).read_bytes() == b"cat"
    assert missing_origin(chain, CURE) is None


def test_a_folder_that_was_replaced_is_reported_and_refused(chain):
    Path("cat.png").write_bytes(b"dog")
    run(STAGE, "cat.png", "a/first")
    with pytest.raises(InputError, match="renders is not the one that renders a/second was made from"):
        list(ancestors(chain, CURE))
    with pytest.raises(InputError, match="name it with --views"):
        second_inputs(NEXT, chain, {})


def test_a_source_file_that_was_replaced_is_reported_and_refused(chain):
    Path("cat.png").write_bytes(b"dog")
    with pytest.raises(InputError, match="source is not the one"):
        find_source(chain, CURE)


def test_an_input_that_was_moved_is_reported(chain):
    shutil.move("a/first", "elsewhere")
    assert find_ancestor(chain, "views", CURE) is None
    assert missing_origin(chain, CURE).path == Path.cwd() / "a/first"
    (warning,) = second_inputs(NEXT, chain, {}).warnings
    assert "a/first" in warning
    assert "is gone" in warning
    assert "--views" in warning


def test_a_path_through_a_linked_folder_records_where_things_really_lie():
    Path("disk/deep").mkdir(parents=True)
    Path("link").symlink_to("disk/deep")
    Path("cat.png").write_bytes(b"cat")
    Path("disk/cat.png").write_bytes(b"another, where the dots would lead from the linked folder")
    folder = run(STAGE, "cat.png", "link/out")
    assert folder.manifest.inputs[0].path == "../../../cat.png"
    assert Path(find_source(folder, CURE)).read_bytes() == b"cat"
    second = run(NEXT, "link/out", "link/second")
    assert [ancestor.manifest.digest for ancestor in ancestors(second, CURE)] == [folder.manifest.digest]
    moved = Path("b/c/d")
    moved.mkdir(parents=True)
    Path("disk").rename("b/c/d/disk")  # a chain that moves as a whole is whole
    assert [ancestor.manifest.digest for ancestor in ancestors(open_folder(moved / "disk/deep/second"), CURE)] == [
        folder.manifest.digest
    ]


def test_an_absolute_input_in_a_manifest_is_refused(chain):
    path = chain.path / "manifest.json"
    path.write_text(path.read_text().replace('"../first"', '"/etc"'))
    with pytest.raises(InputError, match="is absolute"):
        open_folder(chain.path)
