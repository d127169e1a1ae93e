"""Read, write, convert, mask and measure pictures (OpenImageIO)."""
