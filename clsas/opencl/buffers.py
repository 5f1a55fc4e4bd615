"""The buffers that kernels share: their formats and sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.core.lines import RangeLines, wavelength_m
from clsas.core.threads import in_threads
from clsas.opencl import phases
from clsas.opencl.device import Device, aligned
from clsas.opencl.kernels import Kernel
from clsas.signal.interpolation import (
    Gain,
    Resampling,
)
from clsas.sonar.beam import INTERVALS, BeamWindow

VECTOR_ROOM = 16
"""Channels by which rows are longer in which a vector may begin at the last."""
_LINES_AT_ONCE = 32  # upsampled together: what stays in a core's cache


GIVEN_BYTES = 64 << 20
"""Of lines as they come, at most, that are on a device at once to be upsampled."""
MARGIN = 32
"""Zeros on either side of an upsampled line: what lies further out is moved into them."""
GUARD = 16
"""Zeros on either side of a virtual channel's line, which the last stage's lookup may touch."""


@dataclass(frozen=True, eq=False)
class BeamTable:
    """A beam's weights on a device, tabulated over the sine of the aspect angle.

    Attributes
    ----------
    per_sine : float
        Intervals of the table per sine. Kernels take track directions times this.
    arguments : dict of str to Buffer or float
        What the kernels take, by name (`cl/beam.h`).
    """

    per_sine: float
    arguments: dict[str, Any]

    @property
    def origin(self) -> dict[str, Any]:
        """What `expand_tiles` takes of them."""
        name = "beam_origin"
        return {name: self.arguments[name]} if self.arguments else {}


def beam_table(device: Device, beam: BeamWindow | None, lines: RangeLines) -> BeamTable:
    """Upload a beam's weights; without a beam, kernels take no arguments for it."""
    if beam is None:
        return BeamTable(0.0, {})
    low, high = (float(limit) for limit in beam.limits)
    lowest, highest = max(low, -1.0), min(high, 1.0)
    per_sine = INTERVALS / (highest - lowest)
    return BeamTable(
        per_sine,
        {
            "beam_table": device.upload(beam.table(wavelength_m(lines))),
            "beam_origin": lowest * per_sine,
            "beam_low": (low - lowest) * per_sine,
            "beam_high": (high - lowest) * per_sine,
        },
    )


def upsampled_lines(
    samples: NDArray[np.complex64],
    resampling: Resampling,
    width: int,
    margin: int,
    pitch: int,
    gain: Gain | None = None,
) -> NDArray[np.float32]:
    """Return lines upsampled as the kernels want them: `pitch` samples each, zeros around.

    With one lane per work-item they are interleaved, [channels, pitch, 2]; with more, real and
    imaginary parts are planes, [channels, 2, pitch]. `gain` multiplies their spectrum.
    """
    of_line = (pitch, 2) if width == 1 else (2, pitch)
    padded = aligned(np.zeros, (len(samples), *of_line), np.float32)
    inside = slice(margin, margin + resampling.length)

    factor = None if gain is None else gain(resampling.frequency)

    def fill(some: slice) -> None:
        upsampled = resampling.apply(samples[some], factor)
        for part, values in enumerate((upsampled.real, upsampled.imag)):
            if width == 1:
                padded[some, inside, part] = values
            else:
                padded[some, part, inside] = values

    for _ in in_threads(fill, slices(slice(0, len(samples)), _LINES_AT_ONCE)):
        pass
    return padded


def float_pairs(positions_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return float32 [n, 6]: positions [n, 3] as nearest float32 numbers, and what these leave."""
    nearest = positions_m.astype(np.float32)
    return np.concatenate([nearest, (positions_m - nearest).astype(np.float32)], axis=1)


def filter_table(device: Device, coefficients: NDArray[np.floating]) -> cl.Buffer:
    """Upload the coefficients of an interpolation filter as kernels take them."""
    return device.upload(coefficients.astype(np.float32))


def phase_polynomials(device: Device, terms: int) -> cl.Buffer:
    """Upload the polynomials for sine and cosine of phases."""
    return device.upload(phases.polynomials(terms))


def expansion_terms(beam: BeamWindow | None) -> int:
    """Return how many numbers `expand_tiles` finds per tile and channel."""
    return 9 if beam is None else 19


def expansion_kernel(device: Device, beam: BeamWindow | None, **paths: int) -> Kernel:
    """Return `expand_tiles`; `paths` are its options BISTATIC and MOVING."""
    intervals = 0 if beam is None else INTERVALS
    return device.kernel("expand_tiles", WIDTH=device.info.width, BEAM=intervals, **paths)


def channel_pitch(channels: int) -> int:
    """Channels with padding to whole vectors of any width."""
    return round_up(channels, 16)


def round_up(number: int, multiple: int) -> int:
    """Return the least multiple that is not below a number."""
    return -(-number // multiple) * multiple


def slices(whole: slice, most: int) -> Iterator[slice]:
    """Cut a slice into pieces of at most `most`."""
    for start in range(whole.start, whole.stop, most):
        yield slice(start, min(start + most, whole.stop))


def sample_bytes(half_precision: bool) -> int:
    """Return the bytes of a complex sample that stages hand on."""
    return 4 if half_precision else 8


def padded_length(resampling: Resampling) -> int:
    """Return the samples of an upsampled line on the device, with zeros around it.

    Lines at equal places in a cache's sets would evict each other.
    """
    length = -(-(resampling.length + 2 * MARGIN) // 16) * 16
    return length + 16 * (length % 256 == 0)
