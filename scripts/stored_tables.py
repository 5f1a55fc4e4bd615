"""Measured tables of the documentation: CSV files in docs/tables, which its pages show.

A file begins with lines `# key: value` that state the origin of its numbers (`ORIGIN`). A header
and rows follow. A page shows a file between two comments, `<!-- table: PATH -->` with the path
relative to the page, and `<!-- end of table -->`. `scripts/pages tables` fills in what stands
between them. The page can therefore be read on GitHub too, which does not include files.
"""

from __future__ import annotations

import csv
import datetime
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import clsas

ROOT = Path(__file__).resolve().parents[1]
TABLES = ROOT / "docs" / "tables"
ORIGIN = ("clsas", "commit", "date", "device", "driver", "command")
"""Keys of a file's first lines: version, its commit, day, what computed, and with which command."""
SHOWN = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


@dataclass(frozen=True)
class StoredTable:
    """Contents of a file.

    Attributes
    ----------
    origin : dict of str to str
        Where the numbers come from, by the keys of `ORIGIN`.
    header : list of str
    rows : list of list of str
    """

    origin: dict[str, str]
    header: list[str]
    rows: list[list[str]]


def here(device: str, driver: str, command: str) -> dict[str, str]:
    """Return the origin of numbers that a command has just measured."""
    return dict(
        zip(
            ORIGIN,
            (clsas.__version__, commit(), f"{datetime.date.today()}", device, driver, command),
            strict=True,
        )
    )


def commit() -> str:
    """Return the checked-out commit; "changed" follows if the library differs from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "clsas", "cl")
    return (git("rev-parse", "--short=7", "HEAD") or "unknown") + " changed" * bool(changed)


def write(
    path: Path, origin: dict[str, str], header: Sequence[str], rows: Sequence[Sequence[object]]
) -> None:
    """Write a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        file.writelines(f"# {key}: {origin[key]}\n" for key in ORIGIN)
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


def read(path: Path) -> StoredTable:
    """Return a file's contents, or raise ValueError if it is not as this module describes."""
    lines = path.read_text(encoding="utf-8").splitlines()
    origin = {}
    for key, line in zip(ORIGIN, lines, strict=False):
        stated = re.fullmatch(rf"# {key}: (\S.*)", line)
        if stated is None:
            raise ValueError(f"{path}: line {len(origin) + 1} must be '# {key}: ...', got {line!r}")
        origin[key] = stated[1]
    header, *rows = csv.reader(lines[len(ORIGIN) :])
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"{path}: {len(row)} cells in {row}, {len(header)} in the header")
    return StoredTable(origin, header, rows)


def printed(text: str) -> list[tuple[list[str], list[list[str]]]]:
    """Return header and rows of every Markdown table in what a command printed."""
    found: list[tuple[list[str], list[list[str]]]] = []
    before = ""
    for line in text.splitlines():
        if line.startswith("|"):
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1])]
            if not before.startswith("|"):
                found.append((cells, []))
            elif not set(line) <= set("|- :"):
                found[-1][1].append(cells)
        before = line
    return found


def markdown(table: StoredTable, link: str) -> str:
    """Return a table as Markdown, and a line that states its origin and links its file."""
    rows = [table.header, ["---"] * len(table.header), *table.rows]
    text = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    origin = "clsas {clsas}, commit {commit}, {date}; {device}, {driver}; `{command}`"
    return f"{text}\n\n*[CSV]({link}): {origin.format(**table.origin)}*\n"


def filled(page: Path) -> str:
    """Return the text of a page with the present contents of the files that it shows."""

    def shown(match: re.Match[str]) -> str:
        start, link, end = match.groups()
        return f"{start}\n{markdown(read(page.parent / link), link)}\n{end}"

    return SHOWN.sub(shown, page.read_text(encoding="utf-8"))


def uneven(text: str) -> list[str]:
    """Return the rows of Markdown tables whose number of cells is not that of their header."""
    found = []
    cells, fenced = 0, False
    for line in text.splitlines():
        fenced ^= line.lstrip().startswith("```")
        if fenced or not line.lstrip().startswith("|"):
            cells = 0
            continue
        count = len(re.findall(r"(?<!\\)\|", line.strip()[:-1]))
        cells = cells or count
        if count != cells or not line.rstrip().endswith("|"):
            found.append(line)
    return found
