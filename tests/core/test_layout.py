"""Check the rules of the layout: the direction of imports, the list of packages, the speed of --help."""

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib

import pytest

from gdtool.commands import COMMANDS
from gdtool.folders import schema
from tests.conftest import ROOT

HEAVY = {"numpy", "torch", "trimesh", "scipy", "igl", "pymeshlab", "skimage", "OpenImageIO", "embreex"}


def modules(folder):
    return sorted((ROOT / folder).rglob("*.py"))


def imports(path, top_level_only=False):
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module or ""


def may_import():
    """Read from docs/architecture.md which rooms each room may import, itself among them.

    Text in parentheses there is a reason, not a room.
    """
    rows = re.findall(r"^\| `gdtool/(\w+)/` \|[^|]*\|([^|]*)\|$", (ROOT / "docs/architecture.md").read_text(), re.M)
    return {room: {room, *re.findall(r"\w+", re.sub(r"\(.*?\)", "", others))} for room, others in rows}


def test_the_table_of_rooms_is_the_tree():
    assert set(may_import()) == {p.parent.name for p in ROOT.glob("gdtool/*/__init__.py")} - {"models"}


@pytest.mark.parametrize("path", modules("gdtool"), ids=lambda p: str(p.relative_to(ROOT)))
def test_arrows_point_one_way(path):
    room = path.relative_to(ROOT / "gdtool").parts[0]
    for name in imports(path):
        assert not name.startswith("commands"), name
        if room == "core":
            assert name.split(".")[0] not in HEAVY | {"click"}, name
            assert not name.startswith("gdtool.assets") or "procedural" in name, name
        if room != "__main__.py":
            assert not name.startswith("gdtool.commands"), name
            if room != "stages" and name.startswith("gdtool."):
                assert name.split(".")[1] in may_import()[room], f"{room} imports {name}"


@pytest.mark.parametrize(
    "path", modules("gdtool/stages") + modules("gdtool/core") + modules("commands"), ids=lambda p: p.name
)
def test_heavy_packages_load_inside_functions(path):
    """Every room but core and stages counts as heavy: it imports numpy at the top of its modules."""
    rooms = tuple(f"gdtool.{room}" for room in may_import() if room not in ("core", "stages"))
    for name in imports(path, top_level_only=True):
        assert name.split(".")[0] not in HEAVY, name
        assert not name.startswith(rooms), name


@pytest.mark.parametrize("path", modules("gdtool/stages"), ids=lambda p: p.name)
def test_a_stage_is_short(path):
    """A stage turns folders into values and back. What takes more lines than that belongs to a room."""
    assert len(path.read_text().splitlines()) <= 200


def test_package_list_is_the_tree():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    packages = {".".join(p.parent.relative_to(ROOT).parts) for p in ROOT.glob("gdtool/**/__init__.py")}
    assert listed == packages | {"gdtool.commands", "gdtool.schemas", "gdtool.models.default"}


def test_every_command_has_its_file_and_stage():
    for name in COMMANDS:
        module = name.replace("-", "_") + ".py"
        assert (ROOT / "commands" / module).is_file(), name
        assert (ROOT / "gdtool/stages" / module).is_file(), name


def test_version_is_the_installed_one():
    import gdtool

    assert importlib.metadata.version("gdtool") == gdtool.__version__


def test_schemas_are_those_of_the_types():
    for name, content in schema.schemas().items():
        assert (ROOT / "schemas" / name).read_text() == schema.text(content), f"{name} is stale: make schemas"
    for kind in schema.CONTENTS:
        assert (ROOT / "schemas" / f"{kind}.md").is_file(), f"no page says what {kind} is"


def processor_seconds(command):
    """Measure the least processor time of three runs: wall-clock time depends on the other load of the machine."""
    least = float("inf")
    for _ in range(3):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        least = min(least, usage.ru_utime + usage.ru_stime)
    return least


@pytest.mark.parametrize("arguments", [["--help"], *([name, "--help"] for name in COMMANDS)], ids=lambda a: a[0])
def test_help_is_quick(arguments):
    """--help takes at most three times what Python takes to start with click and msgspec."""
    command = [sys.executable, "-m", "gdtool", *arguments]
    shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert len(arguments) == 1 or "Example" in shown
    assert processor_seconds(command) < 3 * processor_seconds([sys.executable, "-c", "import click, msgspec"])
