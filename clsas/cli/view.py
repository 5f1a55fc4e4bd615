"""Command that shows an image or a mosaic in a browser: view."""

from __future__ import annotations

import shutil
import tempfile
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import check_levels, load
from clsas.cli.outputs import printable, progress_bar, report, warn
from clsas.cli.parameters import File, keep_out, need_matplotlib
from clsas.cli.wording import command
from clsas.maps import viewer


class Folder(File):
    """A folder for a viewer, which is checked before any work."""

    written = True

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if a viewer cannot be written there."""
        path = super().convert(value, param, ctx)
        try:
            viewer.check_folder(path)
        except OSError as error:
            self.fail(str(error), param, ctx)
        return path


@command()
@click.argument("source", metavar="INPUT", type=File(exists=True))
@click.argument("folder", metavar="[FOLDER]", required=False, type=Folder())
@click.option(
    "--against", metavar="OTHER", type=File(exists=True),
    help="Second image or mosaic on the same grid, to blink or swipe against the first.",
)  # fmt: skip
@options.dynamic_range
@options.colour_map
@click.option("--no-open", is_flag=True, help="Only write FOLDER, and open no browser.")
@options.as_json
def view(
    source: Path,
    folder: Path | None,
    against: Path | None,
    levels: dict[str, Any],
    no_open: bool,
    as_json: bool,
) -> None:
    """Show an image or a mosaic in a browser.

    INPUT is an image in HDF5 or the Zarr store of a mosaic, which may be larger than memory. It is
    written to FOLDER as a page that pans, zooms, changes levels and colours, and measures
    distances. The folder needs neither a server nor a network, and can be copied to others: they
    open the file index.html in it. Without FOLDER, the page goes to a temporary folder.

    \b
    Example:  clsas view exact.h5 --against image.h5
    """
    if no_open and folder is None:
        raise click.UsageError("--no-open requires FOLDER")
    need_matplotlib()
    check_levels(levels)
    paths = [source] if against is None else [source, against]
    for path in paths:
        if path.is_dir():
            keep_out("FOLDER", folder, "the store", path)
    sources = [
        clsas.Store.opened(path) if path.is_dir() else load(path, clsas.Image) for path in paths
    ]
    start = time.perf_counter()
    with _destination(folder) as made, progress_bar("writing tiles") as progress:
        viewer.write(
            sources[0],
            made,
            against=sources[1] if against is not None else None,
            names=[printable(path.resolve().name) for path in paths],
            progress=progress,
            **levels,
        )
    seconds = time.perf_counter() - start
    page, size_bytes = made / viewer.PAGE, size_of(made)
    report(
        as_json,
        f"{printable(page)}: {size_bytes / 1e6:.3g} MB in {seconds:.2f} s",
        file=page, bytes=size_bytes, seconds=seconds,
    )  # fmt: skip
    if not no_open and not webbrowser.open(page.resolve().as_uri()):
        warn("no browser was found: open the page yourself")


def size_of(folder: Path) -> int:
    """Return the bytes of all files in a folder."""
    return sum(each.stat().st_size for each in folder.rglob("*.*"))


@contextmanager
def _destination(folder: Path | None) -> Iterator[Path]:
    """Yield a given folder, or a new temporary one that is removed if writing fails."""
    if folder is not None:
        yield folder
        return
    temporary = Path(tempfile.mkdtemp(prefix="clsas-view-"))
    try:
        yield temporary / "viewer"
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
