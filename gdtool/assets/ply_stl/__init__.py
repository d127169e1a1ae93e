"""Read PLY and STL files, the formats of scanners and 3D printers.

`read.read_ply_or_stl` makes a Scene of a file; `binary_ply.read_binary_ply` returns the arrays of a binary PLY.
"""
