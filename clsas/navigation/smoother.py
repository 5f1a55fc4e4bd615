"""Errors of a navigation, estimated from displacements between pings and its own accuracy.

The state of a ping is (sway, yaw): how far its array lies to port of its navigated position, and
how far it is turned from its navigated heading. A displacement between two pings, measured at the
middle of their overlap, relates their states linearly:

    yaw'  = yaw + b,
    sway' = sway + yaw l - yaw' l' + a,

where a is the measured sway, b the measured yaw, and l and l' are the distances from the middle of
either array forward to the middle of the overlap. The prior for the states is the accuracy of the
navigation: they form a Gauss-Markov process with the given standard deviation at every ping, which
persists over some pings. A Kalman filter forward and a Rauch-Tung-Striebel smoother (1965) backward
estimate the states and their covariances from both. A covariance never exceeds that of the
navigation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Errors, pings times blocks, that are needed per lag of the autocovariance. With 60, the variance
# of independent errors is estimated to 15 %.
_ERRORS_PER_LAG = 60
_DRAWS = 400  # random tracks from which the deviation of a shape is estimated, to 4 %


@dataclass(frozen=True, eq=False)
class Step:
    """Relation between the states x of a ping and x' of the next one: x' = F x + u.

    Attributes
    ----------
    transition : float64 [n, n]
        F.
    drift : float64 [n]
        Expectation of u.
    spread : float64 [n, n]
        Covariance of u.
    """

    transition: NDArray[np.float64]
    drift: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def over(
        cls,
        moved: NDArray[np.float64],
        covariance: NDArray[np.float64],
        levers_m: tuple[float, float],
    ) -> Step:
        """Return the step of sway and yaw for a displacement at the middle of an overlap.

        Parameters
        ----------
        moved : float64 [2]
            Sway in metres and yaw in radians.
        covariance : float64 [2, 2]
            Covariance of both.
        levers_m : (first, second)
            Distances from the middles of both arrays forward to the middle of the overlap.
        """
        here, there = (np.array([[1.0, lever], [0.0, 1.0]]) for lever in levers_m)
        back = np.linalg.inv(there)
        return cls(back @ here, back @ moved, back @ covariance @ back.T)

    @classmethod
    def along(cls, moved: float, deviation: float) -> Step:
        """Return the step of a single number that changes by `moved`."""
        return cls(np.eye(1), np.array([moved]), np.array([[deviation**2]]))


def integrated(steps: Sequence[Step], deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the states of all pings, [pings, n], when the steps are exact.

    The first state, that is, a common shift and turn, is chosen so that the track stays as near as
    possible to its navigation. `deviations`, [pings, n], are those of the navigation. Where they
    are 0, the first state is 0.
    """
    size = len(steps[0].drift)
    states, from_first = [np.zeros(size)], [np.eye(size)]
    for step in steps:
        states.append(step.transition @ states[-1] + step.drift)
        from_first.append(step.transition @ from_first[-1])
    found, changes = np.stack(states), np.stack(from_first)
    free = np.all(deviations > 0, axis=0)
    weights = np.where(free, 1 / np.where(free, deviations, 1.0), 0.0)
    design = (weights[..., None] * changes)[..., free].reshape(-1, int(free.sum()))
    first = np.linalg.lstsq(design, -(weights * found).ravel(), rcond=None)[0]
    return found + changes[..., free] @ first


def smooth(
    steps: Sequence[Step | None], deviations: NDArray[np.float64], correlation_pings: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the states of all pings, [pings, n], and their covariances, [pings, n, n].

    Parameters
    ----------
    steps : sequence of Step or None, [pings - 1]
        Relations between consecutive states; None where nothing was measured.
    deviations : float64 [pings, n]
        Standard deviations of the navigation.
    correlation_pings : float
        Number of pings over which errors of the navigation persist: the errors of two pings that
        are k pings apart have the correlation exp(-k/correlation_pings).
    """
    pings, size = deviations.shape
    keep = np.exp(-1 / correlation_pings)
    states, covariances = np.zeros((pings, size)), np.zeros((pings, size, size))
    covariances[0] = np.diag(deviations[0] ** 2)
    both: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []  # a ping and the next one
    for ping, step in enumerate(steps):
        # The navigation predicts the next state: part of its error persists, and the rest is fresh.
        change = np.diag(keep * deviations[ping + 1] / deviations[ping])
        fresh = (1 - keep**2) * deviations[ping + 1] ** 2
        across = change @ covariances[ping]
        mean = np.concatenate([states[ping], change @ states[ping]])
        covariance = np.block(
            [[covariances[ping], across.T], [across, across @ change.T + np.diag(fresh)]]
        )
        if step is not None:
            observed = np.hstack([-step.transition, np.eye(size)])
            spread = observed @ covariance @ observed.T + step.spread
            gain = np.linalg.solve(spread, observed @ covariance).T
            mean = mean + gain @ (step.drift - observed @ mean)
            covariance = covariance - gain @ observed @ covariance
            covariance = (covariance + covariance.T) / 2
        both.append((mean, covariance))
        states[ping + 1], covariances[ping + 1] = mean[size:], covariance[size:, size:]
    for ping in range(pings - 2, -1, -1):
        mean, covariance = both[ping]
        ahead, across = covariance[size:, size:], covariance[size:, :size]
        gain = np.linalg.solve(ahead, across).T
        states[ping] = mean[:size] + gain @ (states[ping + 1] - mean[size:])
        change = gain @ (covariances[ping + 1] - ahead) @ gain.T
        covariances[ping] = covariance[:size, :size] + change
    return states, covariances


def shape_deviation_m(
    sway_sd_m: NDArray[np.float64], yaw_sd_rad: NDArray[np.float64], advance_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the standard deviation of a track's sway without a common shift and turn, [pings].

    The sharpness of an image depends on this part of the sway alone. Errors of the displacements
    from ping to ping (sway and yaw, [pings - 1]) add up along a track that advances by `advance_m`,
    [pings - 1]. The deviation is that of many random tracks from the straight lines fitted to them.
    """
    random = np.random.default_rng(0)
    shape = _DRAWS, len(advance_m)
    yaw = np.cumsum(random.standard_normal(shape) * yaw_sd_rad, axis=1)
    before = np.concatenate([np.zeros((_DRAWS, 1)), yaw[:, :-1]], axis=1)
    steps_m = random.standard_normal(shape) * sway_sd_m + advance_m * (before + yaw) / 2
    sway_m = np.concatenate([np.zeros((_DRAWS, 1)), np.cumsum(steps_m, axis=1)], axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(advance_m)])
    line, _ = np.linalg.qr(np.stack([np.ones_like(along_m), along_m], axis=1))
    return np.sqrt(np.mean((sway_m - sway_m @ line @ line.T) ** 2, axis=0))


def persistence(scatter: NDArray[np.float64]) -> float:
    """Return the variance of a sum of errors over that of independent errors, at least 1.

    Echoes stay in the beam for many pings, and so do the errors that they cause. These errors
    differ between blocks of range: `scatter`, [pings - 1, blocks], is the deviation of each block
    from the joint displacement. The variance of the sum is estimated from the autocovariance of
    `scatter`, weighted by a triangle (Newey and West 1987). The number of lags grows with the
    number of errors. One block or a few pings are not enough, and the result is 1.
    """
    count, blocks = scatter.shape
    lags = min(count - 1, int(count * blocks / _ERRORS_PER_LAG))
    square = float(np.sum(scatter**2))
    if blocks < 2 or lags < 1 or square <= 0:
        return 1.0
    shared = [float(np.sum(scatter[each:] * scatter[:-each])) for each in range(1, lags + 1)]
    weights = 1 - np.arange(1, lags + 1) / (lags + 1)
    return max(1.0, 1 + 2 * float(weights @ shared) / square)
