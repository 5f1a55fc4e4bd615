"""How an image is formed: by a factorization, or exactly. Either is a small frozen type."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from clsas.aperture.interpolated import InterpolatedAperture
from clsas.aperture.nearest import NearestBeams
from clsas.core import reprs, validate
from clsas.core.fields import CONFIG, Constraint, Count, Number, Size, Whole
from clsas.opencl.phases import TERMS
from clsas.signal.fields import RangeFilter, StoredResampling, StoredUpsampler
from clsas.signal.interpolation import PHASES

UNREACHED = "no line reaches the grid"
"""Reason of an exact image of zeros, of which `clsas.plan` has warned."""


@dataclass(frozen=True)
class ExactImage:
    """Backprojection of all channels to all pixels.

    Attributes
    ----------
    accuracy_db : float
        Relative rms error of its interpolation.
    reason : str
        Why the image cannot be factorized, in words; "" if it can, but not faster.
    """

    accuracy_db: Number
    reason: str = ""
    kind: Literal["exact"] = "exact"

    sides: ClassVar[tuple[Size, ...]] = ()
    half_precision: ClassVar[bool] = False
    band: ClassVar[None] = None

    __pydantic_config__ = CONFIG


@dataclass(frozen=True, eq=False)
class Factorization:
    """A division of the image into subimages within subimages, with the filters in between.

    A root subimage is formed from the lines themselves. Each stage divides the subimages of the
    one before and combines their channels into fewer, virtual ones. The last stage's, the leaves,
    are backprojected.

    Attributes
    ----------
    sides : tuple of (rows, columns)
        Pixels of a subimage, stage by stage.
    tile : (rows, columns)
        Pixels that are backprojected together: leaves, or parts of them.
    aperture : InterpolatedAperture or NearestBeams
        How channels are combined into virtual ones.
    align, final : Interpolator
        Filters in range: of the stages, and of the last backprojection.
    resampling : Resampling
        Positions of samples after lines are upsampled.
    upsampler : Upsampler or None
        Filters that upsample lines; None by FFT.
    half_precision : bool
        True if stages hand on lines in half precision: half of the memory.
    half_lengths : tuple of int
        Samples to either side of a subimage's centre that its lines hold, stage by stage.
    most_channels : tuple of int
        Virtual channels of a subimage, stage by stage, that buffers have room for from the start.
    highest_cycles_per_m : float
        Phase per metre of range at the upper end of the lines' band.
    closest_m : float
        Distance from the track that no pixel is closer than.
    limits : (low, high) or None
        With a beam: sines of the aspect angle between which its weights matter.
    roots_at_once, roots_prepared : int
        Roots that are formed together, and whose geometry is prepared together.
    phase_terms : int
        Terms of the polynomials for sine and cosine of pixels' phases.
    stretch : float
        By how much faster ranges grow along the line of sight than those from the mean track,
        relative to these; the mean over all channels.
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
        """Centre and half width of the band that filters are made for; None for any."""
        return self.aperture.band

    def __post_init__(self) -> None:
        """Check that the fields fit each other."""

        def check(fits: bool, name: str, allowed: str) -> None:
            if not fits:
                got = validate.shown(getattr(self, name))
                raise ValueError(f"{name} must be {allowed}, got {got}")

        nested = all(
            a % b == 0
            for large, small in pairwise((*self.sides, self.tile))
            for a, b in zip(large, small, strict=True)
        )
        check(nested, "sides", f"pairs of rows and columns that divide each other, to {self.tile}")
        whole_items = self.tile[0] % 16 == 0 and self.tile[1] % 4 == 0
        check(whole_items, "tile", "a multiple of 16 rows and 4 columns")
        whole_leaves = self.aperture.splits_leaves or self.tile == self.sides[-1]
        check(whole_leaves, "tile", "the last of sides")
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
