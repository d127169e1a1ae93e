"""Render images of a scene by ray casting: geometry and material buffers, and lit color.

For other rooms: `render.Renderer`, `direct.DirectLight` and `surface_points.SurfaceLookup` (materials at points).
"""
