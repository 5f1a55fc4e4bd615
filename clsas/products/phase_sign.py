"""Sign of a recording's phase: a patch imaged from its lines and from their conjugates."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.validate import ClsasWarning
from clsas.exact.backprojection import backproject
from clsas.navigation.autofocus import sharpness
from clsas.opencl.device import Device
from clsas.products.inspection_result import PhaseSign
from clsas.sonar.sampling import Finding

CLEAR = 1.5
"""Ratio of sharpness above which the sign is told: seeds of speckle differ by 1.1."""
_PRODUCT = 100.0  # length of the aperture over the resolution that it gives; wrong signs blur by it
_LEAST_PRODUCT = 8.0  # below this both signs look alike
_LEAST_CHANNELS, _MOST_CHANNELS = 16, 4096
_MOST_BEND = 0.25
"""Bend of a track, over that of ranges, up to which the direction of a place need not be known. On
a circle about the scene ranges do not bend at all, and both signs look alike."""
_PIXELS = 256  # along a side, at most
_CELLS = 24.0  # range resolution cells of a patch
_GRID_POINTS = 24  # of a grid, along either side, that are looked at for bright echoes
_ACCURACY_DB = -40.0


@dataclass(frozen=True, eq=False)
class _Spot:
    """A place with strong echoes, and the channel in the middle of those that receive them.

    It is `known` on a grid. Without one only its range is, and its side is assumed.
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
) -> PhaseSign | None:
    """Image a patch of the brightest echoes both ways; None if it cannot tell.

    The right sign gives an image of the resolution that the aperture allows, the wrong one blurs
    it to the length of the aperture. `cell_m` is the resolution in range.
    """
    best = None
    for spot in _spots(lines, grid):
        made = _patch(lines, spot, wavelength_m, cell_m)
        if made is None:
            continue
        part, patch = made
        try:
            found = PhaseSign(
                _sharpness(part, patch, device),
                _sharpness(replace(part, samples=part.samples.conj()), patch, device),
                tuple(float(each) for each in spot.place_m),  # type: ignore[arg-type]
            )
        except ValueError:  # numbers that no image can be formed of
            continue
        if best is None or max(found.as_given, found.conjugate) > max(
            best.as_given, best.conjugate
        ):
            best = found
    return best


def check_sign(sign: PhaseSign | None) -> list[Finding]:
    """Return a phase of the wrong sign, if the difference is clear."""
    if sign is None or sign.ratio < CLEAR:
        return []
    x, y, z = sign.centre_m
    return [
        Finding(
            "phase_sign",
            f"the conjugate lines give a sharper image, {sign.conjugate:.3g} against "
            f"{sign.as_given:.3g} (mean squared intensity over the squared mean, about "
            f"({x:.4g}, {y:.4g}, {z:.4g}) m): the phase has the opposite sign of "
            "exp(-j 4 pi carrier range/c)",
            sign.ratio,
            CLEAR,
            "dataclasses.replace(lines, samples=lines.samples.conj()); for phase histories sign=+1",
        )
    ]


def _sharpness(lines: RangeLines, patch: Grid, device: Device | str | int | None) -> float:
    with warnings.catch_warnings():  # of accuracy, which matters little here
        warnings.simplefilter("ignore", ClsasWarning)
        return sharpness(backproject(lines, patch, device=device, accuracy_db=_ACCURACY_DB))


def _spots(lines: RangeLines, grid: Grid | None) -> list[_Spot]:
    """Return the brightest place of a grid or, without one, a place on either side of the track."""
    if grid is not None:
        return _brightest_of(lines, grid.spread(_GRID_POINTS).reshape(-1, 3))
    levels = np.abs(lines.samples).max(axis=1)
    channel = int(levels.argmax())
    sample = int(np.abs(lines.samples[channel]).argmax())
    range_m = float(lines.first_range_m[channel]) + sample * lines.range_step_m
    centres_m = lines.phase_centres_m
    course = _course(centres_m)
    across = np.cross([0.0, 0.0, 1.0], course)
    if np.linalg.norm(across) < 0.1:  # a course up or down
        across = np.cross([1.0, 0.0, 0.0], course)
    across /= np.linalg.norm(across)
    # A range is half the path from and to both antennas.
    apart_m = float(np.linalg.norm(lines.tx_m[channel] - lines.rx_m[channel])) / 2
    distance_m = math.sqrt(max(range_m**2 - apart_m**2, 0.0))
    if not distance_m:
        return []
    return [
        _Spot(centres_m[channel] + side * distance_m * across, channel, known=False)
        for side in (1, -1)
    ]


def _brightest_of(lines: RangeLines, points_m: NDArray[np.float64]) -> list[_Spot]:
    """Return the point at which some channels receive most, their powers added."""
    some = some_channels(lines.channels, 4 * _LEAST_CHANNELS)
    part = lines.select(some)
    range_m = pairwise_range_m(points_m, part.tx_m, part.rx_m)
    index = np.rint((range_m - part.first_range_m) / part.range_step_m)
    inside = (index >= 0) & (index < lines.length)
    index = np.clip(index, 0, lines.length - 1).astype(np.int64)
    power = np.abs(part.samples[np.arange(len(some)), index]).astype(np.float64) ** 2 * inside
    if not power.any():
        return []
    brightest = int(power.sum(axis=1).argmax())
    held = np.cumsum(power[brightest])
    middle = int(np.searchsorted(held, held[-1] / 2))
    return [_Spot(points_m[brightest], int(some[middle]), known=True)]


def _patch(
    lines: RangeLines, spot: _Spot, wavelength_m: float, cell_m: float
) -> tuple[RangeLines, Grid] | None:
    """Return a part of the lines, and a patch about the spot in their slant plane."""
    centres_m = lines.phase_centres_m
    middle_m = centres_m[spot.channel]
    look = spot.place_m - middle_m
    range_m = float(np.linalg.norm(look))
    if not range_m:
        return None
    wanted_m = math.sqrt(_PRODUCT / 2 * wavelength_m * range_m)
    near = np.flatnonzero(np.linalg.norm(centres_m - middle_m, axis=1) <= wanted_m / 2)
    if len(near) < _LEAST_CHANNELS:
        return None
    part = lines.select(near[some_channels(len(near), _MOST_CHANNELS)])
    # Sums of very large samples would overflow float32.
    part = replace(part, samples=part.samples / (np.abs(part.samples).max() or np.float32(1)))
    along = _course(part.phase_centres_m)
    look = look / range_m
    across = look - along * (look @ along)
    if np.linalg.norm(across) < 0.1:  # straight ahead
        return None
    across /= np.linalg.norm(across)
    length_m = float(np.ptp(part.phase_centres_m @ along)) * float(np.linalg.norm(across))
    if 2 * length_m**2 < _LEAST_PRODUCT * wavelength_m * range_m:
        return None
    if not spot.known and _bend_m(part, along) > _MOST_BEND * length_m**2 / (8 * range_m):
        return None
    # Two pixels per resolution cell; the patch is as long as a wrong sign blurs a point.
    pitch_m = wavelength_m * range_m / (2 * length_m) / 2
    columns = min(math.ceil(1.2 * length_m / pitch_m), _PIXELS)
    rows = int(2 * _CELLS)
    steps_m = cell_m / 2 * across, pitch_m * along
    origin_m = spot.place_m - steps_m[0] * (rows - 1) / 2 - steps_m[1] * (columns - 1) / 2
    return part, Grid.oriented(origin_m, *steps_m, (rows, columns))


def _bend_m(lines: RangeLines, along: NDArray[np.float64]) -> float:
    """Return the largest distance of phase centres from a straight line."""
    away_m = lines.phase_centres_m - lines.phase_centres_m.mean(axis=0)
    return float(np.linalg.norm(away_m - np.outer(away_m @ along, along), axis=1).max())


def _course(centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector along which phase centres spread most."""
    away_m = centres_m - centres_m.mean(axis=0)
    direction: NDArray[np.float64] = np.linalg.eigh(away_m.T @ away_m)[1][:, -1]
    return direction
