"""Benchmarks of bake: maps, seams and mip levels, and the finished asset in Blender."""
