"""Benchmarks of the whole chain: image to asset, model to asset, and back."""
