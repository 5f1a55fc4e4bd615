"""Beams, spreading and shadows along rays, against circles and an ODE solver."""

from dataclasses import replace

import numpy as np
import pytest
from bent import shot

import clsas
from clsas import Pointing, PointTargets, Pulse, Sonar, SoundSpeed, Track, simulate, simulate_lines
from clsas.engine.water.ray_tables import TABLE_ERROR, Q, RayTable, quantity_of, table_around
from clsas.engine.water.rays import farthest_m, rays
from clsas.simulation.recording import FOCUSED
from clsas.simulation.refraction import MOST_FOCUS, Sightlines
from clsas.simulation.scenes import Observer, Seabed

PULSE = Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
BEAMS = {"tx_length_m": 0.06, "rx_length_m": 0.05, "tx_height_m": 0.06, "rx_height_m": 0.04}
SONAR = Sonar(PULSE, [[0, 0, 0]], **BEAMS)
PING = Track([[0.0, 0, -10]], [0.0])
LAYERS = SoundSpeed([0, 10, 13, 30, 60], [1500, 1501, 1491, 1492, 1497])


def gradient(per_s):
    return SoundSpeed([0, 60], [1490 - 10 * per_s, 1490 + 50 * per_s])


def arc(per_s, distance, one, other):
    """Downward sines of a circle at two depths, and the spreading along it.

    The centre lies at the depth at which the speed would be 0, equally far from both ends.
    """
    level = 10 - 1490 / per_s
    up, down = one - level, other - level
    away = (distance**2 + down**2 - up**2) / (2 * distance)
    radius = np.hypot(away, up)
    slowest = -np.sign(per_s)
    sines = slowest * -away / radius, slowest * (distance - away) / radius
    straight2 = distance**2 + (other - one) ** 2
    return *sines, np.sqrt(straight2 * (1 + straight2 / (4 * up * down)))


def spectrum(samples):
    return np.abs(np.fft.fft(samples, 8192))


# One point


@pytest.mark.parametrize("per_s", [-1.0, -0.3, 0.4])
@pytest.mark.parametrize("pointing", [Pointing.broadside(depression_rad=0.15), None])
def test_an_echo_is_that_of_the_direction_and_distance_in_which_it_appears(per_s, pointing):
    """In the water at the sonar a point on the tangent of the circle has the same echo."""
    point = np.array([4.0, 110, -22])
    sine, _, spreading = arc(per_s, np.hypot(4, 110), 10, 22)
    level = point[:2] / np.hypot(*point[:2]) * np.sqrt(1 - sine**2)
    apparent = [0, 0, -10] + spreading * np.append(level, -sine)
    options = {"spreading": True, "pointing": pointing}
    found = simulate(
        SONAR, PING, PointTargets([point]), sound_speed=gradient(per_s), **options
    ).samples[0]
    there = replace(SONAR, sound_speed_m_s=1490.0)
    expected = simulate(there, PING, PointTargets([apparent]), **options).samples[0]
    straight = simulate(there, PING, PointTargets([point]), **options).samples[0]
    loud = spectrum(expected).max()
    assert np.abs(spectrum(found) - spectrum(expected)).max() < 1e-5 * loud
    assert np.abs(spectrum(straight) - spectrum(expected)).max() > 3e-3 * loud


@pytest.mark.exhaustive
@pytest.mark.parametrize("angle_deg", [-3.3, -2.0, 4.0, 8.0, 20.0, 60.0])
def test_spreading_is_that_of_a_tube_of_rays(angle_deg):
    """L^2 = D |dz/d angle| for the height z at which rays of neighbouring angles arrive."""
    distance, depths, speeds = 20.0 if angle_deg > 30 else 80.0, LAYERS.depth_m, LAYERS.speed_m_s
    start = 9.0
    if angle_deg < 0:  # rays that rise and turn
        depths, speeds, start = np.array([0.0, 8, 40]), np.array([1506.0, 1504, 1490]), 12.0
        distance = 450.0
    step = 1e-4
    ends = [
        shot(depths, speeds, start, np.radians(angle_deg) + side * step, distance)[0]
        for side in (-1, 0, 1)
    ]
    expected = np.sqrt(distance * abs(ends[2] - ends[0]) / (2 * step))
    found = rays(SoundSpeed(depths, speeds), distance, -start, -ends[1])
    slowness = np.cos(np.radians(angle_deg)) / np.interp(start, depths, speeds)
    assert found.slowness_s_m == pytest.approx(slowness, rel=1e-6)
    assert np.sign(found.one_slope_s_m) == np.sign(angle_deg)
    assert found.spreading_m == pytest.approx(expected, rel=1e-5)
    back = rays(SoundSpeed(depths, speeds), distance, -ends[1], -start)
    assert back.spreading_m == found.spreading_m


@pytest.mark.parametrize("per_s", [-1.0, -0.3, 1e-9, 0.4])
def test_ends_of_rays_are_those_of_circles(per_s):
    distance = np.array([0.5, 10, 60, 110, 150])
    found = rays(gradient(per_s), distance, -10.0, -22.0)
    leaving, arriving, spreading = arc(per_s, distance, 10, 22)
    exists = found.exists
    assert exists[:4].all()
    assert found.spreading_m[exists] == pytest.approx(spreading[exists], rel=1e-12)
    if abs(per_s) > 1e-6:  # otherwise the circle is too large for these formulas
        speeds = gradient(per_s).at(-10.0), gradient(per_s).at(-22.0)
        assert found.one_slope_s_m * speeds[0] == pytest.approx(leaving, abs=1e-10)
        assert -found.other_slope_s_m * speeds[1] == pytest.approx(arriving, abs=1e-10)


def test_a_caustic_is_bounded_and_named():
    """Across a channel, rays that leave almost level arrive at almost the same depth."""
    profile = SoundSpeed([0, 10, 15, 20, 60], [1500, 1500, 1490, 1500, 1500])
    distance = farthest_m(profile, -10.0, -20.0) - np.geomspace(0.02, 80, 100)
    found = rays(profile, distance, -10.0, -20.0)
    relative = found.spreading_m / np.hypot(distance, 10)
    focus = int(np.where(found.exists, relative, np.inf).argmin())
    assert relative[focus] < 0.9 / MOST_FOCUS
    sonar = Sonar(PULSE, [[0, 0, 0]])
    track = Track([[0.0, 0, -10]], [0.0])
    point = PointTargets([[0, distance[focus], -20]])
    with pytest.warns(clsas.ClsasWarning, match="limited to 10 dB above those of straight paths"):
        near = simulate(sonar, track, point, spreading=True, sound_speed=profile).samples
    plain = simulate(sonar, track, point, sound_speed=profile).samples
    length_m = np.hypot(distance[focus], 10)
    gain = spectrum(near[0]).max() / spectrum(plain[0]).max() * length_m**2
    assert gain == pytest.approx(MOST_FOCUS**2, rel=1e-4)
    assert "caustic" in FOCUSED


# Many points


def test_tables_keep_their_error():
    quantities = tuple(Q)
    table = RayTable.of(LAYERS, -6.0, (20.0, 110.0), (-40.0, -8.0), quantities=quantities)
    random = np.random.default_rng(4)
    distance, z = random.uniform(20, 110, 3000), random.uniform(-40, -8, 3000)
    found = rays(LAYERS, distance, -6.0, z)
    for quantity, read in zip(quantities, table.read(distance, z), strict=True):
        error = np.abs(read - quantity_of(quantity, found, LAYERS, distance, -6.0, z)).max()
        assert error < 2 * (2e-12 if quantity is Q.TIME else TABLE_ERROR)


def test_tables_serve_up_to_a_shadow_zone():
    """Although their limits are otherwise rounded outwards."""
    profile = gradient(1.0)
    far = farthest_m(profile, -10.0, -22.0)
    distance, z = np.array([100.0, 0.99 * far]), np.array([-22.0, -22.0])
    table = table_around(profile, -10.0, distance, z)
    assert table is not None
    assert table.horizontal_m == (100.0, 0.99 * far)
    wide = table_around(profile, -10.0, distance / 2, z)
    assert wide is not None
    assert wide.horizontal_m[1] > distance[1] / 2


def hilly(y_m=(100, 116), z=-22.0, wide_m2=(0.2, 1.0), **others):
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(*y_m, 161))
    heights = np.full(x.shape, z)
    for place in random.uniform([-4, y_m[0]], [4, y_m[1]], (25, 2)):
        near2 = (x - place[0]) ** 2 + (y - place[1]) ** 2
        heights += random.uniform(0.2, 1.0) * np.exp(-near2 / random.uniform(*wide_m2))
    return Seabed((-4, 4), y_m, heights, **{"density_m2": 40, **others})


def water(kind, surface_z_m=0.0):
    if kind == "one speed":
        return SoundSpeed([0, 60], [1500, 1500], surface_z_m)
    return {"thermocline": SoundSpeed([0, 12, 15, 60], [1505, 1504, 1494, 1490], surface_z_m),
            "gradient": gradient(-0.5)}[kind]  # fmt: skip


@pytest.mark.parametrize("moving", [False, True])
def test_one_speed_in_all_depths_changes_nothing(moving):
    sonar = replace(SONAR, rx_m=np.array([[0.0, 0, 0], [0.05, 0, 0]]))
    track = Track.straight((-1, 0, -10.0), (1.5, 0, 0.1), 3, 0.5)
    options = {
        "spreading": True, "pointing": Pointing.broadside(depression_rad=0.1),
        "motion_in_flight": moving,
    }  # fmt: skip
    scene = (hilly(), PointTargets([[0, 110, -19]], [50.0]))
    straight = simulate(sonar, track, scene, **options)
    bent = simulate(sonar, track, scene, sound_speed=water("one speed"), **options)
    assert np.array_equal(straight.start_time_s, bent.start_time_s)
    loud = np.abs(straight.samples).max()
    assert np.abs(straight.samples - bent.samples).max() < 1e-6 * loud


@pytest.mark.parametrize("kind", ["thermocline", "gradient"])
def test_a_seabed_sounds_like_its_points_along_rays(kind):
    """Tiles are left out by the direction of their rays: a third of the floor is the error."""
    profile, seabed = water(kind), hilly(floor_db=-60, density_m2=20)
    options = {
        "spreading": True, "pointing": Pointing.broadside(depression_rad=0.3),
        "sound_speed": profile, "range_m": (95, 125),
    }  # fmt: skip
    found = simulate(SONAR, PING, seabed, **options).samples
    place = PING.positions_m[0]
    positions, amplitudes = seabed.visible(Observer(place, sightlines=Sightlines(profile, -10.0)))
    points = PointTargets(positions, amplitudes.astype(complex))
    expected = simulate(SONAR, PING, points, **options).samples
    assert np.linalg.norm(found - expected) < 10 ** (-55 / 20) * np.linalg.norm(expected)


def marched(seabed, points, eye, per_s, steps=800):
    """Whether circles from the eye clear the heights, by small steps along them."""
    clear = np.ones(len(points), bool)
    ground = np.linalg.norm(points[:, :2] - eye[:2], axis=1)
    ends = -1490 / per_s + 10 + np.stack([np.full(len(points), eye[2]), points[:, 2]])
    away = (ground**2 + ends[1] ** 2 - ends[0] ** 2) / (2 * ground)
    radius2 = away**2 + ends[0] ** 2
    end = 1 - 1.5 * max(seabed.steps_m) / ground
    for share in np.linspace(0.7, 1, steps):
        along = share * end * ground
        height = np.sign(ends[0]) * np.sqrt(radius2 - (along - away) ** 2) + 1490 / per_s - 10
        x, y = (eye[:2] + (points[:, :2] - eye[:2]) * (share * end)[:, None]).T
        clear &= ~(height < seabed.height_m(x, y))
    return clear


@pytest.mark.parametrize("per_s", [-1.0, 1.0])
def test_shadows_are_those_of_marched_circles(per_s):
    seabed, eye = hilly(wide_m2=(1.0, 4.0)), np.array([1.0, 0, -10])
    points = np.random.default_rng(5).uniform([-4, 100, 0], [4, 116, 0], (6000, 3))
    points[:, 2] = seabed.height_m(points[:, 0], points[:, 1])
    sight, offsets = Sightlines(gradient(per_s), -10.0), (points - eye).T
    found = seabed._lit(offsets, eye, sight, sight.arrivals(offsets)[1])
    expected = marched(seabed, points, eye, per_s)
    assert 0.02 < 1 - expected.mean() < 0.9
    assert np.mean(found != expected) < 0.035
    assert abs(found.mean() - expected.mean()) < 0.01


@pytest.mark.parametrize("per_s", [-1.0, 1.0])
def test_a_wall_casts_the_shadow_of_the_circle_through_its_top(per_s):
    """A wall of 1 m ends at y = 101 m; along straight rays, its shadow would end elsewhere."""
    y = np.linspace(98, 120, 221)
    wall = np.where((y > 100.45) & (y < 101.05), -21.0, -22.0)
    seabed = Seabed((-1, 1), (98, 120), np.repeat(wall[:, None], 21, axis=1), density_m2=200)
    eye = np.array([0.0, 0, -10])
    sight = Sightlines(gradient(per_s), -10.0)
    positions, _ = seabed.visible(Observer(eye, sightlines=sight))
    behind = positions[(positions[:, 1] > 101.2) & (np.abs(positions[:, 0]) < 0.7), 1].min()
    leaving = arc(per_s, 101.0, 10, 21)[0]
    ends = np.linspace(101.01, 120, 100_000)
    expected = np.interp(-leaving, -arc(per_s, ends, 10, 22)[0], ends)
    assert behind == pytest.approx(expected, abs=0.2)
    straight = eye[1] + 101.0 * 12 / 11
    assert abs(straight - expected) > 1.0


@pytest.mark.parametrize("per_s", [-1.0, 1.0])
def test_the_angle_of_incidence_is_that_of_the_ray(per_s):
    """Lambert's law: on a level seabed amplitudes fall with the sine at which rays arrive."""
    flat = Seabed((-4, 4), (100, 116), np.full((17, 9), -22.0), density_m2=40)
    eye = np.array([0.0, 0, -10])
    sight = Sightlines(gradient(per_s), -10.0)
    bent, straight = (flat.visible(Observer(eye, sightlines=each)) for each in (sight, None))
    assert np.array_equal(bent[0], straight[0])
    ground = np.hypot(*bent[0][:, :2].T)
    _, arriving, _ = arc(per_s, ground, 10, 22)
    sines = 12 / np.hypot(ground, 12)
    assert np.abs(bent[1]) * sines == pytest.approx(np.abs(straight[1]) * arriving, rel=1e-4)


def test_points_of_a_seabed_without_a_ray_are_refused():
    profile = SoundSpeed([0, 20, 30, 60], [1400, 1400, 1650, 1650])
    seabed = Seabed((-1, 1), (85, 95), np.full((11, 3), -29.0), density_m2=5)
    with pytest.raises(ValueError, match="scene must have no point without a ray"):
        simulate_lines([[0, 0, -6]], [[0, 0, -6]], seabed, carrier_hz=1e5, bandwidth_hz=2e4,
                       sound_speed=profile)  # fmt: skip
