"""The interpolated aperture: virtual channels as dense as band-limited steering functions need.

Aligned on a subimage's centre, a pixel's steering function varies slowly along the aperture. It is
interpolated from those of fewer, virtual channels; their lines are weighted sums of aligned lines.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from clsas.core import reprs
from clsas.core.lines import RangeLines
from clsas.factorized import tree, visibility
from clsas.factorized.estimates import StageChannels
from clsas.factorized.fields import CONFIG, RangeFilter
from clsas.factorized.filters import edges_gain
from clsas.factorized.tree import VirtualChannels
from clsas.signal.interpolation import Gain, Interpolator
from clsas.sonar.beam import BeamWindow

if TYPE_CHECKING:
    from clsas.factorized.sector import Geometry

BEAM_MARGIN = 1 / 16
"""Width of the beam by which a rectangle of leaves may widen what is visible from one of them."""

_Cycles = Annotated[float, Field(ge=-0.5, le=0.5)]


class VisiblePhases(Protocol):
    """Visibility and phase cycles of subimages, as `clsas.planning.view.View` predicts them."""

    @property
    def lines(self) -> RangeLines:
        """The lines."""

    @property
    def beam(self) -> BeamWindow | None:
        """The beam."""

    @property
    def beam_rates(self) -> NDArray[np.float64]:
        """Cycles of the beam's weights per unit of the aperture coordinate."""

    def seen(self, side: tuple[int, int]) -> NDArray[np.bool_]:
        """Return which samples of the track see any of a subimage."""

    def share_seen(self, side: tuple[int, int]) -> float:
        """Return the mean share of the channels that see any of a subimage."""

    def turns(self, side: tuple[int, int], seen: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return the cycles of phase of a subimage while it is seen, their mean or maximum."""

    def cycles(
        self, rates: NDArray[np.float64], seen: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the integral of rates over what is seen, its mean or maximum."""

    def channels(self, taps: int, density: float, turns: float) -> Any:
        """Return the number of virtual channels for phases that turn by some cycles."""


@dataclass(frozen=True, eq=False, config=CONFIG)
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
    band : (centre, half width)
        Frequencies that all filters are made for, cycles per sample.
    """

    filter: RangeFilter
    oversampling: tuple[Annotated[float, Field(ge=1.0, le=100.0)], ...]
    beam_cycles: Annotated[float, Field(ge=0.0, le=1e3)]
    band: tuple[_Cycles, _Cycles]
    method: Literal["interpolated"] = "interpolated"

    aligns_phases: ClassVar[bool] = True
    """The first stage turns the phase of channels off the mean track along their lines."""

    splits_leaves: ClassVar[bool] = False
    """Leaves are small enough for the expansion of ranges about their centres."""

    __repr__ = reprs.of_fields

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.oversampling)

    def describe(self) -> str:
        """Return the filter in words."""
        return f"{self.filter.taps} taps along the aperture at {self.filter.upsampling:.2f} x"

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

    def virtual_channels(
        self,
        geometry: Geometry,
        roots: NDArray[np.int64],
        root_m: NDArray[np.float64],
        place: NDArray[np.float64],
        channels_m: NDArray[np.float64],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage.

        Parameters
        ----------
        geometry : Geometry
        roots, root_m : [roots, 2], [roots, 3]
            First pixels and centres.
        place : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        channels_m : float64 [channels, 3]
            Their positions.
        """
        sides, surface, track = geometry.factorization.sides, geometry.surface, geometry.track
        rates, nodes = geometry.phase_rates(roots, root_m), list[VirtualChannels]()
        for oversampling, side in zip(self.oversampling, sides, strict=True):
            extents = oversampling * surface.extents_in(side, sides[0], roots)
            rate = np.einsum("ra,ars->rs", extents, rates)
            last = len(nodes) == len(sides) - 1
            if last and geometry.beam is not None and geometry.along is not None:
                beam_rate = visibility.beam_rate(geometry.beam, track, geometry.along, root_m)
                rate += self.beam_cycles * beam_rate
            nodes.append(tree.interpolated_channels(track, rate, place, self.filter))
            place = nodes[-1].coordinate
        return nodes

    def predicted_channels(
        self, view: VisiblePhases, sides: tuple[tuple[int, int], ...]
    ) -> list[StageChannels]:
        """Predict the virtual channels of subimages, stage by stage."""
        taps, density = self.filter.taps, 2 * self.filter.upsampling
        found: list[StageChannels] = []
        everywhere_seen = np.ones_like(view.seen(sides[0]))
        used = view.lines.channels * view.share_seen(sides[0])
        for level, (oversampling, side) in enumerate(zip(self.oversampling, sides, strict=True)):
            seen = view.seen(side)
            if level:
                turns = self.oversampling[level - 1] * view.turns(sides[level - 1], seen)
                used = min(found[-1].count, view.channels(taps, density, turns))
            turns = oversampling * view.turns(side, seen)
            everywhere, most = (
                density * oversampling * view.turns(side, where, most=True) + taps + 2
                for where in (everywhere_seen, seen)
            )
            if view.beam is not None:
                if level == len(sides) - 1:
                    turns += self.beam_cycles * view.cycles(view.beam_rates, seen)
                    beam_cycles = view.cycles(view.beam_rates, seen, most=True)
                    most += density * self.beam_cycles * beam_cycles
                most *= 1 + BEAM_MARGIN
            count = view.channels(taps, density, turns)
            found.append(StageChannels(used, count, taps * used / count, everywhere, most))
        return found
