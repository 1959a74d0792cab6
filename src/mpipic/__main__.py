"""`python -m mpipic` is the command line."""

from mpipic.cli import main

main()
