"""Accuracy of the navigation that lines come with, and what is found beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import validate

_LEAST_DEVIATION = 1e-9  # of a navigation, metres or radians
_MOST_DEVIATION_M = 1e3
_IMPLAUSIBLE = 3.0  # standard deviations of the navigation, rms over the pings


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Accuracy of a navigation.

    Attributes
    ----------
    deviations : float64 [pings, 3]
        Standard deviations of sway (m), yaw (rad) and surge (m).
    correlation_pings : float
        Pings over which errors persist.
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
        """Return checked deviations; errors persist over the whole recording unless given."""
        if correlation_pings is None:
            correlation_pings = pings
        persist = validate.number("correlation_pings", correlation_pings, "pings", least=0.5)
        found = []
        for name, value, unit, most in (
            ("sway_sd_m", sway_sd_m, "m", _MOST_DEVIATION_M),
            ("yaw_sd_rad", yaw_sd_rad, "rad", math.pi),
            ("surge_sd_m", surge_sd_m, "m", _MOST_DEVIATION_M),
        ):
            checked = validate.array(name, value, np.float64, (pings,), broadcast=True)
            if checked.min() < _LEAST_DEVIATION or checked.max() > most:
                wrong = checked.min() if checked.min() < _LEAST_DEVIATION else checked.max()
                raise ValueError(
                    f"{name} must be from {_LEAST_DEVIATION:g} to {most:.4g} {unit}, "
                    f"got {wrong:g} {unit}"
                )
            found.append(checked)
        return cls(np.stack(found, axis=1), persist)


def check_plausible(states: NDArray[np.float64], accuracy: Accuracy) -> None:
    """Warn of corrections far beyond the accuracy of the navigation; `states` are [pings, 3]."""
    beyond = np.sqrt(np.mean((states / accuracy.deviations) ** 2, axis=0))
    worst = int(np.argmax(beyond))
    if beyond[worst] > _IMPLAUSIBLE:
        name, option = (("sway", "sway_sd_m"), ("yaw", "yaw_sd_rad"), ("surge", "surge_sd_m"))[
            worst
        ]
        validate.warn(
            f"the {name} found is {beyond[worst]:.3g} times the accuracy given for the navigation "
            f"({option}), rms over the pings. Check that accuracy, side, element_length_m, and the "
            "sign of phase: `clsas inspect` tells conjugated samples"
        )
