"""`python -m gdtool` runs the same command line as the installed `gdtool` script."""

from gdtool.commands import main

main()
