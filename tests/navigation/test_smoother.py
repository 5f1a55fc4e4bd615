"""The smoother, compared with the joint posterior of all states and with the navigation alone."""

import numpy as np
import pytest

from clsas.navigation.smoother import Step, smooth

PINGS, CORRELATION = 14, 6.0


@pytest.fixture
def deviations():
    random = np.random.default_rng(0)
    return np.stack([random.uniform(0.05, 0.2, PINGS), random.uniform(0.01, 0.03, PINGS)], axis=1)


def steps(sway_m=1e-3, yaw_rad=1e-4):
    """Return steps over an overlap ahead of the middle of one array and behind that of the next."""
    random = np.random.default_rng(1)
    covariance = np.diag([sway_m**2, yaw_rad**2])
    return [
        Step.over(random.normal(size=2) * [0.02, 5e-3], covariance, (0.3, -0.4))
        for _ in range(PINGS - 1)
    ]


def at_once(steps, deviations, correlation):
    """Return mean and covariance of all states given all steps, by dense linear algebra."""
    apart = np.abs(np.subtract.outer(np.arange(PINGS), np.arange(PINGS)))
    prior = np.einsum("pn,qn,pq,nm->pnqm", deviations, deviations,
                      np.exp(-apart / correlation), np.eye(2))  # fmt: skip
    prior = prior.reshape(2 * PINGS, 2 * PINGS)
    rows, seen, spread = [], [], []
    for ping, step in enumerate(steps):
        if step is None:
            continue
        row = np.zeros((2, PINGS, 2))
        row[:, ping], row[:, ping + 1] = -step.transition, np.eye(2)
        rows.append(row.reshape(2, -1))
        seen.append(step.drift)
        spread.append(step.spread)
    matrix, noise = np.concatenate(rows), np.zeros((2 * len(spread), 2 * len(spread)))
    for number, each in enumerate(spread):
        noise[2 * number : 2 * number + 2, 2 * number : 2 * number + 2] = each
    gain = np.linalg.solve(matrix @ prior @ matrix.T + noise, matrix @ prior).T
    covariance = (prior - gain @ matrix @ prior).reshape(PINGS, 2, PINGS, 2)
    return (gain @ np.concatenate(seen)).reshape(PINGS, 2), np.einsum("pnpm->pnm", covariance)


@pytest.mark.parametrize("missing", [(), (4, 5), (0, PINGS - 2)])
def test_states_are_the_posterior_of_all_pings(deviations, missing):
    given = [None if ping in missing else step for ping, step in enumerate(steps())]
    states, covariances = smooth(given, deviations, CORRELATION)
    expected, spreads = at_once(given, deviations, CORRELATION)
    np.testing.assert_allclose(states, expected, atol=1e-9)
    np.testing.assert_allclose(covariances, spreads, atol=1e-9)


@pytest.mark.parametrize("correlation", [0.5, 10.0, PINGS, 1e4])
def test_deviations_never_exceed_those_of_the_navigation(deviations, correlation):
    for given in (steps(), steps(10.0, 1.0), [None] * (PINGS - 1)):
        _, covariances = smooth(given, deviations, correlation)
        reported = np.sqrt(np.einsum("pnn->pn", covariances))
        assert np.all(reported <= deviations * (1 + 1e-6))
    np.testing.assert_allclose(reported, deviations)  # in the last case, nothing is measured


def test_a_long_track_keeps_its_shape():
    """Steps are a million times as accurate as the navigation, over 2000 pings."""
    count, random = 2000, np.random.default_rng(3)
    true = np.cumsum(1e-3 * random.standard_normal(count))
    measured = np.diff(true) + 1e-7 * random.standard_normal(count - 1)
    given = [Step.along(each, 1e-7) for each in measured]
    states, covariances = smooth(given, np.full((count, 1), 0.1), count)
    error = states[:, 0] - true
    assert np.std(error) < 1e-5
    assert np.all((covariances[:, 0, 0] > 0.05**2) & (covariances[:, 0, 0] <= 0.1**2))
