"""Cases of the benchmarks at other sizes."""

from __future__ import annotations

from dataclasses import replace

from clsas.selftest.cases import FFBP_2K, Case


def scaled(size: int) -> Case:
    """Return ffbp-2k with `size` channels and `size` x `size` pixels over the same area.

    Frequencies are scaled so that pixels and channels keep their spacing in wavelengths.
    """
    case = FFBP_2K
    finer = size / case.pixels
    return replace(
        case,
        channels=size,
        spacing_m=case.spacing_m * case.channels / size,
        carrier_hz=case.carrier_hz * finer,
        bandwidth_hz=case.bandwidth_hz * finer,
        pixels=size,
    )
