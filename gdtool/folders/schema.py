"""Generate the JSON Schemas of the folder format from the types that gdtool itself decodes with (`make schemas`)."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec

from gdtool.core.kinds import CONTENTS
from gdtool.core.manifest import FORMAT, Manifest
from gdtool.folders.records import Cameras, Light


def schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schemas (2020-12) by file name: one per kind of manifest, and the records inside folders."""
    out = {}
    for kind, content in CONTENTS.items():
        kinds = (content, Manifest)
        (body, manifest), components = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")
        del manifest
        root = components["Manifest"]
        root["properties"]["content"] = body
        root["properties"]["kind"] = {"const": kind}
        root["properties"]["format"] = {"const": FORMAT}
        out[f"{kind}.schema.json"] = _document(
            f"manifest.json of a {kind} folder", root, {k: v for k, v in components.items() if k != "Manifest"}
        )
    for name, record in (("cameras", Cameras), ("light", Light)):
        _, components = msgspec.json.schema_components((record,), ref_template="#/$defs/{name}")
        root = components.pop(record.__name__)
        out[f"{name}.schema.json"] = _document(f"{name}.json", root, components)
    return out


def _document(title: str, root: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Assemble a schema document."""
    out = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root, "title": title}
    return {**out, "$defs": definitions} if definitions else out


def text(schema: dict[str, Any]) -> str:
    """Format a schema as the text of its file."""
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name, schema in schemas().items():
        Path(sys.argv[1], name).write_text(text(schema))
