"""Sign of a recording's phase: small images formed from its lines and from their conjugates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from clsas.engine.data import validate
from clsas.engine.data.geometry import course, pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.device.device import Device
from clsas.engine.imaging import backproject
from clsas.engine.scene import check_numbers
from clsas.engine.signal.doubts import blurred_aperture_m

CLEAR = 1.5
"""Least ratio of the two sharpnesses that determines the sign. In speckle it reaches 1.1."""
_SHARP = 10.0
"""Least sharpness along the track of a patch in focus. A point has 80 and speckle 2. Where the arcs
of several targets cross, or on a noisy track, it reaches 7 with either sign."""
_TARGETS = 5  # targets whose patches are compared; all that are in focus must agree
_LEAST_BLUR = 8.0  # below it, both signs look alike
_LEAST_CHANNELS, _MOST_CHANNELS = 16, 1024
_MOST_BEND = 0.25
"""Bend of the track relative to that of the ranges, up to which the direction of a target need not
be known. On a circle around the scene, ranges do not bend at all and both signs look alike."""
_PIXELS = 256  # most columns of a patch
_CELLS = 24.0  # length of a patch in range, in resolution cells
_SEARCHED_CHANNELS = 128  # channels searched for targets, spread evenly
_GRID_POINTS = 24  # points along either side of a grid at which the search starts
_FINER = 4  # factor by which each step of the search is finer
_ACCURACY_DB = -40.0


@dataclass(frozen=True, eq=False)
class PhaseSign:
    """Sharpness of a small image of the lines as given, and of their conjugates.

    Attributes
    ----------
    as_given, conjugate : float
        Mean squared intensity along the track over the squared mean: 2 for speckle and for blurred
        points, more for sharper images.
    centre_m : (float, float, float)
        Centre of the image in metres.

    See Also
    --------
    Inspection.sign : Where `inspect` reports it.
    """

    as_given: float
    conjugate: float
    centre_m: tuple[float, float, float]

    @property
    def ratio(self) -> float:
        """Sharpness with conjugate lines relative to that with the lines as given."""
        return self.conjugate / self.as_given if self.as_given else 1.0


def phase_sign(
    lines: RangeLines,
    grid: Grid | None,
    wavelength_m: float,
    cell_m: float,
    device: Device | None,
) -> tuple[PhaseSign | None, str]:
    """Return the sharpest of a few patches about the brightest targets, or None.

    Each patch is imaged from the lines and from their conjugates. The correct sign gives the
    resolution that the aperture allows; the wrong one blurs a point over the length of the
    aperture. Targets are searched on the grid or, without one, beside the track. Also return the
    reason why the sign is undetermined, or "".
    """
    if not lines.samples.any():
        return None, "the lines are silent, or the same in all pings"
    if not lines.carrier_hz:
        return None, "the lines still have their carrier: images of conjugates are as sharp"
    try:
        targets = _beside_track(lines, cell_m) if grid is None else _on_grid(lines, grid, cell_m)
    except _UndeterminedError as error:
        return None, str(error)
    signs, reasons = [], []
    for position_m, channel in targets:
        try:
            part, patch = _patch(
                lines, position_m, channel, wavelength_m, cell_m, is_located=grid is not None
            )
        except _UndeterminedError as error:
            reasons.append(str(error))
            continue
        sharpness = []
        for each in (part, replace(part, samples=part.samples.conj())):
            with validate.muted():  # about accuracy, which is not needed here
                image = backproject(
                    each, patch, device=device, accuracy_db=_ACCURACY_DB, certificate=False
                )
            # Row by row, that is along the track: echoes confined to a few ranges do not count as
            # sharp, since blurred ones are too.
            amplitude = np.abs(image.pixels)
            intensity = (amplitude / (amplitude.max() or 1.0)).astype(np.float64) ** 2
            mean_square = float((intensity**2).mean(axis=1).sum())
            squared_mean = float((intensity.mean(axis=1) ** 2).sum())
            sharpness.append(mean_square / squared_mean if squared_mean else 0.0)
        x, y, z = position_m.tolist()
        signs.append(PhaseSign(sharpness[0], sharpness[1], centre_m=(x, y, z)))

    if not signs:
        return None, reasons[0]
    sharp = [sign for sign in signs if _best_sharpness(sign) >= _SHARP]
    clear = [sign for sign in sharp if not 1 / CLEAR < sign.ratio < CLEAR]
    best = max(clear or signs, key=_best_sharpness)
    if not sharp:
        return best, f"no patch is in focus, with a sharpness of {_SHARP:g} (speckle has 2)"
    if not clear:
        return best, "both signs give equally sharp images"
    if len({sign.ratio > 1 for sign in clear}) > 1:
        return best, "patches disagree"
    return best, ""


def _best_sharpness(sign: PhaseSign) -> float:
    return max(sign.as_given, sign.conjugate)


class _UndeterminedError(Exception):
    """The sign cannot be determined from a target; the message says why."""


def _beside_track(lines: RangeLines, cell_m: float) -> list[tuple[NDArray[np.float64], int]]:
    """Return positions on both sides of the track, at the ranges of the brightest samples.

    Each comes with the channel of its sample.
    """
    searched = some_channels(lines.channels, _SEARCHED_CHANNELS)
    level = np.abs(lines.samples[searched])
    centres_m = lines.phase_centres_m
    along = course(centres_m)
    across = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(across) < 0.1:  # the course is vertical
        across = np.cross([1.0, 0.0, 0.0], along)
    across /= np.linalg.norm(across)
    range_m = lines.first_range_m[searched, None] + np.arange(lines.length) * lines.range_step_m
    targets: list[tuple[NDArray[np.float64], int]] = []
    reason = "no samples are left to search"
    for _ in range(_TARGETS):
        row, sample = np.unravel_index(int(level.argmax()), level.shape)
        if not level[row, sample]:
            break
        channel, found_m = int(searched[row]), float(range_m[row, sample])
        # Range is half the path, to one antenna and back to the other.
        apart_m = float(np.linalg.norm(lines.tx_m[channel] - lines.rx_m[channel])) / 2
        if found_m > apart_m:
            away_m = math.sqrt(found_m**2 - apart_m**2) * across
            targets.append((centres_m[channel] + away_m, channel))
            targets.append((centres_m[channel] - away_m, channel))
        elif not targets:
            reason = (
                f"the brightest echoes have an impossible range of {found_m:.4g} m, since their "
                f"transmitter and receiver are {2 * apart_m:.4g} m apart"
            )
        level[np.abs(range_m - found_m) <= _CELLS / 2 * cell_m] = 0
    if not targets:
        raise _UndeterminedError(reason)
    return targets


def _on_grid(lines: RangeLines, grid: Grid, cell_m: float) -> list[tuple[NDArray[np.float64], int]]:
    """Return the positions on a grid from which channels receive most.

    They are exact to a resolution cell in range. Each comes with the channel by which half of its
    energy has arrived.
    """
    searched = some_channels(lines.channels, _SEARCHED_CHANNELS)
    part = lines.select(searched)
    level = np.abs(part.samples)
    power = (level / (level.max() or np.float32(1))) ** 2
    centres_m = lines.phase_centres_m
    along = course(centres_m)

    points_m = grid.spread(_GRID_POINTS)
    pitch_m = 0.0  # the largest distance from a point to its nearest neighbour
    if len(points_m) > 1:
        pitch_m = float(cKDTree(points_m).query(points_m, k=2)[0][:, 1].max())
    left = _received(part, power, points_m, pitch_m).sum(axis=1)
    targets = []
    for _ in range(_TARGETS):
        brightest = int(left.argmax())
        if not left[brightest] > 0:
            break
        position_m, fine_m = points_m[brightest], pitch_m
        left[np.linalg.norm(points_m - position_m, axis=1) < 3 * pitch_m] = 0
        channel = int(searched[_halfway(_received(part, power, position_m[None], pitch_m)[0])])
        across = _across(position_m - centres_m[channel], along)
        if across is not None:
            while fine_m > cell_m:
                fine_m /= _FINER
                offsets_m = fine_m * np.arange(1 - _FINER, _FINER)
                moves_m = offsets_m[:, None, None] * across + offsets_m[:, None] * along
                tried_m = position_m + moves_m.reshape(-1, 3)
                energy = _received(part, power, tried_m, fine_m).sum(axis=1)
                position_m = tried_m[int(energy.argmax())]
            channel = int(searched[_halfway(_received(part, power, position_m[None], cell_m)[0])])
        targets.append((position_m, channel))
    if not targets:
        raise _UndeterminedError("no echoes come from the grid")
    return targets


def _received(
    part: RangeLines,
    power: NDArray,
    points_m: NDArray[np.float64],
    pitch_m: float,
) -> NDArray[np.float32]:
    """Return the largest power within a square of side `pitch_m` about each point.

    The result is [points, channels]. Points at this pitch miss no target between them. A target
    has power in all channels, but a crossing of the arcs of two targets only in some.
    """
    reach = math.ceil(min(math.sqrt(0.5) * pitch_m / part.range_step_m, part.length))
    largest = maximum_filter1d(power, 2 * reach + 1, axis=1, mode="constant")
    range_m = pairwise_range_m(points_m, part.tx_m, part.rx_m)
    index = np.rint((range_m - part.first_range_m) / part.range_step_m)
    inside = (index >= 0) & (index < part.length)
    index = np.clip(index, 0, part.length - 1).astype(np.int64)
    found: NDArray[np.float32] = largest[np.arange(len(largest)), index] * inside
    return found


def _halfway(received: NDArray[np.float32]) -> int:
    """Return the channel by which half of the energy has arrived."""
    arrived = np.cumsum(received)
    return int(np.searchsorted(arrived, arrived[-1] / 2))


def _patch(
    lines: RangeLines,
    position_m: NDArray[np.float64],
    channel: int,
    wavelength_m: float,
    cell_m: float,
    is_located: bool,
) -> tuple[RangeLines, Grid]:
    """Return the lines near a channel, and a patch about a target in their slant plane.

    Of a target that is not located, only the range is known, and its direction is assumed.
    """
    centres_m = lines.phase_centres_m
    middle_m = centres_m[channel]
    look_m = position_m - middle_m
    range_m = float(np.linalg.norm(look_m))
    aperture_m = blurred_aperture_m(wavelength_m, range_m)
    near = np.flatnonzero(np.linalg.norm(centres_m - middle_m, axis=1) <= aperture_m / 2)
    if len(near) < _LEAST_CHANNELS:
        raise _UndeterminedError(
            f"{aperture_m:.3g} m of the track have {len(near)} channels; at least "
            f"{_LEAST_CHANNELS} are needed"
        )
    part = lines.select(near[some_channels(len(near), _MOST_CHANNELS)])
    # Sums of very large samples would overflow float32.
    part = replace(part, samples=part.samples / (np.abs(part.samples).max() or np.float32(1)))
    along = course(part.phase_centres_m)
    across = _across(look_m, along)
    if across is None:
        raise _UndeterminedError("the track leads straight to the brightest echoes")
    length_m = float(np.ptp(part.phase_centres_m @ along)) * float(look_m @ across) / range_m
    if 2 * length_m**2 < _LEAST_BLUR * wavelength_m * range_m:
        raise _UndeterminedError(
            f"the track is too short: the brightest echoes, at {range_m:.4g} m, have an effective "
            f"aperture of {length_m:.3g} m"
        )
    away_m = part.phase_centres_m - part.phase_centres_m.mean(axis=0)
    bend_m = float(np.linalg.norm(away_m - np.outer(away_m @ along, along), axis=1).max())
    if not is_located and bend_m > _MOST_BEND * length_m**2 / (8 * range_m):
        raise _UndeterminedError("the track is not straight: a grid is needed")
    # There are two pixels per resolution cell. The patch is as long as the blur of a wrong sign.
    pitch_m = wavelength_m * range_m / (2 * length_m) / 2
    columns = min(math.ceil(1.2 * length_m / pitch_m), _PIXELS)
    rows = int(2 * _CELLS)
    steps_m = cell_m / 2 * across, pitch_m * along
    origin_m = position_m - steps_m[0] * (rows - 1) / 2 - steps_m[1] * (columns - 1) / 2
    try:
        check_numbers(part, None)
        return part, Grid.oriented(origin_m, *steps_m, (rows, columns))
    except ValueError as error:
        raise _UndeterminedError(str(error)) from error


def _across(look_m: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the direction of a vector's component across a course; None if that is tiny."""
    across = look_m - along * (look_m @ along)
    size, least = float(np.linalg.norm(across)), 0.1 * float(np.linalg.norm(look_m))
    return across / size if size > least else None
