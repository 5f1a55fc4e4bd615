"""Accuracy of the navigation that is to be corrected, and a check of the corrections against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.declared import Number

SWAY_SD = Number(
    "m", least=1e-9, most=1e3, help="Standard deviation of the sway in the navigation data."
)
YAW_SD = Number(
    "degrees", least=1e-7, most=180.0, help="Standard deviation of the yaw in the navigation data."
)
SURGE_SD = Number(
    "m", least=1e-9, most=1e3, help="Standard deviation of the surge in the navigation data."
)
"""Declare the accuracy of the navigation that is corrected."""
CORRELATION = Number(
    "pings",
    least=0.5,
    help="Pings over which errors of the navigation persist.",
    default="the whole recording",
)
"""Declares for how long errors of the navigation persist."""

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
        yaw_sd_deg: ArrayLike,
        surge_sd_m: ArrayLike,
        correlation_pings: float | None,
    ) -> Accuracy:
        """Return the accuracy that the arguments of `micronavigate` describe, after checking them.

        By default, errors persist over the whole recording.
        """
        if correlation_pings is None:
            correlation_pings = pings
        correlation_pings = CORRELATION.check("correlation_pings", correlation_pings)
        deviations = []
        for name, value, what in (
            ("sway_sd_m", sway_sd_m, SWAY_SD),
            ("yaw_sd_deg", yaw_sd_deg, YAW_SD),
            ("surge_sd_m", surge_sd_m, SURGE_SD),
        ):
            checked = validate.array(name, value, np.float64, (pings,), broadcast=True)
            for end in (checked.min(), checked.max()):
                what.check(name, end)
            deviations.append(checked)
        sway_m, yaw_deg, surge_m = deviations
        return cls(np.stack([sway_m, np.radians(yaw_deg), surge_m], axis=1), correlation_pings)


def check_plausible(states: NDArray[np.float64], accuracy: Accuracy) -> None:
    """Warn if corrections, [pings, 3], are far larger than the navigation's standard deviations."""
    ratio = np.sqrt(np.mean((states / accuracy.deviations) ** 2, axis=0))
    worst = int(np.argmax(ratio))
    if ratio[worst] > _IMPLAUSIBLE:
        name, option = (("sway", "sway_sd_m"), ("yaw", "yaw_sd_deg"), ("surge", "surge_sd_m"))[
            worst
        ]
        validate.warn(
            f"the {name} found is {ratio[worst]:.3g} times the accuracy given for the navigation "
            f"(`{option}`), rms over the pings. Check `{option}`, `side` and `element_length_m`, "
            "and run `clsas inspect`, which detects samples with the wrong sign of phase"
        )
