"""Objects as text: short descriptions with sizes, extents and units, and reports with tables.

Every public class builds its `repr` by `of_fields` if listing the fields is enough, else by
`summary`; neither shows whole arrays. Results that are more than a line are a `Report`, which is
text for terminals and HTML for notebooks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate

_UNITS = {
    "_m_s": "m/s", "_m": "m", "_s": "s", "_seconds": "s", "_hz": "Hz", "_db": "dB",
    "_rad": "rad", "_deg": "deg", "_m2": "per m2", "_bytes": "bytes",
}  # fmt: skip
_PREFIXES = {
    "m": ((1e-6, "µm"), (1e-3, "mm"), (0.1, "m")),  # metres from 0.1 m on, as people say it
    "s": ((1e-6, "µs"), (1e-3, "ms"), (1.0, "s")),
    "Hz": ((1.0, "Hz"), (1e3, "kHz"), (1e6, "MHz"), (1e9, "GHz")),
    "bytes": ((1.0, "bytes"), (2**10, "KiB"), (2**20, "MiB"), (2**30, "GiB")),
}
_SCALES = {"µm": 1e-6, "mm": 1e-3, "µs": 1e-6, "ms": 1e-3}
_SCALES |= {"kHz": 1e3, "MHz": 1e6, "GHz": 1e9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_DIGITS = {"s": 4, "bytes": 4, "dB": 4}  # significant digits; other units, such as metres, have 6
_MOST_ITEMS = 4  # longer tuples and arrays are described by their size


def summary(obj: object, *parts: str | None) -> str:
    """Return "Type(part, part, ...)" from the parts that are not None or empty."""
    return f"{type(obj).__name__}({', '.join(filter(None, parts))})"


def of_fields(obj: Any) -> str:
    """Return a summary of the fields of a dataclass in their order: name, value and unit.

    Units follow from the ends of names, as in `carrier_hz`. Private fields and fields that are None
    are left out. Long arrays and tuples are described by their size.
    """
    shown = [f for f in fields(obj) if f.repr and not f.name.startswith("_")]
    values = {field.name: getattr(obj, field.name) for field in shown}
    return summary(obj, *(_field(name, v) for name, v in values.items() if v is not None))


def quantity(value: float, unit: str) -> str:
    """Return a number with its unit; metres, seconds, hertz and bytes get a suitable prefix."""
    digits = _DIGITS.get(unit, 6)
    for least, prefixed in reversed(_PREFIXES.get(unit, ())):
        if abs(value) >= least * (1 - 1e-9):
            return f"{value / _SCALES.get(prefixed, 1.0):.{digits}g} {prefixed}"
    return f"{value:.{digits}g} {unit}".rstrip()


def measured(value: float, unit: str, digits: int = 4) -> str:
    """Return a measured value to some significant digits, with a prefixed unit that suits it."""
    return quantity(float(f"{value:.{digits}g}"), unit)


def with_deviation(value: float, deviation: float, unit: str) -> str:
    """Return a value and its standard deviation, rounded alike, such as "4.00 ± 0.15 mm"."""
    if not 0 < deviation < math.inf:
        return quantity(value, unit)
    larger = max(abs(value), deviation)
    shown, prefixed = quantity(larger, unit).split(maxsplit=1)
    factor = 10.0 ** round(math.log10(larger / float(shown)))
    digits = max(1 - math.floor(math.log10(deviation / factor)), 0)
    return f"{value / factor:.{digits}f} ± {deviation / factor:.{digits}f} {prefixed}"


def span(low: float, high: float, unit: str) -> str:
    """Return "low to high" with the unit, or one value if both are equal."""
    if low == high:
        return f"{_place(low, unit)} {unit}"
    return f"{_place(low, unit)} to {_place(high, unit)} {unit}"


def extents(low_m: Sequence[float] | NDArray, high_m: Sequence[float] | NDArray) -> str:
    """Return the extents of a box, such as "x -2.5 to 2.5 m, y 40 to 45 m, z 0 m"."""
    ends = zip("xyz", low_m, high_m, strict=True)
    return ", ".join(f"{name} {span(low, high, 'm')}" for name, low, high in ends)


def by(shape: Sequence[int]) -> str:
    """Return a shape as text, such as "401 x 501"."""
    return " x ".join(map(str, shape))


def _place(value: float, unit: str) -> str:
    """Return one end of a span. Metres are rounded to micrometres, even if they are UTM-sized."""
    if unit != "m":
        return f"{value:.{_DIGITS.get(unit, 6)}g}"
    return f"{round(float(value), 6) + 0.0:.14g}"


def _field(name: str, value: Any) -> str:
    """Return a field as text, such as "carrier 1 MHz"."""
    end = max((end for end in _UNITS if f"_{name}".endswith(end)), key=len, default="")
    unit = _UNITS.get(end, "")
    words = (name[: -len(end)] if end and len(end) < len(name) else name).replace("_", " ")
    return f"{words} {_value(value, unit)}"


def _value(value: Any, unit: str = "") -> str:
    """Return a value as short text."""
    if isinstance(value, np.ndarray) and value.size > _MOST_ITEMS:
        return f"{value.dtype} [{', '.join(map(str, value.shape))}]"
    if isinstance(value, (np.ndarray, np.generic)):
        value = tuple(value.ravel().tolist()) if value.ndim else value.item()
    if isinstance(value, (bool, str)):
        return validate.shown(value)
    if isinstance(value, (int, float)):
        return quantity(value, unit)
    if isinstance(value, (tuple, list, dict)):
        if len(value) > _MOST_ITEMS or isinstance(value, dict):
            return f"[{len(value)} {'entries' if isinstance(value, dict) else 'values'}]"
        return f"({', '.join(map(_value, value))}) {unit}".rstrip()
    return repr(value)


@dataclass(frozen=True)
class Table:
    """Rows of cells under headings.

    Parameters
    ----------
    headings : sequence of str
        One per column.
    rows : sequence of sequences of str
        Cells. Every row has as many as there are headings.
    align : str
        "right" for numbers, "left" for words.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str = "right"

    def lines(self) -> list[str]:
        """Return the lines of the table as text, columns two spaces apart."""
        table = [self.headings, *self.rows]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        side = ">" if self.align == "right" else "<"
        return [
            "  ".join(f"{c:{side}{w}}" for c, w in zip(row, widths, strict=True)).rstrip()
            for row in table
        ]

    def html(self) -> str:
        """Return the table as HTML."""
        rows = [_row("th", self.headings, self.align)]
        rows += [_row("td", row, self.align) for row in self.rows]
        return f"<table>{''.join(rows)}</table>"


@dataclass(frozen=True)
class Report:
    """Lines of text and tables, one below the other.

    Parameters
    ----------
    parts : sequence of str and Table
        Each string is a line: one sentence or finding.
    """

    parts: Sequence[str | Table]

    def text(self) -> str:
        """Return the report for a terminal."""
        lines = [part.lines() if isinstance(part, Table) else [part] for part in self.parts]
        return "\n".join(chain.from_iterable(lines))

    def html(self) -> str:
        """Return the report for a notebook. Spaces in lines are kept, so that columns stay."""
        style = ' style="white-space: pre-wrap"'
        parts = [
            part.html() if isinstance(part, Table) else f"<p{style}>{escape(part)}</p>"
            for part in self.parts
        ]
        return f"<div>{''.join(parts)}</div>"


def _row(kind: str, cells: Sequence[str], align: str) -> str:
    style = f' style="text-align: {align}"'
    return f"<tr>{''.join(f'<{kind}{style}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"
