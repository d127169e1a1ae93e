"""Check that docs/faults.md names a test for each fault, and that these tests exist."""

import ast
import re

from tests.conftest import ROOT

PAGE = ROOT / "docs" / "faults.md"
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def rows():
    """Return the rows of the table."""
    lines = PAGE.read_text().splitlines()
    return [line for line in lines if line.startswith("| ") and not line.startswith(("| fault", "|---"))]


def test_each_line_of_the_page_names_a_test():
    assert len(rows()) >= 40
    assert [row for row in rows() if not NAMED.search(row)] == []


def test_each_test_that_the_page_names_exists():
    missing = []
    for file, name in NAMED.findall(PAGE.read_text()):
        path = ROOT / file
        names = (
            {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}
            if path.is_file()
            else set()
        )
        if name not in names:
            missing.append(f"{file}::{name}")
    assert missing == []
