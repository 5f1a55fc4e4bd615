import numpy as np
import pytest
from bent import travel_times

from clsas import SoundSpeed
from clsas.core.rays import rays
from clsas.core.thinning import FEW, VERTICAL_ERROR_S, thinned

DEPTH = np.linspace(0, 60, 500)


def cast(noise_m_s, depth=DEPTH):
    """A thermocline that is no polygon, as a probe measures it."""
    noise = noise_m_s * np.random.default_rng(1).normal(size=len(depth))
    return SoundSpeed(depth, 1500 - 8 / (1 + np.exp(-(depth - 14) / 1.5)) + noise)


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
