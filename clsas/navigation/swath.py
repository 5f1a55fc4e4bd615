"""Swath of the seabed that is measured, and checks of the sizes of arrays and elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.navigation.overlap import Array

SIDES = ("port", "starboard")
"""Sides of the track on which the seabed may lie."""
_LEAST_WINDOW = 16  # samples
_WINDOW_CELLS = 150.0  # default length of a window, range resolution cells
_LONGEST_ARRAY = 4.0  # farthest ranges
_SHORTEST_ARRAY, _SHORTEST_ELEMENT = 0.5, 0.05  # wavelengths


@dataclass(frozen=True, eq=False)
class Swath:
    """Part of the seabed that is measured, divided into windows of range.

    Attributes
    ----------
    edges_m : float64 [windows + 1]
        Ranges between windows, and at both ends.
    side : int
        1 if the seabed lies to port, -1 if it lies to starboard.
    seabed_z_m : float or None
        Height of the seabed. With None, all rays are horizontal.
    element_length_m : (transmitter, receiver) or None
        Lengths of the elements, whose beam weighs the directions. With None, the beam counts as
        narrow.
    """

    edges_m: NDArray[np.float64]
    side: int = 1
    seabed_z_m: float | None = None
    element_length_m: tuple[float, float] | None = None

    @property
    def middles_m(self) -> NDArray[np.float64]:
        """Ranges in the middle of the windows, [windows]."""
        return (self.edges_m[1:] + self.edges_m[:-1]) / 2

    def slopes(
        self, height_m: NDArray[np.float64], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal and vertical parts of unit rays that end on the seabed.

        `height_m` is the height of their origins. A ray that is too short to reach the seabed
        points straight down.
        """
        if self.seabed_z_m is None:
            return np.ones_like(range_m), np.zeros_like(range_m)
        down = np.clip((height_m - self.seabed_z_m) / range_m, -1.0, 1.0)
        return np.sqrt(1 - down**2), -down


def checked_swath(
    lines: RangeLines,
    range_m: tuple[float, float] | None,
    window_m: float | None,
    side: str,
    seabed_z_m: float | None,
    element_length_m: float | tuple[float, float] | None,
) -> Swath:
    """Return the swath that the arguments of `micronavigate` describe, after checking them."""
    side = validate.one_of("side", side, SIDES)
    near_m, far_m = _checked_ranges(lines, range_m)
    if window_m is None:
        cell_m = lines.range_step_m * max(measure_spectrum(lines).oversampling, 1.0)
        window_m = min(_WINDOW_CELLS * cell_m, far_m - near_m)
    window_m = validate.number(
        "window_m",
        window_m,
        "m",
        least=_LEAST_WINDOW * lines.range_step_m,
        most=(far_m - near_m) * (1 + 1e-9),
    )
    if seabed_z_m is not None:
        seabed_z_m = _checked_seabed(lines, seabed_z_m, near_m)
    lengths_m = None if element_length_m is None else _checked_lengths(element_length_m)
    windows = max(int((far_m - near_m) / window_m + 1e-9), 1)
    edges_m = np.linspace(near_m, far_m, windows + 1)
    return Swath(edges_m, 1 if side == "port" else -1, seabed_z_m, lengths_m)


def _checked_ranges(lines: RangeLines, range_m: tuple[float, float] | None) -> tuple[float, float]:
    """Return the nearest and farthest range to use; by default nearly all that channels share."""
    nearest_m, farthest_m = float(lines.first_range_m.max()), float(lines.last_range_m.min())
    if range_m is None:
        # A margin keeps displaced rays within the samples of every channel.
        margin_m = 0.02 * (farthest_m - nearest_m)
        near_m, far_m = nearest_m + margin_m, farthest_m - margin_m
    else:
        near_m, far_m = map(float, validate.array("range_m", range_m, np.float64, (2,)))
    if not nearest_m <= near_m < far_m <= farthest_m:
        raise ArgumentError(
            "range_m",
            f"lie within the ranges that all channels have, {nearest_m:.6g} to {farthest_m:.6g} m, "
            "with the nearest first",
            (near_m, far_m),
        )
    least_m = _LEAST_WINDOW * lines.range_step_m
    if far_m - near_m < least_m:
        allowed = f"be at least {_LEAST_WINDOW} samples long, {least_m:.4g} m"
        raise ArgumentError("range_m", allowed, f"{far_m - near_m:.4g} m")
    return near_m, far_m


def _checked_seabed(lines: RangeLines, seabed_z_m: float, near_m: float) -> float:
    seabed_z_m = validate.number("seabed_z_m", seabed_z_m, "m")
    height_m = float(np.abs(lines.phase_centres_m[:, 2] - seabed_z_m).max())
    if height_m >= near_m:
        raise ArgumentError(
            "seabed_z_m",
            f"differ from the height of the sonar by less than the nearest range, {near_m:.4g} m, "
            "so that rays reach the seabed",
            f"a difference of {height_m:.4g} m",
        )
    return seabed_z_m


def _checked_lengths(element_length_m: float | tuple[float, float]) -> tuple[float, float]:
    given = validate.array("element_length_m", element_length_m, np.float64, None).ravel()
    if not 1 <= given.size <= 2 or given.min() <= 0:
        raise ArgumentError(
            "element_length_m", "be one or two lengths above 0 m", validate.shown(element_length_m)
        )
    return float(given[0]), float(given[-1])


def check_sizes(lines: RangeLines, array: Array, swath: Swath, wavelength_m: float) -> None:
    """Refuse arrays and elements of impossible sizes, which indicate lengths in other units."""
    centres_m = lines.phase_centres_m[array.channels(0)]
    length_m, farthest_m = float(np.ptp(centres_m @ array.forward[0])), float(swath.edges_m[-1])
    least_m, most_m = _SHORTEST_ARRAY * wavelength_m, _LONGEST_ARRAY * farthest_m
    if not least_m <= length_m <= most_m:
        raise ArgumentError(
            "lines",
            f"have phase centres that extend over {least_m:.3g} to {most_m:.3g} m in a ping (half "
            f"a wavelength to {_LONGEST_ARRAY:g} times the farthest range)",
            f"{length_m:.3g} m",
            "are their positions in metres?",
        )
    least_m, most_m = _SHORTEST_ELEMENT * wavelength_m, 2 * length_m
    for each_m in swath.element_length_m or ():
        if not least_m <= each_m <= most_m:
            raise ArgumentError(
                "element_length_m",
                f"be from {least_m:.3g} m (a twentieth of a wavelength) to {most_m:.3g} m (twice "
                "the length of the array)",
                f"{each_m:.3g} m",
            )
