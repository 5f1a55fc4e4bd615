"""Factorized backprojection with nearest beams: the method and the formulas of THESIS chapter 4."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.aperture.dense_tracks import Shape
from clsas.aperture.predicted_channels import StageChannels, VisiblePhases
from clsas.aperture.virtual_channels import VirtualChannels, nearest_nodes
from clsas.core.fields import CONFIG, Constraint, Whole
from clsas.signal.interpolation import Gain, Interpolator

Stages = Sequence[tuple[int, int]]
"""(QR, QI) of every stage: how many lines are summed, and the division of either image side."""


@dataclass(frozen=True)
class NearestBeams:
    """Virtual channels that are sums of neighbours as they are, at their mean position [43].

    The alternative is `clsas.aperture.interpolated.InterpolatedAperture`.

    Attributes
    ----------
    factors : tuple of int
        Neighbours that are summed into one beam, QR, stage by stage.
    """

    factors: Annotated[tuple[Whole, ...], Constraint(min_length=1)]
    method: Literal["nearest"] = "nearest"

    filter: ClassVar[Interpolator] = Interpolator(1, 1.0, np.zeros((0, 2, 0)), -math.inf, -math.inf)
    """A single tap of weight 1."""
    band: ClassVar[None] = None
    """Linear interpolation takes any band."""
    dimensions: ClassVar[int] = 1
    shape: ClassVar[Shape] = "track"
    """Virtual channels are means of neighbours on one curve."""

    aligns_phases: ClassVar[bool] = False
    splits_leaves: ClassVar[bool] = True
    """Leaves as large as the stages ask for are backprojected in tiles."""

    __pydantic_config__ = CONFIG

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.factors)

    def describe(self) -> str:
        """Return the sums in words."""
        return f"sums of {', '.join(map(str, self.factors))} neighbours"

    def lines_gain(self, align: Interpolator, final: Interpolator, ratio: float) -> Gain | None:
        """Return None: the thesis leaves lines as they are."""

    def used_channels(
        self,
        place: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return all channels: which of them are neighbours does not depend on the sector."""
        return slice(0, len(place))

    def beams(
        self, coordinate: NDArray[np.float64], channels_m: NDArray[np.float64]
    ) -> list[VirtualChannels]:
        """Return the beams of some roots, stage by stage.

        Parameters
        ----------
        coordinate : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        channels_m : float64 [channels, 3]
            Their positions.
        """
        found, position_m = [], np.broadcast_to(channels_m, (*coordinate.shape, 3))
        for factor in self.factors:
            found.append(nearest_nodes(coordinate, position_m, factor))
            coordinate, position_m = found[-1].coordinate, found[-1].position_m
        return found

    def predicted_channels(
        self, phases: VisiblePhases, sides: tuple[tuple[int, int], ...]
    ) -> list[StageChannels]:
        """Return the beams of a subimage, stage by stage."""
        found, channels = [], phases.model.lines.channels
        for factor in self.factors:
            used, channels = channels, math.ceil(channels / factor)
            found.append(StageChannels(used, channels, factor, channels, channels))
        return found


def range_error_m(
    range_m: ArrayLike, half_length_m: ArrayLike, angle_rad: ArrayLike, away_rad: ArrayLike
) -> NDArray[np.float64]:
    """Return the error of one beam standing for a sector, at one place [40].

    Parameters
    ----------
    range_m : array_like
        Distance r of the point from the middle of the subaperture.
    half_length_m : array_like
        Half the subaperture's length, t.
    angle_rad : array_like
        Angle a between the subaperture and the beam's direction.
    away_rad : array_like
        Angle b from the beam's direction to the point.

    Notes
    -----
    sqrt(r^2 + t^2 - 2 r t cos(a + b)) - sqrt(r^2 + t^2 - 2 r t cos(a)).
    """
    r, t, a, b = map(np.asarray, (range_m, half_length_m, angle_rad, away_rad))
    square = r * r + t * t
    return np.sqrt(square - 2 * r * t * np.cos(a + b)) - np.sqrt(square - 2 * r * t * np.cos(a))


def stage_errors_m(
    stages: Stages, aperture_m: float, image_m: float, nearest_m: float
) -> list[float]:
    """Return the largest range error of every stage [45]; those of a plan add up.

    Parameters
    ----------
    stages : sequence of (QR, QI)
    aperture_m : float
        Distance between neighbouring channels of the raw lines.
    image_m : float
        Longer side of the image.
    nearest_m : float
        Least range, Rmin.

    Notes
    -----
    L_A L_I/(4 Rmin) for L_A <= Rmin, else L_I/2, with the subaperture's length L_A and the
    subimage's side L_I after the stage. This bounds [40] with t = L_A/2 over the sector L_I/(2 r)
    to either side, as |d rho/d angle| <= min(r, t). Channels lie less far out, at most
    (QR - 1)/QR of t; corners of square subimages that are seen obliquely, at 22.5 degrees most,
    err by up to (1 + sqrt 2)/2 more.
    """
    errors, length_m, side_m = [], aperture_m, image_m
    for beams, divisions in stages:
        length_m *= beams
        side_m /= divisions
        near = length_m > nearest_m
        errors.append(side_m / 2 if near else length_m * side_m / (4 * nearest_m))
    return errors


def operations(
    stages: Stages, channels: int, samples: Sequence[int], pixels: int, gamma: float = 0.0
) -> list[float]:
    """Return the operations of every stage and, last, of the backprojection [44].

    Parameters
    ----------
    stages : sequence of (QR, QI)
    channels : int
        Raw lines, N.
    samples : sequence of int
        Range samples per line, Nr, stage by stage.
    pixels : int
        Of the whole image, X Y.
    gamma : float
        What a line costs in a stage besides its samples.

    Notes
    -----
    As the thesis's worked example has it, N lines take part in the first stage, for each of its
    QI^2 subimages; N/QR in the second, for each of its QI^4; and so on.
    """
    counts, subimages = [], 1
    for (beams, divisions), length in zip(stages, samples, strict=True):
        subimages *= divisions**2
        counts.append(float(channels * (subimages * length + gamma)))
        channels = math.ceil(channels / beams)
    counts.append(float(channels * pixels))
    return counts
