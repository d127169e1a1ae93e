"""Read Wavefront OBJ files and their MTL materials.

`read.read_obj` makes a Scene of a file; `lines.read_lines` returns the lines of a file as arrays, polygons included.
"""
