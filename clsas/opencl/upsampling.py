"""Lines upsampled on a device."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.opencl.buffers import GIVEN_BYTES, MARGIN, sample_bytes
from clsas.opencl.device import Device
from clsas.signal.interpolation import PHASES, Resampling, Upsampler

_GROUP = 64  # work-items that share a line where each has one lane


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
    kernel = device.kernel(
        "upsample",
        "upsample_lines",
        WIDTH=width,
        TAPS=taps,
        PHASES=PHASES,
        PERMUTE=int(device.info.permute),
        TURN=int(resampling.shift != 0),
        HALF=int(half_precision),
    )
    phase = (resampling.first + np.arange(PHASES)) * step % PHASES
    coefficients = upsampler.coefficients[phase].reshape(-1, width, taps).swapaxes(1, 2)
    filters = device.upload((gain * coefficients).astype(np.float32))
    turn = int(np.int32(np.uint32(round(resampling.centre_cycles_per_sample * 2**32) % 2**32)))
    channels, count = samples.shape
    lines = device.buffer(sample_bytes(half_precision) * channels * pitch)
    at_once = max(GIVEN_BYTES // (8 * count), 1)
    for start in range(0, channels, at_once):
        some = samples[start : start + at_once]
        given = device.share(some)
        event = device.run(
            kernel,
            (1 if width > 1 else _GROUP, len(some)),
            given,
            count,
            filters,
            resampling.first,
            step,
            turn,
            lines,
            start,
            pitch,
            MARGIN,
            resampling.length,
        )
        if start + at_once < channels:
            event.wait()
    device.queue.flush()
    return lines
