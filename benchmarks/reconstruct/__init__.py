"""Benchmarks of reconstruct: surfaces and materials from exact and from disturbed views."""
