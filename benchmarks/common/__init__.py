"""Shared by the benchmarks: timing of commands, resumable rows, test meshes, wireframes."""
