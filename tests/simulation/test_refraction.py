import numpy as np
import pytest
from bent import ranges_m, travel_times
from cases import along_x

import clsas
from clsas import PointTargets, Pulse, Sonar, SoundSpeed, Track, simulate, simulate_lines
from clsas.engine.data.track import Channels
from clsas.selftest import oracle
from clsas.simulation.refraction import BlockRays

PROFILE = SoundSpeed([0, 12, 15, 60], [1505, 1504, 1494, 1490])
TRACK = along_x(9, 1.0, z=-6.0)
POINTS = np.random.default_rng(0).uniform([-3, 40, -25], [3, 44, -25], (40, 3))
AMPLITUDES = np.random.default_rng(1).normal(size=(40, 2)) @ [1, 1j]


def expected_m(points=POINTS, antennas=TRACK):
    times = travel_times(PROFILE.depth_m, PROFILE.speed_m_s, 6.0, 25.0, 60.0)
    return ranges_m(times, points, antennas)


def test_lines_have_echoes_at_the_ends_of_rays():
    lines = simulate_lines(
        TRACK, TRACK, PointTargets(POINTS, AMPLITUDES), carrier_hz=100e3, bandwidth_hz=30e3,
        sound_speed=PROFILE,
    )  # fmt: skip
    assert lines.sound_speed is PROFILE
    assert lines.sound_speed_m_s == 1500
    band = oracle.Band(2 * 100e3 / 1500, 2 * 30e3 / 1500, 0.0)
    echoes = [oracle.Echo(expected_m(), AMPLITUDES, [band])]
    for channel in (0, 4, 8):
        ideal = oracle.samples(
            [oracle.Echo(echoes[0].range_m[channel : channel + 1], AMPLITUDES, [band])],
            lines.first_range_m[channel], lines.range_step_m, lines.length, 2 * 100e3 / 1500,
        )  # fmt: skip
        middle = slice(200, -200)
        assert oracle.error_db(lines.samples[channel, middle], ideal[0, middle]) < -80


def test_echoes_of_a_sonar_travel_along_rays():
    pulse = Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    sonar = Sonar(pulse, [[0, 0, 0]], tx_length_m=0.05, rx_length_m=0.05)
    track = Track.straight((-4, 0, -6), (1.0, 0, 0), 9, 1.0)
    target = PointTargets(POINTS[:1], [1.0])
    echoes = simulate(sonar, track, target, sound_speed=PROFILE)
    lines = clsas.compress(echoes)
    assert lines.sound_speed is PROFILE
    peak = np.abs(lines.samples).argmax(axis=1)
    found_m = lines.first_range_m + lines.range_step_m * peak
    assert np.abs(found_m - expected_m(POINTS[:1])[:, 0]).max() <= lines.range_step_m
    straight_m = np.linalg.norm(POINTS[0] - TRACK, axis=1)
    assert np.abs(found_m - straight_m).min() > 2 * lines.range_step_m


@pytest.mark.parametrize("climb", [0.0, 0.15])
def test_tables_serve_many_points_and_moving_receivers(climb):
    random = np.random.default_rng(5)
    points = random.uniform([-3, 40, -25], [3, 44, -23], (5000, 3))
    velocity = np.array([2.0, 0.1, climb])
    tx, rx = np.array([0.5, 0, -6.0]), np.array([1.5, 0, -6.2])

    def delays(some):
        block = BlockRays(PROFILE, some, some[:, 2])
        return block.legs(Channels(tx, rx, velocity), tx[2], rx[2], climb).delay_s

    many, few = delays(points), delays(points[:100])
    # Once the echo is there, the receiver is where the ray ends.
    from clsas.engine.water.rays import rays

    def time_s(antenna):
        offset = points[:100] - antenna
        return rays(PROFILE, np.hypot(*offset[:, :2].T), antenna[..., 2], points[:100, 2]).time_s

    arrived = rx + few[:, None] * velocity
    assert np.abs(time_s(tx) + time_s(arrived) - few).max() < 1e-12
    assert np.abs(many[:100] - few).max() < 1e-9


def test_shadow_zones_are_refused():
    steep = SoundSpeed([0, 20, 30, 60], [1400, 1400, 1650, 1650])
    with pytest.raises(ValueError, match=r"scene must have no point without a ray: no direct ray"):
        simulate_lines(
            TRACK, TRACK, PointTargets([[0, 90, -29]]), carrier_hz=1e5, bandwidth_hz=2e4,
            sound_speed=steep,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("profile", "message"),
    [
        (SoundSpeed([0, 20], [1500, 1500]), "depths of the scene's points, 25 to 25 m"),
        (SoundSpeed([8, 60], [1500, 1500]), "depths of `tx_m`, 6 to 6 m"),
    ],
)
def test_a_profile_must_reach_everything(profile, message):
    with pytest.raises(ValueError, match=message):
        simulate_lines(
            TRACK, TRACK, PointTargets(POINTS), carrier_hz=1e5, bandwidth_hz=2e4,
            sound_speed=profile,
        )  # fmt: skip
