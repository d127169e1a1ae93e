"""Decide which faces share a chart: segment, merge small charts, remove overlaps, and cut charts that pack badly."""
