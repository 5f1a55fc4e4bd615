"""Result of a calibration with known points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs
from clsas.engine.data.lines import RangeLines
from clsas.navigation.range_model import UNKNOWNS

UNITS = {"time_offset": "s", "sound_speed": "m/s", "forward": "m", "port": "m", "up": "m"}
"""Units of the unknowns."""


def in_words(name: str, value: float, sd: float) -> str:
    """Return a value and its standard deviation, such as "time offset 10.0 ± 1.5 µs"."""
    return f"{name.replace('_', ' ')} {reprs.with_deviation(value, sd, UNITS[name])}"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration with known points. Its values are the corrections that were added.

    Attributes
    ----------
    lines : RangeLines
        The given lines with corrected first ranges, sound speed and positions.
    unknowns : tuple of str
        Names of the unknowns that were solved for.
    values : float64 [unknowns]
        Corrections in s, m/s and m: time added to that of every sample, speed added to the lines'
        sound speed, and displacement added to all positions.
    covariance : float64 [unknowns, unknowns]
        Covariance matrix of the values, in the products of their units.
    held : tuple of str
        Unknowns that the points cannot distinguish from others. They were not changed.
    residual_m : float64 [channels, points]
        Measured ranges minus those of the corrected lines; NaN where a point was not seen.
    misfit_m : float
        Rms error of ranges in addition to the noise, due to the track, the points or the model.
    phases : bool [points]
        True where the phases of a point's response were used. Elsewhere, the ranges are those of
        the peak of the envelope.

    See Also
    --------
    calibrate_track : Function that returns this result.
    """

    lines: RangeLines
    unknowns: tuple[str, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    held: tuple[str, ...]
    residual_m: NDArray[np.float64]
    misfit_m: float
    phases: NDArray[np.bool_]

    def __repr__(self) -> str:
        """Return the corrections with their standard deviations, and the residual."""
        return reprs.summary(self, self.describe())

    def describe(self) -> str:
        """Return the corrections with their standard deviations, on one line."""
        found = []
        for name, value, deviation in zip(self.unknowns, self.values, self.sd, strict=True):
            whole = self.sound_speed_m_s if name == "sound_speed" else float(value)
            found.append(in_words(name, whole, float(deviation)))
        found += [f"{name.replace('_', ' ')} held" for name in self.held]
        residual_m = float(np.sqrt(np.nanmean(self.residual_m**2)))
        found.append(f"residual {reprs.quantity(residual_m, 'm')} rms")
        return ", ".join(found) + f" at {self.residual_m.shape[1]} points"

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
    def time_offset_s(self) -> float:
        """Time that was added to that of every sample, s; 0 if it was not solved for."""
        return self._value("time_offset")

    @property
    def range_offset_m(self) -> float:
        """Time offset as a range at the corrected sound speed, m."""
        return self.time_offset_s * self.sound_speed_m_s / 2

    @property
    def sound_speed_m_s(self) -> float:
        """Corrected sound speed, m/s."""
        return self.lines.sound_speed_m_s

    @property
    def lever_arm_m(self) -> NDArray[np.float64]:
        """Displacement forward, to port and up that was added to all positions, m, [3]."""
        return np.array([self._value(name) for name in UNKNOWNS[2:]])

    @property
    def seen(self) -> NDArray[np.int64]:
        """Number of channels in which each point was measured, [points]."""
        return np.isfinite(self.residual_m).sum(axis=0)

    @property
    def residual_rms_m(self) -> NDArray[np.float64]:
        """Rms residual of each point, m, [points]; NaN for a point that was not seen."""
        count = np.maximum(self.seen, 1)
        square = np.nansum(self.residual_m**2, axis=0) / count
        return np.where(self.seen > 0, np.sqrt(square), np.nan)

    @property
    def figures(self) -> dict[str, Any]:
        """All numbers, in types that JSON can represent."""
        return {
            "unknowns": list(self.unknowns),
            "values": self.values.tolist(),
            "sd": self.sd.tolist(),
            "correlation": self.correlation.tolist(),
            "held": list(self.held),
            "time_offset_s": self.time_offset_s,
            "sound_speed_m_s": self.sound_speed_m_s,
            "lever_arm_m": self.lever_arm_m.tolist(),
            "seen": self.seen.tolist(),
            "residual_rms_m": [n if math.isfinite(n) else None for n in self.residual_rms_m],
            "misfit_m": self.misfit_m,
            "phases": self.phases.tolist(),
        }

    def _value(self, name: str) -> float:
        """Return the correction of an unknown, 0 if it was not solved for."""
        return float(self.values[self.unknowns.index(name)]) if name in self.unknowns else 0.0
