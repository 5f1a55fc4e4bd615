"""Errors of a navigation, from displacements between pings and the navigation's own accuracy.

The state of a ping is (sway, yaw): how far its array lies to port of where the navigation has it,
and how far it is turned. A displacement between two pings, measured at the middle of their overlap,
relates both states linearly:

    yaw'  = yaw + b,
    sway' = sway + yaw l - yaw' l' + a,

with the measured sway a and yaw b, and l, l' the distances from either array's middle forward to
the middle of the overlap. The navigation itself is a measurement of (0, 0) at every ping. A Kalman
filter forward and the smoother of Rauch, Tung and Striebel (1965) backward give the states that
explain both, and their covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Step:
    """A displacement between two pings.

    Attributes
    ----------
    moved : float64 [2]
        Sway in metres and yaw in radians, at the middle of the overlap.
    covariance : float64 [2, 2]
        Of both.
    levers_m : (here, there)
        From the middles of both arrays forward to the middle of the overlap.
    """

    moved: NDArray[np.float64]
    covariance: NDArray[np.float64]
    levers_m: tuple[float, float]

    @property
    def _inverse(self) -> NDArray[np.float64]:
        """What the middle of the overlap makes of the next array's state, undone."""
        return np.array([[1.0, -self.levers_m[1]], [0.0, 1.0]])

    @property
    def transition(self) -> NDArray[np.float64]:
        """State of the next ping over that of this one."""
        return self._inverse @ np.array([[1.0, self.levers_m[0]], [0.0, 1.0]])

    @property
    def drift(self) -> NDArray[np.float64]:
        """What the displacement adds to the next ping's state."""
        return self._inverse @ self.moved

    @property
    def spread(self) -> NDArray[np.float64]:
        """Covariance of `drift`."""
        return self._inverse @ self.covariance @ self._inverse.T


def integrated(steps: Sequence[Step]) -> NDArray[np.float64]:
    """Return the states of all pings, [pings, 2], with (0, 0) at the first."""
    states = np.zeros((len(steps) + 1, 2))
    for ping, step in enumerate(steps):
        states[ping + 1] = step.transition @ states[ping] + step.drift
    return states


def smooth(
    steps: Sequence[Step], sway_sd_m: NDArray[np.float64], yaw_sd_rad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the states of all pings, [pings, 2], and their covariances, [pings, 2, 2].

    `sway_sd_m` and `yaw_sd_rad` are the standard deviations of the navigation as a measurement of
    every ping, [pings].
    """
    pings = len(steps) + 1
    fix = np.stack([sway_sd_m, yaw_sd_rad], axis=1) ** 2
    states, covariances = np.zeros((pings, 2)), np.zeros((pings, 2, 2))
    ahead, spread = np.zeros((pings, 2)), np.zeros((pings, 2, 2))  # before the ping's own fix
    state, covariance = np.zeros(2), np.diag(fix[0])
    states[0], covariances[0] = state, covariance
    for ping, step in enumerate(steps, start=1):
        state = ahead[ping] = step.transition @ state + step.drift
        covariance = step.transition @ covariance @ step.transition.T + step.spread
        spread[ping] = covariance
        gain = np.linalg.solve(covariance + np.diag(fix[ping]), covariance).T
        state = state - gain @ state
        covariance = (np.eye(2) - gain) @ covariance
        states[ping], covariances[ping] = state, (covariance + covariance.T) / 2
        covariance = covariances[ping]
    for ping in range(pings - 2, -1, -1):
        carried = steps[ping].transition @ covariances[ping]
        gain = np.linalg.solve(spread[ping + 1], carried).T
        states[ping] += gain @ (states[ping + 1] - ahead[ping + 1])
        covariances[ping] += gain @ (covariances[ping + 1] - spread[ping + 1]) @ gain.T
    return states, covariances
