"""Stretch of lines: how much faster ranges grow for the channels than for the mean track.

Where transmitter and receiver lie apart, or receivers move, the range of a channel grows along the
line of sight by a slightly different factor than the range from the mean track. The mean of this
factor is a constant of the image. The first stage corrects deviations from it by turning the phase
along each line. This shifts the band of the line, so that later range filters must pass a wider
band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.filters import Gain
from clsas.aperture.phase_rates import drift, stretches
from clsas.core.wavelengths import cycles_per_m_at
from clsas.planning.channels import sampled_channels
from clsas.planning.subimages import SMALL
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator
from clsas.signal.spectrum import Spectrum, shares_of_bins

_LEAST_BINS = 1 / 32  # of the lines' spectrum; a plain choice: smaller shifts widen no band
_MOST_CYCLES = 8.0  # per sample; far outside the pass band of any filter
_BOUNDS = -0.5, 1.0  # of the mean stretch


@dataclass(frozen=True, eq=False)
class Stretch:
    """Stretch of an image's lines, and the shifts of their band.

    Attributes
    ----------
    mean : float
        Mean over channels and sample points, weighted by power; 0 for channels on the mean track.
    shares : float64 [2 n + 1] or None
        Share of the power that is shifted by -n, ..., n bins of the lines' spectrum; None where
        shifts are negligible.
    """

    mean: float = 0.0
    shares: NDArray[np.float64] | None = None


def stretch_of(model: VisibilityModel) -> Stretch:
    """Return the stretch of lines as seen from the sample points. It does not depend on roots."""
    return model.from_cache(("stretch", model.limits), lambda: _stretch_of(model))


def _stretch_of(model: VisibilityModel) -> Stretch:
    channels = sampled_channels(replace(model, root=None), SMALL)
    power = float(channels.weight.sum())
    if not power:  # no channel's beam touches the grid, or these channels are silent
        return Stretch()
    centres_m = model.points_m[channels.points]
    virtual_m = channels.virtual_m(centres_m)
    along = drift(model.lines)
    found = stretches(*channels.antennas, along, model.surface.plane, centres_m, virtual_m)
    share = channels.weight / power
    mean = float(np.clip(np.sum(share * found), *_BOUNDS))
    cycles = cycles_per_m_at(model.lines, model.spectrum.centre) * model.lines.range_step_m
    shift = np.clip((found - mean) * cycles, -_MOST_CYCLES, _MOST_CYCLES)
    bins = shift / model.spectrum.bin_width
    if np.abs(bins).max() < _LEAST_BINS:
        return Stretch(mean)
    return Stretch(mean, shares_of_bins(bins, share))


def aligned_spectrum(model: VisibilityModel) -> Spectrum:
    """Return the spectrum of the lines after the first stage has turned their phases."""
    shares = stretch_of(model).shares
    return model.spectrum if shares is None else model.spectrum.shifted(shares)


def uncompensated(
    model: VisibilityModel,
    align: Interpolator,
    final: Interpolator,
    stages: int,
    ratio: float,
    gain: Gain,
) -> float:
    """Return the error power of a gain that is designed for lines whose band is not shifted.

    The gain corrects the mean response of all range filters. Only the first of them is applied
    before the shift.

    Parameters
    ----------
    model : VisibilityModel
    align, final : Interpolator
    stages : int
    ratio : float
        Upsampled samples per sample.
    gain : callable
        Result of `clsas.aperture.filters.edges_gain`.
    """
    shares, spectrum = stretch_of(model).shares, model.spectrum
    if shares is None:
        return 0.0
    before, wide = (
        np.concatenate([-each.frequency[::-1], each.frequency])
        for each in (spectrum, aligned_spectrum(model))
    )
    after = align.response(wide / ratio) ** (stages - 1) * final.response(wide / ratio)
    shifted = np.lib.stride_tricks.sliding_window_view(after, len(shares))
    of_all = (gain(np.abs(before)) * align.response(before / ratio))[:, None] * shifted
    power = np.concatenate([spectrum.power[::-1], spectrum.power]) / 2
    return float(power @ (of_all - 1) ** 2 @ shares)
