"""Options that several commands share, and options made from declarations of the library."""

from __future__ import annotations

import functools
import inspect
import re
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import click

from clsas.cli.parameters import AXIS, INPUT, POSITION, RATIO, SPAN, STAGES, Output
from clsas.cli.wording import typed
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import UnreachedWarning
from clsas.engine.data.declared import (
    Choice,
    Count,
    Declared,
    Flag,
    Names,
    Number,
    Other,
    Positions,
    Several,
    Span,
    declared,
    default_of,
    limits_in_words,
)
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import Request
from clsas.engine.imaging import factorize
from clsas.files.hdf5 import SUFFIXES
from clsas.files.scene_tables import EXACT_KEYS, PLAN_KEYS, PROMISE_KEYS
from clsas.maps.exporting import ExportOptions
from clsas.plot.canvas import SUFFIXES as PICTURES
from clsas.plot.canvas import Scale

_TYPES = {Number: float, Count: int, Span: SPAN, Positions: POSITION, Other: str}
"""Type of an option, by the kind of its declaration."""


class DeclaredOption(click.Option):
    """Option that sets an argument of the library, which messages replace by the option."""

    def __init__(self, *names: Any, argument: str, **how: Any) -> None:
        super().__init__(*names, **how)
        self.argument = argument


def of(
    source: Callable[..., Any],
    *arguments: str,
    into: str,
    called: dict[str, tuple[str, ...]] | None = None,
    types: dict[str, Any] | None = None,
    default: str = "",
    beside: str = "",
    required: bool = False,
) -> Callable:
    """Return a decorator that adds options for arguments that a class or function declares.

    The command receives those that were given as a dict, by the names of the arguments.

    Parameters
    ----------
    source : callable
        The class or function, which states units, limits, defaults and help.
    *arguments : str
        The arguments, in the order of `--help`.
    into : str
        Parameter of the command that receives the dict. Several decorators may fill the same one.
    called : dict of tuple of str
        Names of options, by argument, where these are not those of the arguments.
    types : dict
        Types of options, by argument, where the kind of a declaration does not determine them.
    default : str
        What the help states as the default instead, if the command has another one.
    beside : str
        Option without which these have no effect.
    required : bool
        Whether they must be given.
    """

    def decorate(command: Callable) -> Callable:
        parameters = {f"{into}__{argument}": argument for argument in arguments}

        @functools.wraps(command)
        def run(*args: Any, **given: Any) -> Any:
            chosen = {argument: given.pop(name) for name, argument in parameters.items()}
            chosen = {name: each for name, each in chosen.items() if _is_given(each)}
            chosen = given.pop(into, {}) | chosen
            return command(*args, **given, **{into: chosen})

        for argument in reversed(arguments):
            what = declared(source)[argument]
            stated = default or _default_in_words(source, argument, what)
            names = (called or {}).get(argument, [option_of(argument)])
            if isinstance(what, Flag) and what.default:  # left out, it is neither true nor false
                names = [f"{name}/--no-{name[2:]}" for name in names]
            run = click.option(
                *names, f"{into}__{argument}",
                cls=DeclaredOption, argument=argument, required=required,
                help=_help(what, stated, beside), callback=partial(_checked, what),
                **_kind(what, (types or {}).get(argument)),
            )(run)  # fmt: skip
        return run

    return decorate


def _is_given(value: Any) -> bool:
    """Return whether click found an option; one that may be repeated is else an empty tuple."""
    return value is not None and not (isinstance(value, tuple) and not value)


def option_of(argument: str) -> str:
    """Return the option that an argument has unless another one is chosen."""
    return f"--{argument.replace('_', '-')}"


def _help(what: Declared, default: str, beside: str) -> str:
    """Return the help of an option: what is declared, its unit, and its default."""
    text = f"With {beside}, {what.help[0].lower()}{what.help[1:]}" if beside else what.help
    unit = getattr(what, "unit", "")
    if unit and unit not in re.findall(r"\w+", text):
        first, stop, others = text.partition(".")
        text = f"{first} ({unit}){stop}{others}"
    if isinstance(what, Positions):
        text += " X,Y is at z = 0."
    if isinstance(what, Names | Positions | Several):
        text += " Repeat the option for several."
    # Click itself lists words to choose from.
    limits = (
        "" if isinstance(_kind(what, None).get("type"), click.Choice) else limits_in_words(what)
    )
    shown = "; ".join(note for note in (limits, default and f"default: {default}") if note)
    return f"{text} [{shown}]" if shown else text


def _kind(what: Declared, given: Any) -> dict[str, Any]:
    """Return how click parses an option."""
    if isinstance(what, Flag):
        return {"is_flag": True, "default": None}
    if isinstance(what, Several):
        return _kind(what.each, given) | {"multiple": True}
    if isinstance(what, Choice | Names):
        words = all(isinstance(each, str) for each in what.allowed)
        kind = click.Choice(what.allowed) if words else int
        return {"type": kind, "multiple": isinstance(what, Names)}
    return {"type": given or _TYPES[type(what)], "multiple": isinstance(what, Positions)}


def _checked(what: Declared, ctx: click.Context, param: click.Parameter, value: Any) -> Any:
    """Return the value of an option that is allowed; a usage error otherwise."""
    if not _is_given(value):
        return value
    if isinstance(what, Positions):
        value = [(*position, 0.0)[:3] for position in value]
    argument = getattr(param, "argument", "")
    try:
        return what.check(argument, value)
    except ArgumentError as error:
        is_part = error.argument.startswith(f"{argument} ")  # such as "x stop"
        part = error.argument.removeprefix(argument) if is_part else ""
        message = error.sentence(part, typed(error.given)).strip()
        raise click.BadParameter(message, ctx, param) from error


def _default_in_words(source: Callable[..., Any], argument: str, what: Declared) -> str:
    """Return the default of an argument as --help states it."""
    value = default_of(source, argument)
    if value is None or value is inspect.Parameter.empty or isinstance(value, bool):
        return getattr(what, "default", "")
    if isinstance(value, tuple):
        return ", ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


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
dynamic_range = of(
    Scale, "dynamic_range_db", into="levels",
    called={"dynamic_range_db": ("--dynamic-range-db", "--db")},
)  # fmt: skip
colour_map = of(
    Scale, "colour_map", into="levels", called={"colour_map": ("--colour-map", "--colours")}
)
levels = _together(dynamic_range, of(Scale, "percentiles", into="levels"), colour_map)
map_marks = of(ExportOptions, "north_arrow", "scale_bar", "caption", into="marks")
scene = click.option("--scene", type=INPUT, help="Scene file. Options override its values.")
device = click.option(
    "--device",
    help="Device to use: its index, kind (cpu, gpu), platform (pocl, intel, nvidia) or part of its "
    "name, as `clsas devices` lists them.",
)
bank = of(RangeLines.bank, "number", into="of_bank", called={"number": ("--bank",)})
promise = of(factorize, *PROMISE_KEYS, into="promise")
axes = of(Grid.plane, "x", "y", "z", into="axes", types={"x": AXIS, "y": AXIS})
grid = _together(scene, axes)
method = of(
    Request, *PLAN_KEYS, into="request", types={"tolerance_wavelengths": RATIO, "stages": STAGES}
)
exactly = of(ExactImage, *EXACT_KEYS, into="request")
beam = of(
    BeamWindow, "width_deg", "shape", "squint_deg", "element_length_m", "track_pings", into="beam",
    called={"width_deg": ("--beam-deg",), "shape": ("--beam-shape",)},
)  # fmt: skip
