"""Benchmarks of unwrap."""
