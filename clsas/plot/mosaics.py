"""Pictures of mosaics, with or without the borders of their patches."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.plot.canvas import length_unit
from clsas.plot.levels import image_db

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from clsas.mosaics.store import Store

_MOST_PIXELS = 1024  # pixels along the longer side of an overview


def mosaic(
    store: Store | str | os.PathLike,
    *,
    most: int = _MOST_PIXELS,
    borders: bool = False,
    **options: Any,
) -> Figure:
    """Draw an overview of a mosaic in dB over metres.

    Parameters
    ----------
    store : Store or path
        The mosaic on disk.
    most : int
        Most pixels along the longer side of the overview. Each is the rms of the pixels of the
        mosaic that it covers.
    borders : bool
        True to draw the borders of the patches.
    **options
        Further arguments of `clsas.plot.image_db`.

    Raises
    ------
    ImportError
        If matplotlib or Zarr is not installed.
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, the store is damaged, or the mosaic
        has arbitrary points.
    OSError
        If the store does not exist or cannot be read.
    """
    from clsas.mosaics.store import Store

    if not isinstance(store, Store):
        store = Store.opened(validate.path("store", store))
    validate.flag("borders", borders)
    most = validate.count("most", most)
    figure = image_db(store.overview(most), **options)
    if borders and store.patch_shape is not None:
        patch_borders(figure.axes[0], store.grid, store.patch_shape)
    return figure


def patch_borders(axes: Axes, grid: Grid, patch_shape: tuple[int, int]) -> None:
    """Draw the borders between patches into axes that show an image or overview of a grid.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Axes that `clsas.plot.image` drew into.
    grid : Grid
        Grid of the whole mosaic, such as `Mosaic.grid`.
    patch_shape : (rows, columns)
        Pixels of a patch, such as `Mosaic.patch_shape`.

    Raises
    ------
    TypeError, ValueError
        If `grid` is not a plane or height map, or a side of `patch_shape` is not a positive
        integer.
    """
    from matplotlib.axes import Axes

    validate.instance("axes", axes, Axes)
    validate.instance("grid", grid, Grid)
    across, upward = grid.sides
    factor, _ = length_unit(max(float(np.abs(s.places_m).max()) for s in (across, upward)))
    rows, columns = validate.sides("patch_shape", patch_shape)
    for side, every, draw in ((across, columns, axes.axvline), (upward, rows, axes.axhline)):
        for first in range(every, len(side.places_m), every):
            place = factor * (side.places_m[first] - side.step_m / 2)
            draw(place, color="white", linewidth=0.6, alpha=0.7)
