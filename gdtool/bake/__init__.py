"""Bake the materials of a source surface into texture maps of a mesh, and write the asset's files.

Read the modules in this order: `target` (the mesh and its texels), `origin` (the surface or model to bake from),
`reproject` (the point of the source for each texel), `pipeline` (the values of all texels), `occlusion`, `maps` (the
images to store), `asset` (the files).
"""
