"""Benchmarks: time against error of every stage, beside what else a user could run. One folder a stage.

Run one from the root of a checkout as a module, for example `python -m benchmarks.remesh.sweep`. Results go to
docs/benchmarks. Each `sweep` varies the knobs of its stage."""
