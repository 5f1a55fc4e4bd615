"""Buffers that several imagers share: their shapes, slots that reuse them, and what fills them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike, NDArray

from clsas.engine.data.beam import INTERVALS, BeamWindow
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.threads import in_threads
from clsas.engine.device.device import Device, aligned
from clsas.engine.device.kernels import PRECISE_PHASE_TERMS, Kernel, sine_and_cosine
from clsas.engine.signal.interpolation import PHASES, Gain, Resampling, Upsampler

VECTOR_ROOM = 16
"""Padding, in channels, of rows in which a vector may begin at the last channel."""
MARGIN = 32
"""Zeros on either side of an upsampled line. Positions farther out are moved into the zeros."""
GUARD = 16
"""Zeros on either side of the line of a virtual channel, which the last stage's lookup may read."""
GIVEN_BYTES = 64 << 20
"""Largest size of the lines that are on a device at once before they are upsampled."""
_LINE_ITEMS = 64  # work-items that share a line if each has one lane
_SAMPLES_AT_ONCE = 1 << 16  # that are upsampled together, so that they stay in a core's cache


# Shapes and sizes: a run allocates from them, and a plan adds them up.


@dataclass(frozen=True)
class Buffer:
    """Shape of a buffer, and the type of its numbers."""

    shape: tuple[int, ...]
    dtype: DTypeLike

    @property
    def nbytes(self) -> int:
        """Size of the buffer, bytes."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    def holding(self, values: NDArray) -> NDArray:
        """Return an array of this shape and type that begins with the given values.

        Only the last axis may be longer. It is filled with the last value, because kernels compute
        whole vectors, including lanes that are left out of the sums, and must not divide by zero.
        """
        count = values.shape[-1]
        if count == self.shape[-1]:
            return np.ascontiguousarray(values.reshape(self.shape), self.dtype)
        padded = np.empty(self.shape, self.dtype)
        padded[..., :count] = values
        padded[..., count:] = values[..., -1:] if count else 0
        return padded


Buffers = dict[str, Buffer]
"""Buffers by name."""


def total_bytes(buffers: Buffers) -> int:
    """Return the size of all buffers."""
    return sum(buffer.nbytes for buffer in buffers.values())


def pixel_buffers(pixels: int, beam: BeamWindow | None) -> Buffers:
    """Return buffers for pixels and, with a normalising beam, for the sums of their weights."""
    buffers = {"pixels": Buffer((pixels,), np.complex64)}
    if beam is not None and beam.normalise:
        buffers["weight_sums"] = Buffer((pixels,), np.complex64)
    return buffers


def beam_buffers(beam: BeamWindow | None) -> Buffers:
    """Return the buffer of the table of a beam's weights."""
    return {} if beam is None else {"beam_table": Buffer((INTERVALS, 4), np.float32)}


def lines_buffer(lines: int, pitch: int, half_precision: bool) -> Buffer:
    """Return the buffer of the lines that stages read and write."""
    return Buffer((lines, pitch, 2), np.float16 if half_precision else np.float32)


def upsampling_buffers(channels: int, length: int, pitch: int, half_precision: bool) -> Buffers:
    """Return the buffers for upsampling: the upsampled lines, and the given ones."""
    at_once = min(max(GIVEN_BYTES // (8 * length), 1), channels)
    return {
        "lines": lines_buffer(channels, pitch, half_precision),
        "given": Buffer((at_once, length), np.complex64),
    }


def padded_length(resampling: Resampling, margin: int = MARGIN) -> int:
    """Return the length of an upsampled line on the device, with the zeros on either side.

    A multiple of 256 is avoided, because lines at the same positions of cache sets would evict each
    other.
    """
    length = round_up(resampling.length + 2 * margin, 16)
    return length + 16 * (length % 256 == 0)


def channel_pitch(channels: int) -> int:
    """Return the number of channels padded to whole vectors of any width."""
    return round_up(channels, 16)


def round_up(number: int, multiple: int) -> int:
    """Return the smallest multiple that is not below a number."""
    return -(-number // multiple) * multiple


def slices(whole: slice, most: int) -> Iterator[slice]:
    """Divide a slice into pieces of at most `most`."""
    for start in range(whole.start, whole.stop, most):
        yield slice(start, min(start + most, whole.stop))


class Slot:
    """Named buffers of one job, which are filled again once the job that used them is done.

    With two slots in turn, the host fills one while the device works on the other. Set `busy` to
    the last event that uses any of the buffers. The events of copies that the job waits for are in
    `filled`.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.busy: cl.Event | None = None
        self.filled: list[cl.Event] = []
        self._buffers: dict[str, cl.Buffer] = {}

    def __getitem__(self, name: str) -> cl.Buffer:
        """Return a buffer that was filled or made earlier."""
        return self._buffers[name]

    def wait(self) -> None:
        """Wait until the buffers are free. Call this before they are filled."""
        # A job that no channel contributes to is never run, so nothing has waited for its uploads.
        for event in self.filled:
            event.wait()
        self.filled.clear()
        if self.busy is not None:
            self.busy.wait()

    def make(self, buffers: Buffers) -> dict[str, cl.Buffer]:
        """Return buffers of at least these sizes, by name."""
        return {name: self.buffer(name, buffer.nbytes) for name, buffer in buffers.items()}

    def buffer(self, name: str, bytes_: int) -> cl.Buffer:
        """Return a buffer of at least so many bytes."""
        return self._at_least(name, bytes_, self.device.buffer)

    def zeros(self, name: str, bytes_: int) -> cl.Buffer:
        """Return a buffer of at least so many bytes, which contained zeros when it was made."""
        return self._at_least(name, bytes_, self.device.zeros)

    def _at_least(self, name: str, bytes_: int, make: Callable[[int], cl.Buffer]) -> cl.Buffer:
        if name in self._buffers and self._buffers[name].size < bytes_:
            self.wait()
            del self._buffers[name]  # before a larger one is made, which may take its memory
        if name not in self._buffers:
            self._buffers[name] = make(bytes_)
        return self._buffers[name]

    def fill(self, name: str, array: np.ndarray) -> None:
        """Start copying an array into a buffer; the event to wait for is appended to `filled`."""
        array = np.ascontiguousarray(array)
        buffer = self.buffer(name, array.nbytes)
        event = cl.enqueue_copy(self.device.uploads, buffer, array, is_blocking=False)
        self.filled.append(event)
        self.device.uploads.flush()


# Tables that kernels read.


def filter_table(device: Device, coefficients: NDArray[np.floating]) -> cl.Buffer:
    """Upload the coefficients of an interpolation filter in the format of the kernels."""
    return device.upload(coefficients.astype(np.float32))


def phase_polynomials(device: Device, terms: int) -> cl.Buffer:
    """Upload the polynomials for sine and cosine of phases."""
    return device.upload(sine_and_cosine(terms))


def geometry_buffer(
    channels: int, beam: BeamWindow | None, *, bistatic: bool = False, moving: bool = False
) -> Buffer:
    """Return the buffer of the geometry of some channels, with the rows of cl/antennas.h.

    Rows are padded, so that a vector may begin at the last channel.
    """
    rows = 6 + 6 * bistatic + 3 * moving + 3 * (beam is not None)
    return Buffer((rows, channels + VECTOR_ROOM), np.float32)


def float_pairs(positions_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return positions [n, 3] rounded to float32, followed by the remainders, float32 [n, 6]."""
    nearest = positions_m.astype(np.float32)
    return np.concatenate([nearest, (positions_m - nearest).astype(np.float32)], axis=1)


@dataclass(frozen=True, eq=False)
class BeamTable:
    """Weights of a beam on a device, tabulated over the sine of the aspect angle.

    Attributes
    ----------
    per_sine : float
        Intervals of the table per unit of the sine. Track directions are multiplied by it before
        they are handed to kernels.
    arguments : dict of str to Buffer or float
        Arguments of the kernels by name (`cl/beam.h`).
    """

    per_sine: float
    arguments: dict[str, Any]

    @property
    def origin(self) -> dict[str, Any]:
        """Arguments of the kernel `expand_tiles`."""
        name = "beam_origin"
        return {name: self.arguments[name]} if self.arguments else {}


def beam_table(device: Device, beam: BeamWindow | None, lines: RangeLines) -> BeamTable:
    """Upload the weights of a beam. Without a beam, kernels have no arguments for it."""
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


def expansion_terms(beam: BeamWindow | None) -> int:
    """Return the number of coefficients that `expand_tiles` computes per tile and channel."""
    return 9 if beam is None else 19


def expansion_kernel(device: Device, beam: BeamWindow | None, **paths: int) -> Kernel:
    """Return the kernel `expand_tiles`; `paths` are its options BISTATIC and MOVING."""
    intervals = 0 if beam is None else INTERVALS
    return device.kernel("expand_tiles", WIDTH=device.info.width, BEAM=intervals, **paths)


# Upsampled lines, [channels, pitch, 2] with one lane per work-item, where kernels read real and
# imaginary parts in one piece, and [channels, 2, pitch] with more lanes.


def upsampled_lines(
    samples: NDArray[np.complex64],
    resampling: Resampling,
    width: int,
    margin: int,
    pitch: int,
    gain: Gain | None = None,
) -> NDArray[np.float32]:
    """Return lines, upsampled on the host by FFT in the format of the kernels.

    They have `pitch` samples each, with zeros around. With one lane per work-item, `width` 1, the
    result is float32 [channels, pitch, 2], otherwise [channels, 2, pitch]. The spectrum is
    multiplied by `gain`.
    """
    of_line = (pitch, 2) if width == 1 else (2, pitch)
    padded = aligned(np.zeros, (len(samples), *of_line), np.float32)
    parts = np.moveaxis(padded, -1, 0) if width == 1 else np.moveaxis(padded, 1, 0)
    inside = slice(margin, margin + resampling.length)
    factor = None if gain is None else gain(resampling.frequency)

    def fill(some: slice) -> None:
        upsampled = resampling.apply(samples[some], factor)
        parts[0, some, inside] = upsampled.real
        parts[1, some, inside] = upsampled.imag

    at_once = max(_SAMPLES_AT_ONCE // resampling.upsampled_period, 1)
    for _ in in_threads(fill, slices(slice(0, len(samples)), at_once)):
        pass
    return padded


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
    `pitch` samples per line, with zeros around them: [channels, pitch, 2] with one lane per
    work-item, otherwise [channels, 2, pitch]. Lines are multiplied by `gain`, and stored in half
    precision if `half_precision` is set.
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
        PHASE_TERMS=PRECISE_PHASE_TERMS,
    )
    phase = (resampling.first + np.arange(PHASES)) * step % PHASES
    coefficients = upsampler.coefficients[phase].reshape(-1, width, taps).swapaxes(1, 2)
    shift: dict[str, Any] = {}
    if shifted:
        cycles = round(resampling.centre_cycles_per_sample * 2**32) % 2**32
        shift["frequency"] = np.uint32(cycles).astype(np.int32)
        shift["phase_polynomials"] = phase_polynomials(device, PRECISE_PHASE_TERMS)
    filters = filter_table(device, gain * coefficients)
    channels, count = samples.shape
    buffers = upsampling_buffers(channels, count, pitch, half_precision)
    lines = device.buffer(buffers["lines"].nbytes)
    at_once = buffers["given"].shape[0]
    for start in range(0, channels, at_once):
        some = samples[start : start + at_once]
        event = device.run(
            kernel,
            (1 if width > 1 else _LINE_ITEMS, len(some)),
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
