"""Pings that a platform took standing still while its navigation moved.

All pings of a halt receive the same echoes. Of a platform that moves, those of a stretch of several
Fresnel lengths have little in common: every echo's phase turns by cycles. The navigation tells how
much they should have in common. A wall or a pipe along the track gives the same echoes everywhere,
too, and nothing then tells a halt from a passage.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsas.navigation.responses import Contributions, Passage
from clsas.signal.readout import Readout

_STRETCH = 4.0
"""Fresnel lengths of a stretch. An echo from broadside has 1/16 of its power in common over it, one
from elsewhere less; over half of it 1/5."""
_LEAST_PINGS = 8  # of a stretch
_READ_PINGS, _READ_RECEIVERS = 32, 4  # of a stretch, at most
_MOST_COMMON = 0.3
"""Share of the power. Passages of points and speckle have up to 0.03, halts 0.56 where noise has
the power of the echoes."""
_MOST_EXPECTED = 0.2
"""Share by the navigation, up to which it tells a passage from a halt. Straight tracks have up to
0.07, a circle about the one response 1."""


def halt(passage: Passage, readout: Readout, found: Contributions) -> tuple[int, int] | None:
    """Return the first and last ping of the longest halt that the navigation does not have.

    Parameters
    ----------
    passage : Passage
        By the navigation.
    readout : Readout
        The lines.
    found : Contributions
        To the brightest responses along the navigation's track. Their ranges are looked at.

    Returns
    -------
    (first, last) or None
        None where pings have little in common, or as much as the navigation makes expect.
    """
    halts: list[tuple[int, int]] = []
    for first, stop in _stretches(passage, found):
        if _expected_share(passage, found, first, stop) > _MOST_EXPECTED:
            continue
        if _common_share(passage, readout, found, first, stop) <= _MOST_COMMON:
            continue
        if halts and halts[-1][1] >= first - 1:
            halts[-1] = halts[-1][0], stop - 1
        else:
            halts.append((first, stop - 1))
    return max(halts, key=lambda each: each[1] - each[0], default=None)


def _stretches(passage: Passage, found: Contributions) -> list[tuple[int, int]]:
    """Return the first pings of stretches, and those after their last ones."""
    along_m = passage.along_m
    length_m = _STRETCH * passage.fresnel_length_m(found)
    count = max(int((along_m[-1] - along_m[0]) / length_m), 1)
    starts_m = along_m[0] + (along_m[-1] - along_m[0]) * np.arange(1, count) / count
    edges = [0, *np.searchsorted(along_m, starts_m).tolist(), passage.pings]
    kept = [0]
    for edge in edges[1:]:
        if edge - kept[-1] >= _LEAST_PINGS:
            kept.append(edge)
    kept[-1] = passage.pings if len(kept) > 1 else kept[-1]
    return list(pairwise(kept))


def _expected_share(passage: Passage, found: Contributions, first: int, stop: int) -> float:
    """Return the share of the power that pings have in common if they move like the navigation."""
    some = np.flatnonzero((passage.ping >= first) & (passage.ping < stop))
    if not len(some):
        return 1.0
    turns = 2 * found.range_m[some] / passage.wavelength_m
    common = np.abs(np.mean(np.exp(2j * np.pi * turns), axis=0)) ** 2
    brightness = np.abs(np.sum(found.values[some, :, 0], axis=0, dtype=np.complex128)) ** 2
    total = float(brightness.sum())
    return float(brightness @ common) / total if total else 1.0


def _common_share(
    passage: Passage, readout: Readout, found: Contributions, first: int, stop: int
) -> float:
    """Return the share of the power that is the same in all pings of a stretch.

    Of independent pings the expectation is 0. Pings count alike, however loud they are.
    """
    lines = passage.lines
    starts = lines.ping_starts
    counts = np.diff(np.append(starts, lines.channels))[first:stop]
    pings = first + _spread(stop - first, _READ_PINGS)
    common = total = 0.0
    for receiver in _spread(int(counts.min()), _READ_RECEIVERS).tolist():
        channels = starts[pings] + receiver
        values = _unit_power(readout.read(channels, _ranges_m(readout, found, channels)))
        number = len(values)
        if number < _LEAST_PINGS:
            continue
        mean = float(np.sum(np.abs(values.mean(axis=0)) ** 2))
        common += (number * mean - 1) / (number - 1)
        total += 1.0
    return common / total if total else 0.0


def _spread(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _ranges_m(
    readout: Readout, found: Contributions, channels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return ranges about the responses that all of the channels have, [channels, n]."""
    lines = readout.lines
    least_m = max(float(found.range_m[channels].min()), float(lines.first_range_m[channels].max()))
    most_m = min(float(found.range_m[channels].max()), float(lines.last_range_m[channels].min()))
    range_m = np.arange(least_m, most_m + lines.range_step_m, lines.range_step_m)
    return np.broadcast_to(range_m, (len(channels), len(range_m)))


def _unit_power(values: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """Return the pings that received something, [pings, n], each with a power of 1 in all."""
    wide = values.astype(np.complex128)
    power = np.sum(np.abs(wide) ** 2, axis=1)
    heard = power > 0
    return wide[heard] / np.sqrt(power[heard])[:, None]
