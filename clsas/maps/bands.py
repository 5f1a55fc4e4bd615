"""Bands of rasters: what their numbers mean, and how numbers of several pixels become one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.maps.sources import Source
from clsas.mosaics.means import block_sums


@dataclass(frozen=True, eq=False)
class Band:
    """Numbers of the pixels of a grid, which are read window by window.

    Means leave out pixels without data: amplitudes of 0, and other numbers that are NaN.

    Attributes
    ----------
    name : str
        What the numbers are, such as "Height".
    unit : str
        Their unit; "" for numbers without one, and for amplitudes.
    read : callable
        Called as read(rows, columns) with two slices; returns the numbers of a window of the grid.
    is_amplitude : bool
        True for amplitudes or complex pixels, whose mean is that of their power, and which
        `Encoding` turns into pixels of a file. Other numbers are averaged and written as they are.
    is_deviation : bool
        True for standard deviations, whose squares are averaged. The result is that of the height
        of one pixel. The mean of several heights deviates less.
    """

    name: str
    unit: str
    read: Callable[[slice, slice], NDArray]
    is_amplitude: bool = False
    is_deviation: bool = False

    @property
    def no_data(self) -> float:
        """Number of pixels without data."""
        return 0.0 if self.is_amplitude else math.nan

    def summands(self, values: NDArray) -> NDArray[np.float64]:
        """Return what a mean adds up, such as power or squared deviations; NaN without data."""
        if self.is_amplitude:
            return np.where(values != 0, np.abs(values).astype(np.float64) ** 2, math.nan)
        numbers = values.real.astype(np.float64)
        return np.square(numbers) if self.is_deviation else numbers

    def means(self, summands: NDArray[np.float64], count: int, least: float) -> NDArray[np.float32]:
        """Return means over blocks of `count` x `count`, of `least` or more that have data."""
        known = ~np.isnan(summands)
        total = block_sums(np.where(known, summands, 0.0), count, count)
        weight = block_sums(known.astype(np.uint16), count, count)
        mean = np.divide(
            total, weight, out=np.full_like(total, self.no_data), where=weight >= least
        )
        is_square = self.is_amplitude or self.is_deviation
        return (np.sqrt(mean) if is_square else mean).astype(np.float32)

    def halved(self, values: NDArray) -> NDArray[np.float32]:
        """Return the means of 2 x 2 pixels, of those that have data."""
        return self.means(self.summands(values), 2, 1)


def bands_of(source: Source, kind: str) -> tuple[Band, ...]:
    """Return the bands of a raster that shows a source.

    Parameters
    ----------
    source : Source
        An image on a plane or height map, a mosaic, or heights.
    kind : str
        One of `clsas.maps.encoding.KINDS`: pixels of the amplitude. 8-bit levels stand alone,
        without the heights of a height map. Heights have no amplitude.
    """
    if source.has_heights:
        height, deviation, coherence = (
            partial(source.read_layer, name) for name in ("height_m", "sd_m", "coherence")
        )
        return (
            _height(source.grid, height),
            Band("Standard deviation", "m", deviation, is_deviation=True),
            Band("Coherence", "", coherence),
        )

    def amplitude(rows: slice, columns: slice) -> NDArray[np.float32]:
        return np.abs(source.read(rows, columns))

    read = source.read if kind == "complex" else amplitude
    bands = (Band("Amplitude", "", read, is_amplitude=True),)
    if source.grid.height_m is None or kind == "8bit":
        return bands
    height_m = source.grid.height_m
    return (*bands, _height(source.grid, lambda rows, columns: height_m[rows, columns]))


def _height(grid: Grid, above_m: Callable[[slice, slice], NDArray]) -> Band:
    """Return the band of heights above the plane of a grid, on the vertical axis of the map."""
    origin_m, *steps_m = grid.vectors_m
    place = grid.georeference
    first_m = (origin_m if place is None else place.to_map(origin_m))[2]
    down_m, right_m = (step[2] * np.arange(n) for step, n in zip(steps_m, grid.shape, strict=True))

    def read(rows: slice, columns: slice) -> NDArray[np.float64]:
        plane_m = first_m + np.add.outer(down_m[rows], right_m[columns])
        return plane_m + above_m(rows, columns)

    return Band("Height", "m", read)
