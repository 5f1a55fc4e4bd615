from dataclasses import replace

import numpy as np
import pytest
from bent import ranges_m, travel_times
from cases import along_x, lines_over
from rays import rays
from tiers import thinned

import clsas
from clsas import BeamWindow, ClsasWarning, Grid, SoundSpeed
from clsas.engine.data.decibels import in_db
from clsas.engine.exact.layout import gather
from clsas.engine.water.ray_delays import RaySample, delays_s, sample_pixels
from clsas.engine.water.refraction import homogeneous

PROFILE = SoundSpeed([0, 12, 15, 60], [1505, 1504, 1494, 1490])
SEABED = -25.0
GRID = Grid.plane((-2, 2, 33), (58, 63, 41), SEABED)
TRACK = along_x(150, 0.08, z=-6.0)


def over(grid=GRID, tx=TRACK, rx=None, *, profile=PROFILE, carrier_hz=100e3, **more):
    lines = lines_over(grid, tx, rx, carrier_hz=carrier_hz, step_m=0.02, **more)
    return replace(lines, sound_speed=profile)


def error_db(lines, grid=GRID, beam=None):
    """Error of the delays of apparent antennas at random pixels and channels, and its bound."""
    water = homogeneous(lines, grid, beam, None)
    straight = water.lines(lines.without_samples())
    random = np.random.default_rng(1)
    pixel = random.integers(grid.size, size=2000)
    channel = random.integers(lines.channels, size=2000)
    delay_s = delays_s(lines, channel, grid.at(pixel))
    antennas = straight.tx_m[channel], straight.rx_m[channel]
    velocity = straight.rx_velocity_m_s
    velocity = None if velocity is None else velocity[channel]
    range_m = clsas.engine.data.geometry.bistatic_range_m(
        water.grid.at(pixel), *antennas, velocity, straight.sound_speed_m_s
    )
    if water.corrections is not None:  # those of another pixel of the group
        groups = gather(water.grid, np.inf, 16)
        group = np.empty(grid.size, int)
        group[groups.index.ravel()] = np.repeat(np.arange(groups.parts), groups.part_pixels)
        given_m = water.corrections.at(groups.middle_pixels(slice(None)))[group[pixel]]
        weights = water.corrections.weights(water.corrections.antennas[channel])
        range_m += np.einsum("nk,nk->n", given_m, weights)
    offset_m = water.change.offsets_m(channel, range_m[:, None])[:, 0]
    away_s = 2 * (range_m + offset_m) / straight.sound_speed_m_s - delay_s
    rms = np.sqrt(np.mean((2 * np.pi * lines.carrier_hz * away_s) ** 2))
    return 20 * np.log10(rms), in_db(water.error)


def test_lines_without_a_profile_pay_nothing():
    lines = over(profile=None)
    water = homogeneous(lines, GRID, None, -50)
    assert water.lines(lines) is lines
    assert water.grid is GRID
    assert water.error == 0.0


def test_delays_are_those_of_independent_rays():
    lines = over()
    times = travel_times(PROFILE.depth_m, PROFILE.speed_m_s, 6.0, 25.0, 90.0)
    points = GRID.spread(5)
    channel, point = np.divmod(np.arange(150 * 25), 25)
    found = delays_s(lines, channel, points[point]).reshape(150, 25)
    assert np.abs(found - 2 * ranges_m(times, points, TRACK) / 1500).max() < 1e-13


@pytest.mark.parametrize(("velocity", "most_s"), [([1.8, 0.1, -0.2], 1e-13), ([40, 60, -5], 1e-8)])
def test_moving_receivers_are_where_they_are_when_echoes_arrive(velocity, most_s):
    tx, rx = array()
    lines = over(tx=tx, rx=rx, velocity=velocity)
    channel = np.arange(lines.channels)
    points = GRID.at(np.random.default_rng(5).integers(GRID.size, size=lines.channels))
    found = delays_s(lines, channel, points)
    moved = rx + found[:, None] * np.array(velocity)
    at_rest = delays_s(over(tx=tx, rx=moved), channel, points)
    assert np.abs(found - at_rest).max() < most_s


def heaving():
    turn = np.linspace(0, 9, len(TRACK))
    return TRACK + np.stack([0 * turn, 0.3 * np.sin(turn), 0.4 * np.cos(turn)], axis=1)


def array():
    """Pings of an array of 3 m that is not level, and moves."""
    tx = np.repeat(along_x(20, 0.6, z=-6.0), 8, axis=0)
    rx = tx + np.tile(along_x(8, 0.4) + np.outer(np.arange(8), [0, 0, 0.02]), (20, 1))
    return tx, rx


CASES = {
    "level": lambda: over(),
    "heave": lambda: over(tx=heaving()),
    "bistatic": lambda: over(tx=array()[0], rx=array()[1]),
    "moving": lambda: over(tx=array()[0], rx=array()[1], velocity=[1.8, 0.1, 0.0]),
    "climbing": lambda: over(tx=array()[0], rx=array()[1], velocity=[1.8, 0.1, -0.2]),
}


@pytest.mark.parametrize("name", CASES)
def test_delays_to_a_level_seabed_are_exact(name):
    error, bound = error_db(CASES[name]())
    assert error < (-60 if name in ("moving", "climbing") else -78)
    assert error < bound


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "relief_m"), thinned(["level", "heave", "bistatic", "moving"], [0.05, 0.5])
)
def test_delays_to_a_relief(name, relief_m):
    heights = np.random.default_rng(2).uniform(-relief_m, relief_m, GRID.shape)
    for grid in (GRID.with_height(heights), _slope(relief_m / 4)):
        error, bound = error_db(CASES[name](), grid)
        assert error < -57
        assert error < bound + 1  # sample pixels may miss the worst ones


def _slope(rise):
    return Grid.oriented([-2, 58, SEABED], [0, 0.125, 0.125 * rise], [0.125, 0, 0], (41, 33))


def test_points_in_any_order():
    points = np.random.default_rng(3).uniform([-2, 58, -26], [2, 63, -24], (300, 3))
    error, bound = error_db(over(), Grid.points(points))
    assert error < min(-45, bound + 1)


def test_pixels_nearer_and_farther_than_those_of_the_sample():
    """81 of 400 points are sampled; a twentieth of their extent beyond these, delays are right."""
    points = np.column_stack([np.zeros(400), np.linspace(58, 63, 400), np.full(400, SEABED)])
    points[[3, 7], 1] = 57.75, 63.25
    points = points[np.random.default_rng(3).permutation(400)]
    assert not {57.75, 63.25} & set(points[sample_pixels(Grid.points(points)), 1])
    error, _ = error_db(over(), Grid.points(points))
    assert error < -78


@pytest.mark.parametrize("height_m", [0.5, 2.0])
def test_a_rock_between_the_sample_pixels_is_seen(height_m):
    grid = Grid.plane((-3, 3, 121), (50, 56, 121), SEABED)
    rock = np.zeros(grid.shape)
    rock[63:73, 34:44] = height_m
    assert not rock[:: 120 // 8, :: 120 // 8].any()
    grid = grid.with_height(rock)
    error, bound = error_db(over(grid), grid)
    assert error < bound + 1
    assert homogeneous(over(grid), grid, None, None).grid.points_m is not None


@pytest.mark.slow
def test_a_rock_in_a_shadow_zone_is_refused():
    profile = SoundSpeed([0, 80], [1500, 1420])
    grid = Grid.plane((-2, 2, 81), (343, 347, 81), SEABED)
    rock = np.zeros(grid.shape)
    rock[43, 37] = 15.0
    lines = over(grid, profile=profile)
    homogeneous(lines, grid, None, None)
    with pytest.raises(ValueError, match="shadow zone"):
        homogeneous(lines, grid.with_height(rock), None, None)


@pytest.mark.slow
def test_a_beam_limits_what_has_to_be_right():
    """Without it, channels 200 m away would have no ray to the grid."""
    lines = over(tx=along_x(400, 1.0, z=-6.0))
    with pytest.raises(ValueError, match="no direct ray connects depths of 6 m and 25 m over"):
        homogeneous(replace(lines, sound_speed=SoundSpeed([0, 60], [1480, 1600])), GRID, None, -50)
    beam = BeamWindow(10, "hann")
    lines = replace(lines, sound_speed=SoundSpeed([0, 60], [1480, 1600]))
    water = homogeneous(lines, GRID, beam, -50)
    sample = RaySample.of(lines, GRID, beam)
    assert water.change.error(sample, sample.points_m) < 1e-7
    assert water.error < 1e-6  # with that of the beam's weights


@pytest.mark.parametrize("velocity", [None, [-1.8, 0.0, -0.5], [0.4, 2.6, -0.9], [3.0, 0.0, 0.2]])
@pytest.mark.parametrize("speed_m_s", [1480, 1500])
def test_in_water_of_one_speed_antennas_and_samples_are_what_they_are(speed_m_s, velocity):
    close = Grid.plane((-2, 2, 33), (3, 9, 41), -10.0)
    rx = TRACK + np.array([0.2, 0, 0.06])
    lines = over(close, rx=rx, velocity=velocity, profile=SoundSpeed([0, 60], [speed_m_s] * 2))
    water = homogeneous(lines, close, None, -80)
    straight = water.lines(lines)
    assert water.error < 1e-15
    assert straight.sound_speed_m_s == speed_m_s
    assert np.shares_memory(straight.samples, lines.samples)
    assert np.abs(straight.rx_m - rx).max() < 1e-9


@pytest.mark.parametrize(
    ("velocity", "apart_m", "depths_m", "speeds_m_s"),
    [
        ([-1.8, 0.0, -0.5], 0.1, [0, 7, 8, 60], [1490, 1490.02, 1489.99, 1490.01]),
        ([0.4, 2.6, -0.9], 0.05, [0, 60], [1500, 1501.5]),
        ([3.0, 0.0, 0.2], 0.2, [0, 8, 9, 60], [1500, 1500, 1499.9, 1499.9]),
    ],
)
def test_moving_receivers_in_water_of_nearly_one_speed(velocity, apart_m, depths_m, speeds_m_s):
    """They are where they are when echoes arrive, however far they are from the transmitter."""
    close = Grid.plane((-2, 2, 33), (3, 9, 41), -10.0)
    rx = TRACK + np.array([apart_m, 0, 0.3 * apart_m])
    lines = over(close, rx=rx, velocity=velocity, profile=SoundSpeed(depths_m, speeds_m_s))
    assert homogeneous(lines, close, None, None, corrected=False).error < 10**-7.2


DEPTHS = np.linspace(0, 60, 300)


@pytest.mark.parametrize(
    ("speed_m_s", "tx"),
    [
        (1500 - 8 / (1 + np.exp((14 - DEPTHS) / 1.5)), heaving()),
        (1500 - 6 * np.exp(-(((DEPTHS - 15) / 4) ** 2)), TRACK),
        (1510 - 9 * np.tanh(DEPTHS / 20) - 3 * np.tanh((DEPTHS - 16) / 4), heaving()),
    ],
)
def test_delays_in_profiles_of_many_depths(speed_m_s, tx):
    """Rays take thinned profiles, but their times are those of all depths."""
    profile = SoundSpeed(DEPTHS, speed_m_s)
    lines = over(tx=tx, profile=profile)
    channel, points = np.arange(0, 150, 20), GRID.spread(3)[:8]
    distance_m = np.hypot(*(points - tx[channel])[:, :2].T)
    time_s, _ = rays(DEPTHS, speed_m_s, distance_m, -tx[channel, 2], 25.0)
    assert np.abs(delays_s(lines, channel, points) - 2 * time_s).max() < 2.5e-10
    assert error_db(lines)[0] < -78


def test_resampled_lines_are_those_at_the_delays():
    """A tone on its carrier stays one, whatever is mixed out."""
    lines = over(carrier_hz=100e3)
    range_m = lines.first_range_m[:, None] + lines.range_step_m * np.arange(lines.length)
    envelope = np.exp(-(((range_m - range_m.mean()) / 1.0) ** 2))
    lines = replace(lines, samples=envelope * np.exp(2j * np.pi * 5.0 * range_m))
    water = homogeneous(lines, GRID, None, None)
    straight = water.lines(lines)
    index = np.arange(0, straight.length, 7)
    apparent_m = straight.first_range_m[:, None] + straight.range_step_m * index
    offset_m = water.change.offsets_m(np.arange(lines.channels), apparent_m)
    delay_s = 2 * (apparent_m + offset_m) / straight.sound_speed_m_s
    at_m = 1500 * delay_s / 2
    expected = np.exp(-(((at_m - range_m.mean()) / 1.0) ** 2)) * np.exp(2j * np.pi * 5.0 * at_m)
    turns = 100e3 * (delay_s - 2 * apparent_m / straight.sound_speed_m_s)
    expected *= np.exp(2j * np.pi * turns)
    away = np.abs(straight.samples[:, index] - expected).max()
    assert away < 2e-4


def test_a_profile_must_reach_antennas_and_pixels():
    with pytest.raises(ValueError, match="depths of `tx_m`, 6 to 6 m, got a profile from 10 to 60"):
        over(profile=SoundSpeed([10, 60], [1500, 1500]))
    shallow = over(profile=SoundSpeed([0, 20], [1500, 1500]))
    with pytest.raises(ValueError, match="depths of the grid's pixels, 25 to 25 m"):
        clsas.backproject(shallow, GRID)
    with pytest.raises(ValueError, match="if its depths are kilometres, multiply them by 1000"):
        over(profile=SoundSpeed([0, 0.2, 5.0], [1500, 1499, 1510]))
    with pytest.raises(TypeError, match="sound_speed must be of type SoundSpeed or NoneType"):
        replace(shallow, sound_speed=1500.0)


def test_a_shadow_zone_is_refused_with_its_range():
    lines = over(profile=SoundSpeed([0, 20, 30, 60], [1400, 1400, 1650, 1650]))
    says = r"sound_speed must lead a direct ray to every pixel: no direct ray .* beyond \d+\.\d m"
    with pytest.raises(ValueError, match=says):
        clsas.backproject(lines, GRID)


def test_pixels_beyond_all_lines_need_no_rays():
    lines = over(profile=SoundSpeed([0, 60], [1480, 1540]))
    far = Grid.plane((-1, 1, 8), (900, 901, 8), SEABED)
    with pytest.warns(ClsasWarning):
        assert not clsas.backproject(lines, far).pixels.any()


def test_an_error_that_is_left_is_reported():
    wide = Grid.plane((-30, 30, 41), (40, 100, 61), SEABED)
    heights = np.random.default_rng(4).uniform(-3, 3, wide.shape)
    lines = over(wide, along_x(200, 0.3, z=-6.0), profile=SoundSpeed([0, 60], [1500, 1482]))
    with pytest.warns(ClsasWarning, match="refraction alone .* requested -60 dB"):
        homogeneous(lines, wide.with_height(heights), None, -60)


@pytest.mark.slow
@pytest.mark.parametrize("request_db", [{"tolerance_db": -60}, {"accuracy_db": -60}])
def test_an_exact_image_finds_its_water_once(request_db, monkeypatch):
    """One that was planned takes that of its plan, and the user is warned once."""
    small = Grid.plane((-30, 30, 11), (40, 100, 11), SEABED)
    heights = np.random.default_rng(4).uniform(-3, 3, small.shape)
    lines = over(small, along_x(200, 0.3, z=-6.0), profile=SoundSpeed([0, 60], [1500, 1482]))
    found, samples = [], RaySample.of
    monkeypatch.setattr(RaySample, "of", lambda *given: found.append(1) or samples(*given))
    with pytest.warns(ClsasWarning) as caught:
        imager = clsas.Imager(lines, small.with_height(heights), **request_db)
    imager(lines)
    assert imager.plan is None or imager.plan.is_exact
    assert sum("refraction alone" in str(each.message) for each in caught) == 1
    assert len(found) == 1
