"""Work on triangle and quad meshes.

`meshes` holds the mesh classes that other packages use too. Further modules: edges and connectivity (`topology`,
`nonmanifold_edges`, `enclosed_bodies`), repair, simplification, creases (`sharpen`), normals and tangents, rays,
distances, grids of signed distances, quality and comparison (`mesh_quality`, `metrics`), and the UV rasteriser.
"""
