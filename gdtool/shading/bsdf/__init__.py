"""Evaluate reflection models, alone and under spherical Gaussian light.

For other rooms: `closed_form.shade` (differentiable radiance) and `sg.SphericalGaussians` (a sum of lobes).
"""
