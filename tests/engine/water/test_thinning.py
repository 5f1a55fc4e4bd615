import tracemalloc

import numpy as np
import pytest
from bent import travel_times
from scipy.integrate import cumulative_trapezoid

from clsas import SoundSpeed
from clsas.engine.water.rays import rays
from clsas.engine.water.thinning import FEW, VERTICAL_ERROR_S, _fitted, thinned

DEPTH = np.linspace(0, 60, 500)


def cast(noise_m_s, depth=DEPTH):
    """A thermocline that is no polygon, as a probe measures it."""
    noise = noise_m_s * np.random.default_rng(1).normal(size=len(depth))
    return SoundSpeed(depth, 1500 - 8 / (1 + np.exp(-(depth - 14) / 1.5)) + noise)


@pytest.mark.slow
@pytest.mark.parametrize(("noise_m_s", "most"), [(0.0, 60), (0.001, 100)])
def test_travel_times_stay(noise_m_s, most):
    """Against rays through all depths, by quadrature."""
    profile = cast(noise_m_s)
    found = thinned(profile)
    assert len(found.depth_m) <= most
    assert found.depth_m[[0, -1]].tolist() == [0, 60]
    distance_m = np.random.default_rng(2).uniform(1, 90, 300)
    for ends in ((6.0, 25.0), (10.0, 22.5), (1.0, 59.0)):
        times = travel_times(profile.depth_m, profile.speed_m_s, *ends, 95.0, count=1200)
        slope = (ends[1] - ends[0]) / np.hypot(ends[1] - ends[0], distance_m)
        away_s = rays(profile, distance_m, -ends[0], -ends[1]).time_s - times(distance_m)
        assert np.abs(away_s * slope).max() < 2 * VERTICAL_ERROR_S


def test_a_few_depths_stay():
    for count in (2, FEW):
        profile = cast(0.05, np.linspace(0, 60, count))
        assert thinned(profile) is profile


def test_a_profile_that_needs_its_depths_keeps_them():
    depth = np.arange(200.0)
    profile = SoundSpeed(depth, 1500 + 10 * (depth % 2))
    assert thinned(profile) is profile


@pytest.mark.parametrize("depths", [300, 1000])
def test_steep_profiles_are_not_refused(depths):
    """Fitted speeds overshoot at kinks, by more than a profile may change."""
    depth = np.linspace(0, 3, depths)
    profile = SoundSpeed(depth, 1440 + np.clip(59 * (depth - 1.51), 0, 40))
    assert thinned(profile) is profile
    assert np.isfinite(rays(profile, 5.0, -0.5, -2.5).time_s)


def test_the_time_hardly_grows_with_the_depths():
    found = [len(thinned(cast(0.002, np.linspace(0, 60, n))).depth_m) for n in (1000, 5000)]
    assert max(found) < 200


def test_casts_of_a_hundred_thousand_depths_need_little_memory():
    """A least-squares matrix of all depths would have 43 MB for 54 kept depths, and 320 for 400."""
    profile = cast(0.001, np.linspace(0, 60, 100_000))
    tracemalloc.start()
    found = thinned(profile)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found.depth_m) < 100
    assert peak < 20e6
    at_all = np.interp(profile.depth_m, found.depth_m, found.speed_m_s)
    errors = np.concatenate([[0], np.cumsum((profile.speed_m_s - at_all)[:-1] * 60 / 99_999)])
    assert np.abs(errors).max() < 1.01 * VERTICAL_ERROR_S * profile.speed_m_s.min() ** 2


@pytest.mark.parametrize("kept", [[0, 499], [0, 3, 4, 90, 300, 499], [0, 1, 2, 498, 499]])
def test_the_fit_is_that_of_all_depths(kept):
    """With a column per kept depth: the integral of the polygon that is 1 there, 0 elsewhere."""
    speed, kept = cast(0.002).speed_m_s, np.array(kept)
    hats = np.stack([np.interp(DEPTH, DEPTH[kept], unit) for unit in np.eye(len(kept))], axis=1)
    matrix = cumulative_trapezoid(hats, DEPTH, axis=0, initial=0.0)
    offset = speed - np.interp(DEPTH, DEPTH[kept], speed[kept])
    wanted = cumulative_trapezoid(offset, DEPTH, initial=0.0)
    expected = speed[kept] + np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    found, error = _fitted(DEPTH, speed, kept)
    assert found == pytest.approx(expected, rel=1e-13)
    left = np.abs(wanted - matrix @ (expected - speed[kept]))
    assert np.all(np.abs(error) >= left - 1e-9)  # m^2/s; allowed are 4.5e-4
