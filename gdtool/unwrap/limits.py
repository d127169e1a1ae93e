"""Limits of unwrapping that the command needs before numpy is imported."""

from __future__ import annotations

# Seconds for each face in the quickest way (charts by the side that faces look at), with reading and writing: 400,000
# quads on two cores of 2.5 GHz.
SECONDS_PER_FACE = 1.2e-4
