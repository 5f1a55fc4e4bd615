"""Image quality: position, resolution and side lobes of point responses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Number, check_declared
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Axis, Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.measures.cuts import Cut, measure_cut

_SEARCH = 10  # pixels around the given position in which the peak is searched
_REACH = 1024  # most pixels on either side of the peak that are measured


@dataclass(frozen=True, eq=False)
class PointResponse:
    """Response of a point in an image, as returned by `clsas.measure_point`.

    Attributes
    ----------
    x_m, y_m, z_m : float
        Position of the peak in metres.
    amplitude : float
        Amplitude of the peak. Its phase is not known between pixels, which alias the range carrier.
    azimuth, range : Cut
        Cuts through the peak along the columns and rows of the image: x and y of a horizontal
        plane, x and z of a vertical one.
    georeference : Georeference or None
        Where the image lies on Earth; its `to_geographic` takes the position.
    """

    x_m: float
    y_m: float
    z_m: float
    amplitude: float
    azimuth: Cut
    range: Cut
    georeference: Georeference | None = None

    def __repr__(self) -> str:
        """Return a summary: position and amplitude of the peak, and the resolutions."""
        position = zip("xyz", (self.x_m, self.y_m, self.z_m), strict=True)
        return reprs.summary(
            self,
            *(f"{name} {value:.7g} m" for name, value in position),
            f"amplitude {self.amplitude:.4g}",
            f"azimuth resolution {reprs.quantity(self.azimuth.resolution_m, 'm')}",
            f"range resolution {reprs.quantity(self.range.resolution_m, 'm')}",
        )


def measure_point(
    image: Image,
    near: Sequence[float],
    *,
    search_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            most=validate.FARTHEST_M,
            help="Largest distance of the peak from the position.",
        ),
    ] = None,
    extent_m: Annotated[
        float | None,
        Number("m", above=0.0, help="Distance from the peak within which side lobes count."),
    ] = None,
) -> PointResponse:
    """Return the response of a point in an image: its position, resolution and side lobes.

    Parameters
    ----------
    image : Image
        Image on a plane of any direction or a height map. Its pixels must be small enough to sample
        the bandwidth (at most 1 / bandwidth apart), but need not sample the carrier.
    near : (float, float) or (float, float, float)
        Approximate position of the point in metres. Two numbers are coordinates on the axes of the
        image (`Grid.sides`), as pictures show them: x and y of a horizontal plane, x and z of a
        vertical one. Three numbers are a position x, y, z, which is projected onto the plane.
    search_m : float, optional
        Distance from `near`, along columns and along rows, within which the largest pixel is
        searched, in metres; by default 10 pixels.
    extent_m : float, optional
        Distance from the peak up to which side lobes count, in metres, in order to exclude other
        targets; by default up to the border of the image, but at most 1024 pixels.

    Returns
    -------
    PointResponse

    Raises
    ------
    ValueError
        If the image has arbitrary points or is zero near the point; if `near` is outside the image;
        if there is no peak, or the peak is at the border; if `extent_m` is less than a pixel, or
        too small for the main lobe and a side lobe on each side.
    TypeError
        If an argument has the wrong type.

    Warns
    -----
    ClsasWarning
        If a side lobe is higher than the peak. The peak is then itself a side lobe, or there are
        other targets.

    See Also
    --------
    plot.cuts : Draw the cuts.

    Notes
    -----
    The pixels of a point have the phase exp(j 2 k rho(x)), which wraps from pixel to pixel if these
    are larger than a quarter of a wavelength. The spectrum of the image may therefore lie anywhere,
    even across the edge of an FFT's band. The phase step between pixels of the main lobe gives the
    centre of the spectrum modulo the sampling. Once this carrier is removed, sinc interpolation is
    exact.

    Examples
    --------
    A point whose image is a product of two sinc functions, whose first zeros are 20 mm from the
    peak along x and 40 mm along y. The resolution is 0.886 times these distances:

    >>> import clsas
    >>> import numpy as np
    >>> grid = clsas.Grid.plane(x=(0.0, 2.0, 201), y=(40.0, 41.5, 151))
    >>> x, y = grid.axes_m
    >>> pixels = np.outer(np.sinc((y - 40.6) / 0.04), np.sinc((x - 0.803) / 0.02)) + 0j
    >>> point = clsas.measure_point(clsas.Image(pixels, grid), near=(0.8, 40.6))
    >>> print(f"x = {point.x_m:.3f} m, resolution {point.azimuth.resolution_m:.4f} m")
    x = 0.803 m, resolution 0.0177 m
    """
    validate.instance("image", image, Image)
    across, upward = axes = image.grid.sides
    for axis in axes:
        if len(axis.places_m) < 3:
            side = axis.name.removeprefix("along ")
            allowed = f"have 3 or more pixels along {side}"
            raise ArgumentError("image", allowed, len(axis.places_m))
    dx, dy = across.step_m, upward.step_m
    if extent_m is not None:
        validate.number("extent_m", extent_m, "m", least=max(abs(dx), abs(dy)))
    near_m = on_axes(image.grid, axes, near)
    peak_row, peak_column = _find_peak(image.pixels, axes, near_m, search_m)

    top, left = max(peak_row - _REACH, 0), max(peak_column - _REACH, 0)
    around = image.pixels[top : peak_row + _REACH + 1, left : peak_column + _REACH + 1]
    pixels = _without_carrier(around.astype(np.complex128), peak_row - top, peak_column - left)
    row, column, amplitude = _refine_peak(pixels, peak_row - top, peak_column - left)

    along_x = _sinc([row], pixels.shape[0])[0] @ pixels
    along_y = pixels @ _sinc([column], pixels.shape[1])[0]
    x_m, y_m, z_m = _position_m(image.grid, top + row, left + column)
    response = PointResponse(
        x_m=x_m,
        y_m=y_m,
        z_m=z_m,
        amplitude=amplitude,
        azimuth=measure_cut(across, along_x, column, amplitude, extent_m),
        range=measure_cut(upward, along_y, row, amplitude, extent_m),
        georeference=image.georeference,
    )
    highest_db = max(*response.azimuth.pslr_db, *response.range.pslr_db)
    if highest_db > 0:
        validate.warn(
            f"the peak near ({near_m[0]:.9g}, {near_m[1]:.9g}) m is {highest_db:.1f} dB lower than "
            "a side lobe of it: give a position closer to the point or a larger `search_m`, or "
            "exclude other targets with `extent_m`"
        )
    return response


def _find_peak(
    pixels: NDArray,
    axes: tuple[Axis, Axis],
    near_m: NDArray[np.float64],
    search_m: float | None,
) -> tuple[int, int]:
    """Return row and column of the largest pixel near coordinates on the axes."""
    if search_m is not None:
        check_declared(measure_point, {"search_m": search_m})
    windows = []
    for axis, at in zip(axes, near_m, strict=True):
        count, index = len(axis.places_m), (at - axis.places_m[0]) / axis.step_m
        if not -0.5 <= index <= count - 0.5:
            ends = sorted((axis.places_m[0], axis.places_m[-1]))
            allowed = f"be inside the image, {axis.name} from {ends[0]:g} to {ends[1]:g} m"
            raise ArgumentError("near", allowed, f"{at:g} m")
        search = _SEARCH if search_m is None else search_m / abs(axis.step_m)
        nearest = int(np.clip(round(index), 0, count - 1))
        first = max(math.ceil(index - search), 0)
        windows.append(slice(min(first, nearest), max(math.floor(index + search), nearest) + 1))
    columns, rows = windows
    around = f"({near_m[0]:g}, {near_m[1]:g}) m"
    amplitude = np.abs(pixels[rows, columns])
    row, column = np.unravel_index(amplitude.argmax(), amplitude.shape)
    if amplitude[row, column] == 0:
        raise ArgumentError("near", "be where the image is not zero", around)
    row, column = int(row) + rows.start, int(column) + columns.start
    for axis, index in zip(axes, (column, row), strict=True):
        if not 0 < index < len(axis.places_m) - 1:
            raise ArgumentError(
                "image",
                f"extend beyond the peak near {around}",
                f"a peak at its border, {axis.name} = {axis.places_m[index]:g} m",
            )
    if np.abs(pixels[row - 1 : row + 2, column - 1 : column + 2]).max() > np.abs(
        pixels[row, column]
    ):
        raise ArgumentError(
            "near",
            "have a peak around it",
            f"{around} with only the flank of one outside the search",
            "give a position closer to the point or a larger `search_m`",
        )
    return row, column


def on_axes(grid: Grid, axes: tuple[Axis, Axis], near: Sequence[float]) -> NDArray[np.float64]:
    """Return the coordinates on the axes, in metres, of two numbers or of a position."""
    position_m = validate.array("near", near, np.float64, None)
    if not np.all(np.abs(position_m) <= validate.FARTHEST_M):
        allowed = f"lie within {validate.FARTHEST_M:g} m of the origin"
        raise ArgumentError("near", allowed, validate.shown(near))
    if position_m.shape != (3,):
        return validate.array("near", position_m, np.float64, (2,))
    origin_m, row_step_m, column_step_m = grid.vectors_m
    steps_m = np.stack([column_step_m, row_step_m], axis=1)
    index = np.linalg.lstsq(steps_m, position_m - origin_m, rcond=None)[0]
    return np.array([a.places_m[0] + i * a.step_m for a, i in zip(axes, index, strict=True)])


def _position_m(grid: Grid, row: float, column: float) -> tuple[float, float, float]:
    """Return the position of a row and column between pixels, at the height of the nearest."""
    origin_m, row_step_m, column_step_m = grid.vectors_m
    x_m, y_m, z_m = origin_m + row * row_step_m + column * column_step_m
    height_m = 0.0 if grid.height_m is None else grid.height_m[round(row), round(column)]
    return float(x_m), float(y_m), float(z_m + height_m)


def _without_carrier(pixels: NDArray, row: int, column: int) -> NDArray:
    """Return pixels with the spectrum of the point at one of them shifted to zero frequency."""
    main_lobe = pixels[row - 1 : row + 2, column - 1 : column + 2]
    down = np.angle(np.vdot(main_lobe[:-1], main_lobe[1:]))
    across = np.angle(np.vdot(main_lobe[:, :-1], main_lobe[:, 1:]))
    rows, columns = (np.arange(n) for n in pixels.shape)
    return pixels * np.exp(-1j * (down * rows[:, None] + across * columns))


def _sinc(positions: ArrayLike, count: int) -> NDArray:
    """Return the weights [positions, count] that evaluate `count` samples between them."""
    return np.sinc(np.asarray(positions)[:, None] - np.arange(count))


def _refine_peak(pixels: NDArray, row: float, column: float) -> tuple[float, float, float]:
    """Return row, column and amplitude of the peak of the interpolated image near a pixel."""
    zoom = np.arange(-16, 17)
    for step in (1 / 16, 1 / 256, 1 / 4096):
        rows, columns = row + step * zoom, column + step * zoom
        near = np.abs(_sinc(rows, pixels.shape[0]) @ pixels @ _sinc(columns, pixels.shape[1]).T)
        i, j = np.unravel_index(near.argmax(), near.shape)
        row, column = float(rows[i]), float(columns[j])
    return row, column, float(near[i, j])
