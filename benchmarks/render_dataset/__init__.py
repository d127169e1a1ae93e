"""Benchmarks of render-dataset: pictures against path tracers, and objects a core-minute."""
