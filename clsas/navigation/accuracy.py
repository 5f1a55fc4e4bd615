"""Accuracy of the navigation that is to be corrected, and a check of the corrections against it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError

_LEAST_DEVIATION = 1e-9  # smallest standard deviation accepted, metres or radians
_MOST_DEVIATION_M = 1e3
_IMPLAUSIBLE = 3.0  # rms correction above which a warning is given, in standard deviations


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Accuracy of a navigation.

    Attributes
    ----------
    deviations : float64 [pings, 3]
        Standard deviations of sway (m), yaw (rad) and surge (m).
    correlation_pings : float
        Number of pings over which errors persist.
    """

    deviations: NDArray[np.float64]
    correlation_pings: float

    @classmethod
    def of(
        cls,
        pings: int,
        sway_sd_m: ArrayLike,
        yaw_sd_rad: ArrayLike,
        surge_sd_m: ArrayLike,
        correlation_pings: float | None,
    ) -> Accuracy:
        """Return the accuracy that the arguments of `micronavigate` describe, after checking them.

        By default, errors persist over the whole recording.
        """
        if correlation_pings is None:
            correlation_pings = pings
        correlation_pings = validate.number(
            "correlation_pings", correlation_pings, "pings", least=0.5
        )
        deviations = []
        for name, value, unit, most in (
            ("sway_sd_m", sway_sd_m, "m", _MOST_DEVIATION_M),
            ("yaw_sd_rad", yaw_sd_rad, "rad", math.pi),
            ("surge_sd_m", surge_sd_m, "m", _MOST_DEVIATION_M),
        ):
            checked = validate.array(name, value, np.float64, (pings,), broadcast=True)
            if checked.min() < _LEAST_DEVIATION or checked.max() > most:
                outside = checked.min() if checked.min() < _LEAST_DEVIATION else checked.max()
                allowed = f"be from {_LEAST_DEVIATION:g} to {most:.4g} {unit}"
                raise ArgumentError(name, allowed, f"{outside:g} {unit}")
            deviations.append(checked)
        return cls(np.stack(deviations, axis=1), correlation_pings)


def check_plausible(states: NDArray[np.float64], accuracy: Accuracy) -> None:
    """Warn if corrections, [pings, 3], are far larger than the navigation's standard deviations."""
    ratio = np.sqrt(np.mean((states / accuracy.deviations) ** 2, axis=0))
    worst = int(np.argmax(ratio))
    if ratio[worst] > _IMPLAUSIBLE:
        name, option = (("sway", "sway_sd_m"), ("yaw", "yaw_sd_rad"), ("surge", "surge_sd_m"))[
            worst
        ]
        validate.warn(
            f"the {name} found is {ratio[worst]:.3g} times the accuracy given for the navigation "
            f"(`{option}`), rms over the pings. Check `{option}`, `side` and `element_length_m`, "
            "and run `clsas inspect`, which detects samples with the wrong sign of phase"
        )
