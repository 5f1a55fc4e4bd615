"""Predicted numbers of virtual channels, stage by stage, on curves and on a sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.core.lines import RangeLines
from clsas.sonar.beam import BeamWindow

BEAM_MARGIN = 1 / 16
"""Width by which finding visibility for a rectangle of leaves may widen it, in beam widths."""


@dataclass(frozen=True)
class StageChannels:
    """Predicted channels of a stage.

    Attributes
    ----------
    used : float
        Channels of the stage before that one subimage combines, on average.
    count : float
        Virtual channels of a subimage, on average.
    summed : float
        Channels whose weighted sum is one virtual channel.
    everywhere : float
        Upper bound on the virtual channels of a root along the whole aperture.
    most : float
        Upper bound on the virtual channels of a subimage.
    bands : int
        Upper bound on the bands of the stage's channels; see
        `clsas.aperture.virtual_channels.Bands`.
    """

    used: float
    count: float
    summed: float
    everywhere: float
    most: float
    bands: int = 1


class VisibleChannels(Protocol):
    """Channels from which subimages are visible, as a `VisibilityModel` of the planner has them."""

    @property
    def lines(self) -> RangeLines:
        """The range lines."""

    @property
    def beam(self) -> BeamWindow | None:
        """The beam, if there is one."""

    @property
    def track(self) -> MeanTrack:
        """The mean track."""

    def visible(self, side: tuple[int, int]) -> NDArray[np.bool_]:
        """Return the samples of the track from which subimages of a size are visible."""

    def visible_share(self, side: tuple[int, int]) -> float:
        """Return the mean share of channels from which a subimage of a size is visible."""


class VisiblePhases(Protocol):
    """Phases of subimages along the aperture, as `AperturePhases` of the planner predicts them."""

    @property
    def model(self) -> VisibleChannels:
        """Visibility of the same subimages."""

    def beam_phase_cycles(self, visible: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return the cycles that the beam's weights count as; 0 without a beam.

        It is the mean over the sample points or, with `most`, the maximum.
        """

    def subimage_phase_cycles(
        self, side: tuple[int, int], visible: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the cycles of subimages of a size along the visible samples of the track.

        It is the mean over the sample points or, with `most`, the maximum.
        """

    def virtual_channels(self, taps: float, density: float, phase_cycles: float) -> float:
        """Return the number of virtual channels of a subimage, from its phase in cycles."""

    def rows(
        self,
        side: tuple[int, int],
        taps: float,
        density: float,
        beam_density: float = 0.0,
        *,
        most: bool = False,
    ) -> float:
        """Return the number of rows of virtual channels across a sheet; 1 without one."""


@dataclass(frozen=True)
class SampledStage:
    """Virtual channels of a stage, as dense as its subimages require.

    Attributes
    ----------
    phases : VisiblePhases
    side : (rows, columns)
        Size of the subimages.
    filter_density : float
        Virtual channels per cycle of the phase that the aperture filter needs.
    oversampling : float
        How much denser virtual channels are.
    beam_cycles : float
        Cycles that an edge of the beam counts as.
    """

    phases: VisiblePhases
    side: tuple[int, int]
    filter_density: float
    oversampling: float
    beam_cycles: float

    @property
    def densities(self) -> tuple[float, float]:
        """Virtual channels per cycle of the subimages' phase, and of the beam's."""
        return self.filter_density * self.oversampling, self.filter_density * self.beam_cycles

    def cycles(self, visible: NDArray[np.bool_]) -> float:
        """Return the cycles along the aperture that virtual channels sample, on average."""
        cycles = self.oversampling * self.phases.subimage_phase_cycles(self.side, visible)
        return cycles + self.beam_cycles * self.phases.beam_phase_cycles(visible)

    def most_along(self, visible: NDArray[np.bool_], taps: float) -> float:
        """Return an upper bound on the virtual channels along the aperture."""
        subimages, beam = self.densities
        return (
            subimages * self.phases.subimage_phase_cycles(self.side, visible, most=True)
            + beam * self.phases.beam_phase_cycles(visible, most=True)
            + self.phases.model.track.strips * (taps + 2)
        )

    def used_along(self, visible: NDArray[np.bool_], taps: float) -> float:
        """Return the virtual channels along the aperture that a subimage of the next stage uses.

        That subimage is visible from `visible`.
        """
        cycles = self.oversampling * self.phases.subimage_phase_cycles(self.side, visible)
        return self.phases.virtual_channels(taps, self.filter_density, cycles)

    def used_across(self, taps: float) -> float:
        """Return the rows across a sheet that a subimage of the next stage uses."""
        return self.phases.rows(self.side, taps, self.densities[0])


@dataclass(frozen=True)
class _Overhang:
    """Virtual channels past the ends of the aperture, where filters extend beyond it.

    Each stage interpolates the virtual channels that the stage before has past the ends, and needs
    further ones for that. Their number grows from stage to stage, as if filters had more taps.

    Attributes
    ----------
    between : float
        Virtual channels between the ends, in one dimension of the aperture.
    taps : float
        Taps of a single filter that would extend as far past the ends.
    """

    between: float
    taps: float

    def after(self, between: float, taps: int) -> _Overhang:
        """Return the overhang of the next stage, with `between` virtual channels."""
        # These are farther apart than those of this stage, so that fewer fill the same overhang.
        return _Overhang(between, taps + self.taps * min(between / max(self.between, 1e-9), 1.0))


_NO_OVERHANG = _Overhang(1.0, 0.0)


def channels_on_curves(stages: Sequence[SampledStage], taps: int) -> list[StageChannels]:
    """Predict the virtual channels of subimages on one curve or on strips, stage by stage.

    Parameters
    ----------
    stages : sequence of SampledStage
    taps : int
        Taps of the aperture filter.
    """
    phases = stages[0].phases
    model, margin = phases.model, _margin(phases)
    anywhere = np.ones_like(model.visible(stages[0].side))
    used = model.lines.channels * model.visible_share(stages[0].side)
    along = _NO_OVERHANG
    found: list[StageChannels] = []
    for number, stage in enumerate(stages):
        visible = model.visible(stage.side)
        if number:
            parent = stages[number - 1]
            used = min(found[-1].count, parent.used_along(visible, along.taps))
        cycles = stage.cycles(visible)
        along = along.after(stage.filter_density * cycles, taps)
        count = phases.virtual_channels(along.taps, stage.filter_density, cycles)
        found.append(
            StageChannels(
                used=used,
                count=count,
                summed=taps * used / count,
                everywhere=stage.most_along(anywhere, along.taps),
                most=stage.most_along(visible, along.taps) * margin,
                bands=model.track.strips,
            )
        )
    return found


def channels_on_sheet(stages: Sequence[SampledStage], taps: int) -> list[StageChannels]:
    """Predict the virtual channels of subimages on a sheet, stage by stage.

    They form rows and columns. Parameters are those of `channels_on_curves`.
    """
    phases = stages[0].phases
    model, margin = phases.model, _margin(phases)
    anywhere = np.ones_like(model.visible(stages[0].side))
    used = model.lines.channels * model.visible_share(stages[0].side)
    along = across = _NO_OVERHANG
    bands = 0
    found: list[StageChannels] = []
    for number, stage in enumerate(stages):
        visible = model.visible(stage.side)
        if number:
            parent = stages[number - 1]
            columns = parent.used_along(visible, along.taps)
            used = min(found[-1].count, columns * parent.used_across(across.taps))
        cycles = stage.cycles(visible)
        along = along.after(stage.filter_density * cycles, taps)
        across = across.after(phases.rows(stage.side, 0, *stage.densities), taps)
        rows = phases.rows(stage.side, across.taps, *stage.densities)
        most_rows = phases.rows(stage.side, across.taps, *stage.densities, most=True)
        count = rows * phases.virtual_channels(along.taps, stage.filter_density, cycles)
        found.append(
            StageChannels(
                used=used,
                count=count,
                summed=taps**2 * used / count,
                everywhere=most_rows * stage.most_along(anywhere, along.taps),
                most=most_rows * stage.most_along(visible, along.taps) * margin,
                # Raw channels have a band for each row that may be the first of their rows. Those
                # of later stages have a band for each row of the stage before.
                bands=bands if number else math.ceil(most_rows) + 2,
            )
        )
        bands = math.ceil(most_rows) + 3
    return found


def _margin(phases: VisiblePhases) -> float:
    """Return the factor by which rectangles of leaves may raise the number of virtual channels."""
    return 1.0 if phases.model.beam is None else 1 + BEAM_MARGIN
