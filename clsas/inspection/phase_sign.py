"""Sign of a recording's phase: small patches imaged from its lines and from their conjugates."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines, some_channels
from clsas.core.validate import ClsasWarning
from clsas.exact.backprojection import backproject
from clsas.exact.checks import check_numbers
from clsas.inspection.result import PhaseSign
from clsas.opencl.device import Device
from clsas.sonar.sampling import Finding

CLEAR = 1.5
"""Ratio of sharpness above which the sign is told: seeds of speckle differ by 1.1."""
_SHARP = 10.0
"""Sharpness along the track above which a patch is in focus: 80 for a point, 2 for speckle. Where
arcs of several targets cross, or on a noisy track, either sign has up to 7."""
_SPOTS = 5  # judged, and all in focus must agree
_PRODUCT = 100.0  # length of the aperture over the resolution that it gives; wrong signs blur by it
_LEAST_PRODUCT = 8.0  # below this both signs look alike
_LEAST_CHANNELS, _MOST_CHANNELS = 16, 1024
_MOST_BEND = 0.25
"""Bend of a track, over that of ranges, up to which the direction of a place need not be known. On
a circle about the scene ranges do not bend at all, and both signs look alike."""
_PIXELS = 256  # along a side, at most
_CELLS = 24.0  # range resolution cells of a patch
_SEARCHED_CHANNELS = 128  # searched for bright places, spread evenly
_GRID_POINTS = 24  # along either side of a grid, at which the search begins
_FINER = 4  # refinement of the search per step
_ACCURACY_DB = -40.0


class _NotToldError(Exception):
    """A place whose images cannot tell the sign; the message says why."""


@dataclass(frozen=True, eq=False)
class _Spot:
    """A place with strong echoes, and the channel at which half of their energy has arrived.

    It is `known` on a grid. Without a grid its range is known, and its direction is assumed.
    """

    place_m: NDArray[np.float64]
    channel: int
    known: bool


def phase_sign(
    lines: RangeLines,
    grid: Grid | None,
    wavelength_m: float,
    cell_m: float,
    device: Device | str | int | None,
) -> tuple[PhaseSign | None, str]:
    """Image patches about the brightest echoes both ways.

    The right sign gives an image of the resolution that the aperture allows, the wrong one blurs
    it to the length of the aperture.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid or None
        Where to look. Without it, places beside the track are tried.
    wavelength_m, cell_m : float
        Wavelength, and resolution in range, metres.
    device : Device, str, int or None
        See `clsas.opencl.device.choose`.

    Returns
    -------
    sign : PhaseSign or None
        The sharpest patch; None if none could be imaged.
    reason : str
        Why the sign is not told; "" if it is.
    """
    if not lines.samples.any():
        return None, "nothing is left to image: lines are silent, or alike in all pings"
    if not lines.carrier_hz:
        return None, (
            "the lines still have their carrier: conjugate lines give the conjugate image, which "
            "is as sharp"
        )
    try:
        if grid is None:
            spots = _brightest_beside(lines, cell_m)
        else:
            spots = _brightest_of(lines, grid, cell_m)
    except _NotToldError as error:
        return None, str(error)
    judged, reason = [], ""
    for spot in spots:
        try:
            judged.append(_judged(lines, spot, wavelength_m, cell_m, device))
        except _NotToldError as error:
            reason = reason or str(error)
    if not judged:
        return None, reason
    sharp = [sign for sign in judged if max(sign.as_given, sign.conjugate) >= _SHARP]
    clear = [sign for sign in sharp if not 1 / CLEAR < sign.ratio < CLEAR]
    best = max(clear or judged, key=lambda sign: max(sign.as_given, sign.conjugate))
    if not sharp:
        return best, f"no patch is in focus (sharpness of {_SHARP:g}; speckle has 2)"
    if not clear:
        return best, "both signs look alike"
    if len({sign.ratio > 1 for sign in clear}) > 1:
        return best, "patches disagree"
    return best, ""


def check_sign(sign: PhaseSign | None, reason: str) -> list[Finding]:
    """Return a phase of the wrong sign, unless there is a reason why the sign is not told."""
    if sign is None or reason or sign.ratio < CLEAR:
        return []
    x, y, z = sign.centre_m
    return [
        Finding(
            "phase_sign",
            f"the conjugate lines give a sharper image, {sign.conjugate:.3g} against "
            f"{sign.as_given:.3g} (mean squared intensity over the squared mean, along the track "
            f"about ({x:.4g}, {y:.4g}, {z:.4g}) m): the phase has the opposite sign of "
            "exp(-j 4 pi carrier range/c)",
            sign.ratio,
            CLEAR,
            "dataclasses.replace(lines, samples=lines.samples.conj()); for phase histories sign=+1",
        )
    ]


def _judged(
    lines: RangeLines,
    spot: _Spot,
    wavelength_m: float,
    cell_m: float,
    device: Device | str | int | None,
) -> PhaseSign:
    part, patch = _patch(lines, spot, wavelength_m, cell_m)
    conjugate = replace(part, samples=part.samples.conj())
    with warnings.catch_warnings():  # of accuracy, which matters little here
        warnings.simplefilter("ignore", ClsasWarning)
        images = [
            backproject(each, patch, device=device, accuracy_db=_ACCURACY_DB)
            for each in (part, conjugate)
        ]
    x, y, z = spot.place_m.tolist()
    as_given, of_conjugate = (_sharpness_along(image) for image in images)
    return PhaseSign(as_given, of_conjugate, centre_m=(x, y, z))


def _sharpness_along(image: Image) -> float:
    """Return the mean squared intensity of rows over their squared mean.

    Rows lie along the track. That echoes fill few ranges, as blurred ones do too, does not count.
    """
    amplitude = np.abs(image.pixels)
    intensity = (amplitude / (amplitude.max() or 1.0)).astype(np.float64) ** 2
    squared_mean = float((intensity.mean(axis=1) ** 2).sum())
    return float((intensity**2).mean(axis=1).sum()) / squared_mean if squared_mean else 0.0


def _brightest_beside(lines: RangeLines, cell_m: float) -> list[_Spot]:
    """Return places on either side of the track, at the ranges of the brightest samples.

    Raises
    ------
    _NotToldError
        If no place has such a range.
    """
    part_of = some_channels(lines.channels, _SEARCHED_CHANNELS)
    level = np.abs(lines.samples[part_of])
    centres_m = lines.phase_centres_m
    course = _course(centres_m)
    across = np.cross([0.0, 0.0, 1.0], course)
    if np.linalg.norm(across) < 0.1:  # a course up or down
        across = np.cross([1.0, 0.0, 0.0], course)
    across /= np.linalg.norm(across)
    range_m = lines.first_range_m[part_of, None] + np.arange(lines.length) * lines.range_step_m
    spots: list[_Spot] = []
    reason = "no samples are left to look at"
    for _ in range(_SPOTS):
        row, sample = np.unravel_index(int(level.argmax()), level.shape)
        if not level[row, sample]:
            break
        channel, found_m = int(part_of[row]), float(range_m[row, sample])
        # A range is half the path from and to both antennas.
        apart_m = float(np.linalg.norm(lines.tx_m[channel] - lines.rx_m[channel])) / 2
        if found_m > apart_m:
            distance_m = math.sqrt(found_m**2 - apart_m**2)
            spots += [
                _Spot(centres_m[channel] + side * distance_m * across, channel, known=False)
                for side in (1, -1)
            ]
        elif not spots:
            reason = (
                f"no place has the range of the brightest echoes, {found_m:.4g} m: its transmitter "
                f"and receiver are {2 * apart_m:.4g} m apart"
            )
        level[np.abs(range_m - found_m) <= _CELLS / 2 * cell_m] = 0
    if not spots:
        raise _NotToldError(reason)
    return spots


def _brightest_of(lines: RangeLines, grid: Grid, cell_m: float) -> list[_Spot]:
    """Return the places of a grid from which channels receive most.

    Raises
    ------
    _NotToldError
        If they receive nothing from it.
    """
    energy = _Energy(lines)
    points_m = grid.spread(_GRID_POINTS)
    pitch_m = _pitch_m(points_m)
    left = energy.around(points_m, pitch_m).sum(axis=1)
    spots = []
    for _ in range(_SPOTS):
        brightest = int(left.argmax())
        if not left[brightest] > 0:
            break
        spot = energy.spot(points_m[brightest], pitch_m)
        spots.append(energy.refined(spot, pitch_m, cell_m))
        left[np.linalg.norm(points_m - points_m[brightest], axis=1) < 3 * pitch_m] = 0
    if not spots:
        raise _NotToldError("no echoes come from the grid")
    return spots


def _pitch_m(points_m: NDArray[np.float64]) -> float:
    """Return the largest distance from a point to its nearest neighbour; 0 for a single point."""
    if len(points_m) < 2:
        return 0.0
    away_m = np.linalg.norm(points_m[:, None] - points_m, axis=-1)
    np.fill_diagonal(away_m, np.inf)
    return float(away_m.min(axis=1).max())


class _Energy:
    """Power of some channels, summed over channels without regard to phase."""

    def __init__(self, lines: RangeLines) -> None:
        self.lines = lines
        self.some = some_channels(lines.channels, _SEARCHED_CHANNELS)
        self.part = lines.select(self.some)
        level = np.abs(self.part.samples)
        self.power = (level / (level.max() or np.float32(1))) ** 2

    def around(self, points_m: NDArray[np.float64], pitch_m: float) -> NDArray[np.float32]:
        """Return the largest power within a square about each point, [points, channels].

        Points of a pitch then miss no target between them: one counts in all channels, and a
        crossing of the arcs of two targets only in those of the arcs.
        """
        part = self.part
        reach = math.ceil(min(math.sqrt(0.5) * pitch_m / part.range_step_m, part.length))
        power = maximum_filter1d(self.power, 2 * reach + 1, axis=1, mode="constant")
        range_m = pairwise_range_m(points_m, part.tx_m, part.rx_m)
        index = np.rint((range_m - part.first_range_m) / part.range_step_m)
        inside = (index >= 0) & (index < part.length)
        index = np.clip(index, 0, part.length - 1).astype(np.int64)
        found: NDArray[np.float32] = power[np.arange(len(power)), index] * inside
        return found

    def spot(self, place_m: NDArray[np.float64], pitch_m: float) -> _Spot:
        """Return a place with the channel at which half of its energy has arrived."""
        held = np.cumsum(self.around(place_m[None], pitch_m)[0])
        middle = int(np.searchsorted(held, held[-1] / 2))
        return _Spot(place_m, int(self.some[middle]), known=True)

    def refined(self, spot: _Spot, pitch_m: float, cell_m: float) -> _Spot:
        """Return the brightest place about a spot, to a resolution cell in range."""
        place_m = spot.place_m
        along = _course(self.lines.phase_centres_m)
        across = _across(place_m - self.lines.phase_centres_m[spot.channel], along)
        if across is None:
            return spot
        while pitch_m > cell_m:
            pitch_m /= _FINER
            offsets_m = pitch_m * np.arange(1 - _FINER, _FINER)
            moves_m = offsets_m[:, None, None] * across + offsets_m[:, None] * along
            places_m = place_m + moves_m.reshape(-1, 3)
            place_m = places_m[int(self.around(places_m, pitch_m).sum(axis=1).argmax())]
        return self.spot(place_m, cell_m)


def _patch(
    lines: RangeLines, spot: _Spot, wavelength_m: float, cell_m: float
) -> tuple[RangeLines, Grid]:
    """Return a part of the lines, and a patch about the spot in their slant plane.

    Raises
    ------
    _NotToldError
        If the part is too short, leads straight to the spot, or bends about it, or if its numbers
        are beyond what can be imaged.
    """
    centres_m = lines.phase_centres_m
    middle_m = centres_m[spot.channel]
    look = spot.place_m - middle_m
    range_m = float(np.linalg.norm(look))
    wanted_m = math.sqrt(_PRODUCT / 2 * wavelength_m * range_m)
    near = np.flatnonzero(np.linalg.norm(centres_m - middle_m, axis=1) <= wanted_m / 2)
    if len(near) < _LEAST_CHANNELS:
        raise _NotToldError(
            f"channels on {wanted_m:.3g} m of the track: {len(near)}, fewer than {_LEAST_CHANNELS}"
        )
    part = lines.select(near[some_channels(len(near), _MOST_CHANNELS)])
    # Sums of very large samples would overflow float32.
    part = replace(part, samples=part.samples / (np.abs(part.samples).max() or np.float32(1)))
    along = _course(part.phase_centres_m)
    across = _across(look, along)
    if across is None:
        raise _NotToldError("the track leads straight to the brightest echoes")
    length_m = float(np.ptp(part.phase_centres_m @ along)) * float(look @ across) / range_m
    if 2 * length_m**2 < _LEAST_PRODUCT * wavelength_m * range_m:
        raise _NotToldError(
            f"the track is too short: {length_m:.3g} m of it see the brightest echoes at "
            f"{range_m:.4g} m"
        )
    if not spot.known and _bend_m(part, along) > _MOST_BEND * length_m**2 / (8 * range_m):
        raise _NotToldError("the track is not straight, so that a grid is needed")
    # Two pixels per resolution cell; the patch is as long as a wrong sign blurs a point.
    pitch_m = wavelength_m * range_m / (2 * length_m) / 2
    columns = min(math.ceil(1.2 * length_m / pitch_m), _PIXELS)
    rows = int(2 * _CELLS)
    steps_m = cell_m / 2 * across, pitch_m * along
    origin_m = spot.place_m - steps_m[0] * (rows - 1) / 2 - steps_m[1] * (columns - 1) / 2
    try:
        check_numbers(part, None)
        return part, Grid.oriented(origin_m, *steps_m, (rows, columns))
    except ValueError as error:  # numbers that no image can be formed of
        raise _NotToldError(str(error)) from error


def _across(look: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit vector of a look's part across a course; None if it has hardly any."""
    across = look - along * (look @ along)
    size, least = float(np.linalg.norm(across)), 0.1 * float(np.linalg.norm(look))
    return across / size if size > least else None


def _bend_m(lines: RangeLines, along: NDArray[np.float64]) -> float:
    """Return the largest distance of phase centres from a straight line."""
    away_m = lines.phase_centres_m - lines.phase_centres_m.mean(axis=0)
    return float(np.linalg.norm(away_m - np.outer(away_m @ along, along), axis=1).max())


def _course(centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector along which phase centres spread most."""
    away_m = centres_m - centres_m.mean(axis=0)
    direction: NDArray[np.float64] = np.linalg.eigh(away_m.T @ away_m)[1][:, -1]
    return direction
