"""Read models into a Scene, write a Scene as glTF, and generate procedural objects.

- `load.load_scene` reads any supported file; `gltf/`, `obj/` and `ply_stl/` hold the readers.
- `scene` defines Scene, Material and Texture.
- `procedural/` generates objects from a seed.
"""
