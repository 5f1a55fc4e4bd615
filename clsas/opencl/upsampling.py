"""Lines upsampled on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.opencl import phases
from clsas.opencl.buffers import MARGIN, Buffer, Buffers, lines_buffer, phase_polynomials
from clsas.opencl.device import Device
from clsas.signal.interpolation import PHASES, Resampling, Upsampler

_GROUP = 64  # work-items that share a line where each has one lane
GIVEN_BYTES = 64 << 20
"""Lines as they come that are on a device at once, at most."""


def upsampling_buffers(channels: int, length: int, pitch: int, half_precision: bool) -> Buffers:
    """Return the buffers that upsampling lines of some length takes: both kinds of lines."""
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
    """Return lines [channels, n] upsampled on a device as its kernels want them.

    The samples are to be kept, and left alone, until the device is done with them. The result has
    `pitch` samples per line, with zeros around them: interleaved, [channels, pitch, 2], with
    one lane per work-item, else [channels, 2, pitch]. It is `gain` times the lines, and with
    `half_precision` held so.
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
