"""Fuse prepared views into a signed distance grid, extract its mesh and refine it.

`fusion.fuse_views` is the entry point.
"""
