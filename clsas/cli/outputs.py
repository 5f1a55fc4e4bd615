"""Outputs of commands: results as text or JSON, and progress bars."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from clsas.cli.wording import in_options
from clsas.engine.data import validate
from clsas.files.json_types import json_able


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Yield a callback that moves a progress bar, or None if there is no terminal."""
    with step_bar() as progress:
        if progress is not None:
            progress(what, 0, None)  # show it before the first step is done
        yield None if progress is None else partial(progress, what)


@contextmanager
def step_bar() -> Iterator[Callable[[str, int, int | None], None] | None]:
    """Yield a callback that moves the bar of a named step, or None if there is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def show(step: str, done: int, total: int | None) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step, total=None)
            bar.update(tasks[step], completed=done, total=total)

        yield show


def report(as_json: bool, text: str, **results: Any) -> None:
    """Print results as JSON, or as text in the words of the command line."""
    if as_json:
        print_json(results)
    else:
        say(in_options(text))


def say(text: str, *, err: bool = False) -> None:
    """Print a text with control characters escaped; to standard error if `err`.

    Pass names of files, and words read from them, through `printable` first: otherwise their line
    breaks could look like messages of clsas.
    """
    click.echo(validate.escaped(text), err=err)


def printable(name: object) -> str:
    """Return the name of a file, or words read from one, on a single line for `say`."""
    return validate.printable(str(name))


def warn(message: str) -> None:
    """Print a warning."""
    say(f"Warning: {printable(in_options(message))}", err=True)


def print_json(results: Any, indent: int | None = 2) -> None:
    """Print results as JSON, on a single line if `indent` is None."""
    click.echo(json.dumps(json_able(results), indent=indent, allow_nan=False))


_LISTED = 3  # patches that are listed for each flag; arbitrary


def described_flags(flagged: dict[tuple[int, int], tuple[str, ...]]) -> list[str]:
    """Return one line for every flag, with the patches that have it."""
    alike: dict[str, list[str]] = {}
    for (row, column), flags in flagged.items():
        alike.setdefault(printable("; ".join(flags)), []).append(f"{row},{column}")
    lines = []
    for words, patches in alike.items():
        more = f" and {len(patches) - _LISTED} more" if len(patches) > _LISTED else ""
        lines.append(f"  patch {'; '.join(patches[:_LISTED])}{more}: {words}")
    return lines
