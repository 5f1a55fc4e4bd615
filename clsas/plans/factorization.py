"""The two ways to form an image, by a factorization or exactly, as small frozen types."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from clsas.core import reprs, validate
from clsas.core.fields import CONFIG, Constraint, Count, Number, Size, Whole
from clsas.factorized.virtual_channels import InterpolatedAperture, NearestBeams
from clsas.opencl.phases import TERMS
from clsas.signal.fields import RangeFilter, StoredResampling, StoredUpsampler
from clsas.signal.interpolation import PHASES

UNREACHED = "no line reaches the grid"
"""Reason for an exact image that is all zeros; `clsas.plan` has then warned."""


@dataclass(frozen=True)
class ExactImage:
    """Backprojection of all channels to all pixels.

    Attributes
    ----------
    accuracy_db : float
        Relative rms error of interpolation, dB.
    reason : str
        Reason why the image is not factorized, in words; "" if an exact image was requested.
    taps, upsampling
        Interpolation of the lines; None to choose the fastest: see `clsas.backproject`.
    """

    accuracy_db: Number
    reason: str = ""
    taps: int | None = None
    upsampling: float | None = None
    kind: Literal["exact"] = "exact"

    sides: ClassVar[tuple[Size, ...]] = ()
    half_precision: ClassVar[bool] = False
    band: ClassVar[None] = None

    __pydantic_config__ = CONFIG


@dataclass(frozen=True, eq=False)
class Factorization:
    """A division of the image into subimages within subimages, and the filters between stages.

    The roots are formed from the lines themselves. Each stage divides the subimages of the stage
    before, and combines their channels into fewer virtual channels. The subimages of the last
    stage, the leaves, are backprojected.

    Attributes
    ----------
    sides : tuple of (rows, columns)
        Size of subimages in pixels, stage by stage.
    tile : (rows, columns)
        Size of the blocks of pixels that are backprojected together: leaves, or parts of them.
    aperture : InterpolatedAperture or NearestBeams
        Method that combines channels into virtual channels.
    align, final : Interpolator
        Filters in range, of the stages and of the last backprojection.
    resampling : Resampling
        Positions of samples after upsampling.
    upsampler : Upsampler or None
        Filters that upsample lines; None for upsampling by FFT.
    half_precision : bool
        True if the lines between stages are in half precision, which halves their memory.
    half_lengths : tuple of int
        Number of samples on either side of a subimage's centre in its lines, stage by stage.
    most_channels : tuple of int
        Number of virtual channels of a subimage, stage by stage, for which buffers have room from
        the start.
    highest_cycles_per_m : float
        Phase per metre of range at the upper end of the lines' band, cycles.
    closest_m : float
        Lower bound on the distance of pixels from the track.
    limits : (low, high) or None
        With a beam, the sines of the aspect angle between which its weights matter.
    roots_at_once, roots_prepared : int
        Number of roots that are formed together, and whose geometry is prepared together.
    phase_terms : int
        Number of terms in the polynomials for sine and cosine of the phases of pixels.
    stretch : float
        Relative excess of the growth of ranges along the line of sight over that of ranges from
        the mean track, averaged over all channels.
    """

    sides: Annotated[tuple[Size, ...], Constraint(min_length=1)]
    tile: Size
    aperture: Annotated[InterpolatedAperture | NearestBeams, Constraint(discriminator="method")]
    align: RangeFilter
    final: RangeFilter
    resampling: StoredResampling
    upsampler: StoredUpsampler | None
    half_precision: bool
    half_lengths: tuple[Count, ...]
    most_channels: tuple[Count, ...]
    highest_cycles_per_m: Annotated[float, Constraint(ge=0.0, le=1e9)]
    closest_m: Annotated[float, Constraint(ge=0.0, le=1e12)]
    limits: tuple[Annotated[float, Constraint(ge=-3.0, lt=math.inf)], Number] | None
    roots_at_once: Whole
    roots_prepared: Whole
    phase_terms: Annotated[int, Constraint(ge=TERMS[0], le=TERMS[-1])] = TERMS[-1]
    stretch: Annotated[float, Constraint(ge=-0.5, le=1.0)] = 0.0
    kind: Literal["factorized"] = "factorized"

    __pydantic_config__ = CONFIG
    __repr__ = reprs.of_fields

    @property
    def band(self) -> tuple[float, float] | None:
        """Centre and half width of the band for which filters were designed; None for any band."""
        return self.aperture.band

    def __post_init__(self) -> None:
        """Raise ValueError if the fields contradict each other."""

        def check(fits: bool, name: str, allowed: str) -> None:
            if not fits:
                got = validate.shown(getattr(self, name))
                raise ValueError(f"{name} must be {allowed}, got {got}")

        nested = all(
            a % b == 0
            for large, small in pairwise((*self.sides, self.tile))
            for a, b in zip(large, small, strict=True)
        )
        check(
            nested,
            "sides",
            f"rows and columns, each divisible by the next and at last by {self.tile}",
        )
        whole_items = self.tile[0] % 16 == 0 and self.tile[1] % 4 == 0
        check(whole_items, "tile", "a multiple of 16 rows and 4 columns")
        whole_leaves = self.aperture.splits_leaves or self.tile == self.sides[-1]
        check(whole_leaves, "tile", "the last pair of sides")
        levels = len(self.sides)
        check(self.aperture.stages == levels, "aperture", f"made for {levels} stages")
        for name in ("half_lengths", "most_channels"):
            check(len(getattr(self, name)) == levels, name, f"{levels} numbers, one for each stage")
        ascend = self.limits is None or self.limits[0] < self.limits[1]
        check(ascend, "limits", "two ascending sines")
        together = self.roots_at_once > 0 and self.roots_prepared % self.roots_at_once == 0
        check(together, "roots_prepared", f"a multiple of roots_at_once, {self.roots_at_once}")
        made = self.upsampler is not None
        check(made or not self.half_precision, "half_precision", "false without an upsampler")
        r = self.resampling
        if self.upsampler is None:
            fits = 0 <= r.first <= r.upsampled_period - r.length
            check(fits, "resampling", "from samples within its period")
        else:
            fits = r.period * PHASES == r.upsampled_period * self.upsampler.step
            check(fits, "resampling", f"by {PHASES} / {self.upsampler.step}, as the upsampler does")
