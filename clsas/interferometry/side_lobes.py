"""Pixels that show side lobes and ambiguities of brighter places rather than their own echoes.

A shadow is not empty. Side lobes of bright places lie in it, and ambiguities: echoes from another
direction, which phase centres as far apart as half an element do not suppress. Both are as coherent
as the places where they come from, and have the phase of those.

How much of them a pixel receives follows from the image and from the response to a point in the
middle of the grid, of the same channels, beam and band. Powers add up, since speckle of different
places is independent. If p(d) is the share of a point's power that its response has at the distance
d, beyond the window of the heights, and P the power of the image, then pixel x receives

    E(x) = sum_d p(d) P(x - d)

from elsewhere. Heights are not valid where that is most of the power in the window.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data.beam import track_directions
from clsas.engine.data.fourier import turned
from clsas.engine.data.geometry import SAME_PLACE_M, bistatic_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, antennas_of, wavelength_m
from clsas.engine.data.pings import channels_per_ping
from clsas.engine.data.system import element_pattern
from clsas.engine.data.threads import cores
from clsas.engine.imaging import Imager
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.interferometry.coherence import Window
from clsas.interferometry.pair import Pair
from clsas.measures.density import usual_spacing_m

# Share of the power of a window from elsewhere above which a height is not valid. On the simulated
# wreck 0.25 masks 2 % of the lit pixels that are right, 0.5 a quarter of a percent, and 1 leaves
# twice as many wrong pixels in the shadow as 0.5.
_MOST_FROM_ELSEWHERE = 0.5
_SAMPLES = 256  # of every line, from which its level is measured to some per cent
_LEAST_ACROSS = 1e-3  # avoids a division by zero if elements look along the track


def from_elsewhere(
    power: NDArray[np.floating], response: NDArray[np.float64], window: Window
) -> NDArray[np.bool_]:
    """Return which pixels receive most of their power from beyond their own window.

    Responses to a point in the middle, within the extent of a window, count as the pixel's own.
    """
    row, column = middle(power.shape)
    inside = (
        slice(max(row - window.rows // 2, 0), row + window.rows // 2 + 1),
        slice(max(column - window.columns // 2, 0), column + window.columns // 2 + 1),
    )
    own = float(response[inside].sum())
    if own == 0:  # no line reaches the point
        return np.zeros(power.shape, bool)
    beyond = response / own
    beyond[inside] = 0.0
    size = [fft.next_fast_len(2 * n - 1, real=True) for n in power.shape]
    spectra = (
        fft.rfft2(each.astype(np.float32), size, workers=cores()) for each in (power, beyond)
    )
    everywhere = fft.irfft2(math.prod(spectra), size, workers=cores())
    rows, columns = power.shape
    received = window.sums(everywhere[row : row + rows, column : column + columns])
    found: NDArray[np.bool_] = received > _MOST_FROM_ELSEWHERE * window.sums(power)
    return found


def middle(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the row and the column of the point whose response is imaged."""
    rows, columns = shape
    return (rows - 1) // 2, (columns - 1) // 2


def point_response(pair: Pair, grid: Grid, imager: Imager) -> NDArray[np.float64]:
    """Return the power of the first bank's image of a point in the middle of a plane.

    The imager is one of the bank there.
    """
    point_m = grid.positions_m()[middle(grid.shape)]
    lines, beam = pair.a, pair.beam
    along = track_directions(lines) if beam is None else beam.directions(lines)
    pixels = imager(lines_of_point(lines, point_m, along), certificate=False).pixels
    return pixels.real.astype(np.float64) ** 2 + pixels.imag.astype(np.float64) ** 2


def lines_of_point(
    lines: RangeLines, point_m: NDArray[np.float64], along: NDArray[np.float64]
) -> RangeLines:
    """Return the lines that a point would cause, with the band of the lines.

    Lines do not contain the length of the elements. It is taken to be twice the usual spacing of
    the phase centres, the spacing up to which elements of that length are sampled. They lie along
    the track, unit vectors [channels, 3].
    """
    range_m = bistatic_range_m(point_m, *antennas_of(lines, np.arange(lines.channels)))
    spectrum = measure_spectrum(lines)
    frequency = fft.fftfreq(lines.length)
    from_centre = np.abs((frequency - spectrum.centre + 0.5) % 1 - 0.5)
    band = np.sqrt(np.interp(from_centre, spectrum.frequency, spectrum.share))
    band[from_centre > 0.5 / spectrum.oversampling] = 0.0
    pulse = fft.fftshift(fft.ifft(band))
    # The lines need not end where those of the recording do, and fade before they end.
    from_end = np.minimum(np.arange(lines.length), np.arange(lines.length)[::-1])
    pulse *= np.sin(np.pi / 2 * np.minimum(4 * from_end / lines.length, 1)) ** 2
    amplitude = _two_way_pattern(lines, point_m, along) * _gains(lines)
    received = amplitude * turned(-lines.carrier_cycles_per_m * range_m)
    largest = float(np.abs(received).max() * np.abs(pulse).max())
    return replace(
        lines,
        samples=np.outer(received / (largest or 1.0), pulse).astype(np.complex64),
        first_range_m=range_m - lines.length // 2 * lines.range_step_m,
    )


def _gains(lines: RangeLines) -> NDArray[np.float64]:
    """Return the amplitude of every channel relative to its ping, [channels].

    Receivers may have weights, or be dead. The median is that of the seabed, not of bright echoes.
    It is averaged over all pings if these have the same receivers.
    """
    step = max(lines.length // _SAMPLES, 1)
    level = np.median(np.abs(lines.samples[:, ::step]), axis=1).astype(np.float64)
    starts = lines.ping_starts
    counts = channels_per_ping(starts, lines.channels)
    of_ping = (np.add.reduceat(level, starts) / counts)[lines.ping_numbers]
    relative = np.divide(level, of_ping, out=np.ones_like(level), where=of_ping > 0)
    if np.ptp(counts) == 0:
        relative = np.tile(relative.reshape(len(counts), -1).mean(axis=0), len(counts))
    return relative


def _two_way_pattern(
    lines: RangeLines, point_m: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the amplitude with which every channel receives a point, [channels].

    Elements lie along the track, or across the direction in which they look if that is known.
    """
    look = lines.look_direction
    if look is not None:
        along = along - np.einsum("ci,ci->c", along, look)[:, None] * look
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), _LEAST_ACROSS)
    sight_m = point_m - lines.phase_centres_m
    distance_m = np.maximum(np.linalg.norm(sight_m, axis=1), SAME_PLACE_M)
    sine = np.einsum("ci,ci->c", sight_m, along) / distance_m
    length_m = 2 * usual_spacing_m(lines)
    one_way = element_pattern(length_m, sine, 1.0, wavelength_m(lines))
    return one_way.astype(np.float64) ** 2
