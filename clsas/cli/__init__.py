"""The `clsas` command: a thin layer over the library, with one function per subcommand.

Results go to standard output, progress and warnings to standard error. Exit codes: 0 done, 1 error
(one `Error:` message), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import difflib
import importlib
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import click

import clsas
from clsas.engine.data.extras import needed

# Module and first sentence of the help of every command, under the headings of `clsas --help`.
# Importing the module of a command takes up to a second: --help, --version and completion do not.
_GROUPS = {
    "Recordings": {
        "simulate": ("lines", "Simulate the echoes that a scene file describes."),
        "compress": ("lines", "Compress echoes into range lines."),
        "convert": ("lines", "Convert a recording to another format."),
        "inspect": ("inspection", "Show what a recording contains, and what is wrong with it."),
        "known-points": (
            "navigation",
            "Correct timing, sound speed and lever arm by known points.",
        ),
        "navigate": ("navigation", "Correct the track of an array by micronavigation."),
        "focus": ("navigation", "Correct a track by autofocus on bright responses."),
        "pair-errors": ("pair_errors", "Correct phase, delay and roll of two receiver banks."),
    },
    "Images": {
        "process": ("processing", "Take a recording to a focused image, step by step."),
        "plan": ("images", "Show how an image would be formed, its time and its error."),
        "image": ("images", "Form an image of range lines, to a tolerance or exactly."),
        "heights": ("heights", "Measure the heights of a seabed from two receiver banks."),
        "mosaic": ("mosaics", "Form an image of any size, patch by patch."),
        "view": ("view", "Show an image or a mosaic in a browser."),
        "show": ("show", "Draw an image, heights, lines, a plan or a recording."),
        "export": (
            "export",
            "Write an image or heights as a map, a picture or a web page.",
        ),
    },
    "Measures": {
        "certify": ("measures", "Measure the error of an image against its range lines."),
        "quality": ("measures", "Measure the contrast, a point or the error of an image."),
        "limits": ("limits", "Show the limits of a survey: sampling, speed, resolution."),
        "assess": ("assess", "Show which effects an image needs, and what each costs."),
        "tradeoff": ("measures", "Measure time and error of one image at many tolerances."),
    },
    "Machine": {
        "devices": ("machine", "List OpenCL devices, and show which one is used and why."),
        "selftest": ("selftest", "Test the accuracy of a device, in about a minute."),
        "bench": ("measures", "Time benchmark cases, and measure their errors."),
        "demo": ("machine", "Simulate, image and measure the thesis's wide-beam case."),
    },
}
_COMMANDS = {name: entry for group in _GROUPS.values() for name, entry in group.items()}


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

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            if close := difflib.get_close_matches(args[0].lower(), _COMMANDS):
                guesses = " or ".join(map(repr, close))
                error.message += f" Did you mean {guesses}?"  # type: ignore[misc]
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, _COMMANDS))
        for heading, group in _GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [(f"{name:<{width}}", what) for name, (_, what) in group.items()]
                )

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        commands = [
            CompletionItem(name, help=what)
            for name, (_, what) in _COMMANDS.items()
            if name.startswith(incomplete)
        ]
        return commands + click.Command.shell_complete(self, ctx, incomplete)  # and the options

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
                error.message = _worded(error.message)  # type: ignore[misc]
                raise
            except BrokenPipeError:
                raise  # the reader of our output has gone; click handles this
            except KeyboardInterrupt as interrupt:
                raise _interrupted() from interrupt
            except _errors() as error:
                if ctx.params.get("traceback"):
                    raise
                raise click.ClickException(_printable(_text(error))) from error


def _errors() -> tuple[type[Exception], ...]:
    """Return the exceptions that users or their machines cause, not faults of clsas."""
    import pyopencl

    ours = clsas.DeviceError, clsas.ToleranceError
    return *ours, ValueError, TypeError, OSError, ImportError, MemoryError, pyopencl.Error


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
                     clsas image lines.h5 --scene scene.toml -o image.h5
                     clsas show image.h5
                     clsas quality image.h5 --near 0,42.5
    """


def _importing() -> AbstractContextManager[None]:
    """Delay Ctrl-C until imports are done, since it makes some extension modules abort."""
    from clsas.engine.data.threads import uninterrupted  # imports NumPy, which is slow

    return uninterrupted()


def _interrupted() -> click.exceptions.Exit:
    click.echo("Interrupted", err=True)
    return click.exceptions.Exit(130)


def _showing(others: Callable[..., None]) -> Callable[..., None]:
    """Return a function that prints warnings of clsas as messages, and others as Python does.

    A command says the same only once, even if it forms many images.
    """
    shown = set()

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, clsas.ClsasWarning):
            text = _worded(str(message))
            if text not in shown:
                click.echo(f"Warning: {text}", err=True)
            shown.add(text)
        else:
            others(_printable(str(message)), category, *where, **options)

    return show


def _printable(text: str) -> str:
    """Return a message with control characters escaped, since parts may come from a file."""
    from clsas.engine.data import validate  # imports NumPy, which is slow

    return validate.printable(text)


def _worded(text: str) -> str:
    """Return a message in the words of the command line, printable."""
    from clsas.cli.wording import in_options

    return _printable(in_options(text))


def _text(error: BaseException) -> str:
    """Return the message of an exception in the words of the command line."""
    from clsas.cli.wording import error_message

    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"out of memory: {error}" if str(error) else "out of memory"
    notes = "".join(f" ({note})" for note in getattr(error, "__notes__", []))
    return (error_message(error) or type(error).__name__) + notes
