"""Factorized backprojection with nearest beams: method and formulas of chapter 4 of THESIS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.dense_tracks import Shape
from clsas.aperture.predicted_channels import StageChannels, VisiblePhases
from clsas.aperture.virtual_channels import VirtualChannels, summed_neighbours
from clsas.core.fields import CONFIG, Constraint, Whole
from clsas.signal.interpolation import Gain, Interpolator

Stages = Sequence[tuple[int, int]]
"""(QR, QI) of each stage: the number of lines summed, and the divisor of both image sides."""


@dataclass(frozen=True)
class NearestBeams:
    """Virtual channels that are plain sums of neighbours, at their mean positions [43].

    `clsas.aperture.interpolated.InterpolatedAperture` is the alternative.

    Attributes
    ----------
    factors : tuple of int
        Number of neighbours that are summed into one virtual channel, QR, stage by stage.
    """

    factors: Annotated[tuple[Whole, ...], Constraint(min_length=1)]
    method: Literal["nearest"] = "nearest"

    filter: ClassVar[Interpolator] = Interpolator(1, 1.0, np.zeros((0, 2, 0)), -math.inf, -math.inf)
    """A single tap of weight 1."""
    band: ClassVar[None] = None
    """Linear interpolation serves any band."""
    dimensions: ClassVar[int] = 1
    shape: ClassVar[Shape] = "track"
    """Virtual channels are means of neighbours on one curve."""

    aligns_phases: ClassVar[bool] = False
    splits_leaves: ClassVar[bool] = True
    """Leaves have the size that the stages define, and are backprojected in smaller tiles."""

    __pydantic_config__ = CONFIG

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.factors)

    def describe(self) -> str:
        """Return the sums in words."""
        return f"sums of {', '.join(map(str, self.factors))} neighbours"

    def lines_gain(self, align: Interpolator, final: Interpolator, ratio: float) -> Gain | None:
        """Return None: the thesis does not compensate for range filters."""

    def used_channels(
        self,
        coordinate: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return all channels: the choice of neighbours does not depend on the sector."""
        return slice(0, len(coordinate))

    def virtual_channels(
        self, coordinate: NDArray[np.float64], channels_m: NDArray[np.float64]
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage.

        Parameters
        ----------
        coordinate : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        channels_m : float64 [channels, 3]
            Their positions.
        """
        found, position_m = [], np.broadcast_to(channels_m, (*coordinate.shape, 3))
        for factor in self.factors:
            found.append(summed_neighbours(coordinate, position_m, factor))
            coordinate, position_m = found[-1].coordinate, found[-1].position_m
        return found

    def predicted_channels(
        self, phases: VisiblePhases, sides: tuple[tuple[int, int], ...]
    ) -> list[StageChannels]:
        """Return the virtual channels of a subimage, stage by stage."""
        found, channels = [], phases.model.lines.channels
        for factor in self.factors:
            used, channels = channels, math.ceil(channels / factor)
            found.append(StageChannels(used, channels, factor, channels, channels))
        return found


def stage_errors_m(
    stages: Stages, aperture_m: float, image_m: float, nearest_m: float
) -> list[float]:
    """Return the largest range error of each stage [45]; those of all stages add up.

    Parameters
    ----------
    stages : sequence of (QR, QI)
    aperture_m : float
        Distance between neighbouring channels of the raw lines.
    image_m : float
        Longer side of the image.
    nearest_m : float
        Smallest range, Rmin.

    Notes
    -----
    The error is L_A L_I/(4 Rmin) for L_A <= Rmin, else L_I/2, where L_A is the length of the
    subaperture and L_I the side of the subimage after the stage. It bounds the range error of one
    beam that stands for a sector [40],

        sqrt(r^2 + t^2 - 2 r t cos(a + b)) - sqrt(r^2 + t^2 - 2 r t cos(a)),

    for a point at range r, half the subaperture's length t = L_A/2, an angle a between subaperture
    and beam, and angles b from the beam to the point of up to L_I/(2 r), because
    |d rho/d angle| <= min(r, t). Channels are closer to the middle, at (QR - 1)/QR of t at most.
    Corners of square subimages have errors up to (1 + sqrt 2)/2 larger where they are seen
    obliquely, the most at 22.5 degrees.
    """
    errors, length_m, side_m = [], aperture_m, image_m
    for summed, divisions in stages:
        length_m *= summed
        side_m /= divisions
        near = length_m > nearest_m
        errors.append(side_m / 2 if near else length_m * side_m / (4 * nearest_m))
    return errors


def operations(
    stages: Stages, channels: int, samples: Sequence[int], pixels: int, gamma: float = 0.0
) -> list[float]:
    """Return the operations of each stage and, last, of the backprojection [44].

    Parameters
    ----------
    stages : sequence of (QR, QI)
    channels : int
        Number of raw lines, N.
    samples : sequence of int
        Range samples per line, Nr, stage by stage.
    pixels : int
        Pixels of the whole image, X Y.
    gamma : float
        Cost of a line in a stage in addition to its samples, operations.

    Notes
    -----
    As in the worked example of the thesis, N lines take part in the first stage for each of its
    QI^2 subimages, N/QR in the second for each of its QI^4, and so on.
    [44] as printed divides the operations of a stage by the QR of that stage, too.
    """
    counts, subimages = [], 1
    for (summed, divisions), length in zip(stages, samples, strict=True):
        subimages *= divisions**2
        counts.append(float(channels * (subimages * length + gamma)))
        channels = math.ceil(channels / summed)
    counts.append(float(channels * pixels))
    return counts
