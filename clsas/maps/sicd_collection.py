"""The range lines of an image as SICD describes them: track, times and spatial frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial, polynomial
from numpy.typing import NDArray

from clsas.engine.data.georeference import Georeference
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.maps.collection import Collection
from clsas.maps.sicd_raster import Raster, ecf_m
from clsas.measures.resolution import half_power_width

# Pixels along either side of the grid to which polynomials are fitted, and their highest order:
# plain choices, with two pixels per coefficient.
_PIXELS, _HIGHEST = 9, 4
_HIGHEST_OF_TRACK = 9  # a circle to 1e-4 of its radius
# Deviation of the polynomials from the track over the distance to the scene. Programs find the
# direction of layover by them, which it changes by as many radians.
_DEVIATION = 1e-3
_BINS = 1024  # of a spectrum; twice as many change its width at half power by 1e-4 at most
_TIME, _FREQUENCY = 1e-3, 1e-2  # deviations over the duration and over the bandwidth that suffice
_INTERVAL_S = 1e-3  # between pings, whose times range lines lack


@dataclass(frozen=True, eq=False)
class Axis:
    """Spatial frequencies along the rows or the columns of a raster.

    Attributes
    ----------
    step_m : float
        Distance of the pixels on Earth, metres.
    centre : float
        Spatial frequency of a constant, cycles per metre: the multiple of the sample rate 1/step_m
        closest to the middle of the band, since pixels keep their phase.
    offset : float64 [orders + 1, orders + 1]
        Polynomial of the distances in metres from the scene centre point along rows and columns:
        the middle of the band less `centre`.
    lowest, highest : float
        Lowest and highest frequency of the whole image less `centre`, within half the sample rate.
    bandwidth : float
        Extent of the band of the scene centre point, cycles per metre; at most the sample rate.
    width_m : float
        Width at half power of the response of a point, metres.
    """

    step_m: float
    centre: float
    offset: NDArray[np.float64]
    lowest: float
    highest: float
    bandwidth: float
    width_m: float


def times_s(lines: RangeLines) -> NDArray[np.float64]:
    """Return the time of every channel, in which pings have equal intervals, [channels]."""
    return lines.ping_numbers * np.float64(_INTERVAL_S)


def track_polynomials(
    lines: RangeLines, place: Georeference, range_m: float
) -> NDArray[np.float64]:
    """Return polynomials of the track's ECF coordinates over time, float64 [orders + 1, 3].

    Raises
    ------
    ValueError
        If polynomials cannot follow the track as seen from a distance, metres.
    """
    position_m = ecf_m(place, lines.ping_centres_m)
    middle_m = position_m.mean(axis=0)  # removed from sums of squares of 1e6 m
    time_s = _INTERVAL_S * np.arange(len(position_m))
    deviation_m = np.inf
    for order in range(1, min(_HIGHEST_OF_TRACK, len(time_s) - 1) + 1):
        found = [Polynomial.fit(time_s, each, order) for each in (position_m - middle_m).T]
        fitted_m = np.stack([each(time_s) for each in found], axis=1) + middle_m
        deviation_m = float(np.linalg.norm(fitted_m - position_m, axis=1).max())
        if deviation_m <= _DEVIATION * range_m:
            coefficients = np.zeros((order + 1, 3))
            for axis, each in enumerate(found):
                own = each.convert().coef
                coefficients[: len(own), axis] = own
            coefficients[0] += middle_m
            return coefficients
    raise ArgumentError(
        "lines",
        "come from one pass in the order of recording, since SICD describes the track by "
        "polynomials",
        f"a track that deviates from them by {deviation_m:.3g} m at a range of {range_m:.4g} m",
    )


def time_and_axes(
    collection: Collection, raster: Raster
) -> tuple[NDArray[np.float64], tuple[Axis, Axis]]:
    """Return the time at which pixels are observed, and the frequencies along rows and columns.

    The time is a polynomial like `Axis.offset`: the mean over the channels that a pixel receives
    from.

    Raises
    ------
    ValueError
        If no line reaches the middle of the grid, or all see it from one direction.
    """
    lengths_m = np.linalg.norm(raster.vectors_m(), axis=1)
    sides = (np.linspace(0, n - 1, _PIXELS) for n in raster.shape)
    index = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    time_of_channels_s = times_s(collection.lines)
    times, supports, used = [], [], []
    for where, point_m in zip(index, raster.positions_m(index), strict=True):
        channels, weight, changes_m = collection.contributions(point_m, raster.steps_m)
        if weight.sum():
            times.append(float(time_of_channels_s[channels] @ weight / weight.sum()))
            supports.append(collection.support(changes_m))
            used.append(where)
    centre_m = raster.positions_m(raster.centre)
    _, weight, changes_m = collection.contributions(centre_m, raster.steps_m)
    if not weight.sum():
        raise ArgumentError("lines", "reach the middle of the image")
    at_m = (np.array(used) - raster.centre) * lengths_m
    corners_m = (raster.corners - raster.centre) * lengths_m
    time = _fitted(at_m, np.array(times), _TIME * float(time_of_channels_s[-1]))
    support = np.array(supports) / lengths_m[:, None]  # cycles per metre
    lowest, highest = (collection.support(changes_m) / lengths_m[:, None]).T
    axes = []
    for axis, step_m in enumerate(lengths_m):
        extent = float(highest[axis] - lowest[axis])
        rate = 1 / step_m
        centre = rate * round((lowest[axis] + highest[axis]) / 2 / rate)
        bandwidth = min(extent, rate)
        offset = _fitted(at_m, support[:, axis].mean(axis=1) - centre, _FREQUENCY * bandwidth)
        at_corners = polynomial.polyval2d(corners_m[:, 0], corners_m[:, 1], offset)
        first, last = at_corners.min() - bandwidth / 2, at_corners.max() + bandwidth / 2
        if max(-first, last) > rate / 2:  # the band continues at the other end
            first, last = -rate / 2, rate / 2
        cycles = np.multiply.outer(changes_m[axis] / step_m, collection.cycles_per_m).ravel()
        amplitude = np.multiply.outer(weight, collection.amplitude).ravel()
        amplitude, edges = np.histogram(cycles, _BINS, weights=amplitude)
        width_m = half_power_width((edges[:-1] + edges[1:]) / 2, amplitude)
        if not np.isfinite(width_m):
            raise ArgumentError(
                "lines",
                "resolve the middle of the image for SICD",
                hint="those within the beam see it from one direction only",
            )
        axes.append(
            Axis(
                step_m=float(step_m),
                centre=float(centre),
                offset=offset,
                lowest=float(first),
                highest=float(last),
                bandwidth=float(bandwidth),
                width_m=width_m,
            )
        )
    return time, (axes[0], axes[1])


def _fitted(
    at_m: NDArray[np.float64], values: NDArray[np.float64], deviation: float
) -> NDArray[np.float64]:
    """Return the polynomial of the lowest order with a deviation, or else of the highest order."""
    scale_m = np.abs(at_m).max(axis=0)
    x, y = (at_m / scale_m).T
    found = np.zeros((1, 1))
    for order in range(_HIGHEST + 1):
        powers = polynomial.polyvander2d(x, y, [order, order])
        solved = np.linalg.lstsq(powers, values, rcond=None)[0]
        found = np.asarray(solved, np.float64).reshape(order + 1, order + 1)
        if np.abs(powers @ found.ravel() - values).max() <= deviation:
            break
    exponents = np.arange(len(found))
    return found / np.multiply.outer(scale_m[0] ** exponents, scale_m[1] ** exponents)
