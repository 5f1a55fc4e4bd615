"""Factorized backprojection with nearest beams: the method and the formulas of THESIS chapter 4."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.factorized import tree
from clsas.factorized.aperture import mean_track
from clsas.factorized.dense_apertures import Shape
from clsas.factorized.estimates import StageChannels
from clsas.factorized.fields import CONFIG, Whole
from clsas.factorized.interpolated import VisiblePhases
from clsas.factorized.surface import surface_of
from clsas.factorized.tree import Division, VirtualChannels
from clsas.signal.interpolation import Gain, Interpolator
from clsas.signal.spectrum import band_wavelength_m

if TYPE_CHECKING:
    from clsas.factorized.plan import Plan
    from clsas.factorized.sector import Geometry

Stages = Sequence[tuple[int, int]]
"""(QR, QI) of every stage: how many lines are summed, and the division of either image side."""


@dataclass(frozen=True, config=CONFIG)
class NearestBeams:
    """Virtual channels that are sums of neighbours as they are, at their mean position [43].

    Methods as those of `clsas.factorized.interpolated.InterpolatedAperture`, the other way to
    choose virtual channels.

    Attributes
    ----------
    factors : tuple of int
        Neighbours that are summed into one beam, QR, stage by stage.
    """

    factors: Annotated[tuple[Whole, ...], Field(min_length=1)]
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

    def virtual_channels(
        self,
        geometry: Geometry,
        roots: NDArray[np.int64],
        root_m: NDArray[np.float64],
        place: NDArray[np.float64],
        across: NDArray[np.float64] | None,
        channels_m: NDArray[np.float64],
    ) -> list[VirtualChannels]:
        """Return the beams of some roots, stage by stage."""
        nodes, position_m = [], np.broadcast_to(channels_m, (*place.shape, 3))
        for factor in self.factors:
            nodes.append(tree.nearest_nodes(place, position_m, factor))
            place, position_m = nodes[-1].coordinate, nodes[-1].position_m
        return nodes

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


def plan_errors_m(
    plan: Plan, lines: RangeLines, grid: Grid, pixels: ArrayLike
) -> NDArray[np.float64]:
    """Return the range errors that a plan of nearest beams makes, followed stage by stage.

    Parameters
    ----------
    plan : Plan
        Made with `stages`, at least one.
    lines : RangeLines
        Without motion during flight.
    grid : Grid
        A plane.
    pixels : array_like of int, [n, 2]
        Rows and columns.

    Returns
    -------
    ndarray of float64, shape [n, channels]
        The range at which a pixel takes a channel's line, less the right one; channels in order
        along the track.

    Notes
    -----
    [42] and [43] applied to every channel: in each stage its line is shifted so that the range of
    the subimage's centre is right for the mean of its neighbours, which then stands for it.
    """
    image = plan.factorization
    wavelength_m = band_wavelength_m(lines, image.resampling.centre_cycles_per_sample)
    track = mean_track(lines, wavelength_m)
    if track is None or not isinstance(image.aperture, NearestBeams) or not grid.is_planar:
        raise ValueError("plan must be one of stages, for lines and a plane that it was made for")
    order = np.argsort(track.coordinate, kind="stable")
    ends_m = lines.tx_m[order], lines.rx_m[order]
    division = Division(surface_of(grid), image.sides)
    index = np.asarray(pixels, np.int64)
    points_m = np.asarray(grid.origin_m) + index @ division.surface.steps_m
    errors_m = -pairwise_range_m(points_m, *ends_m)
    position_m = lines.phase_centres_m[order]
    beam = np.arange(lines.channels)  # of the stage before, that holds each channel
    for level, (side, beams) in enumerate(zip(image.sides, image.aperture.factors, strict=True)):
        centres_m = division.centres_m(level, index // side * side)
        errors_m += pairwise_range_m(centres_m, *ends_m)[:, beam]
        starts = np.arange(0, len(position_m), beams)
        counts = np.diff(np.append(starts, len(position_m)))
        position_m = np.add.reduceat(position_m, starts) / counts[:, None]
        beam, ends_m = beam // beams, (position_m, position_m)
        errors_m -= pairwise_range_m(centres_m, *ends_m)[:, beam]
    return errors_m + pairwise_range_m(points_m, *ends_m)[:, beam]
