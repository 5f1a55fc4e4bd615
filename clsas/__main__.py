"""`python -m clsas` is the `clsas` command."""

import sys


def run() -> None:
    """Run the command; Ctrl-C ends it with code 130 also while its modules are imported."""
    try:
        from clsas.cli import main
    except KeyboardInterrupt:
        print("Interrupted", file=sys.stderr)
        sys.exit(130)
    main(prog_name="clsas")


if __name__ == "__main__":
    run()
