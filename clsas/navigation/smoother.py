"""Errors of a navigation, from displacements between pings and the navigation's own accuracy.

The state of a ping is (sway, yaw): how far its array lies to port of where the navigation has it,
and how far it is turned. A displacement between two pings, measured at the middle of their overlap,
relates both states linearly:

    yaw'  = yaw + b,
    sway' = sway + yaw l - yaw' l' + a,

with the measured sway a and yaw b, and l, l' the distances from either array's middle forward to
the middle of the overlap. Before any echo the navigation's own accuracy tells how large states are:
they are a Gauss-Markov process, which has that standard deviation at every ping and persists over
some pings. A Kalman filter forward and the smoother of Rauch, Tung and Striebel (1965) backward
give the states that explain both, and their covariances. A covariance is never larger than that of
the navigation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ERRORS_PER_LAG = 60  # of pings and blocks: tell the variance of independent errors to 15 %
_DRAWS = 400  # of errors: the deviation is certain to 4 %


@dataclass(frozen=True, eq=False)
class Step:
    """Relation between the states of a ping and of the next: x' = F x + u, with an uncertain u.

    Attributes
    ----------
    transition : float64 [n, n]
        F.
    drift : float64 [n]
        u.
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
        """Return the step of sway and yaw from a displacement at the middle of an overlap.

        Parameters
        ----------
        moved : float64 [2]
            Sway in metres and yaw in radians.
        covariance : float64 [2, 2]
            Of both.
        levers_m : (here, there)
            From the middles of both arrays forward to the middle of the overlap.
        """
        here, there = (np.array([[1.0, lever], [0.0, 1.0]]) for lever in levers_m)
        back = np.linalg.inv(there)
        return cls(back @ here, back @ moved, back @ covariance @ back.T)

    @classmethod
    def along(cls, moved: float, deviation: float) -> Step:
        """Return the step of a single number that changes by `moved`."""
        return cls(np.eye(1), np.array([moved]), np.array([[deviation**2]]))


def integrated(steps: Sequence[Step], deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the states of all pings, [pings, n], by steps taken as exact.

    The first state is the one that keeps the track nearest to its navigation: a common shift and
    turn. `deviations` are those of the navigation, [pings, n]; a number whose are 0 begins at 0.
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
        Relations between consecutive states; None where the echoes tell none.
    deviations : float64 [pings, n]
        Standard deviations of the navigation.
    correlation_pings : float
        Pings over which errors of the navigation persist: those of two pings that are k apart have
        the correlation exp(-k/correlation_pings).
    """
    pings, size = deviations.shape
    keep = np.exp(-1 / correlation_pings)
    states, covariances = np.zeros((pings, size)), np.zeros((pings, size, size))
    covariances[0] = np.diag(deviations[0] ** 2)
    both: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []  # of a ping and the next
    for ping, step in enumerate(steps):
        change = np.diag(keep * deviations[ping + 1] / deviations[ping])
        fresh = (1 - keep**2) * deviations[ping + 1] ** 2
        mean, covariance = _extended(states[ping], covariances[ping], change, np.diag(fresh))
        if step is not None:
            mean, covariance = _measured(mean, covariance, step)
        both.append((mean, covariance))
        states[ping + 1], covariances[ping + 1] = mean[size:], covariance[size:, size:]
    for ping in range(pings - 2, -1, -1):
        mean, covariance = both[ping]
        here, ahead, across = (
            covariance[:size, :size],
            covariance[size:, size:],
            covariance[size:, :size],
        )
        gain = np.linalg.solve(ahead, across).T
        states[ping] = mean[:size] + gain @ (states[ping + 1] - mean[size:])
        covariances[ping] = here + gain @ (covariances[ping + 1] - ahead) @ gain.T
    return states, covariances


def _extended(
    state: NDArray[np.float64],
    covariance: NDArray[np.float64],
    change: NDArray[np.float64],
    fresh: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and covariance of a state and the next: `change` of it, and `fresh` noise."""
    across = change @ covariance
    return (
        np.concatenate([state, change @ state]),
        np.block([[covariance, across.T], [across, across @ change.T + fresh]]),
    )


def _measured(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], step: Step
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and covariance of a state and of the next, given the step between them."""
    seen = np.hstack([-step.transition, np.eye(len(step.drift))])
    spread = seen @ covariance @ seen.T + step.spread
    gain = np.linalg.solve(spread, seen @ covariance).T
    covariance = covariance - gain @ seen @ covariance
    return mean + gain @ (step.drift - seen @ mean), (covariance + covariance.T) / 2


def shape_deviation_m(
    sway_sd_m: NDArray[np.float64], yaw_sd_rad: NDArray[np.float64], advance_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the standard deviation of a track's sway without a common shift and turn, [pings].

    Errors of the displacements from ping to ping (sway and yaw, [pings - 1]) add up along a track
    that advances by `advance_m` each. What is left of many random draws beside their straight lines
    tells how certain the track's shape is, which is what an image needs.
    """
    random = np.random.default_rng(0)
    shape = _DRAWS, len(advance_m)
    yaw = np.cumsum(random.standard_normal(shape) * yaw_sd_rad, axis=1)
    before = np.concatenate([np.zeros((_DRAWS, 1)), yaw[:, :-1]], axis=1)
    steps_m = random.standard_normal(shape) * sway_sd_m + advance_m * (before + yaw) / 2
    sway_m = np.concatenate([np.zeros((_DRAWS, 1)), np.cumsum(steps_m, axis=1)], axis=1)
    at_m = np.concatenate([[0.0], np.cumsum(advance_m)])
    line, _ = np.linalg.qr(np.stack([np.ones_like(at_m), at_m], axis=1))
    return np.sqrt(np.mean((sway_m - sway_m @ line @ line.T) ** 2, axis=0))


def persistence(scatter: NDArray[np.float64]) -> float:
    """Return the variance of a sum of errors over that of independent ones, at least 1.

    Echoes stay in the beam for many pings, and so do the errors that they make. They differ between
    blocks of range: `scatter`, [pings - 1, blocks], is how far every block is off the joint
    displacement. Its covariance from ping to ping tells, weighted by a triangle (Newey and West
    1987), over as many pings as all blocks together tell. One block or few pings do not tell: 1.
    """
    count, blocks = scatter.shape
    lags = min(count - 1, int(count * blocks / _ERRORS_PER_LAG))
    square = float(np.sum(scatter**2))
    if blocks < 2 or lags < 1 or square <= 0:
        return 1.0
    shared = [float(np.sum(scatter[each:] * scatter[:-each])) for each in range(1, lags + 1)]
    weights = 1 - np.arange(1, lags + 1) / (lags + 1)
    return max(1.0, 1 + 2 * float(weights @ shared) / square)
