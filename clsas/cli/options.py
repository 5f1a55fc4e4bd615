"""Options that several commands share."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import click

from clsas.cli.parameters import AXIS, INPUT, PERCENTILES, RATIO, STAGES, Output
from clsas.engine.data import validate
from clsas.engine.data.beam import SHAPES
from clsas.engine.data.coverage import UnreachedWarning
from clsas.engine.data.validate import ArgumentError, described
from clsas.engine.exact.decide import BEST_ACCURACY_DB
from clsas.engine.factorized.planner import (
    BEST_TOLERANCE_DB,
    WORST_TOLERANCE_DB,
    checked_tolerance_db,
    wavelengths,
)
from clsas.files.hdf5 import SUFFIXES
from clsas.plot.canvas import SUFFIXES as PICTURES


def checked(check: Callable[[Any], object]) -> Callable:
    """Return a callback for an option that turns exceptions of a check into usage errors."""

    def callback(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        try:
            for each in value if param.multiple else [value]:
                if each is not None:
                    check(each)
        except (TypeError, ValueError) as error:
            raise click.BadParameter(unnamed(error), ctx, param) from error
        return value

    return callback


def unnamed(error: Exception) -> str:
    """Return the message of an exception without the argument's name, since click names it."""
    if isinstance(error, ArgumentError):
        return error.sentence("", described(error.given)).lstrip()
    return str(error)


def output(kind: str) -> Callable:
    """Return the option for the resulting file."""
    return click.option(
        "-o", "--output", type=Output(*SUFFIXES), required=True, help=f"{kind} to write."
    )


def picture(what: str) -> Callable:
    """Return the option for a picture of the result."""
    return click.option(
        "--picture", type=Output(*PICTURES),
        help=f"Also draw {what}, as PNG, PDF or SVG according to the suffix.",
    )  # fmt: skip


def refusing_unreached(command: Callable) -> Callable:
    """Return a command that refuses a grid that no line reaches, or takes --allow-unreached."""

    @functools.wraps(command)
    def run(*args: Any, allow_unreached: bool, **given: Any) -> Any:
        with warnings.catch_warnings():
            if not allow_unreached:
                warnings.simplefilter("error", UnreachedWarning)
            try:
                return command(*args, **given)
            except UnreachedWarning as error:
                raise ValueError(f"{error}. To form it anyway, use --allow-unreached") from None

    return click.option(
        "--allow-unreached", is_flag=True,
        help="Form the image even if no line reaches any pixel; all pixels are then zero.",
    )(run)  # fmt: skip


def _together(*options: Callable) -> Callable:
    """Return several options as one decorator, in the order in which --help shows them."""

    def decorate(command: Callable) -> Callable:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


as_json = click.option("--json", "as_json", is_flag=True, help="Print results as JSON.")
dynamic_range = click.option(
    "--dynamic-range-db", "--db", "dynamic_range_db", type=float,
    help="Dynamic range of the picture, dB. [default: 60]",
    callback=checked(validate.dynamic_range_db),
)  # fmt: skip
colour_map = click.option(
    "--colour-map", "--colours", "colour_map",
    help="Colours of the picture: sonar (black, copper, cream), gray, cividis or any other colour "
    "map of Matplotlib. [default: inferno]",
)  # fmt: skip
levels = _together(
    dynamic_range,
    click.option(
        "--percentiles", type=PERCENTILES,
        help="Let the colours span these percentiles of the levels instead, such as 1,99.5.",
    ),
    colour_map,
)  # fmt: skip
map_marks = _together(
    click.option("--north-arrow", is_flag=True, help="Draw an arrow to the north into a picture."),
    click.option("--scale-bar", is_flag=True, help="Draw a scale bar into a picture."),
)
scene = click.option("--scene", type=INPUT, help="Scene file. Options override its values.")
device = click.option(
    "--device",
    help="Device to use: its index, kind (cpu, gpu), platform (pocl, intel, nvidia) or part of its "
    "name, as `clsas devices` lists them.",
)
bank = click.option(
    "--bank", type=click.IntRange(min=0),
    help="Use only the lines of this receiver bank, counted from 0. [default: all lines]",
)  # fmt: skip
axes = _together(
    click.option(
        "--x", type=AXIS, help="First and last pixel centre along x (m), and number of pixels."
    ),
    click.option("--y", type=AXIS, help="The same along y."),
    click.option(
        "--z", type=float, callback=checked(partial(validate.number, "z", unit="m")),
        help="With --x and --y, the height of the plane (m). [default: 0]",
    ),
)  # fmt: skip
grid = _together(scene, axes)
check_tolerance_db = checked(checked_tolerance_db)
tolerance_of_images = click.option(
    "--tolerance-db", type=float, default=-40.0, show_default=True, callback=check_tolerance_db,
    help="Largest relative rms error of the images (dB).",
)  # fmt: skip
check_accuracy_db = checked(
    partial(validate.number, "accuracy_db", unit="dB", least=BEST_ACCURACY_DB, below=0.0)
)
check_idle_s = checked(partial(validate.positive, "idle_s", unit="s"))
method = _together(
    click.option(
        "--tolerance-db", type=float, callback=check_tolerance_db,
        help="Largest relative rms error against the exact image (dB). [default: -50]",
    ),
    click.option(
        "--tolerance-wavelengths", type=RATIO,
        callback=checked(
            partial(
                validate.number, "tolerance_wavelengths", unit="wavelengths",
                least=wavelengths(BEST_TOLERANCE_DB), most=wavelengths(WORST_TOLERANCE_DB),
            )
        ),
        help="The tolerance, stated as a range error in wavelengths, such as 1/30.",
    ),
    click.option(
        "--stages", type=STAGES, metavar="QRxQI,...",
        help="Use the thesis's method with this QR and QI in each stage, such as 2x2,2x2.",
    ),
)  # fmt: skip
beam = _together(
    click.option(
        "--beam-deg", type=float, help="Weight channels with a beam of this full width (degrees)."
    ),
    click.option(
        "--beam-shape", type=click.Choice(SHAPES),
        help="Shape of the beam. Images with 'hann' are the fastest. [default: rectangular]",
    ),
    click.option(
        "--squint-deg", type=float,
        help="Squint of the beam's axis, positive forward (degrees). [default: 0]",
    ),
    click.option(
        "--element-length-m", type=float,
        help="Element length (m) for the shape 'inverse', which divides by the two-way pattern.",
    ),
    click.option(
        "--track-pings", type=int,
        help="Number of pings over which the direction of the track is smoothed. [default: a "
        "quarter of all, at most 101]",
    ),
)  # fmt: skip
