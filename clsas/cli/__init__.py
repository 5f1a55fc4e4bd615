"""The `clsas` command: a thin layer over the library, one function per subcommand.

Results go to standard output, progress and warnings to standard error. Exit codes: 0 done, 1 error
(one `Error:` message), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import click
import pyopencl

import clsas
from clsas import validate
from clsas.cli import images, lines, machine, measures, mosaics

# What users cause, and what machines lack.
_ERRORS = (
    ValueError,
    TypeError,
    clsas.DeviceError,
    pyopencl.Error,
    OSError,
    ImportError,
    MemoryError,
)


class _Commands(click.Group):
    """Turns what the library raises and warns of into messages and exit codes."""

    def invoke(self, ctx: click.Context) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("always", clsas.ClsasWarning)
            warnings.simplefilter("ignore", pyopencl.CompilerWarning)
            warnings.showwarning = _showing(warnings.showwarning)
            try:
                return super().invoke(ctx)
            except click.ClickException as error:
                error.message = validate.printable(error.message)  # type: ignore[misc]
                raise
            except BrokenPipeError:
                raise  # click's: whoever reads our output has left
            except KeyboardInterrupt:
                click.echo("Interrupted", err=True)
                ctx.exit(130)
            except _ERRORS as error:
                if ctx.params.get("traceback"):
                    raise
                raise click.ClickException(_message(error)) from error


@click.group(
    cls=_Commands,
    commands=[
        machine.devices,
        lines.simulate,
        lines.compress,
        images.image,
        images.plan,
        mosaics.mosaic,
        measures.quality,
        measures.tradeoff,
        measures.bench,
        machine.demo,
        machine.calibrate,
    ],
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
                     clsas image lines.h5 --scene scene.toml -o image.h5 --png image.png
                     clsas quality image.h5 --near 0,42.5
    """


def _showing(others: Callable[..., None]) -> Callable[..., None]:
    """Return what shows a warning: one of clsas as a message, others as Python does."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, clsas.ClsasWarning):
            click.echo(f"Warning: {validate.printable(str(message))}", err=True)
        else:
            others(message, category, *where, **options)

    return show


def _message(error: BaseException) -> str:
    return validate.printable(_text(error))


def _text(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"out of memory: {error}" if str(error) else "out of memory"
    return str(error) or type(error).__name__
