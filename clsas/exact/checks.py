"""Checks of the input of exact images, including numbers beyond float32 sums or float64 phases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines, fastest
from clsas.core.wavelengths import wavelength_m
from clsas.exact.groups import Groups
from clsas.exact.tiles import Tiles
from clsas.sonar.beam import BeamWindow

_SMALLEST_STEP_M = 1e-9
_LARGEST_SUM = 1e37
_NUMBERS_AT_ONCE = 1 << 18  # numbers that stay in a core's cache between two passes over them
# Largest speed of a receiver, in sound speeds. The third-order terms of cl/expand_tiles.cl neglect
# motion.
_FASTEST = 0.05


def check_input(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, accuracy_db: float, best_db: float
) -> float:
    """Check the lines, grid, beam and accuracy of an image; return the accuracy, dB."""
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.memory("grid", 8 * grid.size)
    accuracy_db = validate.number("accuracy_db", accuracy_db, "dB", least=best_db, below=0.0)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    check_numbers(lines, beam)
    return accuracy_db


def check_accumulate(image: Image, grid: Grid, beam: BeamWindow | None) -> None:
    """Raise an error if the image on a grid cannot be added to the image `accumulate`."""
    validate.instance("accumulate", image, Image)
    is_placed_alike = image.grid.georeference == grid.georeference
    if image.grid is not grid and not (
        is_placed_alike and np.array_equal(image.grid.positions_m(), grid.positions_m())
    ):
        raise ValueError("accumulate must be an image on the same grid")
    if beam is not None and beam.normalise:
        raise ValueError(
            "accumulate must be None with a beam that normalises, because normalised images are "
            "means and cannot be added"
        )


def check_numbers(lines: RangeLines, beam: BeamWindow | None) -> float:
    """Raise ValueError for lines that would overflow float32 sums or lose the phase in float64.

    Returns
    -------
    float
        Largest magnitude of a real or imaginary part of the samples.
    """
    heaviest = 1.0
    if beam is not None:
        if beam.shape == "inverse" and not lines.carrier_hz:
            raise ValueError("carrier_hz must be above 0 for a beam of shape 'inverse'")
        heaviest = max(float(beam.table(wavelength_m(lines)).max()), 1.0)
    validate.number(
        "range_step_m", lines.range_step_m, "m", least=_SMALLEST_STEP_M, most=validate.FARTHEST_M
    )
    farthest_m = np.abs([lines.first_range_m, lines.last_range_m]).max()
    validate.phase(lines.carrier_hz, lines.sound_speed_m_s, float(farthest_m))
    parts = lines.samples.reshape(-1).view(np.float32)  # samples of RangeLines are contiguous
    spans = [parts[i : i + _NUMBERS_AT_ONCE] for i in range(0, parts.size, _NUMBERS_AT_ONCE)]
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
    """Raise ValueError for distances so large that their squares overflow float32."""
    points_m = np.concatenate([antennas_m, layout.centres_m(slice(None))])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if extent_m > validate.FARTHEST_M:
        raise ValueError(
            f"lines and grid must lie within {validate.FARTHEST_M:g} m of each other, "
            f"got {extent_m:g} m"
        )
