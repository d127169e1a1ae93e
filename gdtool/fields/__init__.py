"""Reconstruct a surface with materials from a set of views.

`views` prepares pictures and aligns their depth, `grid` carves and refines a signed distance grid, `neural` fits the
paper's networks, and `appearance` fuses materials and recovers the light.
"""
