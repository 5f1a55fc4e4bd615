"""Measured errors of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.decibels import NO_ERROR_DB, in_db

# Of a normal distribution, 97.5 %. With 1.645 (95 %) the bound held in fewer than 95 % of draws of
# 64 pixels from factorized images of random scenes, whose errors have longer tails.
_QUANTILE = 1.96


@dataclass(frozen=True, eq=False)
class Certificate:
    """Measured error of an image, as returned by `certify`.

    The error is measured at some pixels, which are formed again. Variance and third moment are
    those of the estimate, so that they add up over the parts of an image.

    Parameters
    ----------
    pixels : int
        Number of pixels drawn. A pixel that was drawn several times counts as often.
    of_pixels : int
        Number of pixels of the image.
    seconds : float
        Time that it took.
    power : float
        Estimate of the mean power of the ideal image's pixels.
    error, error_variance, error_third : float
        Estimate of the mean power of the pixels' errors relative to `power`, its variance, and its
        third central moment.
    worst : array_like of int, shape [n, axes], optional
        Row and column (for points, the indices) of those formed pixels that err most, the worst
        first; at most 5. None for a whole mosaic.
    worst_db : array_like of float, shape [n], optional
        Their errors relative to the rms of the image, dB.

    See Also
    --------
    certify : Function that returns it, with an example.
    """

    pixels: int
    of_pixels: int
    seconds: float
    power: float
    error: float
    error_variance: float
    error_third: float
    worst: NDArray[np.int64] | None = None
    worst_db: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        for name in ("pixels", "of_pixels"):
            object.__setattr__(self, name, validate.count(name, getattr(self, name)))
        object.__setattr__(self, "power", validate.positive("power", self.power))
        for name in ("seconds", "error", "error_variance"):
            value = validate.number(name, getattr(self, name), least=0.0)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "error_third", validate.number("error_third", self.error_third))
        if self.worst is not None:
            worst = validate.array("worst", self.worst, np.int64, (None, None))
            errors_db = np.zeros(0) if self.worst_db is None else self.worst_db
            worst_db = validate.array("worst_db", errors_db, np.float64, (len(worst),))
            object.__setattr__(self, "worst", worst)
            object.__setattr__(self, "worst_db", worst_db)

    @property
    def error_db(self) -> float:
        """Estimate of the relative rms error of the whole image, dB."""
        return in_db(self.error)

    @property
    def lower_db(self) -> float:
        """Lower bound of that error, dB, meant to hold in 95 of 100 draws of pixels."""
        return self._bound_db(-1)

    @property
    def upper_db(self) -> float:
        """Upper bound of that error, dB, meant to hold in 95 of 100 draws of pixels.

        It holds less often where a few pixels have most of the error. It equals `error_db` if all
        pixels were formed again.
        """
        return self._bound_db(+1)

    def _bound_db(self, side: int) -> float:
        """Return a bound of the error.

        Errors have a long upper tail, so that estimates are too low more often than too high. The
        third moment corrects the upper bound (Johnson 1978). The lower one is left where it is:
        one draw with a large error must not exclude small ones.
        """
        if self.pixels < min(2, self.of_pixels):
            return side * math.inf
        deviation = math.sqrt(self.error_variance)
        if not deviation:
            return self.error_db
        quantile = side * _QUANTILE
        if side > 0:
            quantile += self.error_third / deviation**3 / 6 * (1 + 2 * _QUANTILE**2)
        return in_db(max(self.error + quantile * deviation, 0.0))

    @property
    def figures(self) -> dict[str, Any]:
        """The error, its bounds, and all that they follow from."""
        bounds = {name: getattr(self, name) for name in ("error_db", "lower_db", "upper_db")}
        return bounds | {each.name: getattr(self, each.name) for each in fields(self)}

    def verdict(self, tolerance_db: float) -> str:
        """Return "met", "missed" or "undecided": whether the error is within a tolerance.

        It is undecided if the tolerance lies between the bounds of the error.
        """
        tolerance_db = validate.number("tolerance_db", tolerance_db, "dB")
        if self.upper_db <= tolerance_db:
            return "met"
        return "missed" if self.lower_db > tolerance_db else "undecided"

    def describe(self, tolerance_db: float | None = None) -> str:
        """Return the error, its bound and what was requested as a line of text."""
        bound = f"below {self.upper_db:.1f} dB with 95 % confidence"
        is_undecided = tolerance_db is not None and self.verdict(tolerance_db) == "undecided"
        if is_undecided and self.lower_db > NO_ERROR_DB:
            bound = f"between {self.lower_db:.1f} and {self.upper_db:.1f} dB with 90 % confidence"
        text = f"error {self.error_db:.1f} dB ({bound}, measured at {self.pixels} pixels)"
        if self.pixels == self.of_pixels:
            text = f"error {self.error_db:.1f} dB (measured at all pixels)"
        return text if tolerance_db is None else f"{text}; {tolerance_db:g} dB requested"

    def __repr__(self) -> str:
        """Return the error, its bound, and what they were measured with."""
        return reprs.summary(
            self,
            f"error {self.error_db:.1f} dB",
            f"at most {self.upper_db:.1f} dB",
            f"{self.pixels} pixels in {reprs.quantity(self.seconds, 's')}",
        )


def scaled(certificate: Certificate | None, factor: float) -> Certificate | None:
    """Return the certificate of an image whose pixels are multiplied by a factor."""
    if certificate is None:
        return None
    return replace(certificate, power=factor**2 * certificate.power)


def of_parts(parts: Sequence[Certificate], kept: Sequence[float] | None = None) -> Certificate:
    """Return the certificate of an image from those of its parts, without a list of pixels.

    Parameters
    ----------
    parts : sequence of Certificate
    kept : sequence of float, optional
        Share of each part that belongs to the image; by default the whole part. A share counts as
        if it had been measured at that share of the pixels drawn, so that the shares of a part add
        up to the part.
    """
    kept = [1.0] * len(parts) if kept is None else kept
    sizes = [share * part.of_pixels for share, part in zip(kept, parts, strict=True)]
    powers = [size * part.power for size, part in zip(sizes, parts, strict=True)]
    total, size = math.fsum(powers), math.fsum(sizes)

    def added(name: str) -> float:
        return math.fsum(k * getattr(part, name) for k, part in zip(kept, parts, strict=True))

    def summed(name: str, order: int) -> float:
        return math.fsum(
            (power / total) ** order * getattr(part, name) / share ** (order - 1)
            for share, power, part in zip(kept, powers, parts, strict=True)
        )

    return Certificate(
        pixels=max(round(added("pixels")), 1),
        of_pixels=round(size),
        seconds=added("seconds"),
        power=total / size,
        error=summed("error", 1),
        error_variance=summed("error_variance", 2),
        error_third=summed("error_third", 3),
    )
