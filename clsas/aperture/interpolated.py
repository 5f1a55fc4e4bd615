"""The interpolated aperture: virtual channels as dense as band-limited steering functions need.

Relative to the centre of a subimage, the steering function of a pixel varies slowly along the
aperture. It is interpolated from its values at fewer, virtual channels, whose lines are weighted
sums of aligned lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

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
from clsas.aperture.predicted_channels import (
    SampledStage,
    StageChannels,
    VisiblePhases,
    channels_on_curves,
    channels_on_sheet,
)
from clsas.aperture.virtual_channels import VirtualChannels, interpolated_channels
from clsas.core import reprs
from clsas.core.fields import CONFIG, Constraint
from clsas.signal.fields import RangeFilter
from clsas.signal.interpolation import Gain, Interpolator

_Cycles = Annotated[float, Constraint(ge=-0.5, le=0.5)]


@dataclass(frozen=True, eq=False)
class InterpolatedAperture:
    """Virtual channels between which steering functions are interpolated.

    Attributes
    ----------
    filter : Interpolator
        Filter along the aperture. Its `upsampling` is the density of virtual channels relative to
        the band limit.
    oversampling : tuple of float
        Density of virtual channels relative to what the filter needs, stage by stage. It
        compensates for their uneven spacing along the track.
    beam_cycles : float
        Cycles per edge of the beam that the virtual channels of the last stage can sample.
    shape : str
        Shape of the mean track: one curve ("track"), several ("strips"), or a "sheet".
    band : (centre, half width)
        Frequencies for which all filters were designed, cycles per sample.
    """

    filter: RangeFilter
    oversampling: tuple[Annotated[float, Constraint(ge=1.0, le=100.0)], ...]
    beam_cycles: Annotated[float, Constraint(ge=0.0, le=1e3)]
    band: tuple[_Cycles, _Cycles]
    shape: Shape = "track"
    method: Literal["interpolated"] = "interpolated"

    aligns_phases: ClassVar[bool] = True
    """The first stage turns the phases of channels off the mean track along their lines."""

    splits_leaves: ClassVar[bool] = False
    """Leaves are small enough for expansions of ranges about their centres."""

    __pydantic_config__ = CONFIG
    __repr__ = reprs.of_fields

    @property
    def dimensions(self) -> int:
        """Dimensions of the aperture in which the filter interpolates."""
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
        """Return the gain of upsampled lines that compensates for the loss in range filters."""
        return edges_gain(align, final, self.stages, ratio)

    def used_channels(
        self,
        coordinate: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return the channels that a sector needs, at least one.

        Parameters
        ----------
        coordinate : float64 [channels]
            Aperture coordinates of channels, ascending.
        start, stop : float64 [leaves]
            Aperture coordinates between which each leaf is visible.
        slack : float
            Largest difference between apparent coordinates and these.
        """
        visible = stop > start
        if not visible.any():
            return slice(0, 1)
        first = np.searchsorted(coordinate, start[visible].min() - slack, "left")
        last = np.searchsorted(coordinate, stop[visible].max() + slack, "right")
        return slice(int(min(first, len(coordinate) - 1)), int(max(last, first + 1)))

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
            Largest phase rates of subimages in the roots: see `cycles_per_extent`.
        beam_rate : float64 [roots, samples] or None
            Rates at which the beam's weights change, which count in the last stage only.
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

        The parameters are those of `on_curves`, with rates along and across the sheet, and the
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
        density, last = 2 * self.filter.upsampling, len(sides) - 1
        stages = [
            SampledStage(phases, side, density, oversampling, self.beam_cycles * (level == last))
            for level, (side, oversampling) in enumerate(zip(sides, self.oversampling, strict=True))
        ]
        predict = channels_on_sheet if self.shape == "sheet" else channels_on_curves
        return predict(stages, self.filter.taps)
