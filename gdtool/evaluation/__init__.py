"""Measure a result against a reference: shapes by two published protocols, pictures by image metrics.

`references` finds what a result is measured against, `shapes` compares triangles, `pictures` compares folders of
pictures and renders a result through the cameras of its views. docs/metrics.md defines each figure.
"""
