"""Benchmarks of train: models beside guesses, the corpus split, growth over minutes, ablations; training settings."""
