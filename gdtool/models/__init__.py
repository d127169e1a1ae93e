"""Model folders that ship with gdtool."""
