"""Fit the paper's SDF and material networks to views; `paper.fit_networks` is the entry point."""
