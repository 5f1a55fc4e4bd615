import tracemalloc

import numpy as np
import pytest
from bent import shot, travel_times

from clsas import SoundSpeed
from clsas.engine.water.ray_tables import TABLE_ERROR_S, RayTable
from clsas.engine.water.rays import farthest_m, rays, shadow

DEPTH = np.array([0.0, 10, 13, 30, 60])
SPEED = np.array([1500.0, 1501, 1491, 1492, 1497])
LAYERS = SoundSpeed(DEPTH, SPEED)
DISTANCES = np.array([0.0, 1e-6, 1, 10, 60, 150, 300])


def gradient(per_s, at=1500.0, depth=60.0):
    return SoundSpeed([0, depth], [at, at + per_s * depth])


def arc_time_s(distance, one, other, profile, per_s):
    """Time along the circle through two depths: cosh(g t) = 1 + g^2 (D^2 + H^2)/(2 c1 c2)."""
    speeds = profile.at(-one) * profile.at(-other)
    half = per_s**2 * (distance**2 + (other - one) ** 2) / (4 * speeds)
    return 2 * np.arcsinh(np.sqrt(half)) / abs(per_s)


def test_rays_of_a_constant_speed_are_straight():
    profile = SoundSpeed([0, 20, 50], [1480, 1480, 1480])
    found = rays(profile, DISTANCES, -5.0, -30.0)
    length = np.hypot(DISTANCES, 25)
    assert found.time_s == pytest.approx(length / 1480, rel=1e-15)
    assert found.slowness_s_m == pytest.approx(DISTANCES / length / 1480, abs=1e-12)
    assert found.other_slope_s_m == pytest.approx(-25 / length / 1480, rel=1e-9)
    level = rays(profile, DISTANCES, -5.0, -5.0)
    assert level.time_s == pytest.approx(DISTANCES / 1480, rel=1e-15)


@pytest.mark.parametrize("per_s", [-1.0, -0.5, -1e-3, -1e-9, 1e-9, 0.016, 0.5, 1.0])
@pytest.mark.parametrize(("one", "other"), [(10, 22), (22, 10), (20, 20.5), (1, 59)])
def test_rays_of_a_gradient_are_arcs(per_s, one, other):
    profile = gradient(per_s)
    found = rays(profile, DISTANCES, -one, -other)
    expected = arc_time_s(DISTANCES, one, other, profile, per_s)
    seen = found.exists
    assert seen[:4].all()
    assert found.time_s[seen] == pytest.approx(expected[seen], rel=4e-15)
    assert np.isinf(found.time_s[~seen]).all()


def test_a_turning_ray_is_on_the_same_circle():
    """Sound that is bent down rises first to get far, as long as it does not meet the surface."""
    profile = gradient(-1.0)
    direct_m = np.sqrt(2 * 1490 * 12)  # to where a ray that starts horizontally arrives
    distance = np.array([0.9, 0.99, 1.01, 1.5, 2.0]) * direct_m
    found = rays(profile, distance, -10.0, -22.0)
    assert found.exists.all()
    expected = arc_time_s(distance, 10, 22, profile, -1.0)
    assert found.time_s == pytest.approx(expected, rel=1e-13)
    assert (found.one_slope_s_m > 0).tolist() == [True, True, False, False, False]


def test_no_ray_passes_below_the_deeper_end():
    profile = gradient(1.0)  # bent up: a longer ray would pass below the seabed
    limit = np.sqrt(22**2 * 0 + (2 * 1500 + 10 + 22) * 12)
    assert farthest_m(profile, -10.0, -22.0) == pytest.approx(limit, abs=0.2)
    found = rays(profile, [limit - 1, limit + 1], -10.0, -22.0)
    assert found.exists.tolist() == [True, False]


@pytest.mark.parametrize(("one", "other"), [(2, 50), (11.5, 29), (5, 12), (13, 30)])
def test_rays_through_layers_agree_with_quadrature(one, other):
    times = travel_times(DEPTH, SPEED, one, other, 120)
    distance = np.linspace(0, 120, 50)
    found = rays(LAYERS, distance, -one, -other)
    assert np.abs(found.time_s - times(distance)).max() < 1e-13


@pytest.mark.parametrize("angle_deg", [4.0, 8.0, 20.0, 60.0])
def test_rays_through_layers_agree_with_an_ode_solver(angle_deg):
    distance = 20.0 if angle_deg > 30 else 80.0
    depth, time_s = shot(DEPTH, SPEED, 9.0, np.radians(angle_deg), distance)
    found = rays(LAYERS, distance, -9.0, -depth)
    assert found.time_s == pytest.approx(time_s, rel=1e-8)
    slowness = np.cos(np.radians(angle_deg)) / LAYERS.at(-9.0)
    assert found.slowness_s_m == pytest.approx(slowness, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [150.0, 250.0, 400.0])
def test_a_ray_that_turns_above_arrives_where_an_ode_solver_says(distance):
    depths, speeds = np.array([0.0, 8, 40]), np.array([1510.0, 1504, 1490])
    found = rays(SoundSpeed(depths, speeds), distance, -12.0, -15.0)
    assert found.one_slope_s_m < 0  # it leaves upwards
    cosine = float(found.slowness_s_m * np.interp(12.0, depths, speeds))
    depth, time_s = shot(depths, speeds, 12.0, -np.arccos(cosine), distance)
    assert depth == pytest.approx(15.0, abs=1e-5)
    assert found.time_s == pytest.approx(time_s, rel=1e-9)


@pytest.mark.parametrize(
    ("distance", "one", "other"), [(60, -5, -25), (20, -11, -40), (90, -9, -14)]
)
def test_slopes_are_the_changes_of_time(distance, one, other):
    def time_s(*move):
        away, up, down = move
        return float(rays(LAYERS, distance + away, one + up, other + down).time_s)

    found = rays(LAYERS, distance, one, other)
    step = 1e-3
    for slope, move in (
        (found.slowness_s_m, (step, 0, 0)),
        (found.one_slope_s_m, (0, step, 0)),
        (found.other_slope_s_m, (0, 0, step)),
    ):
        back = tuple(-each for each in move)
        change = (time_s(*move) - time_s(*back)) / (2 * step)
        assert slope == pytest.approx(change, rel=1e-6)


def test_both_ways_take_the_same_time():
    random = np.random.default_rng(3)
    distance, one, other = random.uniform([[1], [1], [14]], [[100], [30], [59]], (3, 200))
    there, back = rays(LAYERS, distance, -one, -other), rays(LAYERS, distance, -other, -one)
    assert np.array_equal(there.exists, back.exists)
    assert np.array_equal(there.time_s, back.time_s)
    assert np.array_equal(there.one_slope_s_m, back.other_slope_s_m)


def test_a_shadow_is_named_with_its_ranges():
    profile = gradient(1.0)
    text = shadow(profile, 250.0, -10.0, -22.0)
    assert text.startswith("no direct ray connects depths of 10 m and 22 m over 250.0 m")
    assert "beyond 190.7 m" in text


def test_heights_outside_the_profile():
    with pytest.raises(
        ValueError, match="sound_speed must include the depths of `z_m`, 61 to 61 m"
    ):
        rays(LAYERS, 10.0, -5.0, -61.0)


@pytest.mark.parametrize("heights", [(-40.0, -8.0), (-25.0, -24.0), (-30.0, -30.0)])
def test_tables_keep_their_error(heights):
    table = RayTable.of(LAYERS, -6.0, (20.0, 110.0), heights)
    assert table is not None
    random = np.random.default_rng(4)
    distance, z = random.uniform(20, 110, 3000), random.uniform(*heights, 3000)
    error_s = np.abs(table.times(distance, z) - rays(LAYERS, distance, -6.0, z).time_s)
    assert error_s.max() <= 2 * TABLE_ERROR_S


def test_shadows_have_no_table():
    assert RayTable.of(gradient(1.0), -10.0, (100.0, 250.0), (-22.0, -21.0)) is None


@pytest.mark.slow
def test_memory_does_not_grow_with_depths():
    depth_m = np.linspace(0, 40, 20_001)
    cast = SoundSpeed(depth_m, 1500 + np.sin(depth_m))
    distance_m = np.linspace(1, 30, 500)
    tracemalloc.start()
    found = rays(cast, distance_m, -5, -30)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 700e6  # 1.2 GB if all rays are computed together
    alone = rays(cast, distance_m[-1], -5, -30)
    assert found.time_s[-1] == pytest.approx(alone.time_s, rel=1e-15)
