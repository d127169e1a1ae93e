"""Rows of a benchmark kept as they are measured: a run that was killed goes on, one that is complete starts afresh."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.common.measure import machine


class Rows:
    """Rows told apart by model and way, written to a JSON file one by one; only rows of the same settings go on."""

    def __init__(self, path: Path, settings: dict):
        self.path, self.settings, self.rows = path, settings, []
        if path.exists():
            kept = json.loads(path.read_text())
            if kept.get("settings") == settings and not kept.get("complete"):
                self.rows = kept["rows"]

    def has(self, model: str, way: str) -> bool:
        return any(row["model"] == model and row["way"] == way for row in self.rows)

    def add(self, row: dict) -> None:
        """Behind the others of its model, so that what is measured again stays in its place."""
        behind = max((i for i, one in enumerate(self.rows, 1) if one["model"] == row["model"]), default=len(self.rows))
        self.rows.insert(behind, row)
        self.write(False)

    def write(self, complete: bool) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(
            {"machine": machine(), "settings": self.settings, "complete": complete, "rows": self.rows}, indent=1
        )
        fresh = self.path.with_suffix(".part")
        fresh.write_text(text + "\n")
        fresh.replace(self.path)
