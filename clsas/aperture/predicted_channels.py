"""Predictions of a stage's channels, and what they need to know about visibility."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.core.lines import RangeLines
from clsas.sonar.beam import BeamWindow


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
        Channels that one virtual channel is a weighted sum of.
    everywhere : float
        Virtual channels of a root along the whole aperture, at most.
    most : float
        Virtual channels of a subimage, at most.
    bands : int
        Bands of the stage's channels, at most: see `clsas.aperture.virtual_channels.Bands`.
    """

    used: float
    count: float
    summed: float
    everywhere: float
    most: float
    bands: int = 1


class VisibleChannels(Protocol):
    """Channels whose beams touch subimages, as a `VisibilityModel` of the planner predicts them."""

    @property
    def lines(self) -> RangeLines:
        """The lines."""

    @property
    def beam(self) -> BeamWindow | None:
        """The beam."""

    @property
    def track(self) -> MeanTrack:
        """The mean track."""

    def visible(self, side: tuple[int, int]) -> NDArray[np.bool_]:
        """Return which track samples touch a subimage with their beam."""

    def visible_share(self, side: tuple[int, int]) -> float:
        """Return the mean fraction of channels whose beam touches a subimage."""


class VisiblePhases(Protocol):
    """Phases of subimages, as `AperturePhases` of the planner predict them."""

    @property
    def model(self) -> VisibleChannels:
        """Visibility of the same subimages."""

    def beam_phase_cycles(self, visible: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return the cycles that a beam's weights count for, their mean or maximum; 0 without."""

    def subimage_phase_cycles(
        self, side: tuple[int, int], visible: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the visible phase cycles of subimages of a size, their mean or maximum."""

    def virtual_channels(self, taps: Any, density: float, phase_cycles: Any) -> Any:
        """Return the number of virtual channels for some phase cycles."""

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
