"""The lines of a factorized image on a device: upsampled, in half or single precision."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pyopencl as cl

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.factorized.geometry import Geometry, imaged_rms
from clsas.opencl.buffers import MARGIN, lines_buffer, padded_length, upsampled_lines
from clsas.opencl.device import Device
from clsas.opencl.upsampling import upsample
from clsas.plans.factorization import Factorization

_LARGEST_HALF = 65504.0  # largest finite float16
_LEAST_HALF = 2.0**-13  # rms accepted in half precision: twice the smallest normal float16
_FILTERS_SUM = 8.0  # bounds the sum of absolute values of upsampling and aligning filters
_MOST_EXPONENT = 100  # of a gain: float32 can hold filters multiplied or divided by it


@dataclass(frozen=True, eq=False)
class DeviceLines:
    """Upsampled lines on a device.

    Attributes
    ----------
    samples : Buffer
    pitch : int
        Samples from one line to the next.
    half_precision : bool
        True if these lines, and those that stages form, are in half precision.
    gain : float
        Power of 2 by which the samples were multiplied; 1 in single precision.
    """

    samples: cl.Buffer
    pitch: int
    half_precision: bool
    gain: float


def upload(
    lines: RangeLines, factorization: Factorization, device: Device, largest: float
) -> DeviceLines:
    """Start upsampling all lines on a device, in the precision that was planned.

    Parameters
    ----------
    lines : RangeLines
    factorization : Factorization
    device : Device
    largest : float
        Largest magnitude of a sample.

    Raises
    ------
    ValueError
        If the upsampled lines do not fit into one buffer of the device.
    """
    if factorization.half_precision:
        gain = _gain(largest, lines.channels) if largest > 0 else 1.0
        return _uploaded(lines, factorization, device, half_precision=True, gain=gain)
    return _uploaded(lines, factorization, device, half_precision=False)


def in_enough_precision(
    uploaded: DeviceLines, lines: RangeLines, geometry: Geometry, device: Device, largest: float
) -> DeviceLines:
    """Return the lines, upsampled again in single precision if half does not resolve them.

    Parameters
    ----------
    uploaded : DeviceLines
        The result of `upload`, for the same lines.
    lines, geometry, device, largest
        See `upload`.

    Warns
    -----
    ClsasWarning
        If the plan was made for half precision and single precision is used.
    """
    if not uploaded.half_precision or _resolved(uploaded.gain * imaged_rms(geometry, lines)):
        return uploaded
    device.finish()  # kernels may still write to the buffer that is given up
    single = _uploaded(lines, geometry.factorization, device, half_precision=False)
    validate.warn(
        "lines are kept in single precision, not in half as planned, and need up to twice the "
        "memory: echoes from the grid are too weak compared with the largest sample, "
        f"{largest:.3g}, or the gain that they need is out of range"
    )
    return single


def _uploaded(
    lines: RangeLines,
    factorization: Factorization,
    device: Device,
    *,
    half_precision: bool,
    gain: float = 1.0,
) -> DeviceLines:
    resampling = factorization.resampling
    pitch = padded_length(resampling)
    needed = lines_buffer(lines.channels, pitch, half_precision).nbytes
    if needed > device.info.max_buffer_bytes:
        raise ValueError(
            f"{lines.channels} lines of {lines.length} samples need {needed / 2**20:.0f} MiB when "
            f"upsampled, but a buffer of {device.info.label} holds at most "
            f"{device.info.max_buffer_bytes / 2**20:.0f} MiB: image a part of the lines, or "
            "backproject exactly"
        )
    if factorization.upsampler is not None:
        samples = upsample(
            lines.samples,
            resampling,
            factorization.upsampler,
            pitch,
            device,
            half_precision=half_precision,
            gain=gain,
        )
    else:
        align, final = factorization.align, factorization.final
        edges = factorization.aperture.lines_gain(align, final, resampling.ratio)
        samples = device.share(
            upsampled_lines(lines.samples, resampling, device.info.width, MARGIN, pitch, edges)
        )
    return DeviceLines(samples, pitch, half_precision, gain)


def _gain(largest: float, channels: int) -> float:
    """Return a power of 2 that keeps lines, and the sum of all, within half precision."""
    exponent = math.floor(math.log2(_LARGEST_HALF / (_FILTERS_SUM * channels * largest)))
    return 2.0 ** min(max(exponent, -_MOST_EXPONENT), _MOST_EXPONENT)


def _resolved(rms: float) -> bool:
    """Return whether half precision resolves lines of an rms value, or lines of zeros."""
    return rms == 0 or _LEAST_HALF <= rms <= _LARGEST_HALF
