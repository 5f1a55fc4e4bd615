"""Upsampling of range lines on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.engine.device import phases
from clsas.engine.device.buffers import MARGIN, Buffer, Buffers, lines_buffer, phase_polynomials
from clsas.engine.device.device import Device
from clsas.engine.signal.interpolation import PHASES, Resampling, Upsampler

_GROUP = 64  # work-items that share a line if each has one lane
GIVEN_BYTES = 64 << 20
"""Largest size of the lines that are on a device at once before they are upsampled."""


def upsampling_buffers(channels: int, length: int, pitch: int, half_precision: bool) -> Buffers:
    """Return the buffers for upsampling: the upsampled lines, and the given ones."""
    at_once = min(max(GIVEN_BYTES // (8 * length), 1), channels)
    return {
        "lines": lines_buffer(channels, pitch, half_precision),
        "given": Buffer((at_once, length), np.complex64),
    }


def upsample(
    samples: NDArray[np.complex64],
    resampling: Resampling,
    upsampler: Upsampler,
    pitch: int,
    device: Device,
    *,
    half_precision: bool = False,
    gain: float = 1.0,
) -> cl.Buffer:
    """Return lines [channels, n], upsampled on a device in the format of its kernels.

    Keep the samples, and do not change them, until the device is done with them. The result has
    `pitch` samples per line, with zeros around them. With one lane per work-item, real and
    imaginary parts are interleaved, [channels, pitch, 2]; otherwise they are separate,
    [channels, 2, pitch]. Lines are multiplied by `gain`, and stored in half precision if
    `half_precision` is set.
    """
    width, taps, step = device.info.width, upsampler.taps, upsampler.step
    shifted = resampling.shift != 0
    kernel = device.kernel(
        "upsample_lines",
        WIDTH=width,
        TAPS=taps,
        PHASES=PHASES,
        PERMUTE=int(device.info.permute),
        FREQUENCY_SHIFT=int(shifted),
        HALF=int(half_precision),
        PHASE_TERMS=phases.PRECISE_TERMS,
    )
    phase = (resampling.first + np.arange(PHASES)) * step % PHASES
    coefficients = upsampler.coefficients[phase].reshape(-1, width, taps).swapaxes(1, 2)
    filters = device.upload((gain * coefficients).astype(np.float32))
    shift: dict[str, Any] = {}
    if shifted:
        cycles = round(resampling.centre_cycles_per_sample * 2**32) % 2**32
        shift["frequency"] = np.uint32(cycles).astype(np.int32)
        shift["phase_polynomials"] = phase_polynomials(device, phases.PRECISE_TERMS)
    channels, count = samples.shape
    buffers = upsampling_buffers(channels, count, pitch, half_precision)
    lines = device.buffer(buffers["lines"].nbytes)
    at_once = buffers["given"].shape[0]
    for start in range(0, channels, at_once):
        some = samples[start : start + at_once]
        event = device.run(
            kernel,
            (1 if width > 1 else _GROUP, len(some)),
            samples=device.share(some),
            count=count,
            filters=filters,
            first=resampling.first,
            step=step,
            **shift,
            lines=lines,
            first_line=start,
            pitch=pitch,
            margin=MARGIN,
            length=resampling.length,
        )
        if start + at_once < channels:
            event.wait()
    device.queue.flush()
    return lines
