"""Remesh triangles to quads.

`pipeline.remesh` is the entry: it simplifies the surface, tries native remeshers (`engines/`), falls back to paired
triangles (`fallback/`), fits the quads to the surface and its creases (`fit/`) and improves how quads are connected
(`connectivity/`). `task` holds the request, the record and the patch that all of these use. Nothing is imported here:
the stages name the module they need, so that `--help` stays quick.
"""
