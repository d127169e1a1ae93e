"""Time commands, keep resumable rows, make test meshes and draw wireframes, for all benchmarks."""
