"""Check that every command that the documents name exists, with every option that they give it."""

import importlib
import re
import shlex

import pytest

from gdtool.commands import COMMANDS
from tests.conftest import ROOT
from tests.tools.docs_check import COOKBOOK, blocks

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(?:sh|bash|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def lines_with_gdtool(text):
    for script in FENCE.findall(text):
        for part in re.split(r"\n|\||;|&&", script.replace("\\\n", " ")):
            words = shlex.split(part, comments=True) if "gdtool " in part else []
            if "gdtool" in words[:2]:  # "do gdtool …" of a loop
                yield words[words.index("gdtool") + 1 :]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_and_options_exist(page):
    for name, *words in lines_with_gdtool(page.read_text()):
        if name == "COMMAND" or name.startswith("-"):
            continue
        assert name in COMMANDS, f"{page.name}: gdtool {name}"
        command = importlib.import_module("gdtool.commands." + name.replace("-", "_")).command
        known = {option for param in command.params for option in (*param.opts, *param.secondary_opts)} | {
            "--help",
            "-h",
        }
        for word in words:
            if re.match(r"--?[a-z]", word):
                assert word.split("=")[0] in known, f"{page.name}: gdtool {name} {word}"


def test_the_cookbook_has_its_pipelines_in_order():
    text = COOKBOOK.read_text()
    numbered_blocks = blocks(text)
    assert [number for number, _, _ in numbered_blocks] == list(range(1, len(numbered_blocks) + 1))
    assert len(numbered_blocks) >= 10
    assert len(FENCE.findall(text)) == len(numbered_blocks)  # none is left out of the check
    assert all("gdtool" in script for _, _, script in numbered_blocks)
