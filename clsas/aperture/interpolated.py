"""The interpolated aperture: virtual channels as dense as band-limited steering functions need.

Aligned on a subimage's centre, a pixel's steering function varies slowly along the aperture. It is
interpolated from those of fewer, virtual channels; their lines are weighted sums of aligned lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.dense_channels import (
    SheetChannels,
    SheetRates,
    first_on_sheet,
    later_on_sheet,
    strip_channels,
)
from clsas.aperture.dense_tracks import Shape
from clsas.aperture.filters import edges_gain
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.predicted_channels import StageChannels, VisiblePhases
from clsas.aperture.virtual_channels import VirtualChannels, interpolated_channels
from clsas.core import reprs
from clsas.core.fields import CONFIG, Constraint
from clsas.signal.fields import RangeFilter
from clsas.signal.interpolation import Gain, Interpolator

BEAM_MARGIN = 1 / 16
"""Width of the beam by which a rectangle of leaves may widen what is visible from one of them."""

_Cycles = Annotated[float, Constraint(ge=-0.5, le=0.5)]


class _Overhang(NamedTuple):
    """Virtual channels past the aperture's ends, where filters extend beyond the last channel.

    Each stage interpolates the virtual channels that the one before has there, and has more past
    these. So they become more from stage to stage, as if filters had more taps.

    Attributes
    ----------
    columns, rows : float
        Virtual channels along the aperture, and across a sheet, without those past the ends.
    taps_along, taps_across : float
        Taps of filters that would extend as far.
    """

    columns: float
    rows: float
    taps_along: float
    taps_across: float

    @classmethod
    def after(cls, before: _Overhang | None, columns: float, rows: float, taps: int) -> _Overhang:
        """Return that of the next stage; `before` is None for the first."""
        if before is None:
            return cls(columns, rows, taps, taps)
        # Those of the stage before count as fewer: virtual channels lie farther apart now.
        along, across = (
            taps + of_taps * min(now / max(then, 1e-9), 1.0)
            for of_taps, now, then in (
                (before.taps_along, columns, before.columns),
                (before.taps_across, rows, before.rows),
            )
        )
        return cls(columns, rows, along, across)


@dataclass(frozen=True, eq=False)
class InterpolatedAperture:
    """Virtual channels between which steering functions are interpolated.

    Attributes
    ----------
    filter : Interpolator
        Filter along the aperture. Its `upsampling` is the density of virtual channels over the
        band limit.
    oversampling : tuple of float
        Stage by stage, how much denser than the filter needs virtual channels are. It makes up for
        their uneven spacing along the track.
    beam_cycles : float
        Cycles per edge of the beam for which the last stage's virtual channels are dense enough.
    shape : str
        Where they lie: on a curve ("track"), on several ("strips"), or on a "sheet".
    band : (centre, half width)
        Frequencies that all filters are made for, cycles per sample.
    """

    filter: RangeFilter
    oversampling: tuple[Annotated[float, Constraint(ge=1.0, le=100.0)], ...]
    beam_cycles: Annotated[float, Constraint(ge=0.0, le=1e3)]
    band: tuple[_Cycles, _Cycles]
    shape: Shape = "track"
    method: Literal["interpolated"] = "interpolated"

    aligns_phases: ClassVar[bool] = True
    """The first stage turns the phase of channels off the mean track along their lines."""

    splits_leaves: ClassVar[bool] = False
    """Leaves are small enough for the expansion of ranges about their centres."""

    __pydantic_config__ = CONFIG
    __repr__ = reprs.of_fields

    @property
    def dimensions(self) -> int:
        """Dimensions of the aperture in which its filter interpolates."""
        return 2 if self.shape == "sheet" else 1

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.oversampling)

    def describe(self) -> str:
        """Return the filter in words."""
        where = {"track": "along", "strips": "along strips of", "sheet": "along and across"}
        return (
            f"{self.filter.taps} taps {where[self.shape]} the aperture at "
            f"{self.filter.upsampling:.2f} x"
        )

    def lines_gain(self, align: Interpolator, final: Interpolator, ratio: float) -> Gain | None:
        """Return the gain of upsampled lines that makes up for what range filters attenuate."""
        return edges_gain(align, final, self.stages, ratio)

    def used_channels(
        self,
        place: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return the channels that a sector needs; one at least.

        Parameters
        ----------
        place : float64 [channels]
            Aperture coordinates, ascending.
        start, stop : float64 [leaves]
            Where each leaf is visible from.
        slack : float
            By how much coordinates may differ when seen from elsewhere.
        """
        seen = stop > start
        if not seen.any():
            return slice(0, 1)
        first = np.searchsorted(place, start[seen].min() - slack, "left")
        last = np.searchsorted(place, stop[seen].max() + slack, "right")
        return slice(int(min(first, len(place) - 1)), int(max(last, first + 1)))

    def on_curves(
        self,
        track: MeanTrack,
        rates: NDArray[np.float64],
        beam_rate: NDArray[np.float64] | None,
        extents: Sequence[NDArray[np.float64]],
        coordinate: NDArray[np.float64],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage, on one curve or on strips.

        Parameters
        ----------
        track : MeanTrack
        rates : float64 [axes, roots, samples]
            Largest phase rates of their subimages: see `cycles_per_extent`.
        beam_rate : float64 [roots, samples] or None
            Phase rates of the beam's weights, which count in the last stage.
        extents : sequence of float64 [roots, axes]
            Extents of the subimages, stage by stage.
        coordinate : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        """
        interpolated = strip_channels if track.is_dense else interpolated_channels
        found: list[VirtualChannels] = []
        for oversampling, extent in zip(self.oversampling, extents, strict=True):
            rate = np.einsum("ra,ars->rs", oversampling * extent, rates)
            if beam_rate is not None and len(found) == len(extents) - 1:
                rate += self.beam_cycles * beam_rate
            found.append(interpolated(track, rate, coordinate, self.filter))
            coordinate = found[-1].coordinate
        return found

    def on_sheet(
        self,
        track: MeanTrack,
        rates: SheetRates,
        beam_rates: SheetRates | None,
        extents: Sequence[NDArray[np.float64]],
        coordinates: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage, on a sheet.

        Parameters are those of `on_curves`, with rates along and across the sheet, and the
        coordinates of the raw channels along and across it.
        """
        found: list[VirtualChannels] = []
        parent: SheetChannels | None = None
        for oversampling, extent in zip(self.oversampling, extents, strict=True):
            rate = rates.times(oversampling * extent)
            if beam_rates is not None and len(found) == len(extents) - 1:
                rate = rate.plus(self.beam_cycles, beam_rates)
            if parent is not None:
                virtual, parent = later_on_sheet(track, rate, parent, self.filter)
            else:
                virtual, parent = first_on_sheet(track, rate, *coordinates, self.filter)
            found.append(virtual)
        return found

    def predicted_channels(
        self, phases: VisiblePhases, sides: tuple[tuple[int, int], ...]
    ) -> list[StageChannels]:
        """Predict the virtual channels of subimages, stage by stage."""
        model, strips = phases.model, phases.model.track.strips
        taps, density = self.filter.taps, 2 * self.filter.upsampling
        found: list[StageChannels] = []
        everywhere_seen, bands = np.ones_like(model.visible(sides[0])), strips
        used = model.lines.channels * model.visible_share(sides[0])
        before: _Overhang | None = None
        for level, (oversampling, side) in enumerate(zip(self.oversampling, sides, strict=True)):
            seen = model.visible(side)
            beam_cycles = self.beam_cycles if level == len(sides) - 1 else 0.0
            dense = density * oversampling, density * beam_cycles
            turns = oversampling * phases.subimage_phase_cycles(side, seen)
            turns += beam_cycles * phases.beam_phase_cycles(seen)
            past = _Overhang.after(before, density * turns, phases.rows(side, 0, *dense), taps)
            if before is not None:
                parent, above = sides[level - 1], self.oversampling[level - 1]
                seen_turns = above * phases.subimage_phase_cycles(parent, seen)
                columns = phases.virtual_channels(before.taps_along, density, seen_turns)
                rows = phases.rows(parent, before.taps_across, density * above)
                used = min(found[-1].count, columns * rows)
            rows, most_rows = (
                phases.rows(side, past.taps_across, *dense, most=most) for most in (False, True)
            )
            everywhere, most = (
                most_rows
                * (
                    dense[0] * phases.subimage_phase_cycles(side, where, most=True)
                    + dense[1] * phases.beam_phase_cycles(where, most=True)
                    + strips * (past.taps_along + 2)
                )
                for where in (everywhere_seen, seen)
            )
            if model.beam is not None:
                most *= 1 + BEAM_MARGIN
            count = rows * phases.virtual_channels(past.taps_along, density, turns)
            summed = taps**self.dimensions * used / count
            if self.dimensions == 2 and level == 0:
                bands = math.ceil(most_rows) + 2
            before = past
            found.append(StageChannels(used, count, summed, everywhere, most, bands))
            if self.dimensions == 2:
                bands = math.ceil(most_rows) + 3  # the rows, for the next stage
        return found
