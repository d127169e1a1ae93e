"""Compute what surfaces look like under light.

Import from the sub-packages: `bsdf` (reflection models, spherical Gaussians), `lights` (environments) and `render`
(images of a scene). They load torch and scene readers, so this page imports nothing.
"""
