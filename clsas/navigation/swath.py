"""The swath: rays to the seabed, and windows of range; how large arrays and elements may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.navigation.overlap import Array
from clsas.signal.spectrum import measure_spectrum

_LEAST_WINDOW = 16  # samples
_WINDOW_CELLS = 150.0  # range resolution cells of a window, unless given
_LONGEST_ARRAY = 4.0  # farthest ranges
_SHORTEST_ARRAY, _SHORTEST_ELEMENT = 0.5, 0.05  # wavelengths


@dataclass(frozen=True, eq=False)
class Swath:
    """Part of the seabed that is measured, in windows of range.

    Attributes
    ----------
    edges_m : float64 [windows + 1]
        Ranges between windows.
    side : int
        1 where the seabed lies to port, -1 to starboard.
    seabed_z_m : float or None
        Height of the seabed; None takes every ray as horizontal.
    element_length_m : (transmitter, receiver) or None
        Lengths of the elements, whose beam weighs directions; None takes the beam as narrow.
    """

    edges_m: NDArray[np.float64]
    side: int = 1
    seabed_z_m: float | None = None
    element_length_m: tuple[float, float] | None = None

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.edges_m) - 1

    @property
    def middles_m(self) -> NDArray[np.float64]:
        """Ranges in the middle of the windows, [windows]."""
        return (self.edges_m[1:] + self.edges_m[:-1]) / 2

    def slopes(
        self, height_m: NDArray[np.float64], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal and vertical parts of unit rays that end on the seabed.

        `height_m` is that of where rays begin. Rays shorter than their height point straight down.
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
    """Return the swath of checked arguments."""
    side = validate.one_of("side", side, ("port", "starboard"))
    nearest, farthest = float(lines.first_range_m.max()), float(lines.last_range_m.min())
    if range_m is None:
        # Rays are read where every channel has samples, whatever it is displaced.
        spare = 0.02 * (farthest - nearest)
        near, far = nearest + spare, farthest - spare
    else:
        near, far = map(float, validate.array("range_m", range_m, np.float64, (2,)))
    if not nearest <= near < far <= farthest:
        raise ValueError(
            f"range_m must lie within what every channel has, {nearest:.6g} to {farthest:.6g} m, "
            f"the nearer first, got ({near:.6g}, {far:.6g})"
        )
    if far - near < _LEAST_WINDOW * lines.range_step_m:
        raise ValueError(
            f"range_m must be at least {_LEAST_WINDOW} samples long, "
            f"{_LEAST_WINDOW * lines.range_step_m:.4g} m, got {far - near:.4g} m"
        )
    if window_m is None:
        cell_m = lines.range_step_m * max(measure_spectrum(lines).oversampling, 1.0)
        window_m = min(_WINDOW_CELLS * cell_m, far - near)
    window_m = validate.number(
        "window_m",
        window_m,
        "m",
        least=_LEAST_WINDOW * lines.range_step_m,
        most=(far - near) * (1 + 1e-9),
    )
    if seabed_z_m is not None:
        seabed_z_m = validate.number("seabed_z_m", seabed_z_m, "m")
        height_m = float(np.abs(lines.phase_centres_m[:, 2] - seabed_z_m).max())
        if height_m >= near:
            raise ValueError(
                f"seabed_z_m must lie less than the nearest range of {near:.4g} m from the sonar's "
                f"height, got {height_m:.4g} m: rays must reach the seabed beside it"
            )
    lengths = None
    if element_length_m is not None:
        given = validate.array("element_length_m", element_length_m, np.float64, None).ravel()
        if not 1 <= given.size <= 2 or given.min() <= 0:
            raise ValueError(
                "element_length_m must be one or two lengths above 0 m, got "
                f"{validate.shown(element_length_m)}"
            )
        lengths = float(given[0]), float(given[-1])
    windows = max(int((far - near) / window_m + 1e-9), 1)
    edges = np.linspace(near, far, windows + 1)
    return Swath(edges, 1 if side == "port" else -1, seabed_z_m, lengths)


def check_sizes(lines: RangeLines, array: Array, swath: Swath, wave_m: float) -> None:
    """Refuse arrays and elements of a size that no sonar has: lengths in other units."""
    centres_m = lines.phase_centres_m[array.channels(0)]
    length_m, farthest_m = float(np.ptp(centres_m @ array.forward[0])), float(swath.edges_m[-1])
    least_m, most_m = _SHORTEST_ARRAY * wave_m, _LONGEST_ARRAY * farthest_m
    if not least_m <= length_m <= most_m:
        raise ValueError(
            f"the phase centres of a ping must extend over {least_m:.3g} to {most_m:.3g} m (half a "
            f"wavelength to {_LONGEST_ARRAY:g} times the farthest range), got {length_m:.3g} m: "
            "are the positions of lines in metres?"
        )
    least_m, most_m = _SHORTEST_ELEMENT * wave_m, 2 * length_m
    for each_m in swath.element_length_m or ():
        if not least_m <= each_m <= most_m:
            raise ValueError(
                f"element_length_m must be from {least_m:.3g} m (a twentieth of a wavelength) to "
                f"{most_m:.3g} m (the array of receivers), got {each_m:.3g} m"
            )
