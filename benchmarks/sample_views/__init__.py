"""Benchmarks of sample-views: sampler settings, cutting out, detail of the picture, warnings."""
