"""Scenes that all codes image, and their lines in the conventions of each code.

All channels of a scene contribute to every pixel of a square image in the plane z = 0. The straight
track is that of the benchmark case `bp-2k`, or a part of it. The circle has a radius of 15 m and a
height of 8 m above its centre. The helix is that of the case `ffbp-helix`, in air. It has all 150
turns for 150 or more pixels along each side, and fewer turns for fewer pixels.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.fft
from numpy.typing import NDArray

import clsas
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.selftest import cases
from clsas.selftest.cases import Case, DenseCase, helix

Scene = Case | DenseCase
PADDING = 64  # zeros at both ends of a line, which keep its echoes from wrapping around
LIGHT_M_S = 299_792_458.0  # the speed of waves that codes for radar assume

# With a full circle, images resolve a quarter of a wavelength, 3 mm. With 4 channels per pixel
# along the side, phases of the farthest pixels change by half a cycle from channel to channel.
_CIRCLE_PIXEL_M = 2.5e-3
_CIRCLE_CHANNELS = 4
_PER_TURN = 360  # channels of the helix


def straight(pixels: int) -> Case:
    """Return the part of `bp-2k` with a number of pixels along each side, and as many channels."""
    whole = cases.EXACT_CASES["bp-2k"]
    (left, right), (near, far) = whole.x_m, whole.y_m
    steps = (pixels - 1) / (whole.pixels - 1)
    half, middle = (right - left) / 2 * steps, (left + right) / 2
    return replace(
        whole,
        channels=whole.channels * pixels // whole.pixels,
        x_m=(middle - half, middle + half),
        y_m=(near, near + (far - near) * steps),
        pixels=pixels,
    )


def circle(pixels: int) -> DenseCase:
    """Return a circle around an image, with 4 times as many channels as pixels along a side."""
    side_m = _CIRCLE_PIXEL_M * (pixels - 1)

    def track() -> NDArray[np.float64]:
        return helix(1, _CIRCLE_CHANNELS * pixels, 15.0, 8.0, 0.0)

    return DenseCase(track, 120e3, 30e3, 1500.0, (side_m, side_m, 0.0), side_m, pixels)


def spiral(pixels: int) -> DenseCase:
    """Return as many turns of the helix of `ffbp-helix` as pixels along each side of 0.24 m."""
    whole = cases.FACTORIZED_CASES["ffbp-helix"]
    assert isinstance(whole, DenseCase)

    def track() -> NDArray[np.float64]:
        # Take the middle part of the whole track, whose turns are 5 mm apart.
        spare = (len(whole.track()) - _PER_TURN * pixels) // 2
        return whole.track()[max(spare, 0) :][: _PER_TURN * pixels]

    return replace(whole, track=track, pixels=pixels)


TRACKS = {"straight": straight, "circle": circle, "helix": spiral}
PIXELS = {"straight": 1024, "circle": 512, "helix": 150}
"""Default number of pixels along each side."""


def write(path: Path, scene: Scene, lines: clsas.RangeLines) -> None:
    """Write lines and grid to a file, in the conventions of all codes."""
    grid = scene.grid
    corner_m, down_m, across_m = grid.vectors_m
    rows, columns = grid.shape
    scale = LIGHT_M_S / lines.sound_speed_m_s  # keeps wavelengths
    np.savez(
        path,
        samples=lines.samples,
        first_range_m=lines.first_range_m,
        range_step_m=lines.range_step_m,
        carrier_hz=lines.carrier_hz,
        sound_speed_m_s=lines.sound_speed_m_s,
        positions_m=lines.tx_m,
        pixels=[columns, rows],
        corner_m=corner_m,
        step_m=[across_m[0], down_m[1]],
        band_hz=(scene.carrier_hz + np.array([-0.5, 0.5]) * scene.bandwidth_hz) * scale,
        **as_history(lines),
        **as_profiles(lines),
    )


def waves(lines: clsas.RangeLines, count: int) -> NDArray[np.int64]:
    """Return wavenumbers, in cycles per `count` samples, around the centre of the lines' band."""
    centre = round(measure_spectrum(lines).centre * count)
    return np.arange(-(count // 2), count - count // 2) + centre


def odd_length(least: int) -> int:
    """Return an odd length with a fast FFT; odd, so that no wave is exactly half a cycle off."""
    length = scipy.fft.next_fast_len(least)
    while length % 2 == 0:
        length = scipy.fft.next_fast_len(length + 1)
    return length


def as_history(lines: clsas.RangeLines) -> dict[str, object]:
    """Return lines as samples over frequency, like those of a radar with the same wavelengths.

    A point of amplitude A at range R gives S[p, k] = A exp(-j 4 pi f_k (R - ref_p) / c) in channel
    p at frequency f_k, with c the speed of light.
    """
    count = odd_length(lines.length + 2 * PADDING)
    ends = PADDING, count - lines.length - PADDING
    samples = np.pad(lines.samples.astype(np.complex128), ((0, 0), ends))
    first_m = lines.first_range_m - PADDING * lines.range_step_m
    wave = waves(lines, count)
    cycles_per_m = wave / (count * lines.range_step_m)
    spectrum = np.fft.fft(samples, axis=1)[:, wave % count]
    ref_m = first_m + count // 2 * lines.range_step_m
    cycles = lines.carrier_cycles_per_m * ref_m[:, None]
    cycles = cycles + cycles_per_m * (ref_m - first_m)[:, None]
    return {
        "history": (spectrum * np.exp(2j * np.pi * cycles)).astype(np.complex64),
        "ref_m": ref_m,
        "first_hz": (lines.carrier_cycles_per_m + cycles_per_m[0]) * LIGHT_M_S / 2,
        "step_hz": LIGHT_M_S / 2 / (count * lines.range_step_m),
    }


def as_profiles(lines: clsas.RangeLines) -> dict[str, object]:
    """Return lines that begin at the same range, like those of a radar with the same wavelengths.

    The shift theorem moves lines to the common range, and zeros extend them.
    """
    begin_m = lines.first_range_m.min() - PADDING * lines.range_step_m
    shift = (lines.first_range_m - begin_m) / lines.range_step_m
    count = odd_length(int(np.ceil(shift.max())) + lines.length + PADDING)
    wave = waves(lines, count)
    spectrum = np.fft.fft(lines.samples.astype(np.complex128), count, axis=1)
    spectrum[:, wave % count] *= np.exp(-2j * np.pi * wave / count * shift[:, None])
    return {
        "profiles": np.fft.ifft(spectrum, axis=1).astype(np.complex64),
        "begin_m": begin_m,
        "centre_hz": lines.carrier_cycles_per_m * LIGHT_M_S / 2,
    }
