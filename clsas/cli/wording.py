"""Messages in the words of the command line: options, not arguments of Python functions.

An `ArgumentError` says which argument is wrong, and messages have other arguments and code in
backticks. Users of a command have typed options and files, so both become those.
"""

from __future__ import annotations

import ast
import re
from functools import partial
from typing import Any

import click
from click.core import ParameterSource

from clsas.engine.data.validate import ArgumentError, described

_NAMES_AND_CODE = re.compile(r"`([^`\n]+)`")
_CODE = re.compile(r"`([A-Z]\w*|\w+\.[^`\n]+)`")  # functions, methods and classes
_RUNNING = "clsas.cli.running"  # key of the running command's context among those of click

# Parameters of commands that stand for an argument of the library with another name. The first one
# that the command has is used.
_PARAMETERS = {
    "a": ("first_file",),
    "b": ("second_file",),
    "beam": ("scene_path",),
    "follow_s": ("follow",),
    "found": ("heights_file",),
    "georeference": ("crs",),
    "height_file": ("relief",),
    "height_m": ("origin",),
    "image": ("image_file",),
    "images": ("source",),
    "latitude_deg": ("origin",),
    "lines": ("lines_path", "lines_file", "first_file", "recording"),
    "longitude_deg": ("origin",),
    "memory_bytes": ("memory_mib",),
    "path": ("output",),
    "plan": ("plan_path",),
    "source": ("source", "lines_path"),
}
# What the option says in a message, where its name alone is not enough.
_SAID = {
    "georeference": "--crs (or --origin)",
    "height_m": "height of --origin",
    "latitude_deg": "latitude of --origin",
    "longitude_deg": "longitude of --origin",
}
# Properties of files and of the grid, for which there are no options, and what else has no name of
# its own on the command line.
_WORDS = {
    "Echoes": "echoes",
    "Grid": "a grid",
    "Heights": "heights",
    "Image": "an image",
    "Interferogram": "an interferogram",
    "Plan": "a plan",
    "Georeference.local": "--origin",
    "Georeference.projected": "--crs",
    "RangeLines": "range lines",
    "Store": "a mosaic",
    "a and b": "the two banks",
    "bank_numbers": "bank numbers",
    "carrier_hz": "carrier frequency",
    "clsas.autofocus": "clsas focus",
    "clsas.backproject": "--exact",
    "clsas.calibrate_track": "clsas known-points",
    "clsas.compress": "clsas compress",
    "clsas.heights": "clsas heights",
    "clsas.micronavigate": "clsas navigate",
    "clsas.mosaic": "clsas mosaic",
    "clsas.mosaic_heights": "clsas heights -o STORE.zarr",
    "clsas.pair_errors": "clsas pair-errors",
    "clsas.plan": "clsas plan",
    "first_range_m": "first range",
    "georeference": "georeference",
    "georeference.north_up(grid, pixel_m)": "a north-up grid with clsas image --scene",
    "lines.high_passed(hz)": "clsas convert --high-pass-hz",
    "lines.tapered_ends": "clsas convert --taper-m",
    "lines.without_background()": "clsas convert --without-background mean",
    "lines.without_background('median')": "clsas convert --without-background median",
    "lines.without_still_pings()": "clsas convert --without-still-pings",
    "m_per_rad": "height per radian",
    "phase_sd_rad": "deviation of the phase",
    "range_step_m": "range step",
    "rx_m": "receiver positions",
    "rx_velocity_m_s": "receiver velocities",
    "sound_speed": "sound-speed profile",
    "sound_speed_m_s": "sound speed",
    "source and against": "both images",
    "tx_m": "transmitter positions",
}


class Command(click.Command):
    """Command whose messages name its options; see `in_options`."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. Its context outlives it, for the message of an exception."""
        ctx.meta[_RUNNING] = ctx
        return super().invoke(ctx)


command = partial(click.command, cls=Command)
"""Decorator for commands whose messages name their options."""


def option_name(param: click.Parameter) -> str:
    """Return the name of a parameter on the command line."""
    return param.opts[0] if isinstance(param, click.Option) else (param.metavar or "").strip("[]")


def error_message(error: BaseException) -> str:
    """Return an exception's message in the words of the command that is running, if any."""
    running = _running()
    if running is None or not isinstance(error, ArgumentError):
        return in_options(str(error))
    if error.where:  # names are keys of a file
        return in_options(str(error), _CODE)
    argument = _worded(error.argument, running) or error.argument
    return in_options(error.sentence(argument, typed(error.given)))


def in_options(text: str, code: re.Pattern = _NAMES_AND_CODE) -> str:
    """Return a message with words of the running command for what stands in backticks.

    Names of arguments become options, and names of functions commands. Other code stays.
    """
    running = _running()
    if running is None:
        return text
    return code.sub(lambda found: _worded(found[1], running) or found[0], text)


def _running() -> click.Context | None:
    context = click.get_current_context(silent=True)
    return context.meta.get(_RUNNING) if context is not None else None


def _worded(code: str, running: click.Context) -> str | None:
    """Return a command's words for an argument, one with its value, a function or a class."""
    options = _options(running)
    if code in options:
        return options[code]
    words = _WORDS.get(code, "")
    if words and not (words.startswith("--") and words not in _typeable(running)):
        return words
    if bank := re.fullmatch(r"lines\.bank\((\w+)\)", code):
        has_bank = "--bank" in _typeable(running)
        return f"{'--bank' if has_bank else 'clsas convert --bank'} {bank[1]}"
    name, value = code.split("=", 1) if "=" in code else (code, "")
    if name in options:
        return f"{options[name]} {typed(_evaluated(value))}"
    name, *part = re.split(r"(?=[ \[])", code, maxsplit=1)  # such as "x stop" or "stages[0]"
    return options[name] + "".join(part) if name in options else None


def _typeable(running: click.Context) -> set[str]:
    """Return the options of a command as they are typed."""
    return {each for param in running.command.params for each in param.opts}


def _evaluated(text: str) -> Any:
    """Return the value of a literal, or else its text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def typed(value: object) -> str:
    """Return a value as it is typed: LOW:HIGH, or words without quotes."""
    if isinstance(value, tuple) and value:
        if all(isinstance(each, str) for each in value):
            return ", ".join(value)
        if all(isinstance(each, int | float) for each in value):
            return ":".join(f"{each:g}" for each in value)
    return described(value)


def _options(running: click.Context) -> dict[str, str]:
    """Return what stands for every argument of the library in a command."""
    params = {
        getattr(param, "argument", param.name): param
        for param in running.command.params
        if param.name
    }
    options = {
        name: option_name(param)
        for name, param in params.items()
        if isinstance(param, click.Option)
    }
    for argument, names in _PARAMETERS.items():
        found = next((params[name] for name in names if name in params), None)
        if found is not None:
            options[argument] = _SAID.get(argument, option_name(found))
    if {"x", "scene"} <= params.keys():
        is_given = (
            running.get_parameter_source(params["x"].name or "x") is ParameterSource.COMMANDLINE
        )
        options["grid"] = "the grid of --x and --y" if is_given else "[grid]"
    return options
