"""Read scenes from glTF, OBJ, PLY and STL files, write glTF, and generate objects."""
