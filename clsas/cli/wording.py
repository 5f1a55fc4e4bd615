"""Messages in the words of the command line: options, not arguments of Python functions.

The library's messages name arguments and functions. Users of a command have typed options and
files, so every message of a running command passes through `in_options`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

_RUNNING = "clsas.cli.running"  # key of the running command's context among those of click

# Parameters of commands that stand for an argument of the library with another name. The first one
# that the command has is used.
_PARAMETERS = {
    "beam": ("scene_path",),
    "cutoff_hz": ("high_pass_hz",),
    "follow_s": ("follow",),
    "georeference": ("crs",),
    "height_m": ("origin",),
    "images": ("source",),
    "latitude_deg": ("origin",),
    "length_m": ("taper_m",),
    "lines": ("lines_path", "lines_file", "first_file", "recording"),
    "longitude_deg": ("origin",),
    "memory_bytes": ("memory_mib",),
    "number": ("bank",),
    "plan": ("plan_path",),
    "source": ("source",),
    "points_m": ("points",),
    "shape": ("beam_shape",),
    "width_deg": ("beam_deg",),
    "yaw_sd_rad": ("yaw_sd_deg",),
}
# What the option says in a message, where its name alone is not enough.
_SAID = {
    "georeference": "--crs (or --origin)",
    "height_m": "height of --origin",
    "latitude_deg": "latitude of --origin",
    "longitude_deg": "longitude of --origin",
}
# Properties of files and of the grid, for which there are no options.
_PROPERTIES = {
    "a and b": "the two banks",
    "bank_numbers": "bank numbers",
    "carrier_hz": "carrier frequency",
    "first_range_m": "first range",
    "m_per_rad": "height per radian",
    "phase_sd_rad": "deviation of the phase",
    "range_step_m": "range step",
    "rx_m": "receiver positions",
    "rx_velocity_m_s": "receiver velocities",
    "sound_speed_m_s": "sound speed",
    "tx_m": "transmitter positions",
}
_KINDS = {
    "Echoes": "echoes",
    "Grid": "a grid",
    "Heights": "heights",
    "Image": "an image",
    "Interferogram": "an interferogram",
    "Plan": "a plan",
    "RangeLines": "range lines",
    "Store": "a mosaic",
}
_OF_LIBRARY = {
    "autofocus": "clsas focus",
    "backproject": "--exact",
    "calibrate_track": "clsas known-points",
    "heights": "clsas heights",
    "micronavigate": "clsas navigate",
    "mosaic": "clsas mosaic",
    "mosaic_heights": "clsas heights -o STORE.zarr",
    "pair_errors": "clsas pair-errors",
    "plan": "clsas plan",
}
# Whole phrases, tried in this order before anything else.
_PHRASES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"; dataclasses\.replace\(.*?\) declares all channels to be one array", ""),
    (r"\blines\.bank\((\d+)\) has the lines of the first bank", r"{bank} \1 uses the first bank"),
    (r"\bassess lines\.bank\((\d+)\), with sonar\.bank\(\d+\)", r"use --bank \1"),
    (r"\bgive lines\.bank\(n\) of both", "make files of one bank by clsas convert --bank"),
    (r"\blines\.bank\((\d+)\)", r"{bank} \1"),
    (r"; lines\.select\(order\) sorts them", ""),
    (r"\blines\.without_still_pings\(\)", "clsas convert --without-still-pings"),
    (r"\blines\.tapered_ends\b", "clsas convert --taper-m"),
    (r"\. Calibrate replace\(lines, sound_speed=None\)(, near the sonar)?.*", ""),
    (r"\b(have|same) sound_speed\b", r"\1 sound-speed profile"),
    (r"\Asound_speed(?= must|:)", "sound-speed profile"),
    (r" \(bank_numbers\)", ""),
    (r", as of clsas\.mosaic_heights,", " (clsas heights makes them),"),
    (r"\b\w+ \(on the command line ([^()]*)\)", r"\1"),
    (r"\bshape 'inverse'", "--beam-shape inverse"),
    (r", which was requested\b(?! by)", " (--device)"),
    (r"\bof kind '(\w+)'", r"with --as \1"),
    (r"\bclsas\.(\w+)\b(?!\.\w)", lambda found: _OF_LIBRARY.get(found[1], found[0])),
    (
        rf"\b(hold|contain|got|has|or)( only)?(?: an?)? ({'|'.join(_KINDS)})\b",
        lambda found: f"{found[1]}{found[2] or ''} {_KINDS[found[3]]}",
    ),
)
# An argument's name is one, unless it follows a table of a scene file, a quote or a dot, or is part
# of a path.
_BEFORE, _AFTER = r"(?<![\w.\-'\"`\[/])(?<!\] )", r"(?![\w.\-'\"`(\]/])"
_STAND_INS = range(0xE000, 0xF900)  # characters for private use, which stand for paths


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


def in_options(text: str) -> str:
    """Return a message of the library in the words of the command that is running, if any.

    Names of arguments become options or, if a scene file gave the value, its tables. Names of
    functions become commands. Messages about the contents of a file keep the file's words, and
    paths that were typed remain as they are.
    """
    context = click.get_current_context(silent=True)
    running = context.meta.get(_RUNNING) if context is not None else None
    if running is None:
        return text
    text, paths = _without_paths(text, running)
    text = _translated(text, running, tuple(paths))
    return "".join(paths.get(character, character) for character in text)


def _without_paths(text: str, running: click.Context) -> tuple[str, dict[str, str]]:
    """Return a text with a character for every path that was typed, and the paths by character.

    Single words, such as the folder lines, are left as they are: they may be words of the message.
    """
    values = running.params.values()
    typed = [each for value in values for each in (value if isinstance(value, tuple) else (value,))]
    names = {str(path) for path in typed if isinstance(path, Path)}
    unused = (chr(code) for code in _STAND_INS if chr(code) not in text)
    paths = {}
    for name in sorted(names, key=len, reverse=True):  # a short one may be part of a longer one
        if re.search(r"\w", name) and re.search("[./]", name):
            character = next(unused)
            paths[character] = name
            text = re.sub(rf"(?<![\w.\-]){re.escape(name)}(?![\w\-])", character, text)
    return text, paths


def _translated(text: str, running: click.Context, paths: tuple[str, ...]) -> str:
    """Return a message with options for arguments, whose paths are single characters."""
    for pattern, words in _PHRASES:
        if isinstance(words, str):
            has_bank = any(param.name == "bank" for param in running.command.params)
            words = words.replace("{bank}", "--bank" if has_bank else "clsas convert --bank")
        text = re.sub(pattern, words, text)
    words_as_paths = (str(path) for path in running.params.values() if isinstance(path, Path))
    if text.startswith(tuple(f"{path}:" for path in (*paths, *words_as_paths))):
        return text
    options = _options(running)
    for name, option in options.items():
        text = _named(text, name, option)
    for name, words in _PROPERTIES.items():
        if name not in options:
            text = re.sub(f"{_BEFORE}{name}{_AFTER}", words, text)
    return _typed(text, tuple(options.values()))


def _options(running: click.Context) -> dict[str, str]:
    """Return what stands for every argument of the library in a command."""
    params = {param.name: param for param in running.command.params if param.name}
    options = {
        name: option_name(param)
        for name, param in params.items()
        if isinstance(param, click.Option)
    }
    for argument, names in _PARAMETERS.items():
        found = next((params[name] for name in names if name in params), None)
        if found is not None:
            options[argument] = _SAID.get(argument, option_name(found))
    if "unknowns" in params:
        options["unknowns"] = option_name(params["unknowns"])
    if {"x", "scene"} <= params.keys():
        is_given = running.get_parameter_source("x") is ParameterSource.COMMANDLINE
        options["grid"] = "the grid of --x and --y" if is_given else "[grid]"
    return options


def _named(text: str, name: str, option: str) -> str:
    """Return a text that has an option for an argument.

    Words of plain English, such as lines, are arguments only at the beginning, or with a value.
    """
    text = re.sub(f"{_BEFORE}{name} ?= ?(?=[\\w(\\['-])", f"{option} ", text)
    if "_" in name:
        return re.sub(f"{_BEFORE}{name}{_AFTER}", option, text)
    return re.sub(rf"\A((?:patch \d+,\d+: )?){name}(?= (?:must|needs|may|is|start|stop)\b)",
                  lambda found: f"{found[1]}{option}", text)  # fmt: skip


def _typed(text: str, options: tuple[str, ...]) -> str:
    """Return a text with tuples as they are typed: LOW:HIGH, X,Y and words without quotes."""
    if not text.startswith(options) and not any(f"{option} (" in text for option in options):
        return text
    number = r"(-?[\d.]+(?:e[+-]?\d+)?)"
    text = re.sub(rf"(--(?:range|search)-m\b.*?)\({number}, {number}\)", r"\1\2:\3", text)
    text = re.sub(rf"(--(?:near|point) )\({number}, {number}\)", r"\1\2,\3", text)
    words = r"""\((['"]\w+['"](?:, ['"]\w+['"])*),?\)"""
    return re.sub(words, lambda found: re.sub("['\"]", "", found[1]), text)
