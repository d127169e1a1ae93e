"""Fit quads to a triangle mesh: trace creases, project, square up, untangle and extrude tips."""
