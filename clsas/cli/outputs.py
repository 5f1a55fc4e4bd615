"""Outputs of commands: results as text or JSON, and progress bars."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Yield a callback that moves a progress bar, or None without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn(what), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def report(as_json: bool, text: str, **results: Any) -> None:
    """Print results as JSON or as text."""
    if as_json:
        print_json(results)
    else:
        click.echo(text)


def print_json(results: Any, indent: int | None = 2) -> None:
    """Print results as JSON; on one line if `indent` is None."""
    click.echo(json.dumps(json_able(results), indent=indent, allow_nan=False))


def json_able(value: Any) -> Any:
    """Return a value in types of JSON: paths as text, infinity as null, without arrays."""
    if is_dataclass(value):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        return json_able({k: v for k, v in parts.items() if not isinstance(v, np.ndarray)})
    if isinstance(value, dict):
        return {key: json_able(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_able(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
