"""The viewer: a folder that shows an image or a mosaic in any browser, without a server.

`write` reads the pixels twice: for the largest amplitude, and for tiles of 8-bit levels at every
power of two of the pixel size. The page in `clsas/maps/page` draws and colours the tiles; what it
needs to know beside them, such as how the plane lies on the screen and on Earth, is in `scene.js`.
The levels of a store are not read: those that mix patches exist only once all patches are finished,
and a viewer shows unfinished mosaics too.

A page that was opened from a disk may not read files, and may not look into pictures that it shows.
It may run scripts, so that every tile is a script that hands its levels to the page: compressed by
zlib, in base64.
"""

from __future__ import annotations

import base64
import itertools
import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.atomic import check_writable, replacing_folder
from clsas.engine.data.decibels import DYNAMIC_RANGE, largest_amplitude
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid, check_one_grid, without_heights
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.maps.georeferencing import completed_steps
from clsas.maps.sources import Source
from clsas.mosaics.document import MosaicCertificate, requested_db
from clsas.mosaics.pyramid import BRIGHTEST, block_means, covered, eight_bits
from clsas.mosaics.store import Store
from clsas.plot.canvas import COLOUR_MAP, DYNAMIC_RANGE_DB
from clsas.plot.canvas import colour_map as colours_of

PAGE = "index.html"
"""File in the folder of a viewer that a browser opens."""

SIDE = 512
"""Pixels along a side of a tile. Half as many would make four times as many files; twice as many
would take four times as long to appear."""

STEP_DB = 0.4
"""Smallest difference of neighbouring levels, dB. It errs by 0.12 dB rms, far below speckle, and
255 levels then span 101.6 dB. Half the step would make tiles of speckle larger by 18 %."""

_SCENE = "scene.js"
_START = "window.clsasScene = "  # of that file, by which folders of viewers are recognized
_SCRIPTS = ("geometry", "view", "tiles", "marks", "controls", "events")
_FILES = (PAGE, "viewer.css", *(f"{name}.js" for name in _SCRIPTS))
_COLOURS = ("inferno", "sonar", "gray")
_ADDED = {".DS_Store", "Thumbs.db", "desktop.ini"}  # by file browsers, which show folders
_FAINTEST = np.float32(1e-30)  # relative amplitude above 0 in float32, but below every level
_LEVEL = 0.5  # cosine between the normal of a plane and the vertical above which it is a map
_DEGREE = 5  # of polynomials for latitudes and longitudes
_NODES = 12  # along either side of the plane, where they are fitted
_GOOD_DEG = 1e-7  # largest error of latitudes and longitudes: 1 cm


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
    # The 256 colours of each map as hexadecimal digits, six for each colour.
    tables = {
        name: np.asarray(colours_of(name)(np.arange(256), bytes=True))[:, :3].tobytes().hex()
        for name in dict.fromkeys((colour_map, *_COLOURS))
    }
    validate.instance("georeference", georeference, Georeference, type(None))
    validate.progress(progress)
    readers = [Source.of(each, georeference) for each in sources]
    grids = [reader.grid for reader in readers]
    _check_grids(grids)
    check_folder(folder)

    done, total = itertools.count(1), 2 * sum(math.prod(reader.counts) for reader in readers)

    def windows(reader: Source) -> Iterator[tuple[slice, slice, NDArray[np.complex64]]]:
        """Yield the windows of a source with their pixels, and report each."""
        for rows, columns in reader.windows():
            yield rows, columns, reader.read(rows, columns)
            if progress is not None:
                progress(next(done), total)

    # Levels of all images are relative to the largest amplitude.
    reference = max(
        largest_amplitude(pixels) for reader in readers for _, _, pixels in windows(reader)
    )
    reference = reference or 1.0
    known = next((grid for grid in grids if grid.georeference is not None), grids[0])
    sides_m = tuple(float(np.linalg.norm(step)) for step in steps_of(known))
    factors = factors_of_scales(readers[0].shape, (sides_m[0], sides_m[1]))
    step_db = max(STEP_DB, range_db / (BRIGHTEST - 1))
    scene = {
        "names": names,
        "formed": [_formed_in_words(reader) for reader in readers],
        "range_db": range_db,
        "colours": tables,
        "version": __version__,
        "shape": readers[0].shape,
        "side": SIDE,
        "scales": [min(factors), max(factors)],
        "factors": list(factors.values()),
        "reference": reference,
        "step_db": step_db,
        "brightest": BRIGHTEST,
        "frame": frame_of(known),
        "geographic": None,
        "patches": _patches(readers[0]),
    }
    if known.georeference is not None:
        scene["geographic"] = fitted_degrees(known, known.georeference.to_geographic)
    with replacing_folder(folder) as made:
        for name in _FILES:
            (made / name).write_bytes((resources.files("clsas.maps") / "page" / name).read_bytes())
        # Escaped to ASCII, in which no text can end the script.
        (made / _SCENE).write_text(f"{_START}{json.dumps(scene, allow_nan=False)};\n")
        for index, reader in enumerate(readers):
            tiles = Tiles(made / "tiles", str(index), reader.shape, factors, reference, step_db)
            for window in windows(reader):
                tiles.add(*window)
        for name, reader in zip(("source", "against"), readers, strict=False):
            reader.check_unchanged(name)


def _formed_in_words(source: Source) -> str:
    """Return how an image was formed, or the measured error of a mosaic; "" if unknown."""
    if source.image is not None:
        return "" if source.image.formed is None else source.image.formed.describe()
    measured = MosaicCertificate.of(source.records)
    return "" if measured is None else measured.describe(requested_db(source.inputs))


def _check_grids(grids: Sequence[Grid]) -> None:
    """Raise ValueError for grids that the page cannot show, or not on top of each other."""
    for name, grid in zip(("source", "against"), grids, strict=False):
        if grid.points_m is not None:
            raise ArgumentError(name, "be on a plane or height map for the viewer", "points")
    if len(grids) == 2:  # seen from above
        check_one_grid("source and against", *map(without_heights, grids))


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
    exists = True
    try:
        try:
            folder.lstat()  # raises for too long a name
        except FileNotFoundError:
            exists = False
        check_writable(parent, folder)
    except OSError as error:
        raise type(error)(f"{folder} cannot be written: {error.strerror}") from error
    if not exists:
        return
    if not folder.is_dir() or folder.is_symlink():
        raise FileExistsError(f"cannot write the folder {folder}: it is a file or a link")
    names = {each.name for each in folder.iterdir()} - _ADDED
    is_viewer = names == {*_FILES, _SCENE, "tiles"}
    if is_viewer:
        with (folder / _SCENE).open(encoding="ascii", errors="replace") as file:
            is_viewer = file.read(len(_START)) == _START
    if names and not is_viewer:
        raise FileExistsError(
            f"cannot write the folder {folder}: it contains files, and is no viewer of clsas; "
            "choose a new folder"
        )


def steps_of(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the row step and the column step of a plane or height map, metres.

    A single row or column whose step is zero, or parallel to the other one, is as wide as the
    pixels of the other axis. A single pixel without steps has sides of 1 m.
    """
    _, row_step_m, column_step_m = grid.vectors_m
    rows, columns = grid.shape
    if not np.cross(row_step_m, column_step_m).any():
        row_step_m = row_step_m * (rows > 1 or columns == 1)
        column_step_m = column_step_m * (columns > 1)
    given_m = row_step_m, column_step_m
    length_m = max(float(np.linalg.norm(step)) for step in given_m) or 1.0
    row_step_m, column_step_m = completed_steps((rows, columns), row_step_m, column_step_m)
    # What is still missing is beside a vertical step, or there are no steps.
    row_step_m = row_step_m if row_step_m.any() else np.array([0.0, 1.0, 0.0])
    column_step_m = column_step_m if column_step_m.any() else np.array([1.0, 0.0, 0.0])
    return (
        row_step_m if given_m[0].any() else length_m * _unit(row_step_m),
        column_step_m if given_m[1].any() else length_m * _unit(column_step_m),
    )


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


def factors_of_scales(
    shape: tuple[int, int], steps_m: tuple[float, float]
) -> dict[int, tuple[int, int]]:
    """Return pixels of the image along the rows and columns of a tile's pixel, by scale.

    Scales are ascending, and the finest has the number of its level in Deep Zoom: the base 2
    logarithm of the longer side, rounded up. The coarsest scale is the largest that fits into one
    tile. From scale to scale both factors double, unless pixels are at least sqrt(2) times longer
    along one side: then only the other factor does, since rows of 1 m are not to be averaged where
    columns of 1 mm are too fine for a screen.

    Parameters
    ----------
    shape : (rows, columns)
        Shape of the image.
    steps_m : (float, float)
        Distance of its rows and of its columns.
    """
    scale, factors = math.ceil(math.log2(max(shape))), (1, 1)
    found = {scale: factors}
    while max(counts := shape_of(shape, factors)) > SIDE:
        sides_m = [factor * step for factor, step in zip(factors, steps_m, strict=True)]
        rows_finer, columns_finer = (
            count > SIDE and math.sqrt(2) * side_m < other_m
            for count, side_m, other_m in zip(counts, sides_m, sides_m[::-1], strict=True)
        )
        factors = factors[0] << (not columns_finer), factors[1] << (not rows_finer)
        scale -= 1
        found[scale] = factors
    return dict(sorted(found.items()))


def shape_of(shape: tuple[int, int], factors: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of a scale with some factors."""
    rows, columns = (math.ceil(n / factor) for n, factor in zip(shape, factors, strict=True))
    return rows, columns


def frame_of(grid: Grid) -> dict[str, list[Any]]:
    """Return how the pixels of a plane or height map lie in space and on the screen, metres.

    "axes" are the directions to the right and up on the screen: perpendicular unit vectors in the
    plane, one of which is along its rows or columns. A plane that is closer to horizontal is seen
    from above, so that it is never mirrored, and is turned by quarters until x points to the right
    as far as possible. Another plane is turned until z points up, and its other coordinate
    increases to the right.

    Positions of pixels are ``origin + row_step * row + column_step * column``, and with the prefix
    ``screen_`` the same along these axes.
    """
    row_step_m, column_step_m = steps_of(grid)
    along = _unit(column_step_m)
    across = _unit(row_step_m - (row_step_m @ along) * along)
    normal = np.cross(along, across)
    directions = [along, across, -along, -across]
    if abs(normal[2]) >= _LEVEL:
        right = max(directions, key=lambda direction: float(direction[0].round(9)))
        up = np.cross(normal * np.sign(normal[2]), right)
    else:
        up = max(directions, key=lambda direction: float(direction[2].round(9)))
        right = next(d for d in directions if abs(d @ up) < _LEVEL)
        right = right * np.sign(right[np.argmax(np.abs(right).round(9))])
    vectors = {"origin": grid.vectors_m[0], "row_step": row_step_m, "column_step": column_step_m}
    axes = np.stack([right, up])
    return {
        "axes": axes.tolist(),
        **{name: vector.tolist() for name, vector in vectors.items()},
        **{f"screen_{name}": (axes @ vector).tolist() for name, vector in vectors.items()},
    }


def fitted_degrees(
    grid: Grid, to_geographic: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, list[list[float]]] | None:
    """Return Chebyshev series of latitude and longitude over rows and columns.

    The page evaluates the series where the cursor is, without a library for map projections. Rows
    and columns from the first to the last pixel become arguments from -1 to 1; for a single one,
    these are its edges.

    Returns
    -------
    dict or None
        Coefficients [row][column] of "latitude" and "longitude", degrees. None if the series err
        by more than 1e-7 degrees (1 cm): close to a pole, or in scenes of 100 km at high latitudes.
    """
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    row, column = np.meshgrid(nodes, nodes, indexing="ij")
    origin_m, (row_step_m, column_step_m) = grid.vectors_m[0], steps_of(grid)
    rows, columns = (
        (n - 1) / 2 + max(n - 1, 1) / 2 * at
        for n, at in zip(grid.shape, (row, column), strict=True)
    )
    positions_m = origin_m + rows[..., None] * row_step_m + columns[..., None] * column_step_m
    degrees = np.asarray(to_geographic(positions_m))[..., :2].reshape(-1, 2)
    # Longitudes may jump from 180 to -180; the page takes them back into these limits.
    degrees[:, 1] = degrees[0, 1] + (degrees[:, 1] - degrees[0, 1] + 180) % 360 - 180
    series = chebyshev.chebvander2d(row.ravel(), column.ravel(), [_DEGREE, _DEGREE])
    found, *_ = np.linalg.lstsq(series, degrees, rcond=None)
    if np.abs(series @ found - degrees).max() > _GOOD_DEG:
        return None
    shape = _DEGREE + 1, _DEGREE + 1
    return {
        name: found[:, index].reshape(shape).tolist()
        for index, name in enumerate(("latitude", "longitude"))
    }


def _patches(source: Source) -> list[list[Any]]:
    """Return places of patches, predicted and measured errors (dB), and words.

    Each is [first row, first column, rows, columns, predicted, measured, words]. An image has none.
    """
    if source.store is None:
        return []
    found: list[list[Any]] = []
    for index, window in zip(
        itertools.product(*map(range, source.counts)), source.windows(), strict=True
    ):
        place = [part.start for part in window] + [part.stop - part.start for part in window]
        record = source.records.get((index[0], index[1]))
        if record is None:
            found.append([*place, None, None, "not formed yet"])
            continue
        certificate = record.certificate
        errors_db = record.predicted_error_db, None if certificate is None else certificate.error_db
        rounded = [
            round(each, 1) if each is not None and math.isfinite(each) else None
            for each in errors_db
        ]
        found.append([*place, *rounded, "; ".join(record.flags)])
    return found


class Tiles:
    """Tiles of an image at all scales, which are written as soon as all their pixels are known.

    Their amplitudes are relative to the reference, which no pixel exceeds.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        shape: tuple[int, int],
        factors: dict[int, tuple[int, int]],
        reference: float,
        step_db: float,
    ) -> None:
        """Create the folders of the tiles: folder/NAME/SCALE/COLUMN_ROW.js.

        Parameters
        ----------
        folder : Path
        name : str
            Name of the image, by which its tiles call the page.
        shape : (rows, columns)
            Shape of the image.
        factors : dict
            Scales and their factors, as `factors_of_scales` returns them.
        reference : float
            Amplitude of the brightest level.
        step_db : float
            Difference of neighbouring levels, dB.
        """
        self._folder, self._name, self._shape, self._factors = folder, name, shape, factors
        self._reference, self._step_db = reference, step_db
        # Amplitudes of tiles that lack pixels, and how many, by scale, row and column.
        self._begun: dict[tuple[int, int, int], tuple[NDArray[np.float32], int]] = {}
        for scale in factors:
            (folder / name / str(scale)).mkdir(parents=True)

    def add(self, rows: slice, columns: slice, pixels: NDArray[np.complex64]) -> None:
        """Add the pixels of a window to the tiles of all scales. Windows must not overlap."""
        # The reference itself may be too large for float32, but half of it never is.
        amplitude = np.abs(np.multiply(pixels, np.float32(0.5)))
        amplitude /= np.float32(self._reference / 2)
        np.maximum(amplitude, _FAINTEST, out=amplitude, where=pixels != 0)
        self._add(max(self._factors), rows.start, columns.start, amplitude)

    def _add(self, scale: int, top: int, left: int, amplitude: NDArray) -> None:
        """Add amplitudes at a place of a scale; finish the tiles that they complete."""
        bottom, right = top + amplitude.shape[0], left + amplitude.shape[1]
        height, width = shape_of(self._shape, self._factors[scale])
        for row, column in itertools.product(
            range(top // SIDE, (bottom - 1) // SIDE + 1),
            range(left // SIDE, (right - 1) // SIDE + 1),
        ):
            y, x = row * SIDE, column * SIDE
            tile, missing = self._begun.pop((scale, row, column), (None, 0))
            if tile is None:
                tile = np.empty((min(height - y, SIDE), min(width - x, SIDE)), np.float32)
                missing = tile.size
            first_row, last_row = max(top, y), min(bottom, y + SIDE)
            first, last = max(left, x), min(right, x + SIDE)
            part = amplitude[first_row - top : last_row - top, first - left : last - left]
            tile[first_row - y : last_row - y, first - x : last - x] = part
            if missing > part.size:
                self._begun[scale, row, column] = tile, missing - part.size
            else:
                self._finish(scale, row, column, tile)

    def _finish(self, scale: int, row: int, column: int, tile: NDArray[np.float32]) -> None:
        """Write a tile, and add its means to the next coarser scale."""
        # Speckle has no strings that repeat, and is coded by its distribution: searching for
        # strings would take three times as long for tiles 1 % larger. Z_RLE still packs constant
        # areas.
        packing = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
        packed = packing.compress(eight_bits(tile, 1.0, self._step_db).tobytes()) + packing.flush()
        place = f"{self._name}/{scale}/{column}_{row}"
        text = base64.b64encode(packed).decode()
        (self._folder / f"{place}.js").write_text(f'clsasTile("{place}","{text}");\n')
        if scale == min(self._factors):
            return
        own, coarser = self._factors[scale], self._factors[scale - 1]
        down, across = coarser[0] // own[0], coarser[1] // own[1]
        top, left = row * SIDE, column * SIDE
        weights = np.multiply.outer(
            covered(top, tile.shape[0], own[0], self._shape[0]),
            covered(left, tile.shape[1], own[1], self._shape[1]),
        )
        means = block_means("amplitude", tile, weights, down, across)
        self._add(scale - 1, top // down, left // across, means)
