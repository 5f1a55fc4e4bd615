"""Interpolation of complex pixels between those of an image.

A pixel of the new raster is the sum of those around it, without their carrier, with the weights of
a separable windowed sinc, and with the carrier at its own place. The window is chosen in the
frequency domain, as a filter that is 1 up to a guard below half the sample rate, and falls to 0
there. Interpolation is exact for images without frequencies in the guard. How much power lies there
is measured on the image, and bounds the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy import signal as filters
from scipy.sparse import csr_array

from clsas.engine.data.fourier import gridding, gridding_gain, taps_for
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.maps.carrier import Carrier
from clsas.maps.map_grids import Affine
from clsas.maps.resampling import averaged, lattice, steps_m

MOST_ERROR_DB = -40.0
"""Largest error of interpolated pixels, relative to the rms of the image."""

_GOOD_DB = -60.0  # error from which a narrower guard is not worth its wider margin: a plain choice
_GUARDS = (0.2, 0.1, 0.05)  # cycles per pixel
_STOP_DB = 70.0  # attenuation of the filter's side lobes: below all errors that are stated
_BETA = float(filters.kaiser_beta(_STOP_DB))  # of the Kaiser window that has it
_BLOCK = 256  # pixels along either side of the blocks whose spectrum is measured
_MOST_BLOCKS = 32  # of them along either side of the image: a plain choice
_USED = 0.4  # half the band over the sample rate at which images are interpolated well
# Rows and columns of new pixels as large as those of the image that are interpolated at once. They
# take 200 MB with the pixels around them and their spectrum: a plain choice.
_WINDOW = 1024
_SUM_ERROR_DB, _OVERSAMPLING = -80.0, 1.5  # of the non-uniform FFT: plain choices
_PLACES_AT_ONCE = 1 << 13  # whose weights fit into caches


class InexactError(ArgumentError):
    """The error of interpolated pixels would exceed `MOST_ERROR_DB`."""


Reader = Callable[[slice, slice], NDArray[np.complex64]]


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Pixels of an image at other places.

    Attributes
    ----------
    carrier : Carrier
        Carrier of the image, in the order of its raster.
    affine, onto : tuple of float
        Transforms of the image's raster and of the new one.
    guard : float
        Width of the filter's transition below half the sample rate, cycles per pixel.
    error_db : float
        Bound of the rms error of interpolated pixels, relative to the rms of the image.
    """

    carrier: Carrier
    affine: Affine
    onto: Affine
    guard: float
    error_db: float

    @classmethod
    def of(cls, carrier: Carrier, affine: Affine, onto: Affine, read: Reader) -> Interpolation:
        """Return the interpolation of an image, with the error that its spectrum leads to.

        Parameters
        ----------
        carrier, affine, onto
            As the attributes.
        read : callable
            Called as read(rows, columns); returns a window of the image.

        Raises
        ------
        InexactError
            If the error would exceed `MOST_ERROR_DB`.
        ValueError
            If new pixels are more than 16 times as large as those of the image.
        """
        averaged(affine, onto)  # checks the size of new pixels
        power = _mean_power(carrier, read)
        guards = [g for g in _GUARDS if 2 * margin_of(g) + 2 <= min(carrier.shape)]
        errors_db = [_error_db(power, guard) for guard in guards]
        good = [n for n, error_db in enumerate(errors_db) if error_db <= _GOOD_DB]
        best = good[0] if good else int(np.argmin(errors_db))
        if errors_db[best] > MOST_ERROR_DB:
            raise InexactError(
                "north_up",
                f"cause an error of at most {MOST_ERROR_DB:g} dB in complex pixels",
                f"up to {errors_db[best]:.1f} dB",
                _remedy(carrier, steps_m(affine)),
            )
        return cls(carrier, affine, onto, guards[best], errors_db[best])

    @property
    def margin(self) -> int:
        """Pixels on either side that a new pixel depends on."""
        return margin_of(self.guard)

    @property
    def side(self) -> int:
        """Rows and columns of the new raster that are interpolated at once."""
        return max(_WINDOW // averaged(self.affine, self.onto), 1)

    def at(self, rows: slice, columns: slice, read: Reader) -> NDArray[np.complex64]:
        """Return a window of the new raster, complex64 [rows, columns].

        Pixels are 0 where the image is 0, or ends within the margin.
        """
        matrix, first = lattice(self.affine, self.onto, (rows.start, columns.start))
        shape = rows.stop - rows.start, columns.stop - columns.start
        down, across = np.ogrid[: shape[0], : shape[1]]
        places = [first[n] + matrix[n, 0] * down + matrix[n, 1] * across for n in (0, 1)]
        inside = np.ones(shape, bool)
        for at, n in zip(places, self.carrier.shape, strict=True):
            inside &= (at >= self.margin) & (at <= n - 1 - self.margin)
        pixels = np.zeros(shape, np.complex64)
        if not inside.any():
            return pixels
        row, column = (at[inside] for at in places)
        box = [
            slice(math.floor(at.min()) - self.margin, math.ceil(at.max()) + self.margin + 1)
            for at in (row, column)
        ]
        given = read(*box)
        row, column = row - box[0].start, column - box[1].start
        base = self.carrier.without(given, (box[0].start, box[1].start))
        found = _interpolated(base, row, column, self.guard)
        found *= self.carrier.turns(matrix, first, shape)[inside]
        received = given[np.rint(row).astype(int), np.rint(column).astype(int)] != 0
        pixels[inside] = found * received
        return pixels


def _interpolated(
    base: NDArray[np.complexfloating],
    row: NDArray[np.float64],
    column: NDArray[np.float64],
    guard: float,
) -> NDArray[np.complex64]:
    """Return the low-pass filtered image between its pixels, by a non-uniform FFT of type 2."""
    taps = taps_for(_SUM_ERROR_DB, _OVERSAMPLING)
    sides = [scipy.fft.next_fast_len(n) for n in base.shape]
    fine = [scipy.fft.next_fast_len(math.ceil(_OVERSAMPLING * n) + taps) for n in sides]
    spectrum = scipy.fft.fft2(base, sides, overwrite_x=True)
    kept = []
    for axis, (n, more) in enumerate(zip(sides, fine, strict=True)):
        frequency = np.rint(scipy.fft.fftfreq(n, 1 / n)).astype(int)
        gain = _low_pass(n, guard) / gridding_gain(frequency / more, taps, _OVERSAMPLING) * more / n
        spectrum *= np.expand_dims(gain, 1 - axis).astype(np.float32)
        kept.append(frequency % more)
    padded = np.zeros(fine, spectrum.dtype)
    padded[np.ix_(*kept)] = spectrum
    signal = scipy.fft.ifft2(padded, overwrite_x=True).ravel()

    found = np.empty(len(row), np.complex64)
    for first in range(0, len(row), _PLACES_AT_ONCE):
        some = slice(first, first + _PLACES_AT_ONCE)
        along = (
            gridding(at[some] * (more / n), more, taps, _OVERSAMPLING)
            for at, n, more in zip((row, column), sides, fine, strict=True)
        )
        (down, of_rows), (across, of_columns) = (
            (each.indices.reshape(-1, taps), each.data.reshape(-1, taps).astype(np.float32))
            for each in along
        )
        weights = of_rows[:, :, None] * of_columns[:, None, :]
        places = down[:, :, None] * fine[1] + across[:, None, :]
        ends = np.arange(len(weights) + 1) * taps**2
        matrix = csr_array((weights.ravel(), places.ravel(), ends), (len(weights), len(signal)))
        found[some] = matrix @ signal
    return found


def check_image(grid: Grid) -> None:
    """Raise an error if an image cannot be interpolated.

    Raises
    ------
    ValueError
        If it is not on a plane, or too small.
    """
    if not grid.is_planar:
        raise ArgumentError(
            "north_up",
            "be off for complex pixels of a height map, whose phase changes with the height",
        )
    if min(grid.shape) < (least := 2 * margin_of(_GUARDS[0]) + 2):
        allowed = f"have at least {least} rows and columns for complex pixels with `north_up`"
        raise ArgumentError("source", allowed, f"{grid.shape[0]} x {grid.shape[1]}")


def margin_of(guard: float) -> int:
    """Return half the length of the filter of a guard, pixels: where its side lobes begin."""
    return math.ceil(math.hypot(1, _BETA / math.pi) / guard)


def _low_pass(n: int, guard: float) -> NDArray[np.float64]:
    """Return the filter at the frequencies of an FFT: a step convolved with a Kaiser window."""
    window = filters.windows.kaiser(1001, _BETA)
    passed = 1 - np.cumsum(window) / window.sum()
    frequency = np.abs(scipy.fft.fftfreq(n))
    return np.interp(frequency, np.linspace(0.5 - guard, 0.5, len(passed)), passed)


def _mean_power(carrier: Carrier, read: Reader) -> NDArray[np.float64]:
    """Return the mean power spectrum of the image without its carrier, float64 [n, m].

    Edges of what was received are not band-limited. Blocks with them are left out if there are
    others.
    """
    window = [filters.windows.blackmanharris(min(_BLOCK, n)) for n in carrier.shape]
    whole, part = (np.zeros([len(each) for each in window]) for _ in range(2))
    for rows, columns in _blocks(carrier.shape):
        pixels = read(rows, columns)
        base = carrier.without(pixels, (rows.start, columns.start)) * np.outer(*window)
        total = whole if pixels.all() else part
        total += np.abs(scipy.fft.fft2(base)) ** 2
    return whole if whole.any() else part


def _blocks(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Yield windows spread over an image; they cover it unless it is large."""
    parts = []
    for n in shape:
        side = min(_BLOCK, n)
        count = min(math.ceil(n / side), _MOST_BLOCKS)
        starts = np.linspace(0, n - side, count, dtype=int)
        parts.append([slice(start, start + side) for start in starts])
    yield from product(*parts)


def _error_db(power: NDArray[np.float64], guard: float) -> float:
    """Return a bound of the error for a guard.

    Frequencies in the guard are lost, and have aliased from beyond it: both are errors. Since those
    that aliased farther cannot be seen, the density in the guard is taken for that of all
    frequencies. Errors along rows and columns add up.
    """
    total = power.sum()
    if not total:
        return -_STOP_DB
    density = 0.0
    for axis, n in enumerate(power.shape):
        in_guard = np.abs(scipy.fft.fftfreq(n)) >= 0.5 - guard
        density += float(np.compress(in_guard, power, axis=axis).mean())
    return float(10 * np.log10(2 * density * power.size / total + 10 ** (-_STOP_DB / 10)))


def _remedy(carrier: Carrier, given_m: tuple[float, float]) -> str:
    """Return what helps if the error is too large; distances of rows and of columns are given."""
    instead = "form the image on the grid of `Georeference.north_up`"
    if (carrier.half_band <= _USED).all():
        return (
            f"{instead}, since its beam ends abruptly, or `lines` and `beam` are not those that "
            "formed the image"
        )
    row_m, column_m = (
        step_m * min(_USED / half, 1)
        for step_m, half in zip(given_m, carrier.half_band, strict=True)
    )
    return (
        f"{instead}, or with rows at most {row_m:.3g} m and columns at most {column_m:.3g} m apart "
        f"(they are {given_m[0]:.3g} m and {given_m[1]:.3g} m)"
    )
