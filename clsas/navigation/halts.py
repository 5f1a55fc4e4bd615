"""Pings that a platform recorded standing still while its navigation moved.

All pings of a halt receive the same echoes. If a platform moves, pings of a stretch of several
Fresnel lengths have little in common, because the phase of every echo turns by cycles. The
navigation predicts how much they should have in common. A wall or a pipe along the track also gives
the same echoes everywhere, and a halt cannot then be distinguished from a passage.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsas.engine.signal.interpolation import Readout
from clsas.navigation.responses import Contributions, Passage

_STRETCH = 4.0
"""Length of a stretch in Fresnel lengths. Over it, an echo from broadside has 1/16 of its power in
common, and other echoes less. Over half of it, the share would be 1/5."""
_LEAST_PINGS = 8  # pings in a stretch
_READ_PINGS, _READ_RECEIVERS = 32, 4  # most pings and receivers of a stretch that are compared
_MOST_COMMON = 0.3
"""Largest share of the power that pings of a passage have in common. Passages over points and
speckle reach 0.03. Halts have 0.56 if noise is as strong as the echoes."""
_MOST_EXPECTED = 0.2
"""Largest share predicted by the navigation for which halts and passages differ. Straight tracks
have up to 0.07, and a circle about the only response has 1."""


def halt(passage: Passage, readout: Readout, found: Contributions) -> tuple[int, int] | None:
    """Return the first and last ping of the longest halt that the navigation does not contain.

    Parameters
    ----------
    passage : Passage
        Passage according to the navigation.
    readout : Readout
        The lines.
    found : Contributions
        Contributions to the brightest responses along the navigated track. Pings are compared at
        the ranges of these responses.

    Returns
    -------
    (first, last) or None
        None if pings have little in common, or as much as the navigation predicts.
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
    """Return the first ping of every stretch, and the one after its last."""
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
    """Return the share of the power that pings have in common if the navigation is correct."""
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
    """Return the share of the power that all pings of a stretch have in common.

    Its expectation is 0 for independent pings. All pings count equally, whatever their level.
    """
    lines = passage.lines
    starts = lines.ping_starts
    counts = np.diff(np.append(starts, lines.channels))[first:stop]
    pings = first + _evenly_spaced(stop - first, _READ_PINGS)
    common = total = 0.0
    for receiver in _evenly_spaced(int(counts.min()), _READ_RECEIVERS).tolist():
        channels = starts[pings] + receiver
        values = _unit_power(readout.read(channels, _ranges_m(readout, found, channels)))
        number = len(values)
        if number < _LEAST_PINGS:
            continue
        mean = float(np.sum(np.abs(values.mean(axis=0)) ** 2))
        common += (number * mean - 1) / (number - 1)
        total += 1.0
    return common / total if total else 0.0


def _evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Return up to `most` of `count` numbers."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _ranges_m(
    readout: Readout, found: Contributions, channels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the ranges of the responses that all of the channels have, [channels, n]."""
    lines = readout.lines
    least_m = max(float(found.range_m[channels].min()), float(lines.first_range_m[channels].max()))
    most_m = min(float(found.range_m[channels].max()), float(lines.last_range_m[channels].min()))
    range_m = np.arange(least_m, most_m + lines.range_step_m, lines.range_step_m)
    return np.broadcast_to(range_m, (len(channels), len(range_m)))


def _unit_power(values: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """Return the pings that received anything, [pings, n], each scaled to a total power of 1."""
    wide = values.astype(np.complex128)
    power = np.sum(np.abs(wide) ** 2, axis=1)
    received = power > 0
    return wide[received] / np.sqrt(power[received])[:, None]
