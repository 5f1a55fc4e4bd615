"""`python -m clsas` is the `clsas` command."""

from clsas.cli import main

main(prog_name="clsas")
