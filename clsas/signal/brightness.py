"""Ratio of the power of an image to the power that its beam passes.

Where the beam hardly covers the parts of a scene that its lines hold the echoes of, most of what it
passes cancels in the image. Errors of interpolation do not cancel. They are therefore larger
relative to such an image than relative to one that the beam covers evenly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.wavelengths import wavelength_m
from clsas.signal.spectrum import Spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

_GROUP = 32  # channels summed coherently; with half as many dark images look 2 to 3 dB brighter
_GROUPS = 8  # spread evenly along the lines
_POINTS = (16, 64)  # along either side of the grid: at first, and where that finds little power
_DARKEST = 1e-8  # far below what any image resolves
_DARK = 0.5  # power ratio above which images are not dark; sampling alone moves it by 1 dB
_COVERED = 0.25  # of the best point's power: a beam that covers all points so well leaves none dark
_COVERAGE_CHANNELS = 256  # sampled for that


def brightness(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the power of an image over that of what its beam passes, 1 for all but dark images.

    Parameters
    ----------
    lines, grid, spectrum
        What is imaged, and the spectrum of the lines.
    beam, along : BeamWindow and float64 [channels, 3], or None
        Weights of the channels, and the track's unit directions at these.

    Notes
    -----
    With z_i = w_i s_i(rho_i) exp(j 2 k rho_i), sums of z_i over groups of neighbouring channels
    keep what arrives from about the direction of a pixel. Their power, averaged over pixels and
    groups, over that of all z_i is the brightness. It takes the groups as incoherent, as they are
    for echoes of a seabed; coherent ones make images brighter still.
    """
    if beam is None or along is None or beam.normalise:
        return 1.0
    if lines.channels < 2 * _GROUP or lines.length < 2:
        return 1.0
    some = some_channels(lines.channels, _COVERAGE_CHANNELS)
    covered = _weights(lines, some, grid.spread(_POINTS[0]), beam, along) ** 2
    covered = covered.sum(axis=1)
    if not covered.any() or covered.min() >= _COVERED * covered.max():
        return 1.0
    starts = np.linspace(0, lines.channels - _GROUP, _GROUPS).astype(np.int64)
    channels = (starts[:, None] + np.arange(_GROUP)).ravel()
    found = 1.0
    for most in _POINTS:
        points_m = grid.spread(most)
        found = _of_groups(lines, channels, points_m, spectrum, beam, along)
        if found > _DARK:
            return 1.0
    return max(found, _DARKEST)


def _of_groups(
    lines: RangeLines,
    channels: NDArray[np.int64],
    points_m: NDArray[np.float64],
    spectrum: Spectrum,
    beam: BeamWindow,
    along: NDArray[np.float64],
) -> float:
    """Return the power of sums over groups of channels over that of their terms."""
    part = lines.select(channels)
    range_m = pairwise_range_m(
        points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
    )
    sample = (range_m - part.first_range_m) / part.range_step_m
    lower = np.floor(sample)
    inside = (lower >= 0) & (lower < part.length - 1)
    index = np.where(inside, lower, 0).astype(np.int64)
    # Linear interpolation about the centre of the band.
    between = sample - lower
    turns = spectrum.centre * between
    line = np.arange(len(channels))
    values = (1 - between) * part.samples[line, index]
    values = values + between * part.samples[line, index + 1] * np.exp(
        -2j * np.pi * spectrum.centre
    )
    turns += part.carrier_cycles_per_m * range_m
    values *= np.exp(2j * np.pi * (turns - np.rint(turns)))
    values *= inside * _weights(lines, channels, points_m, beam, along)
    sums = values.reshape(len(points_m), -1, _GROUP).sum(axis=-1)
    passed = float(np.vdot(values, values).real)
    return float(np.vdot(sums, sums).real) / passed if passed else 1.0


def _weights(
    lines: RangeLines,
    channels: NDArray[np.int64],
    points_m: NDArray[np.float64],
    beam: BeamWindow,
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the beam's weights, [points, channels]."""
    sine = sines(points_m, lines.phase_centres_m[channels], along[channels]).T
    weights: NDArray[np.float64] = beam.weights(sine, wavelength_m(lines))
    return weights
