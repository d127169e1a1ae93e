"""Make, read, fit and prefilter environment lights.

For other rooms: `studio.studio` (a light by its name, ready for use) and `load.load_environment` (a name or an image).
"""
