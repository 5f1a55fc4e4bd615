"""Lines of the aperture: the mean track as a curve, or lines along and across a sheet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.planning import phase_rates
from clsas.planning.caching import cached
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel

_CHANNELS = 384  # evenly spaced along a line of a sheet: four times those sampled of them


@dataclass(frozen=True)
class Line:
    """A line of the aperture along which steering functions are interpolated.

    Attributes
    ----------
    direction : str
        "track" for the whole mean track, if it is a curve or strips; "along" or "across" for a line
        of a sheet.
    coordinate : float
        Where a line of a sheet lies, in the sheet's other coordinate.
    """

    direction: Literal["track", "along", "across"]
    coordinate: float = 0.0


@dataclass(frozen=True, eq=False)
class SampledLine:
    """A line of the aperture with its phase rates, channels and beam directions.

    Attributes
    ----------
    track : MeanTrack
        The line as a curve of its own.
    rates : float64 [axes, points, samples]
        Phase rates: see `clsas.planning.phase_rates`.
    channels : float64 [channels]
        Aperture coordinates of channels, ascending. On a sheet they are evenly spaced.
    along : float64 [samples, 3] or None
        Unit directions of the beam at `track.samples`.
    beam_rates : float64 [points, samples]
        Phase rates of the beam's weights, 0 without a beam.
    """

    track: MeanTrack
    rates: NDArray[np.float64]
    channels: NDArray[np.float64]
    along: NDArray[np.float64] | None
    beam_rates: NDArray[np.float64]

    def past_ends(self, coordinate: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which aperture coordinates lie past the ends of the curve, or of their strip."""
        strip = self.track.strip_of(self.channels)
        first, last = (
            np.searchsorted(strip, np.arange(self.track.strips), side) for side in ("left", "right")
        )
        of_strip = self.track.strip_of(coordinate)
        past: NDArray[np.bool_] = coordinate < self.channels[first][of_strip]
        return past | (coordinate > self.channels[last - 1][of_strip])


@cached
def sampled_line(model: VisibilityModel, line: Line) -> SampledLine:
    """Return a line of the aperture with what is sampled along it."""
    if line.direction == "track":
        return SampledLine(
            model.track,
            phase_rates.along(model),
            np.sort(model.track.coordinate),
            model.along,
            phase_rates.of_beam_along(model),
        )
    if line.direction == "along":
        track = model.track.line_along(line.coordinate)
        coordinates = track.samples, np.full(track.samples.shape, line.coordinate)
        rates, beam_rates = phase_rates.along(model), phase_rates.of_beam_along(model)
    else:
        track = model.track.line_across(line.coordinate)
        coordinates = np.full(track.samples.shape, line.coordinate), track.samples
        rates, beam_rates = phase_rates.across(model), phase_rates.of_beam_across(model)
    along = None if model.directions is None else model.directions.at(*coordinates)
    evenly = np.linspace(0, 1, _CHANNELS)
    return SampledLine(track, rates, evenly, along, beam_rates)


def visible_channels(
    model: VisibilityModel, line: SampledLine, side: Side
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return which channels' beams touch subimages of a size at the sample points.

    These are the channels' aperture coordinates, ascending; then for each point the first channel,
    and the number of channels, which is 0 where the track has a gap. The edges of visibility lie
    between samples of the track, so the range is one sample wider on either side.
    """
    channels, samples = line.channels, model.track.samples
    if model.track.is_sheet:
        none = np.zeros(len(model.points_m), np.int64)
        return channels, none, none + len(channels)
    visible = model.visible(side)
    begin = samples[np.maximum(visible.argmax(axis=1) - 1, 0)]
    last = visible.shape[1] - visible[:, ::-1].argmax(axis=1)
    end = samples[np.minimum(last, len(samples) - 1)]
    end[~visible.any(axis=1)] = -np.inf
    first = np.searchsorted(channels, begin)
    return channels, first, np.maximum(np.searchsorted(channels, end, "right") - first, 0)
