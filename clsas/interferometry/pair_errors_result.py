"""Systematic errors of a pair of banks, and lines without them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs
from clsas.engine.data.beam import track_directions
from clsas.engine.data.lines import RangeLines, bank_members
from clsas.interferometry.checks import check_pair

UNKNOWNS = ("phase", "delay", "roll")
"""Errors that `pair_errors` can estimate."""

_SHOWN = {"phase": (1.0, "rad"), "delay": (1e6, "µs"), "roll": (1e3, "mrad")}


def in_words(name: str, value: float, sd: float) -> str:
    """Return an error and its standard deviation, such as "delay 3.300 ± 0.020 µs"."""
    factor, unit = _SHOWN[name]
    return f"{name} {reprs.with_deviation(factor * value, factor * sd, unit)}"


@dataclass(frozen=True, eq=False)
class PairErrors:
    """Errors that the second bank of a pair has in all pixels, relative to the first.

    Attributes
    ----------
    unknowns : tuple of str
        Names of the errors that were estimated: "phase", "delay" or "roll".
    values : float64 [unknowns]
        Phase in the samples, radians; time by which echoes arrive late in them, seconds; and angle
        by which the baseline is turned about the direction of the track, radians, with the port
        side up.
    covariance : float64 [unknowns, unknowns]
        Covariance matrix of the values, in the products of their units.
    held : tuple of str
        Errors that these heights cannot tell apart from the others. They were not changed.
    residual_m : float
        Rms difference that remains between heights and expected heights, without outliers, metres.
    misfit : float
        The same in standard deviations. Where it exceeds 1, heights differ by more than their
        noise, and the covariance is scaled accordingly.
    samples : float
        Effective number of independent heights that were compared. Those whose windows overlap
        count in part.
    range_m : (near, far)
        Ranges of the nearest and the farthest pixel of the grid, metres.
    height_sd_m : (near, far)
        Standard deviation of heights there, metres, due to the errors of the estimates.
    roll_cost_m : (near, far)
        Height that 1 mrad of roll adds there, metres, beyond what the estimated phase or delay
        absorbs, if roll is not estimated.

    See Also
    --------
    pair_errors : Function that returns this result.
    """

    unknowns: tuple[str, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    held: tuple[str, ...]
    residual_m: float
    misfit: float
    samples: float
    range_m: tuple[float, float]
    height_sd_m: tuple[float, float]
    roll_cost_m: tuple[float, float]

    def __repr__(self) -> str:
        """Return the errors with their standard deviations, and the residual."""
        return reprs.summary(self, ", ".join(self._found()))

    def describe(self) -> str:
        """Return all results in a few lines of text."""
        near_m, far_m = (f"{1e3 * sd_m:.2g} mm" for sd_m in self.height_sd_m)
        lines = [
            ", ".join(self._found()),
            f"these estimates leave a standard deviation of {near_m} in heights at "
            f"{self.range_m[0]:.4g} m and {far_m} at {self.range_m[1]:.4g} m",
            *self.held_in_words(),
        ]
        return "\n".join(lines)

    def held_in_words(self) -> Iterator[str]:
        """Yield a sentence for every error that was held: why, and what it may cost."""
        for name in self.held:
            if name == "roll":
                costs = " and ".join(
                    f"{1e3 * cost_m:+.2g} mm at {range_m:.4g} m"
                    for cost_m, range_m in zip(self.roll_cost_m, self.range_m, strict=True)
                )
                yield (
                    "roll is not observable here, because it changes the phase almost alike at all "
                    f"places: the estimate is of {' and '.join(self.unknowns)} alone, and 1 mrad "
                    f"of roll adds {costs} to heights"
                )
            elif self.unknowns == ("roll",):
                yield (
                    f"{name} is not observable here, because roll changes the phase almost alike "
                    "at all places: the roll alone was estimated"
                )
            else:
                other = "delay" if name == "phase" else "phase"
                yield (
                    f"{name} is not observable here, because the band is too narrow to tell it "
                    f"apart from the {other}: the {other} contains both, which is right in the "
                    "middle of the band, but may leave whole heights of ambiguity unresolved"
                )

    def _found(self) -> list[str]:
        estimated = zip(self.unknowns, self.values.tolist(), self.sd.tolist(), strict=True)
        found = [in_words(name, value, sd) for name, value, sd in estimated]
        found += [f"{name} held" for name in self.held]
        residual = reprs.measured(self.residual_m, "m", 3)
        return [*found, f"residual {residual} rms at {self.samples:.0f} independent places"]

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations of the values, [unknowns]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation of the errors of the values, [unknowns, unknowns]."""
        sd = np.maximum(self.sd, 1e-300)
        return self.covariance / np.outer(sd, sd)

    @property
    def phase_rad(self) -> float:
        """Phase in the samples of the second bank, radians; 0 if it was not estimated."""
        return self._value("phase")

    @property
    def delay_s(self) -> float:
        """Time by which echoes are late in the second bank, seconds; 0 if it was not estimated."""
        return self._value("delay")

    @property
    def roll_rad(self) -> float:
        """Roll of the baseline, radians, port side up; 0 if it was not estimated."""
        return self._value("roll")

    @property
    def figures(self) -> dict[str, Any]:
        """All numbers, in types that JSON can represent."""
        return {
            "unknowns": list(self.unknowns),
            "values": self.values.tolist(),
            "sd": self.sd.tolist(),
            "correlation": self.correlation.tolist(),
            "held": list(self.held),
            "residual_m": self.residual_m,
            "misfit": self.misfit,
            "samples": self.samples,
            "range_m": list(self.range_m),
            "height_sd_m": list(self.height_sd_m),
            "roll_cost_m": list(self.roll_cost_m),
        }

    def corrected(self, a: RangeLines, b: RangeLines) -> RangeLines:
        """Return the lines of the second bank without the errors that were estimated.

        Its samples lose the phase and the delay, and its receivers turn about those of the first
        bank, to where they really are.

        Parameters
        ----------
        a, b : RangeLines
            Lines of the two banks: those of the estimate, or others of the same sonar.

        Raises
        ------
        TypeError, ValueError
            If they are not the lines of two banks, as for `heights`.
        """
        check_pair(a, b)
        late_m = self.delay_s * b.sound_speed_m_s / 2
        phase_rad = 2 * b.wavenumber_rad_m * late_m - self.phase_rad
        return replace(
            b.weighted(np.full(b.channels, np.exp(1j * phase_rad))),
            first_range_m=b.first_range_m - late_m,
            rx_m=turned(a, b, self.roll_rad),
        )

    def _value(self, name: str) -> float:
        return float(self.values[self.unknowns.index(name)]) if name in self.unknowns else 0.0


def turned(a: RangeLines, b: RangeLines, angle_rad: float) -> NDArray[np.float64]:
    """Return the receivers of b, turned about those of a and the direction of the track.

    The turn is right-handed: the port side rises.
    """
    along = track_directions(a)
    arm_m = b.rx_m - a.rx_m
    ahead_m = np.einsum("ci,ci->c", arm_m, along)[:, None] * along
    across_m = arm_m - ahead_m
    moved_m = np.cos(angle_rad) * across_m + np.sin(angle_rad) * np.cross(along, arm_m)
    return a.rx_m + ahead_m + moved_m


def with_bank(lines: RangeLines, number: int, bank: RangeLines) -> RangeLines:
    """Return lines in which those of a bank have other samples, ranges and receivers."""
    of_bank = bank_members(lines.bank_numbers, number)

    def put(name: str) -> NDArray:
        values = np.array(getattr(lines, name))
        values[of_bank] = getattr(bank, name)
        return values

    return replace(
        lines, samples=put("samples"), first_range_m=put("first_range_m"), rx_m=put("rx_m")
    )
