"""Fuse materials on the vertices of a surface and recover the light that explains its color."""
