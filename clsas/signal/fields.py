"""Types of fields for filters and resamplings that are stored as JSON; see `clsas.core.fields`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from clsas.core.fields import CONFIG, Array, Constraint, Number, StoredAs, Whole
from clsas.signal.interpolation import PHASES, UPSAMPLING_TAPS, Interpolator, Resampling, Upsampler


@dataclass
class _Filter:
    __pydantic_config__ = CONFIG
    taps: int
    upsampling: Annotated[float, Constraint(ge=1.0, lt=math.inf)]
    coefficients: Array
    error_db: Number
    scatter_db: Number

    def __post_init__(self) -> None:
        if self.taps not in (2, 4, 6, 8):
            raise ValueError(f"taps must be 2, 4, 6 or 8, got {self.taps}")
        shape = (self.taps // 2, 2, self.taps // 2)
        if self.coefficients.shape != shape:
            got = self.coefficients.shape
            raise ValueError(f"coefficients must have the shape {shape}, got {got}")


@dataclass
class _Upsampler:
    __pydantic_config__ = CONFIG
    step: Whole
    coefficients: Array
    error_db: Number

    def __post_init__(self) -> None:
        if self.coefficients.shape not in [(PHASES, taps) for taps in UPSAMPLING_TAPS]:
            raise ValueError(
                f"coefficients must have the shape ({PHASES}, taps), with taps one of "
                f"{UPSAMPLING_TAPS}, got {self.coefficients.shape}"
            )


_Samples = Annotated[int, Constraint(gt=0, lt=2**30)]


@dataclass
class _Resampling:
    __pydantic_config__ = CONFIG
    lead: Annotated[int, Constraint(ge=0, lt=2**20)]
    period: _Samples
    upsampled_period: _Samples
    shift: int
    first: Annotated[int, Constraint(gt=-(2**20), lt=2**20)]
    length: _Samples

    def __post_init__(self) -> None:
        if abs(self.shift) > self.period:
            raise ValueError(f"shift must be within the period {self.period}, got {self.shift}")


RangeFilter = Annotated[Interpolator, StoredAs(_Filter)]
StoredUpsampler = Annotated[Upsampler, StoredAs(_Upsampler)]
StoredResampling = Annotated[Resampling, StoredAs(_Resampling)]
