"""Numbers that float32 sums and float64 phases cannot hold, refused before any work."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines, fastest, wavelength_m
from clsas.exact.tiles import Groups, Tiles
from clsas.sonar.beam import BeamWindow

_LARGEST_DISTANCE_M = 1e9
_SMALLEST_STEP_M = 1e-9
_MOST_CYCLES = 1e10  # float64 leaves 1e-6 of a cycle
_LARGEST_SUM = 1e37
_LOOKED_AT = 1 << 18  # numbers of lines at a time
_FASTEST = 0.05  # of a receiver, in sound speeds: cl/antennas.h iterates on it


def check_accumulate(image: Image, grid: Grid, beam: BeamWindow | None) -> None:
    """Refuse an image that another one on a grid cannot be added to."""
    validate.instance("accumulate", image, Image)
    if image.grid is not grid and not np.array_equal(image.grid.positions_m(), grid.positions_m()):
        raise ValueError("accumulate must be an image on the same grid")
    if beam is not None and beam.normalise:
        raise ValueError("accumulate must be None with a beam that normalises: it is a mean")


def check_numbers(lines: RangeLines, beam: BeamWindow | None) -> float:
    """Refuse lines whose numbers would leave what float32 sums or float64 phases can hold.

    Return the largest part of a sample.
    """
    heaviest = 1.0
    if beam is not None:
        if beam.shape == "inverse" and not lines.carrier_hz:
            raise ValueError("carrier_hz must be above 0 for a beam of the shape 'inverse'")
        heaviest = max(float(beam.table(wavelength_m(lines)).max()), 1.0)
    validate.number(
        "range_step_m", lines.range_step_m, "m", least=_SMALLEST_STEP_M, most=_LARGEST_DISTANCE_M
    )
    farthest_m = np.abs([lines.first_range_m, lines.last_range_m]).max()
    with np.errstate(over="ignore"):
        cycles = np.float64(2) * lines.carrier_hz / lines.sound_speed_m_s * farthest_m
    if not cycles <= _MOST_CYCLES:
        raise ValueError(
            f"carrier_hz = {lines.carrier_hz:g} Hz makes {cycles:.3g} cycles over {farthest_m:g} m "
            f"at {lines.sound_speed_m_s:g} m/s; float64 holds the phase of {_MOST_CYCLES:g}"
        )
    parts = lines.samples.reshape(-1).view(np.float32)  # contiguous, as every RangeLines
    # Part by part, so that a cache holds them for the second look.
    spans = [parts[i : i + _LOOKED_AT] for i in range(0, parts.size, _LOOKED_AT)]
    largest = float(max(max(span.max(), -span.min()) for span in spans))
    most = _LARGEST_SUM / heaviest / lines.channels
    if largest > most:
        raise ValueError(
            f"samples must be at most {most:.3g} for the sum of {lines.channels} channels to stay "
            f"within float32, got {largest:.3g}"
        )
    speed_m_s = fastest(lines) * lines.sound_speed_m_s
    most_m_s = _FASTEST * lines.sound_speed_m_s
    validate.number("the speed of rx_velocity_m_s", speed_m_s, "m/s", most=most_m_s * (1 + 1e-9))
    return largest


def check_distances(antennas_m: NDArray[np.float64], layout: Tiles | Groups) -> None:
    """Refuse distances so large that a square overflows float32."""
    points_m = np.concatenate([antennas_m, layout.centres_m(slice(None))])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if extent_m > _LARGEST_DISTANCE_M:
        raise ValueError(
            f"lines and grid must lie within {_LARGEST_DISTANCE_M:g} m of each other, "
            f"got {extent_m:g} m"
        )
