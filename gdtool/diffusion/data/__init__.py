"""Prepare training data: frame pictures, read archives of views folders, decode and batch objects."""
