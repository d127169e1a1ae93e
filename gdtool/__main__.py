"""`python -m gdtool` runs the same command line as the installed `gdtool` script."""

from gdtool.commands import main  # type: ignore[import-not-found]  # commands/, installed under this name

main()
