"""The viewer: a folder that shows an image or a mosaic in any browser, without a server."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing_folder
from clsas.engine.data.decibels import DYNAMIC_RANGE, largest_amplitude
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.maps.frames import Frame, fitted_degrees, geographic_of, steps_of
from clsas.maps.sources import Source
from clsas.maps.tiles import BRIGHTEST, SIDE, STEP_DB, Pyramid, Quantization, factors_of
from clsas.mosaics.store import Store
from clsas.plot.canvas import COLOUR_MAP, DYNAMIC_RANGE_DB
from clsas.plot.canvas import colour_map as colours_of

PAGE = "index.html"
"""File in the folder of a viewer that a browser opens."""

_SCENE = "scene.js"
_START = "window.clsasScene = "  # of that file, by which folders of viewers are recognized
_SCRIPTS = ("geometry", "view", "tiles", "marks", "controls", "events")
_FILES = (PAGE, "viewer.css", *(f"{name}.js" for name in _SCRIPTS))
_COLOURS = ("inferno", "sonar", "gray")
_ADDED = {".DS_Store", "Thumbs.db", "desktop.ini"}  # by file browsers, which show folders
_SAME = 1e-6  # of a pixel, by which positions of two images may differ


def write(
    source: Image | Store,
    folder: str | os.PathLike,
    *,
    against: Image | Store | None = None,
    names: Sequence[str] = ("image", "other image"),
    dynamic_range_db: float | None = None,
    colour_map: str | None = None,
    georeference: Georeference | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> None:
    """Write a folder that shows an image or a mosaic in a browser.

    The file ``index.html`` in it opens by double click, without a server and without a network.
    The folder needs nothing outside of it, and can be copied. A mosaic is read patch by patch and
    may be larger than memory.

    Parameters
    ----------
    source : Image or Store
        Image on a plane or height map, or mosaic. A mosaic need not be finished.
    folder : path-like
        Folder to write, whose parent must exist. It must be new, empty, or an earlier viewer, which
        is replaced at the end.
    against : Image or Store, optional
        Second image on the same grid, to blink or swipe against the first. If only one of both has
        a georeference, it counts for both.
    names : sequence of str
        Names of the images, for the page.
    dynamic_range_db : float, optional
        Dynamic range that is shown at first, dB; by default 60. The page can change it.
    colour_map : str, optional
        Colours that are shown at first, as for `clsas.plot.image`; by default "inferno".
    georeference : Georeference, optional
        Where the images lie on Earth, if they have no georeference of their own.
    progress : callable, optional
        Called as progress(done, total) while pixels are read.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, an image is on points, the two
        images have different grids or georeferences, or a mosaic is damaged or changes meanwhile.
    FileExistsError
        If the folder contains anything but a viewer.
    ImportError
        If Matplotlib is not installed (extra `plot`), or an image has a georeference and pyproj is
        not installed (extra `maps`).
    OSError
        If the folder cannot be written, for example on a full disk. Nothing is then written.

    Notes
    -----
    Levels are 8-bit numbers in steps of 0.4 dB below the largest amplitude of both images. Coarser
    tiles are means of power, so that speckle and faint shadows look the same at every scale.
    """
    sources = [source] if against is None else [source, against]
    for name, each in zip(("source", "against"), sources, strict=False):
        validate.instance(name, each, Image, Store)
    folder = validate.path("folder", folder)
    names = validate.entries("names", names, "names of the images")[: len(sources)]
    names = [validate.text("every entry of names", name) for name in names]
    if len(names) < len(sources):
        raise ArgumentError("names", f"have {len(sources)} entries", str(len(names)))
    range_db = DYNAMIC_RANGE_DB
    if dynamic_range_db is not None:
        range_db = DYNAMIC_RANGE.check("dynamic_range_db", dynamic_range_db)
    colour_map = COLOUR_MAP if colour_map is None else validate.text("colour_map", colour_map)
    tables = {name: _table(name) for name in dict.fromkeys((colour_map, *_COLOURS))}
    validate.instance("georeference", georeference, Georeference, type(None))
    validate.progress(progress)
    readers = [Source.of(each, georeference) for each in sources]
    grids = [reader.grid for reader in readers]
    _check_grids(grids)
    check_folder(folder)

    report = _Progress(2 * sum(prod(reader.counts) for reader in readers), progress)
    reference = max(_largest(reader, report) for reader in readers) or 1.0
    quantization = Quantization(reference, max(STEP_DB, range_db / (BRIGHTEST - 1)))
    formed = [None if reader.image is None else reader.image.formed for reader in readers]
    described = ["" if each is None else each.describe() for each in formed]
    scene = {"names": names, "formed": described, "range_db": range_db, "colours": tables}
    known = next((grid for grid in grids if grid.georeference is not None), grids[0])
    sides_m = tuple(float(np.linalg.norm(step)) for step in steps_of(known))
    factors = factors_of(readers[0].shape, (sides_m[0], sides_m[1]))
    scene |= _described(readers[0].shape, known, quantization, factors)
    scene |= {"patches": _patches(readers[0])}
    with replacing_folder(folder) as made:
        for name in _FILES:
            (made / name).write_bytes((resources.files("clsas.maps") / "page" / name).read_bytes())
        # Escaped to ASCII, in which no text can end the script.
        (made / _SCENE).write_text(f"{_START}{json.dumps(scene, allow_nan=False)};\n")
        for index, reader in enumerate(readers):
            tiles = made / "tiles" / str(index)
            pyramid = Pyramid(reader.shape, quantization, tiles, str(index), factors)
            for rows, columns in report.through(reader):
                pyramid.add(rows, columns, reader.read(rows, columns))
        for name, reader in zip(("source", "against"), readers, strict=False):
            reader.check_unchanged(name)


def check_folder(folder: Path) -> None:
    """Raise an error unless a viewer may be written to a folder.

    Raises
    ------
    FileExistsError
        If the folder contains anything but a viewer, or is a file.
    FileNotFoundError
        If its parent does not exist.
    OSError
        If the folder cannot be renamed, or its parent cannot be written.
    """
    parent = folder.absolute().parent
    if not parent.is_dir():
        raise FileNotFoundError(f"cannot write {folder}: there is no folder {folder.parent}")
    current = Path.cwd().is_relative_to(os.path.realpath(folder))
    if current or os.path.ismount(folder) or folder.name == "..":
        raise OSError(
            f"cannot write the folder {folder}: the current folder, those above it and mount "
            "points cannot be renamed; choose a new folder"
        )
    try:
        exists = _exists(folder)
        with tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise type(error)(f"{folder} cannot be written: {error.strerror}") from error
    if not exists:
        return
    if not folder.is_dir() or folder.is_symlink():
        raise FileExistsError(f"cannot write the folder {folder}: it is a file or a link")
    if _names_in(folder) and not is_viewer(folder):
        raise FileExistsError(
            f"cannot write the folder {folder}: it contains files, and is no viewer of clsas; "
            "choose a new folder"
        )


def _exists(path: Path) -> bool:
    """Return whether there is a file, folder or link; raise OSError for too long a name."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True


def _names_in(folder: Path) -> set[str]:
    """Return the names in a folder, except those that file browsers add."""
    return {each.name for each in folder.iterdir()} - _ADDED


def is_viewer(folder: Path) -> bool:
    """Return whether a folder contains a viewer of clsas and nothing else.

    Files that file browsers add do not count.
    """
    if _names_in(folder) != {*_FILES, _SCENE, "tiles"}:
        return False
    with (folder / _SCENE).open(encoding="ascii", errors="replace") as file:
        return file.read(len(_START)) == _START


class _Progress:
    """Counts the windows that have been read."""

    def __init__(self, total: int, progress: Callable[[int, int], object] | None) -> None:
        self._done, self._total, self._progress = 0, total, progress

    def through(self, reader: Source) -> Iterator[tuple[slice, slice]]:
        """Yield the windows of a source, and report each after it has been read."""
        for window in reader.windows():
            yield window
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, self._total)


def _largest(reader: Source, report: _Progress) -> float:
    """Return the largest amplitude of an image."""
    most = 0.0
    for rows, columns in report.through(reader):
        most = max(most, largest_amplitude(reader.read(rows, columns)))
    return most


def _check_grids(grids: Sequence[Grid]) -> None:
    """Raise ValueError for grids that the page cannot show, or not on top of each other."""
    for name, grid in zip(("source", "against"), grids, strict=False):
        if grid.points_m is not None:
            raise ArgumentError(name, "be on a plane or height map for the viewer", "points")
    if len(grids) < 2:
        return
    one, other = grids
    steps_m = min(float(np.linalg.norm(step)) for step in steps_of(one))
    most_m = max(
        float(np.abs(mine - theirs).max()) * count
        for mine, theirs, count in zip(one.vectors_m, other.vectors_m, (1, *one.shape), strict=True)
    )
    if one.shape != other.shape or most_m > _SAME * steps_m:
        allowed = f"be on the grid of `source`, {one}"
        raise ArgumentError("against", allowed, str(other), "form it on that grid")
    places = [grid.georeference for grid in grids]
    if None not in places and places[0] != places[1]:
        allowed = f"have the georeference of `source`, {places[0]}"
        raise ArgumentError("against", allowed, str(places[1]), "form both with the same one")


def _described(
    shape: tuple[int, int],
    grid: Grid,
    quantization: Quantization,
    factors: dict[int, tuple[int, int]],
) -> dict[str, Any]:
    """Return what the page needs to know of a grid and of the tiles."""
    to_geographic = geographic_of(grid)
    return {
        "version": __version__,
        "shape": shape,
        "side": SIDE,
        "scales": [min(factors), max(factors)],
        "factors": list(factors.values()),
        "reference": quantization.reference,
        "step_db": quantization.step_db,
        "frame": Frame.of(grid).describe(grid),
        "geographic": None if to_geographic is None else fitted_degrees(grid, to_geographic),
    }


def _patches(source: Source) -> list[list[Any]]:
    """Return [first row, first column, rows, columns, predicted error (dB), words] of patches.

    An image has none.
    """
    if source.store is None:
        return []
    found: list[list[Any]] = []
    for index, window in zip(product(*map(range, source.counts)), source.windows(), strict=True):
        place = [part.start for part in window] + [part.stop - part.start for part in window]
        record = source.records.get((index[0], index[1]))
        if record is None:
            found.append([*place, None, "not formed yet"])
            continue
        error_db = record.predicted_error_db
        rounded = None if error_db is None else round(error_db, 1)
        found.append([*place, rounded, "; ".join(record.flags)])
    return found


def _table(name: str) -> str:
    """Return the 256 colours of a colour map as hexadecimal digits, six for each colour."""
    colours = colours_of(name)(np.arange(256), bytes=True)
    return np.asarray(colours)[:, :3].astype(np.uint8).tobytes().hex()
