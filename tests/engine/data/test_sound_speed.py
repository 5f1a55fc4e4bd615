import numpy as np
import pytest
from scipy.integrate import quad

from clsas import SoundSpeed
from clsas.engine.data.sound_speed import check_reaches

DEPTH = [0, 10, 13, 60]
SPEED = [1500, 1501, 1491, 1492]


def test_mackenzies_formula_gives_his_check_value():
    profile = SoundSpeed.from_temperature([0, 1000], 25, 35)
    assert profile.speed_m_s[1] == pytest.approx(1550.744, abs=5e-4)


def test_speed_is_linear_between_depths():
    profile = SoundSpeed(DEPTH, SPEED, surface_z_m=20.0)
    assert profile.at([20, 10, 8.5, 7, -40]) == pytest.approx([1500, 1501, 1496, 1491, 1492])
    assert np.array_equal(profile.z_m, [20, 10, 7, -40])


@pytest.mark.parametrize(
    ("one", "other"), [(-2, -40), (-11, -12), (-40, -10), (-13, -13), (0, -60)]
)
def test_the_mean_speed_is_that_of_the_time(one, other):
    profile = SoundSpeed(DEPTH, SPEED)
    found = profile.mean_m_s(one, other)
    if one == other:
        assert found == profile.at(one)
        return
    low, high = sorted((-one, -other))
    points = [d for d in DEPTH if low < d < high]
    time_s, _ = quad(lambda d: 1 / np.interp(d, DEPTH, SPEED), low, high, points=points or None)
    assert found == pytest.approx((high - low) / time_s, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0], [1500]), "at least 2 depths"),
        (([0, 10, 10], [1500, 1500, 1500]), "must ascend .*10 m after 10 m"),
        (([0, -10], [1500, 1500]), "must ascend .*-10 m after 0 m"),
        (([-5, 10], [1500, 1500]), "depth_m must be .*-5"),
        (([0, 2e4], [1500, 1500]), "depth_m must be .*20000"),
        (([0, 10], [4921, 4900]), "look like feet per second, multiply them by 0.3048"),
        (([0, 10], [1.5, 1.49]), "look like kilometres per second, multiply them by 1000"),
        (([0, 10], [343, 343]), "must be that of water, 1300 to 1800 m/s, got 343 to 343 m/s$"),
        (
            ([0, 1, 2], [1500, 1400, 1500]),
            "at most 60 m/s per metre of `depth_m`.* remove the outlier",
        ),
        (([0, 10], [1500]), r"speed_m_s must have shape \(2\)"),
        (([0, 10], [1500, np.nan]), "speed_m_s must be finite"),
        (([0, 10], [1500, 1500], np.inf), "surface_z_m must be finite"),
    ],
)
def test_profiles_that_cannot_be(arguments, message):
    with pytest.raises(ValueError, match=message):
        SoundSpeed(*arguments)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [(([0, 9000], 5, 35), "depth_m"), (([0, 10], 300, 35), "temperature_c"),
     (([0, 10], 5, 0.035), "salinity")],
)  # fmt: skip
def test_mackenzies_formula_is_for_the_ocean(arguments, name):
    with pytest.raises(ValueError, match=name):
        SoundSpeed.from_temperature(*arguments)


def test_nothing_is_extrapolated():
    profile = SoundSpeed([2, 30], [1500, 1490])
    with pytest.raises(
        ValueError, match=r"include the depths of `z_m`, 1 to 1 m, got .* 2 to 30 m"
    ):
        profile.at(-1.0)
    with pytest.raises(ValueError, match="depths of tx_m, 31 to 31 m"):
        check_reaches(profile, -31.0, "tx_m")


def test_equal_profiles_are_equal():
    one, other = SoundSpeed(DEPTH, SPEED), SoundSpeed(np.array(DEPTH), np.array(SPEED, float))
    assert one == other
    assert hash(one) == hash(other)
    assert one != SoundSpeed(DEPTH, SPEED, 1.0)
    assert one != SoundSpeed(DEPTH[:3], SPEED[:3])
    assert one != 3
