"""Lookup of samples: how many vectors of them the lanes of a block pick theirs from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from clsas.core.lines import RangeLines, fastest
from clsas.exact.tiles import HELD
from clsas.opencl.device import Device

_FLOAT32 = 0.05  # samples of room for the rounding of positions

# Relative time of a pixel and channel, measured with PoCL.
_COSTS = {16: {2: 1.0}, 8: {1: 1.0, 2: 1.4}}  # by lanes, and vectors from which they pick
_SINGLY = 3.0  # each lane reads its own samples


class _Layout(Protocol):
    def windows(self, most_m: float) -> int: ...


def lookup_options(
    device: Device, layout: _Layout, lines: RangeLines, samples_per_m: float, taps: int
) -> dict[str, int]:
    """Return the build options of the lookup (cl/lookup.h).

    They are the fastest with which every pixel finds its samples: in one vector where the
    positions of a block fit, else in two, else singly.
    """
    # Ranges to moving receivers change a little faster than pixel positions.
    metres = 1 / samples_per_m / (1 + 2 * fastest(lines))
    for vectors in _lookups(device):
        windows = layout.windows(lookup_room(vectors, taps, device.info.width) * metres)
        if windows:
            return {"PERMUTE": vectors, "WINDOWS": windows}
    return {"PERMUTE": 0, "WINDOWS": 1}


def lookup_cost(
    device: Device, layout: _Layout, lines: RangeLines
) -> Callable[[int, float], float]:
    """Return the time of a pixel and channel, 1 at best, as a function of taps and upsampling."""
    if not _lookups(device):
        return lambda taps, upsampling: 1.0
    costs = _lookups(device) | {0: _SINGLY}

    def cost(taps: int, upsampling: float) -> float:
        samples_per_m = upsampling / lines.range_step_m
        return costs[lookup_options(device, layout, lines, samples_per_m, taps)["PERMUTE"]]

    return cost


def lookup_room(vectors: int, taps: int, width: int) -> float:
    """Return the largest distance, samples, of a pixel's echo from the middle of its window.

    A window of AVX-512 is two vectors with the samples of all taps; one of AVX2 is the samples of
    one tap. Rounding positions to whole samples takes half a sample.
    """
    positions = 2 * width - taps + 1 if width == HELD else vectors * width
    return (positions - 1) / 2 - _FLOAT32


def _lookups(device: Device) -> dict[int, float]:
    """Return the costs of picking, by vectors; {} where lanes cannot pick."""
    return _COSTS.get(device.info.width, {}) if device.info.permute else {}
