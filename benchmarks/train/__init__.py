"""Benchmarks of train: quality of a model, its growth over minutes, ablations; settings of the bundled model."""
