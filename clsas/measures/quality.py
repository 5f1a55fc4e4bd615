"""Image quality: position, resolution and side lobes of points, and the level of dark parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.decibels import in_db
from clsas.engine.data.declared import Number, check_declared
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Axis, Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import darkest_pixels
from clsas.engine.data.validate import ArgumentError

_SEARCH = 10  # pixels around the given position in which the peak is searched
_REACH = 1024  # most pixels on either side of the peak that are measured
_LOBES = 10  # side lobes on each side that count in the ISLR
_UPSAMPLING = 32  # points of a cut per pixel

DARKEST = 0.1
"""Default share of the pixels that count as dark."""


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
    pixels = around.astype(np.complex128)
    at_row, at_column = peak_row - top, peak_column - left

    # Shift the spectrum of the point to zero frequency.
    main_lobe = pixels[at_row - 1 : at_row + 2, at_column - 1 : at_column + 2]
    row_turn = np.angle(np.vdot(main_lobe[:-1], main_lobe[1:]))
    column_turn = np.angle(np.vdot(main_lobe[:, :-1], main_lobe[:, 1:]))
    down, right = np.ogrid[: pixels.shape[0], : pixels.shape[1]]
    pixels *= np.exp(-1j * (row_turn * down + column_turn * right))

    # Zoom in on the peak of the interpolated image.
    row, column, zoom = float(at_row), float(at_column), np.arange(-16, 17)
    for step in (1 / 16, 1 / 256, 1 / 4096):
        rows, columns = row + step * zoom, column + step * zoom
        closer = np.abs(_sinc(rows, pixels.shape[0]) @ pixels @ _sinc(columns, pixels.shape[1]).T)
        i, j = np.unravel_index(closer.argmax(), closer.shape)
        row, column = float(rows[i]), float(columns[j])
    amplitude = float(closer[i, j])

    # Its height is that of the nearest pixel.
    origin_m, row_step_m, column_step_m = image.grid.vectors_m
    x_m, y_m, z_m = origin_m + (top + row) * row_step_m + (left + column) * column_step_m
    if image.grid.height_m is not None:
        z_m += image.grid.height_m[round(top + row), round(left + column)]
    along_columns = _sinc([row], pixels.shape[0])[0] @ pixels
    along_rows = pixels @ _sinc([column], pixels.shape[1])[0]
    response = PointResponse(
        x_m=float(x_m),
        y_m=float(y_m),
        z_m=float(z_m),
        amplitude=amplitude,
        azimuth=measure_cut(across, along_columns, column, amplitude, extent_m),
        range=measure_cut(upward, along_rows, row, amplitude, extent_m),
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


def _sinc(positions: ArrayLike, count: int) -> NDArray:
    """Return the weights [positions, count] that evaluate `count` samples between them."""
    return np.sinc(np.asarray(positions)[:, None] - np.arange(count))


def measure_cut(
    axis: Axis,
    samples: NDArray,
    peak: float,
    amplitude: float,
    extent_m: float | None,
) -> Cut:
    """Return the cut of a line of pixels through a peak.

    Parameters
    ----------
    axis : Axis
        Axis along which the pixels lie.
    samples : complex128 [pixels]
    peak : float
        Index of the peak, between pixels.
    amplitude : float
        Amplitude of the peak.
    extent_m : float or None
        Distance from the peak at which the cut ends, in metres; None for that of the last pixel.
    """
    from scipy import signal  # slow to import

    step_m = axis.step_m
    fine = signal.resample(samples, _UPSAMPLING * len(samples))
    offset = (np.arange(len(fine)) / _UPSAMPLING - peak) * step_m
    # Beyond the last sample, the periodic interpolation returns to the first one.
    inside = np.arange(len(fine)) <= _UPSAMPLING * (len(samples) - 1)
    if extent_m is not None:
        inside &= np.abs(offset) <= extent_m
    power = np.abs(fine[inside] / amplitude) ** 2
    offset = offset[inside]
    if step_m < 0:
        offset, power = offset[::-1], power[::-1]

    # Both flanks begin with the peak, and are measured outwards.
    top = int(np.abs(offset).argmin())
    half_widths, nearest_db, highest_db, lobes = [], [], [], []
    main = -float(power[top])
    side_lobes = 0.0
    for side, flank in (("smaller", power[top::-1]), ("larger", power[top:])):
        minima = signal.argrelmin(flank)[0]
        if len(minima) < 2 or flank[: minima[0] + 1].min() > 0.5:
            raise ArgumentError(
                "image",
                f"contain a whole side lobe at {side} {axis.name} (within `extent_m`)",
                hint="choose a larger image or `extent_m`; the point is too close to the border, "
                "or the peak does not belong to a point",
            )
        first, second, last = minima[0], minima[1], minima[: _LOBES + 1][-1]
        below = int(np.argmax(flank < 0.5))
        beyond = (0.5 - flank[below]) / (flank[below - 1] - flank[below])
        half_widths.append(float(below - beyond))
        main += float(flank[:first].sum())
        side_lobes += float(flank[first:last].sum())
        nearest_db.append(in_db(flank[first:second].max()))
        highest_db.append(in_db(flank[first:].max()))
        lobes.append(min(len(minima), _LOBES + 1) - 1)
    return Cut(
        axis=axis.name,
        offset_m=offset,
        level_db=in_db(power),
        resolution_m=sum(half_widths) * abs(step_m) / _UPSAMPLING,
        pslr_nearest_db=(nearest_db[0], nearest_db[1]),
        pslr_db=(highest_db[0], highest_db[1]),
        islr_db=in_db(side_lobes / main),
        lobes=(lobes[0], lobes[1]),
    )


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


@dataclass(frozen=True, eq=False)
class Cut:
    """Cut through a point response along one axis, with its resolution and side lobes.

    The main lobe lies between the first minima on both sides. Side lobes follow outwards, each
    between two minima of the amplitude. The first value of a pair is for the side of smaller
    coordinates, the second for that of larger ones.

    Attributes
    ----------
    axis : str
        Direction of the cut: "x", "y" or "z", or "along columns" or "along rows" if it is parallel
        to none of them.
    offset_m : ndarray of float64, shape [points]
        Distance from the peak in metres.
    level_db : ndarray of float64, shape [points]
        Amplitude relative to the peak, in dB.
    resolution_m : float
        Width of the main lobe at half the power of the peak (-3.01 dB), in metres.
    pslr_nearest_db : (float, float)
        Peak of the first side lobe relative to that of the main lobe, in dB.
    pslr_db : (float, float)
        Peak of the highest side lobe within the cut, relative to that of the main lobe, in dB.
    islr_db : float
        Energy of the nearest side lobes on both sides relative to that of the main lobe, in dB.
    lobes : (int, int)
        Number of whole side lobes in the ISLR: 10, or fewer if the cut ends before.
    """

    axis: str
    offset_m: NDArray[np.float64]
    level_db: NDArray[np.float64]
    resolution_m: float
    pslr_nearest_db: tuple[float, float]
    pslr_db: tuple[float, float]
    islr_db: float
    lobes: tuple[int, int]

    __repr__ = reprs.of_fields


def dark_level_db(image: Image | ArrayLike, *, darkest: float = DARKEST) -> float:
    """Return the rms of the darkest pixels of an image relative to the whole image, in dB.

    Parameters
    ----------
    image : Image or array_like
        Complex pixels, not all of them zero. Pixels that are zero do not count.
    darkest : float
        Share of the pixels that count as dark, above 0 and up to 1; see
        `clsas.engine.data.image_error.darkest_pixels`.

    Returns
    -------
    float
        Level in dB; 0 or less.

    Raises
    ------
    TypeError, ValueError
        If `darkest` is out of bounds, a pixel is not finite, or the image is zero everywhere.

    Examples
    --------
    >>> from clsas.measures.quality import dark_level_db
    >>> round(dark_level_db([1, 10, 10, 10j], darkest=0.25), 1)
    -18.8
    """
    values = np.asanyarray(image.pixels if isinstance(image, Image) else image)
    values = validate.array("image", values, np.complex128, (None,) * max(values.ndim, 1))
    chosen = darkest_pixels(values, darkest)
    amplitude = np.abs(values) / np.abs(values).max()  # whose squares neither overflow nor vanish
    mean, dark = (np.mean(each**2) for each in (amplitude[values != 0], amplitude[chosen]))
    return float(10 * np.log10(dark / mean))
