"""Turn pictures into constraints on depth: prepare views, match them, integrate normals and align depth."""
