"""Read and write glTF 2.0: .glb and .gltf files.

`read.read_gltf` makes a Scene of a file; `write.write_glb` makes a .glb of a Scene. The modules import numpy, so they
are imported where they are used.
"""
