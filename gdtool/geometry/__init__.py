"""Work on triangle meshes: rays, distances, topology, repair, simplification, tangents, quality."""
