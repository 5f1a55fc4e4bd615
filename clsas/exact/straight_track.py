"""The scene of a wavenumber image: straight track, band of the lines, and aspect angles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.fourier import smooth_edge
from clsas.core.geometry import bistatic_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.wavelengths import cycles_per_m_at, wavelength_m
from clsas.signal.spectrum import measure_spectrum
from clsas.sonar.beam import BeamWindow

_UNUSED = 1e-12  # share of the energy that may be left out
_STEEPEST_DEG = 85.0  # largest aspect angle, at which ranges are about ten times those at broadside
_MOST_TURN_DEG = 5.0  # largest angle between the rows of the grid and the track
_EDGE_ZONES = 6.0  # Fresnel zones over which an aperture without a beam fades out
_ANGLES = 8192  # angles in a table of weights


@dataclass(frozen=True, eq=False)
class StraightTrack:
    """The straight line that approximates the track, and the grid in its coordinates.

    Attributes
    ----------
    along_m : float64 [channels]
        Phase centres along the line, relative to their mean.
    shift_m : float64 [channels]
        True range minus the range from the line.
    off_m : float
        Largest distance of a phase centre from the line.
    row_range_m : float64 [rows]
        Distance of the rows of the grid from the line.
    pixel_along_m : float64 [rows, columns]
        Positions of the pixels along the line.
    """

    along_m: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    off_m: float
    row_range_m: NDArray[np.float64]
    pixel_along_m: NDArray[np.float64]

    @property
    def ranges_m(self) -> tuple[float, float]:
        """Distance of the nearest and the farthest row from the line, metres."""
        return float(self.row_range_m.min()), float(self.row_range_m.max())

    def reach_m(self, low: float, high: float) -> tuple[float, float]:
        """Return the first and last position with a pixel at an aspect angle from low to high."""
        ahead_m = np.multiply.outer(np.tan([low, high]), self.ranges_m)
        corners_m = self.pixel_along_m[:: max(len(self.pixel_along_m) - 1, 1), [0, -1]]
        return corners_m.min() - ahead_m[1].max(), corners_m.max() - ahead_m[0].min()


@dataclass(frozen=True, eq=False)
class Band:
    """Band in which the lines have energy.

    Attributes
    ----------
    carrier : float
        Two-way wavenumber of the carrier, rad/m.
    centre_cycles, half_cycles : float
        Centre of the band relative to the carrier, and half its width, cycles per sample.
    wavelength_m : float
        Wavelength in the middle of the band.
    """

    carrier: float
    centre_cycles: float
    half_cycles: float
    wavelength_m: float

    def zone_m(self, range_m: float) -> float:
        """Return the length of a Fresnel zone at a range, metres."""
        return math.sqrt(self.wavelength_m * range_m / 2)


@dataclass(frozen=True, eq=False)
class Aspects:
    """Weights of the spectrum over the aspect angle.

    Attributes
    ----------
    low, high : float
        Aspect angles beyond which the weights are 0, radians.
    sine : float64 [angles]
        Sines of angles between `low` and `high`.
    terms : tuple of float64 [angles]
        Weights at these angles: the factor of 1 and, with a beam, the factor of j/(K R).
    """

    low: float
    high: float
    sine: NDArray[np.float64]
    terms: tuple[NDArray[np.float64], ...]


def band_of(lines: RangeLines) -> Band:
    """Return the band in which the lines have energy."""
    spectrum = measure_spectrum(lines)
    used = np.flatnonzero(np.cumsum(spectrum.power[::-1])[::-1] > _UNUSED)[-1]
    half = float(spectrum.frequency[used] + spectrum.frequency[0])
    cycles_per_m = cycles_per_m_at(lines, spectrum.centre)
    validate.positive("the middle frequency of lines", cycles_per_m, "cycles/m")
    return Band(2 * lines.wavenumber_rad_m, spectrum.centre, half, 2 / cycles_per_m)


def straighten(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, compensated: bool
) -> StraightTrack:
    """Return the straight line along the grid's rows that approximates the track."""
    rows, columns = grid.shape
    tx_m, rx_m = lines.tx_m - lines.tx_m[0], lines.rx_m - lines.tx_m[0]
    origin_m, row_step_m, column_step_m = grid.vectors_m
    row_m = origin_m - lines.tx_m[0] + np.arange(rows)[:, None] * row_step_m
    centres_m = (tx_m + rx_m) / 2
    if lines.rx_velocity_m_s is not None:  # receivers move while the sound travels
        range_m = np.linalg.norm(row_m[rows // 2] - centres_m.mean(axis=0))
        centres_m = centres_m + lines.rx_velocity_m_s * range_m / lines.sound_speed_m_s
    middle_m = centres_m.mean(axis=0)
    offset_m = centres_m - middle_m
    direction = _row_direction(lines, grid, beam, offset_m)
    along_m = offset_m @ direction
    off_m = offset_m - along_m[:, None] * direction
    row_m = row_m - middle_m
    row_along_m = row_m @ direction
    across_m = row_m - row_along_m[:, None] * direction
    squint = 0.0 if beam is None else math.radians(beam.squint_deg)
    aim_m = across_m[rows // 2]
    aim_m = aim_m + np.linalg.norm(aim_m) * math.tan(squint) * direction
    ignored_m = 0.0 if compensated else off_m
    ends_m = (tx_m - middle_m - ignored_m, rx_m - middle_m - ignored_m)
    points_m = along_m[:, None] * direction + aim_m
    motion = lines.rx_velocity_m_s, lines.sound_speed_m_s
    true_range_m = bistatic_range_m(points_m, *ends_m, *motion)
    return StraightTrack(
        along_m,
        true_range_m - float(np.linalg.norm(aim_m)),
        float(np.linalg.norm(off_m, axis=1).max()),
        np.linalg.norm(across_m, axis=1),
        row_along_m[:, None] + np.arange(columns) * (column_step_m @ direction),
    )


def _row_direction(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, offset_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unit direction of the rows of the grid, after checking it against the track's.

    `offset_m` are the phase centres relative to their mean, [channels, 3].
    """
    course = np.linalg.svd(offset_m, full_matrices=False)[2][0]
    if not np.ptp(offset_m @ course) > 0:
        raise ValueError("lines must have phase centres at two positions or more, got one")
    step_m = grid.vectors_m[2] if grid.shape[1] > 1 else course
    direction = step_m / np.linalg.norm(step_m)
    courses = {"track": course}
    if beam is not None:
        courses["beam's along"] = beam.directions(lines).mean(axis=0)
        direction = direction * np.copysign(1, direction @ courses["beam's along"])
    for name, other in courses.items():
        turn = math.acos(min(abs(other @ direction) / np.linalg.norm(other), 1))
        name = f"the angle between the grid's rows and the {name}"
        validate.number(name, math.degrees(turn), "degrees", most=_MOST_TURN_DEG)
    return direction


def aspects_of(
    lines: RangeLines, track: StraightTrack, beam: BeamWindow | None, band: Band
) -> Aspects | None:
    """Return the weights over the aspect angles that occur, or None if no pixel is visible.

    Weights fall to zero smoothly beyond the angles of all pixels, where they do not matter.
    """
    near_m, far_m = track.ranges_m
    validate.number("the distance of grid from the track", near_m, "m", least=band.wavelength_m)
    begin_m, end_m = track.reach_m(0, 0)
    ahead_m = begin_m - track.along_m.max(), end_m - track.along_m.min()
    low = math.atan2(ahead_m[0], near_m if ahead_m[0] < 0 else far_m)
    high = math.atan2(ahead_m[1], near_m if ahead_m[1] > 0 else far_m)
    # A line has no echoes from beyond its end.
    first_m = float((lines.first_range_m - track.shift_m).min())
    last_m = max(float((lines.last_range_m - track.shift_m).max()), 1e-30)
    widest = math.acos(min(near_m / last_m, 1))
    low, high = max(low, -widest), min(high, widest)
    if near_m > last_m or low > high or far_m / math.cos(max(-low, high)) < first_m:
        return None
    zone = band.zone_m(near_m) / near_m
    ends = low - (1 + _EDGE_ZONES) * zone, high + (1 + _EDGE_ZONES) * zone
    if beam is not None:
        ends = max(ends[0], beam.limits_rad[0]), min(ends[1], beam.limits_rad[1])
    if not ends[0] < ends[1]:
        return None
    steepest = math.degrees(max(-ends[0], ends[1]))
    name = "the aspect angle of grid, unless beam limits it,"
    validate.number(name, steepest, "degrees", most=_STEEPEST_DEG)
    # Angles are the middles of intervals, so that jumps at the ends of a beam stay outside.
    step = (ends[1] - ends[0]) / _ANGLES
    angle = ends[0] + step * (np.arange(_ANGLES) + 0.5)
    fade = smooth_edge(((angle - high) / zone - 1) / _EDGE_ZONES)
    fade *= smooth_edge(((low - angle) / zone - 1) / _EDGE_ZONES)
    if beam is None:
        return Aspects(*ends, np.sin(angle), (fade,))
    weight = beam.weights(np.sin(angle), wavelength_m(lines))
    slope = np.gradient(weight, step)
    second = (np.gradient(slope, step) * np.cos(angle) + slope * np.sin(angle)) / 2
    second += 3 / 8 * weight / np.cos(angle)
    return Aspects(*ends, np.sin(angle), (weight * fade, second * fade))
