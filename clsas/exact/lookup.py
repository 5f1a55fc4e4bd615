"""Lookup of samples: the number of vectors from which the lanes of a block pick their samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from clsas.core.lines import RangeLines, fastest
from clsas.exact.tiles import HELD
from clsas.opencl.device import Device

_FLOAT32 = 0.05  # margin for the rounding of positions, samples

# Relative time of a pixel and channel, measured with PoCL, by the number of lanes and the number of
# vectors from which they pick.
_COSTS = {16: {2: 1.0}, 8: {1: 1.0, 2: 1.4}}
_SINGLY = 3.0  # relative time if each lane reads its own samples


class _Layout(Protocol):
    def windows(self, most_m: float) -> int: ...


def lookup_options(
    device: Device, layout: _Layout, lines: RangeLines, samples_per_m: float, taps: int
) -> dict[str, int]:
    """Return the build options of the lookup (cl/lookup.h).

    These are the fastest options with which every pixel finds its samples: in one vector if the
    positions of a block fit into it, else in two, else every lane for itself.
    """
    # Ranges to moving receivers change a little faster than the positions of pixels.
    metres = 1 / samples_per_m / (1 + 2 * fastest(lines))
    for vectors in _lookups(device):
        windows = layout.windows(lookup_room(vectors, taps, device.info.width) * metres)
        if windows:
            return {"PERMUTE": vectors, "WINDOWS": windows}
    return {"PERMUTE": 0, "WINDOWS": 1}


def lookup_cost(
    device: Device, layout: _Layout, lines: RangeLines
) -> Callable[[int, float], float]:
    """Return the relative time per pixel and channel as a function of taps and upsampling."""
    if not _lookups(device):
        return lambda taps, upsampling: 1.0
    costs = _lookups(device) | {0: _SINGLY}

    def cost(taps: int, upsampling: float) -> float:
        samples_per_m = upsampling / lines.range_step_m
        return costs[lookup_options(device, layout, lines, samples_per_m, taps)["PERMUTE"]]

    return cost


def lookup_room(vectors: int, taps: int, width: int) -> float:
    """Return the largest allowed distance of a pixel's echo from the middle of its window, samples.

    With AVX-512, a window is two vectors with the samples of all taps. With AVX2 it contains the
    samples of one tap. Rounding positions to whole samples takes half a sample.
    """
    positions = 2 * width - taps + 1 if width == HELD else vectors * width
    return (positions - 1) / 2 - _FLOAT32


def _lookups(device: Device) -> dict[int, float]:
    """Return the costs of picking by number of vectors; {} if lanes cannot pick."""
    return _COSTS.get(device.info.width, {}) if device.info.permute else {}
