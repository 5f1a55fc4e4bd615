"""The documentation's code runs, shows what it makes, and leaves no public name out."""

import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import stored_tables

import clsas

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
STORED = sorted(stored_tables.TABLES.rglob("*.csv"))
FIGURES = [path for path in (DOCS / "figures").glob("*.py") if path.stem != "drawing"]
PROGRAMS = sorted([*(DOCS / "tutorials").glob("*.md"), *FIGURES])


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(path, id=path.stem, marks=pytest.mark.watches(str(path.relative_to(ROOT))))
        for path in PROGRAMS
    ],
)
def test_tutorials_and_figures_run(program):
    for package in {"mosaic": ["zarr"], "map": ["zarr", "rasterio"]}.get(program.stem, []):
        pytest.importorskip(package)
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "pages", program], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("kind", "said", "fault"),
    [
        ("text", "5.2 cm of 300 channels", None),
        ("text", "... channels", None),
        ("text", "5.9 cm of 300 channels", None),
        ("text", "9.2 cm of 300 channels", "expected"),
        ("text", "5.4 m of 300 channels", "expected"),
        ("text", "5.4 cm", "expected"),
        ("text about", "9.2 cm of 200 channels", None),
        ("text about", "2.8 cm of 590 channels", None),
        ("text about", "2.6 cm of 300 channels", "expected"),
        ("text about", "5.4 cm of 700 channels", "expected"),
        ("text about", "-5.4 cm of 300 channels", "expected"),
        ("text about", "0 cm of 300 channels", "expected"),
        ("text about", "5.4 m of 300 channels", "expected"),
    ],
)
def test_what_pages_say_is_printed_is_compared(kind, said, fault, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f'```python\nprint("5.4 cm of 300 channels")\n```\n\n```{kind}\n{said}\n```\n')
    done = run_page(page)
    assert (done.returncode != 0) == (fault is not None), done.stderr
    assert (fault or "") in done.stderr


@pytest.mark.parametrize(("said", "is_right"), [("90 s, 3 m", True), ("90 s, 9 m", False)])
def test_times_of_about_blocks_are_not_compared(said, is_right, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f'```python\nprint("2.1 s, 3 m")\n```\n\n```text about\n{said}\n```\n')
    assert (run_page(page).returncode == 0) == is_right


def test_a_page_that_shows_a_picture_must_make_it(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("![missing](../images/missing.png)\n")
    done = run_page(page)
    assert done.returncode != 0
    assert "missing.png, which its code does not write" in done.stderr


@pytest.mark.parametrize("installed", [True, False])
def test_pictures_by_a_browser_may_be_missing_where_there_is_none(installed, tmp_path):
    page, programs = tmp_path / "page.md", tmp_path / "programs"
    code = "from pathlib import Path\n\nPath('drawn.png').touch()"
    page.write_text(f"```python chromium\n{code}\n```\n\n![drawn](../images/drawn.png)\n")
    programs.mkdir()
    if installed:
        (programs / "chromium").write_text("#!/bin/sh\n")
        (programs / "chromium").chmod(0o755)
    done = run_page(page, PATH=str(programs))
    assert done.returncode == 0, done.stderr
    assert ("drawn.png" in done.stdout) == installed


def run_page(page, **variables):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        [sys.executable, ROOT / "scripts" / "pages", page],
        capture_output=True, text=True, env=environment,
    )  # fmt: skip


def test_the_reference_holds_every_public_name():
    shown, drawn = set(), set()
    for page in (DOCS / "reference").glob("*.md"):
        # Names below `.. autosummary::` belong to the module that `.. currentmodule::` names.
        module = None
        for line in page.read_text().splitlines():
            if line.startswith(".. currentmodule::"):
                module = line.split()[-1]
            elif re.fullmatch(r"   \w+", line):
                (drawn if module == "clsas.plot" else shown).add(line.strip())
    assert shown == set(clsas.__all__) - {"plot"}
    assert drawn == set(clsas.plot.__all__)


def test_links_between_files_lead_somewhere():
    """In the README too; anchors of pages are checked when the site is built."""
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / link).exists(), (page, link)


def test_the_readme_lists_the_main_pages():
    readme = (ROOT / "README.md").read_text()
    for page in DOCS.glob("*.md"):
        assert f"(docs/{page.name})" in readme
    for page in (DOCS / "tutorials").glob("*.md"):
        assert f"(docs/tutorials/{page.name})" in readme


def test_every_page_is_in_a_table_of_contents():
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")}
    listed = set()
    for page in DOCS.rglob("*.md"):
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL):
            entries = [line for line in block.split() if not line.startswith(":")]
            for entry in entries:
                path = (page.parent / f"{entry}.md").resolve()
                if path.is_file():
                    listed.add(path.relative_to(DOCS).with_suffix("").as_posix())
    assert pages == listed | {"index"}


def test_architecture_names_every_room_and_only_modules_that_exist():
    page = (DOCS / "architecture.md").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = {layer.rpartition(".")[2] for each in contracts for layer in each.get("layers", ())}
    folders = (ROOT / "clsas", ROOT / "clsas" / "engine")
    rooms = {name for name in layers if any((at / name).is_dir() for at in folders)} - {"engine"}
    assert set(re.findall(r"^\*\*`(\w+)`: ", page, re.MULTILINE)) == rooms
    drawn = re.findall(
        r'^\s+\(\(?\(?"(\w+)", "', (DOCS / "figures" / "house.py").read_text(), re.MULTILINE
    )
    assert set(drawn) == rooms
    modules = re.findall(r"`([\w/]+\.(?:py|cl))`", page)
    assert len(modules) > 15
    for module in modules:
        assert (ROOT / module).is_file() or (ROOT / "clsas" / module).is_file(), module


def test_the_citation_is_of_this_version():
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {clsas.__version__}\n" in citation
    assert f"## {clsas.__version__}" in (DOCS / "changelog.md").read_text()


ORIGIN = [
    "# clsas: 0.1.0",
    "# commit: 0123abc",
    "# date: 2026-01-02",
    "# device: a device",
    "# driver: PoCL 3.0",
    "# command: scripts/bench speed",
]


@pytest.mark.parametrize(
    ("row", "even"), [("| 1 | 2 |", True), ("| 1 |", False), ("| 1 | 2 | 3 |", False),
                      ("| 1 | 2", False), (r"| `a\|b` | 2 |", True), ("| `a|b` | 2 |", False)],
)  # fmt: skip
def test_a_row_with_missing_or_further_cells_is_found(row, even, tmp_path):
    table = f"| a | b |\n| --- | --- |\n| 1 | 2 |\n{row}\n"
    assert stored_tables.uneven(f"Text.\n\n{table}\nText.\n") == [row] * (not even)
    assert stored_tables.uneven(f"```text\n{table}```\n") == []


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        ([*ORIGIN, "a,b", "1,2"], None),
        ([*ORIGIN, "a,b", "1"], "1 cells"),
        ([*ORIGIN, "a,b", "1,2,3"], "3 cells"),
        ([*ORIGIN[1:], "a,b", "1,2"], "clsas"),
        ([*ORIGIN[:3], *ORIGIN[4:], "a,b", "1,2"], "device"),
        ([*ORIGIN[:5], "# command: ", "a,b", "1,2"], "command"),
    ],
)
def test_a_stored_table_that_is_damaged_or_states_no_origin_is_refused(lines, fault, tmp_path):
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    if fault is None:
        assert stored_tables.read(tmp_path / "a.csv").rows == [["1", "2"]]
        return
    with pytest.raises(ValueError, match=fault):
        stored_tables.read(tmp_path / "a.csv")


def test_printed_tables_can_be_stored(tmp_path):
    header, rows = ["a", "b, c"], [["1", "x (2 to 3)"], ["", "`|λ|`"]]
    origin = dict.fromkeys(stored_tables.ORIGIN, "x")
    text = stored_tables.markdown(stored_tables.StoredTable(origin, header, rows[:1]), "a.csv")
    assert stored_tables.printed(f"Title\n\n{text}\n{text}") == [(header, rows[:1])] * 2
    stored_tables.write(tmp_path / "a.csv", origin, header, rows)
    assert stored_tables.read(tmp_path / "a.csv").rows == rows


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_tables_of_pages_are_even_and_those_of_their_files(page):
    text = page.read_text()
    assert stored_tables.uneven(text) == []
    assert len(stored_tables.SHOWN.findall(text)) == text.count("<!-- table: ")
    assert stored_tables.filled(page) == text, "run scripts/pages tables"


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_stored_tables_are_of_the_version_that_they_claim(path):
    origin = stored_tables.read(path).origin
    version = origin["clsas"]
    assert re.search(
        rf"^## {re.escape(version)}\b", (DOCS / "changelog.md").read_text(), re.MULTILINE
    )
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", origin["date"])
    assert re.fullmatch(r"[0-9a-f]{7}( changed)?(, [0-9a-f]{7})*", origin["commit"])
    for commit in re.findall(r"[0-9a-f]{7}", origin["commit"]):
        done = subprocess.run(
            ["git", "-C", ROOT, "show", f"{commit}:pyproject.toml"], capture_output=True, text=True
        )
        if done.returncode == 0:  # in a clone with its history
            assert tomllib.loads(done.stdout)["project"]["version"] == version


def test_every_stored_table_is_shown_once():
    shown = [
        (page.parent / link).resolve()
        for page in PAGES
        for _, link, _ in stored_tables.SHOWN.findall(page.read_text())
    ]
    assert sorted(shown) == STORED


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_files_and_names_that_pages_mention_exist(page):
    text = page.read_text()
    for path in re.findall(r"`((?:tests|scripts|clsas|docs)/[\w./]+)`", text):
        assert (ROOT / path).exists() or path == "clsas/cl", path  # which wheels hold
    for name in re.findall(r"\bclsas(?:\.\w+)+", text):
        assert is_there(name), name


def is_there(name):
    """Whether a dotted name is a module, or what a module holds."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        try:
            for part in parts[count:]:
                found = getattr(found, part)
        except AttributeError:
            return False
        return True
    return False


def test_the_index_of_the_thesis_is_complete():
    text = (DOCS / "thesis-index.md").read_text()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ")][2:]
    assert {row[3].strip() for row in rows} == {"done", "differs", "left out"}
    listed = {"equation": set(), "figure": set(), "table": set()}
    for row in rows:
        for kind, numbers in re.findall(r"(equation|figure|table)s? ([\d, to]*\d)", row[0]):
            for first, last in re.findall(r"(\d+)(?: to (\d+))?", numbers):
                listed[kind] |= set(range(int(first), int(last or first) + 1))
    for kind, last in {"equation": 45, "figure": 45, "table": 8}.items():
        assert listed[kind] == set(range(1, last + 1)), kind
    assert sum(row[0].strip() == "future work" for row in rows) == 5
