"""`python -m clsas` is the `clsas` command."""

import sys


def run() -> None:
    """Run the command; Ctrl-C ends it with code 130 also while its modules are imported."""
    from clsas.engine.data.extras import needed

    try:
        with needed("the command line", "cli"):
            from clsas.cli import main
    except ImportError as error:
        sys.exit(f"Error: {error}")
    except KeyboardInterrupt:
        print("Interrupted", file=sys.stderr)
        sys.exit(130)
    main(prog_name="clsas")


if __name__ == "__main__":
    run()
