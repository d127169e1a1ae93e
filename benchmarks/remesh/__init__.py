"""Benchmarks of remesh: solids, real models, nets of many handles, and how far a result varies."""
