"""Tables of results, which are written as text for terminals and as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain


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
