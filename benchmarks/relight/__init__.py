"""Benchmarks of relight: pictures against path tracers, contact sheets, and float32 against float64."""
