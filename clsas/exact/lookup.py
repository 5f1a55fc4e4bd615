"""How kernels look samples up."""

from __future__ import annotations

from clsas.core.lines import RangeLines, fastest
from clsas.exact.tiles import Groups, Tiles
from clsas.opencl.device import Device
from clsas.signal import interpolation


def most_upsampling(device: Device, lines: RangeLines, lookup_radius_m: float) -> dict[int, float]:
    """Return by taps the upsampling beyond which a block is too large for the window, if any."""
    if not device.info.permute:
        return {}
    reach_m = lookup_radius_m * (1 + 2 * fastest(lines))
    samples = {taps: lookup_room(taps, device.info.width) for taps in interpolation.TAPS}
    return {taps: room * lines.range_step_m / max(reach_m, 1e-30) for taps, room in samples.items()}


def lookup_options(
    device: Device, layout: Tiles | Groups, lines: RangeLines, samples_per_m: float, taps: int
) -> dict[str, int]:
    """Return the build options that say how samples are looked up (cl/lookup.h)."""
    # Ranges to receivers that move change a little faster than pixels' places.
    reach_m = lookup_room(taps, device.info.width) / samples_per_m / (1 + 2 * fastest(lines))
    windows = layout.windows(reach_m) if device.info.permute else 0
    return {"PERMUTE": int(windows > 0), "WINDOWS": windows or 1}


def lookup_room(taps: int, width: int) -> float:
    """Return how many samples pixels may lie from the middle of the lookup's window.

    It holds two vectors of samples. Half of the taps lie beyond a pixel. That the places of both
    are rounded is made up for by the window's middle being between two samples; a twentieth is for
    float32.
    """
    return width - taps / 2 - 0.05
