"""Lookup of samples: the size of the window of samples that a work-item holds in registers."""

from __future__ import annotations

from typing import Protocol

from clsas.core.lines import RangeLines, fastest
from clsas.opencl.device import Device
from clsas.signal import interpolation

_FLOAT32 = 0.05  # samples of room for the rounding of positions


class _Layout(Protocol):
    def windows(self, most_m: float) -> int: ...


def most_upsampling(device: Device, lines: RangeLines, lookup_radius_m: float) -> dict[int, float]:
    """Return, by taps, the upsampling beyond which blocks no longer fit a window; {} if none."""
    if not device.info.permute:
        return {}
    reach_m = lookup_radius_m * (1 + 2 * fastest(lines))
    samples = {taps: lookup_room(taps, device.info.width) for taps in interpolation.TAPS}
    return {taps: room * lines.range_step_m / max(reach_m, 1e-30) for taps, room in samples.items()}


def lookup_options(
    device: Device, layout: _Layout, lines: RangeLines, samples_per_m: float, taps: int
) -> dict[str, int]:
    """Return the build options of the lookup (cl/lookup.h)."""
    # Ranges to moving receivers change a little faster than pixel positions.
    most_m = lookup_room(taps, device.info.width) / samples_per_m / (1 + 2 * fastest(lines))
    windows = layout.windows(most_m) if device.info.permute else 0
    return {"PERMUTE": int(windows > 0), "WINDOWS": windows or 1}


def lookup_room(taps: int, width: int) -> float:
    """Return the largest distance, samples, of a pixel's echo from the middle of a window.

    A window holds two vectors of samples. Half the taps of an interpolation reach beyond the echo.
    Rounding both positions to whole samples costs no room, since the window's middle lies between
    two samples.
    """
    return width - taps / 2 - _FLOAT32
