"""The `clsas` command: a thin layer over the library, one function per subcommand.

Results go to standard output, progress and warnings to standard error. Exit codes: 0 done, 1 error
(one `Error:` message), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import click

import clsas
from clsas.core.extras import needed

# Module and first sentence of the help of every command. Importing a command's module takes a
# second, so --help and --version do without.
_COMMANDS = {
    "devices": ("machine", "List OpenCL devices, and show which one is used and why."),
    "simulate": ("lines", "Simulate the echoes of a scene file."),
    "compress": ("lines", "Compress echoes into range lines."),
    "convert": (
        "lines",
        "Convert a file: recordings to range lines in HDF5, range lines to CPHD and back.",
    ),
    "inspect": (
        "inspection",
        "Show what a recording looks like, and what is wrong with it.",
    ),
    "image": ("images", "Form the image of range lines, fast to a tolerance or exactly."),
    "plan": (
        "images",
        "Show the plan of an image, with its predicted time and error.",
    ),
    "assess": (
        "assess",
        "Show which effects an image needs, the error of leaving each out, and its cost.",
    ),
    "known-points": (
        "navigation",
        "Correct time offset, sound speed and lever arm by reflectors at known positions.",
    ),
    "navigate": ("navigation", "Correct an array's track by displaced phase centres."),
    "focus": ("navigation", "Correct a track by the bright responses of an image (autofocus)."),
    "process": (
        "processing",
        "Take a recording to a focused image, by the steps of a scene file.",
    ),
    "mosaic": ("mosaics", "Form an image of any size patch by patch, into a Zarr store."),
    "quality": (
        "measures",
        "Measure an image: contrast, response of a point, error against another image.",
    ),
    "tradeoff": (
        "measures",
        "Measure speed against accuracy: one image with many tolerances, timed and compared.",
    ),
    "bench": (
        "measures",
        "Time a benchmark case and measure its error.",
    ),
    "demo": (
        "machine",
        "Run the thesis's wide-beam case, from simulation to a measured image.",
    ),
    "calibrate": (
        "machine",
        "Measure the costs of imaging steps on a device, and store them for planning.",
    ),
    "selftest": ("selftest", "Test this device's accuracy at the extremes, in about a minute."),
}


class _Commands(click.Group):
    """Group of commands that imports each when it runs, and prints exceptions as messages."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module, _ = _COMMANDS[cmd_name]
        with _importing(), needed("the command line", "cli"):
            imported = importlib.import_module(f"clsas.cli.{module}")
        return getattr(imported, cmd_name.replace("-", "_"))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, what) for name, (_, what) in _COMMANDS.items()])

    def make_context(self, *arguments: Any, **options: Any) -> click.Context:
        try:
            return super().make_context(*arguments, **options)
        except click.ClickException as error:  # an option that the group does not have
            error.message = _printable(error.message)  # type: ignore[misc]
            raise
        except KeyboardInterrupt as interrupt:
            raise _interrupted() from interrupt

    def invoke(self, ctx: click.Context) -> Any:
        with warnings.catch_warnings():
            warnings.showwarning = _showing(warnings.showwarning)
            try:
                with _importing():
                    import pyopencl
                warnings.simplefilter("always", clsas.ClsasWarning)
                warnings.simplefilter("ignore", pyopencl.CompilerWarning)
                return super().invoke(ctx)
            except click.ClickException as error:
                error.message = _printable(error.message)  # type: ignore[misc]
                raise
            except BrokenPipeError:
                raise  # click handles this: the reader of our output has left
            except KeyboardInterrupt as interrupt:
                raise _interrupted() from interrupt
            except _errors() as error:
                if ctx.params.get("traceback"):
                    raise
                raise click.ClickException(_message(error)) from error


def _errors() -> tuple[type[Exception], ...]:
    """Return errors of users, and limits of their machines."""
    import pyopencl

    ours = ValueError, TypeError, clsas.DeviceError, OSError, ImportError, MemoryError
    return *ours, pyopencl.Error


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(clsas.__version__, prog_name="clsas")
@click.option("--traceback", is_flag=True, help="Show Python's traceback of an error.")
def main(traceback: bool) -> None:
    """Synthetic aperture sonar images in the time domain, on any OpenCL device.

    \b
    A first try:     clsas demo
    Step by step:    clsas simulate scene.toml -o echoes.h5
                     clsas compress echoes.h5 -o lines.h5
                     clsas image lines.h5 --scene scene.toml -o image.h5 --picture image.png
                     clsas quality image.h5 --near 0,42.5
    """


def _importing() -> AbstractContextManager[None]:
    """Let Ctrl-C wait for imports: some extension modules would answer it by aborting."""
    from clsas.core.threads import uninterrupted  # imports NumPy, which is slow

    return uninterrupted()


def _interrupted() -> click.exceptions.Exit:
    click.echo("Interrupted", err=True)
    return click.exceptions.Exit(130)


def _showing(others: Callable[..., None]) -> Callable[..., None]:
    """Return a function that shows clsas's warnings as messages and others as Python does."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, clsas.ClsasWarning):
            click.echo(f"Warning: {_printable(str(message))}", err=True)
        else:
            others(_printable(str(message)), category, *where, **options)

    return show


def _printable(text: str) -> str:
    """Return a message whose text may have come from outside."""
    from clsas.core import validate  # imports NumPy, which is slow

    return validate.printable(text)


def _message(error: BaseException) -> str:
    return _printable(_text(error))


def _text(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"out of memory: {error}" if str(error) else "out of memory"
    return str(error) or type(error).__name__
