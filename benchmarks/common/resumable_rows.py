"""Keep the rows of a benchmark in a file as they are measured, so that a run that was killed can go on."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from benchmarks.common.measure import machine


class Rows:
    """Keep rows, one for each model and method ("way"), in a JSON file that is written after each.

    A new run goes on from the file where its settings are the same and it is not complete; else it starts afresh.
    """

    def __init__(self, path: Path, settings: dict):
        self.path, self.settings, self.rows = path, settings, []
        if path.exists():
            earlier = json.loads(path.read_text())
            if earlier.get("settings") == settings and not earlier.get("complete"):
                self.rows = earlier["rows"]

    def has(self, model: str, way: str) -> bool:
        """Tell whether a model was measured by a method."""
        return any(row["model"] == model and row["way"] == way for row in self.rows)

    def add(self, row: dict) -> None:
        """Insert a row after the others of its model, so that what is measured again stays in its place; writes the
        file.
        """
        behind = max(
            (i for i, other in enumerate(self.rows, 1) if other["model"] == row["model"]), default=len(self.rows)
        )
        self.rows.insert(behind, row)
        self.write(False)

    def write(self, complete: bool) -> None:
        """Write all rows; complete: a later run starts afresh."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(
            {"machine": machine(), "settings": self.settings, "complete": complete, "rows": self.rows}, indent=1
        )
        fresh = self.path.with_suffix(".part")
        fresh.write_text(text + "\n")
        fresh.replace(self.path)


class KeyedRows:
    """Keep rows in a file of JSON lines, each with a "key" that says what it was measured on.

    A row is appended as it is measured, and stays for later runs; a later row of the same key replaces it. A line that
    a killed run left unfinished is ignored.
    """

    def __init__(self, path: Path):
        self.path, self.rows = path, {}
        lines = path.read_text().splitlines() if path.exists() else []
        for line in lines:
            with contextlib.suppress(ValueError):
                row = json.loads(line)
                self.rows[row["key"]] = row
        if lines and not path.read_text().endswith("\n"):
            self._append("\n")

    def get(self, key: str) -> dict | None:
        """Return the row of a key, or None."""
        return self.rows.get(key)

    def add(self, row: dict) -> None:
        """Append a row, which has a "key"."""
        self.rows[row["key"]] = row
        self._append(json.dumps(row) + "\n")

    def _append(self, text: str) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            file.write(text)
