"""Bake the materials of a source surface into texture maps of a mesh, and write the asset's files.

The walk: `target` (texels of the mesh), `origin` (what is baked from), `reproject` (from a texel to its place on the
source), `pipeline` (values of all texels), `occlusion`, `maps` (images to store), `asset` (files).
"""
