"""Make quads without an engine: pair triangles, split every face into quads, and smooth the result where that helps."""
