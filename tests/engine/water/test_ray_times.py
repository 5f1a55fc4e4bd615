import numpy as np
import pytest

from clsas import SoundSpeed
from clsas.engine.water.ray_times import RayTimes
from clsas.engine.water.rays import rays

PROFILE = SoundSpeed([0, 12, 15, 60], [1505, 1504, 1494, 1490])
DISTANCES_M, HEIGHTS_M = (30.0, 60.0), (-27.0, -23.0)


def pairs(count, heights_m):
    random = np.random.default_rng(1)
    return (
        random.uniform(*DISTANCES_M, count),
        random.choice(heights_m, count),
        random.uniform(*HEIGHTS_M, count),
    )


@pytest.mark.parametrize("expected", [1.0, 1e9])
@pytest.mark.parametrize("heights_m", [[-6.0], [-6.0, -6.2, -5.5]])
def test_times_are_those_of_rays(heights_m, expected):
    """The time of sound over 1e-12 s is a nanometre."""
    times = RayTimes(PROFILE, DISTANCES_M, HEIGHTS_M, expected)
    distance, antenna_z, z = pairs(500, heights_m)
    found = times.between(distance, antenna_z, z)
    assert np.abs(found - rays(PROFILE, distance, antenna_z, z).time_s).max() < 2e-12


@pytest.mark.parametrize("expected", [1.0, 1e9])
def test_there_is_no_time_in_a_shadow(expected):
    profile = SoundSpeed([0, 60], [1500, 1440])
    times = RayTimes(profile, (10.0, 3000.0), HEIGHTS_M, expected)
    found = times.between(np.array([50.0, 2500.0]), -2.0, np.array([-25.0, -25.0]))
    assert found[0] == pytest.approx(np.hypot(50, 23) / 1487, rel=1e-2)
    assert np.isinf(found[1])
