"""Measures the tables that tests/stress/test_reflection.py holds the closed form to, and writes frozen.json.

    python -m tests.stress.freeze

Run it after a change that is meant to move them, and look at the difference: no figure may grow without a reason.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

TABLE = Path(__file__).with_name("frozen.json")


def measure(rings: int = 512) -> dict:
    """Specular error by roughness/view/sharpness and furnace [lobe alone, white dielectric] by roughness/view."""
    from tests.stress.test_reflection import KINDS, LIGHTS, ROUGHNESS, VIEWS, furnace, specular_error

    return {
        "specular": {
            kind: {
                f"{r:g}/{v}/{s:g}": round(specular_error(kind, r, v, s, rings), 4)
                for r in ROUGHNESS
                for v in VIEWS
                for s in LIGHTS
            }
            for kind in KINDS
        },
        "furnace": {
            kind: {
                f"{r:g}/{v}": [
                    round(furnace(kind, r, float(v), 1.0)[1], 4),
                    round(sum(furnace(kind, r, float(v), 0.0)), 4),
                ]
                for r in ROUGHNESS
                for v in VIEWS
            }
            for kind in KINDS
        },
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    if not TABLE.exists():
        TABLE.write_text("{}")  # the tests' module reads it
    TABLE.write_text(json.dumps(measure(int(sys.argv[1]) if sys.argv[1:] else 512), indent=1) + "\n")
