"""Ratio of the power of an image to the power that its channels receive.

If most echoes at the ranges of the pixels come from places beside the grid, or from such that the
beam hardly covers, most of what the channels receive cancels in the image. Interpolation errors do
not cancel. They are therefore larger relative to such an image than relative to one of a seabed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.visibility import sines
from clsas.engine.data.wavelengths import wavelength_m
from clsas.engine.signal.spectrum import Spectrum

# Channels summed coherently. With half as many, echoes from beside a pixel cancel less, and images
# of points at the edge of the beam look 3 dB brighter than they are; twice as many change 1 dB.
_GROUP = 64
_LEAST_GROUP = 32
_MOST = 1024  # channels summed together if groups are dark: a plain choice
_GROUPS = 4  # groups of channels, spread evenly along the lines
# Points along either side of the grid: first without and with a beam, whose coverage may vary, and
# then if those find little power.
_FEW, _SOME, _MANY = 8, 16, 48
_PAIRS_AT_ONCE = 1 << 16  # of points and channels; bounds memory
_DARKEST = 1e-8  # least ratio returned, far below what any image resolves
_DARK = 0.5  # ratio above which images are not dark; sampling alone changes it by 1 dB


def brightness(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the power of an image over the power that its channels receive, 1 unless it is dark.

    Parameters
    ----------
    lines, grid, spectrum
        Lines, pixels, and the spectrum of the lines.
    beam, along : BeamWindow and float64 [channels, 3], or None
        Weights of the channels, and the unit directions of the track at the channels.

    Notes
    -----
    With z_i = w_i s_i(rho_i) exp(j 2 k rho_i), sums of z_i over groups of neighbouring channels
    keep what arrives from about the direction of a pixel: the beam of a group is so wide that no
    bright echo within the grid is missed. The brightness is the power of these sums, averaged over
    pixels and groups, over the power of all z_i. If it is low, it is that of the sums of all
    channels, where echoes from beside the grid cancel further.
    """
    if lines.channels < 2 * _LEAST_GROUP or lines.length < 2:
        return 1.0
    if beam is None and len(grid.spread(_FEW)) < _FEW**2:
        return 1.0  # a few pixels are dark by chance, which `scatter` allows for
    group = min(_GROUP, lines.channels // 2)
    centres_m = lines.phase_centres_m  # in any order
    order = np.argsort(centres_m[:, np.ptp(centres_m, axis=0).argmax()], kind="stable")
    middles = order[np.linspace(0, lines.channels - 1, 2 * _GROUPS + 1)[1::2].astype(np.int64)]
    channels = np.stack(
        [
            np.argpartition(np.sum((centres_m - centres_m[each]) ** 2, axis=1), group - 1)[:group]
            for each in middles
        ]
    )
    found = 1.0
    for most in (_FEW if beam is None else _SOME, _MANY):
        points_m = grid.spread(most)
        found = _of_groups(lines, channels, points_m, spectrum, beam, along)
        if found > _DARK:
            return 1.0
    # Echoes from beside the grid also cancel between groups.
    whole = order[some_channels(lines.channels, _MOST)][None]
    found = min(found, _of_groups(lines, whole, points_m, spectrum, beam, along))
    return max(found, _DARKEST)


def _of_groups(
    lines: RangeLines,
    groups: NDArray[np.int64],
    points_m: NDArray[np.float64],
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the power of sums over groups [groups, channels], relative to that of their terms."""
    channels = groups.ravel()
    part = lines.select(channels)
    coherent = passed = 0.0
    at_once = max(_PAIRS_AT_ONCE // len(channels), 1)
    for first in range(0, len(points_m), at_once):
        some_m = points_m[first : first + at_once]
        values = _received(part, some_m, spectrum)
        if beam is not None and along is not None:
            values *= _weights(lines, channels, some_m, beam, along)
        sums = values.reshape(len(some_m), *groups.shape).sum(axis=-1)
        coherent += float(np.vdot(sums, sums).real)
        passed += float(np.vdot(values, values).real)
    return coherent / passed if passed else 1.0


def _received(
    lines: RangeLines, points_m: NDArray[np.float64], spectrum: Spectrum
) -> NDArray[np.complex128]:
    """Return s_i(rho_i) exp(j 2 k rho_i) of all channels at points, [points, channels]."""
    range_m = pairwise_range_m(
        points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
    )
    sample = (range_m - lines.first_range_m) / lines.range_step_m
    lower = np.floor(sample)
    inside = (lower >= 0) & (lower < lines.length - 1)
    index = np.where(inside, lower, 0).astype(np.int64)
    # Linear interpolation about the centre of the band.
    between = sample - lower
    turns = spectrum.centre * between
    channel = np.arange(lines.channels)
    values = (1 - between) * lines.samples[channel, index]
    values = values + between * lines.samples[channel, index + 1] * np.exp(
        -2j * np.pi * spectrum.centre
    )
    turns += lines.carrier_cycles_per_m * range_m
    values *= np.exp(2j * np.pi * (turns - np.rint(turns)))
    return values * inside


def _weights(
    lines: RangeLines,
    channels: NDArray[np.int64],
    points_m: NDArray[np.float64],
    beam: BeamWindow,
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the weights of the beam, [points, channels]."""
    sine = sines(points_m, lines.phase_centres_m[channels], along[channels]).T
    weights: NDArray[np.float64] = beam.weights(sine, wavelength_m(lines))
    return weights
