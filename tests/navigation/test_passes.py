"""Passes of micronavigation: coarse arrays, progress, and the deviation of a track's shape."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.navigation.smoother import persistence, shape_deviation_m

SPACING_M = 0.1  # of phase centres; the phases of neighbours differ by half a cycle at 30 mrad
PINGS = 12


@pytest.fixture(scope="module")
def coarse():
    """Return lines of an array of few large receivers, and its sway, which is not navigated."""
    rx_m = [[2 * SPACING_M * (n - 2.5), 0.0, 0.0] for n in range(6)]
    pulse = clsas.Pulse(125e3, 15e3, 1e-3)
    sonar = clsas.Sonar(pulse, rx_m, tx_length_m=0.2, rx_length_m=0.2)
    course = (0, 0, 0), (0.2, 0, 0), PINGS, 1.0
    sway_m = 0.03 * np.sin(np.arange(PINGS) / 2)
    true = clsas.Track.straight(*course, sway_m=sway_m)
    rng = np.random.default_rng(0)
    at = np.stack([rng.uniform(-5, 8, 4000), rng.uniform(28, 40, 4000), np.zeros(4000)], axis=1)
    scene = clsas.PointTargets(at, rng.standard_normal(4000) + 1j * rng.standard_normal(4000))
    lines = clsas.compress(clsas.simulate(sonar, true, scene, range_m=(29, 39)))
    nominal = clsas.channels(sonar, clsas.Track.straight(*course))
    return replace(lines, tx_m=nominal.tx_m, rx_m=nominal.rx_m), sway_m


def detrended(values):
    at = np.arange(len(values))
    return values - np.polyval(np.polyfit(at, values, 1), at)


@pytest.mark.slow
def test_coarse_arrays_do_not_lock_onto_grating_lobes(coarse):
    lines, sway_m = coarse
    reported = []
    found = clsas.micronavigate(
        lines, range_m=(30, 38), element_length_m=0.2, yaw_sd_deg=2.9,
        progress=lambda *each: reported.append(each),
    )  # fmt: skip
    assert np.abs(found.yaw_steps_rad).max() < 2e-3
    residual_m = detrended(found.sway_m - sway_m)
    assert np.std(residual_m) < 0.5e-3
    assert np.std(residual_m) < 3 * found.shape_sd_m.max()
    # Every pass advances the progress, which never decreases and ends at 1.
    done = [each / total for each, total in reported]
    assert done == sorted(done)
    assert done[-1] == 1
    assert sum(each > 0.25 for each in done) > PINGS


def test_deviation_of_shape_is_that_of_random_walks():
    count, random = 60, np.random.default_rng(1)
    advance_m = np.full(count - 1, 0.3)
    walks_m = []
    for _ in range(300):
        yaw = np.concatenate([[0.0], np.cumsum(1e-3 * random.standard_normal(count - 1))])
        steps = 1e-4 * random.standard_normal(count - 1) + 0.3 * (yaw[1:] + yaw[:-1]) / 2
        walks_m.append(detrended(np.concatenate([[0.0], np.cumsum(steps)])))
    found = shape_deviation_m(np.full(count - 1, 1e-4), np.full(count - 1, 1e-3), advance_m)
    np.testing.assert_allclose(found, np.std(walks_m, axis=0), rtol=0.25)
    assert shape_deviation_m(np.zeros(4), np.zeros(4), np.ones(4)) == pytest.approx(np.zeros(5))


def test_errors_that_persist_count_more():
    """Errors that last for several pings add up to more than independent ones."""
    random = np.random.default_rng(2)
    white = random.standard_normal((400, 3))
    kept = np.stack([np.convolve(each, np.ones(5), "valid") for each in white.T], axis=1)
    assert persistence(white) == pytest.approx(1, abs=0.3)
    assert 2.5 < persistence(kept) < 5
    assert persistence(white[:, :1]) == persistence(white[:3]) == 1


def test_corrections_that_leave_no_overlap_are_refused():
    """The ranges are wrong here: samples are 100 m apart, and the swath is 80 km wide."""
    pings, receivers = 12, 8
    tx_m, rx_m = np.zeros((2, pings, receivers, 3))
    tx_m[..., 0] = rx_m[..., 0] = 0.1 * np.arange(pings)[:, None]
    rx_m[..., 0] += 0.05 * np.arange(receivers)
    rng = np.random.default_rng(0)
    at = np.stack([rng.uniform(-15, 15, 500), rng.uniform(25, 40, 500), np.zeros(500)], axis=1)
    lines = clsas.simulate_lines(
        tx_m.reshape(-1, 3), rx_m.reshape(-1, 3),
        clsas.PointTargets(at, rng.standard_normal(500) + 1j * rng.standard_normal(500)),
        carrier_hz=100e3, bandwidth_hz=20e3, first_range_m=25.0, length=800,
    )  # fmt: skip
    with pytest.raises(
        ValueError, match=r"no common phase centres of .* check `range_step_m`, 100 m"
    ):
        clsas.micronavigate(replace(lines, range_step_m=100.0))
