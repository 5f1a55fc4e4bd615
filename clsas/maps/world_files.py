"""Pictures, and the files that place them on a map."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data.atomic import replacing
from clsas.engine.data.image import Image
from clsas.maps.georeferencing import Affine, is_vertical, warn_of_place
from clsas.plot import image_db
from clsas.plot.canvas import PADDING_IN, PNG_DPI, length_unit, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_picture(path: Path, image: Image, options: dict[str, Any]) -> None:
    """Write a picture of an image. A PNG of a georeferenced image gets two files beside it.

    A vertical plane has no place on a map, and its PNG no such files.

    These are a world file (.pgw) and GDAL's auxiliary file (.png.aux.xml), which has the coordinate
    reference system. If they cannot be written, the picture remains. Such files of an earlier
    picture are removed before.

    Raises
    ------
    ImportError
        If matplotlib is not installed, or pyproj for the coordinate reference system.
    OSError
        If a file cannot be written.
    """
    figure = image_db(image, **options)
    place, grid = image.georeference, image.grid
    has_place = place is not None and grid.points_m is None and not is_vertical(place, grid)
    if path.suffix.lower() != ".png" or place is None or not has_place:
        save(figure, path)
        return
    warn_of_place(grid)
    wkt = place.wkt()
    affine = _of_picture(figure, image)
    save(figure, path)
    a, b, c, d, e, f = affine
    # World files count from the centre of the first pixel.
    centre = c + (a + b) / 2, f + (d + e) / 2
    lines = "".join(f"{number!r}\n" for number in (a, d, b, e, *centre))
    with replacing(path.with_suffix(".pgw")) as temporary:
        temporary.write_text(lines)
    numbers = ", ".join(repr(number) for number in (c, a, b, f, d, e))
    described = (
        f"<PAMDataset>\n  <SRS>{escape(wkt, quote=False)}</SRS>\n"
        f"  <GeoTransform>{numbers}</GeoTransform>\n</PAMDataset>\n"
    )
    with replacing(path.with_name(f"{path.name}.aux.xml")) as temporary:
        temporary.write_text(described)


def _of_picture(figure: Figure, image: Image) -> Affine:
    """Return the transform from dots of the saved picture to easting and northing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(PNG_DPI)  # the layout depends on it
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # What `save` writes: the figure with its labels, and a margin.
    box = figure.get_tightbbox(canvas.get_renderer()).padded(PADDING_IN)
    left, top = box.x0 * PNG_DPI, box.y0 * PNG_DPI + int(box.height * PNG_DPI)
    dots = np.array([[left, top], [left + 1, top], [left, top - 1]])
    shown = figure.axes[0].transData.inverted().transform(dots)

    # From places on the axes of the picture to columns and rows, and on to the map.
    grid = image.grid
    assert grid.georeference is not None  # the caller has checked it
    sides = grid.sides
    factor, _ = length_unit(max(float(np.abs(side.places_m).max()) for side in sides))
    column, row = (
        (places / factor - side.places_m[0]) / (side.step_m or 1.0)
        for places, side in zip(shown.T, sides, strict=True)
    )
    a, b, c, d, e, f = grid.georeference.affine(grid)
    column, row = column + 0.5, row + 0.5
    east, north = a * column + b * row + c, d * column + e * row + f
    return (
        *(float(east[1] - east[0]), float(east[2] - east[0]), float(east[0])),
        *(float(north[1] - north[0]), float(north[2] - north[0]), float(north[0])),
    )
