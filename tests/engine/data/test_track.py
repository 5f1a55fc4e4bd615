import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from clsas.engine.data.geometry import bistatic_range_m, legs_m
from clsas.engine.data.system import Pulse, Sonar
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.validate import ClsasWarning

PULSE = Pulse(100e3, 20e3, 1e-3)
SONAR = Sonar(PULSE, rx_m=[[0.5, 0.1, 0], [-0.5, 0.1, 0]], tx_m=[0, 0, 0.2])


def one_ping(**attitude):
    return Track([[0, 0, 0]], [0.0], **attitude)


def test_straight_track():
    track = Track.straight([1, 2, -3], [1.5, 0, 0], 4, 0.5)
    np.testing.assert_allclose(track.positions_m[:, 0], [1, 1.75, 2.5, 3.25])
    np.testing.assert_allclose(track.positions_m[:, 1:], [[2, -3]] * 4)
    np.testing.assert_allclose(track.velocity_m_s, [[1.5, 0, 0]] * 4)
    np.testing.assert_allclose(track.time_s, [0, 0.5, 1, 1.5])


def test_straight_track_heads_where_it_goes():
    track = Track.straight([0, 0, 0], [0, 2.0, 0], 3, 1.0, surge_m=0.1, sway_m=[0, 0.3, 0])
    np.testing.assert_allclose(track.yaw_rad, np.pi / 2)
    np.testing.assert_allclose(track.positions_m[0], [0, 0.1, 0], atol=1e-12)
    # Port of a heading along +y is -x.
    np.testing.assert_allclose(track.positions_m[1], [-0.3, 2.1, 0], atol=1e-12)
    bow = track.rotations.apply([1, 0, 0])
    np.testing.assert_allclose(bow, [[0, 1, 0]] * 3, atol=1e-12)


def test_motion_from_functions_and_arrays_agree_and_has_its_velocity():
    times = 0.01 * np.arange(200)
    motion = {
        "surge_m": lambda t: 0.2 * np.sin(t),
        "sway_m": lambda t: 0.1 * np.sin(2 * t),
        "heave_m": lambda t: 0.3 * np.cos(t),
        "yaw_rad": lambda t: 0.01 * t,
        "pitch_rad": lambda t: 0.02 * np.sin(t),
        "roll_rad": lambda t: 0.03 * np.cos(t),
    }
    course = ([0, 0, -5], [1.5, 0, 0], 200, 0.01)
    functions = Track.straight(*course, **motion)
    arrays = Track.straight(*course, **{name: f(times) for name, f in motion.items()})
    for field in ("positions_m", "yaw_rad", "pitch_rad", "roll_rad"):
        np.testing.assert_array_equal(getattr(functions, field), getattr(arrays, field))
    exact = np.stack(
        [1.5 + 0.2 * np.cos(times), 0.2 * np.cos(2 * times), -0.3 * np.sin(times)], axis=1
    )
    np.testing.assert_allclose(functions.velocity_m_s, exact, atol=1e-8)
    np.testing.assert_allclose(arrays.velocity_m_s[1:-1], exact[1:-1], atol=1e-4)


@pytest.mark.parametrize(
    ("attitude", "platform", "world"),
    [
        ({"yaw_rad": np.pi / 2}, [1, 0, 0], [0, 1, 0]),  # bow to port
        ({"pitch_rad": np.pi / 2}, [1, 0, 0], [0, 0, -1]),  # bow down
        ({"roll_rad": np.pi / 2}, [0, 1, 0], [0, 0, 1]),  # port up
        # Yaw first, then pitch about the turned y, then roll about the twice turned x.
        ({"yaw_rad": np.pi / 2, "pitch_rad": np.pi / 2}, [1, 0, 0], [0, 0, -1]),
        ({"yaw_rad": np.pi / 2, "pitch_rad": np.pi / 2}, [0, 1, 0], [-1, 0, 0]),
        ({"pitch_rad": np.pi / 2, "roll_rad": np.pi / 2}, [0, 1, 0], [1, 0, 0]),
    ],
)
def test_signs_and_order_of_rotations(attitude, platform, world):
    turned = one_ping(**attitude).rotations.apply(platform)[0]
    np.testing.assert_allclose(turned, world, atol=1e-12)


def test_channels_are_ping_major_and_turned():
    track = Track([[0, 0, 0], [10, 0, 0]], [0, 1], yaw_rad=[0, np.pi / 2], velocity_m_s=[1, 0, 0])
    tx, rx, velocity = channels(SONAR, track)
    assert velocity is None
    np.testing.assert_allclose(tx, [[0, 0, 0.2]] * 2 + [[10, 0, 0.2]] * 2, atol=1e-12)
    np.testing.assert_allclose(
        rx, [[0.5, 0.1, 0], [-0.5, 0.1, 0], [9.9, 0.5, 0], [9.9, -0.5, 0]], atol=1e-12
    )
    moving = channels(SONAR, track, motion_in_flight=True)
    np.testing.assert_array_equal(moving.rx_velocity_m_s, [[1, 0, 0]] * 4)


def test_pointing_axes():
    track = Track([[0, 0, 0]] * 4, np.arange(4.0))
    np.testing.assert_allclose(Pointing.broadside().axes(track), [np.eye(3)] * 4, atol=1e-15)
    squint = Pointing.squint(0.3, depression_rad=0.2).axes(track)[0]
    beam = [np.sin(0.3) * np.cos(0.2), np.cos(0.3) * np.cos(0.2), -np.sin(0.2)]
    np.testing.assert_allclose(squint[1], beam)
    np.testing.assert_allclose(squint[0], [np.cos(0.3), -np.sin(0.3), 0], atol=1e-15)
    scan = Pointing.scan([-0.2, 0, 0.2]).axes(track)[:, 1, 0]
    np.testing.assert_allclose(scan, np.sin([-0.2, 0, 0.2, -0.2]))


def test_spot_follows_its_point_from_a_rolling_platform():
    track = Track.straight([0, 0, 0], [1, 0, 0], 9, 1.0, roll_rad=np.linspace(-0.2, 0.2, 9))
    spot = np.array([4.0, 30.0, -10.0])
    axes = Pointing.spot(spot).axes(track)
    way = spot - track.positions_m
    np.testing.assert_allclose(axes[:, 1], way / np.linalg.norm(way, axis=1, keepdims=True))
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), [np.eye(3)] * 9, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    assert np.all(axes[:, 0, 0] > 0.9)


positions = st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array)
speeds = st.lists(st.floats(-30, 30), min_size=3, max_size=3).map(np.array)


@settings(max_examples=200)
@given(point=positions, tx=positions, rx=positions, velocity=speeds)
def test_motion_in_flight_meets_the_moving_receiver(point, tx, rx, velocity):
    c = 1500.0
    out, back = legs_m(point, tx, rx, velocity, c)
    meeting = rx + velocity * (out + back) / c
    assert np.linalg.norm(point - meeting) == pytest.approx(back, rel=1e-12, abs=1e-10)
    # At rest it is the plain path.
    at_rest = bistatic_range_m(point, tx, rx, np.zeros(3), c)
    assert at_rest == pytest.approx(bistatic_range_m(point, tx, rx), rel=1e-15, abs=1e-300)


def test_motion_in_flight_against_a_root_search_and_the_quadratic():
    c, point, tx = 1500.0, np.array([3.0, 40, -5]), np.array([0.1, 0.0, 0.2])
    rx, v = np.array([-0.4, 0.1, 0.0]), np.array([2.0, -0.3, 0.1])
    out = np.linalg.norm(point - tx)
    tau = brentq(
        lambda t: out + np.linalg.norm(point - rx - v * t) - c * t, 0, 1, xtol=1e-16, rtol=1e-15
    )
    rho = bistatic_range_m(point, tx, rx, v, c)
    assert 2 * rho / c == pytest.approx(tau, rel=1e-13)
    d = point - rx
    roots = np.roots([c**2 - v @ v, -2 * (c * out - d @ v), out**2 - d @ d])
    assert 2 * rho / c == pytest.approx(np.max(roots), rel=1e-12)


def test_range_keeps_its_digits_far_from_the_origin():
    offset = np.array([2.0**23, -(2.0**22), 2.0**10])
    point, tx, rx = np.array([1.5, 40, -3]), np.zeros(3), np.array([0.25, 0, 0.125])
    near = bistatic_range_m(point, tx, rx, [1, 0.5, 0], 1500)
    far = bistatic_range_m(point + offset, tx + offset, rx + offset, [1, 0.5, 0], 1500)
    assert near == far


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1, 2], [0, 0, 0], [0, 0, 0]), r"points_m must have shape \(..., 3\), got \(2,\)"),
        (([1, 2, 3], 0.0, [0, 0, 0]), r"tx_m must have shape \(..., 3\), got \(\)"),
        (([1, 2, 3], [0, 0, 0], [0, 0, 0], [1, 0, 0]), "sound_speed_m_s must be given with"),
        (
            ([1, 2, 3], [0, 0, 0], [0, 0, 0], [1600, 0, 0], 1500.0),
            r"rx_velocity_m_s must be slower than sound \(1500 m/s\), got 1600 m/s",
        ),
    ],
)
def test_bad_paths(arguments, message):
    with pytest.raises(ValueError, match=message):
        bistatic_range_m(*arguments)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"positions_m": [[0, 0]]}, ValueError, r"positions_m must have shape \(any, 3\)"),
        ({"time_s": [0, 1]}, ValueError, r"time_s must have shape \(3\)"),
        ({"time_s": [0, 1, 1]}, ValueError, "time_s must ascend strictly, got a step of 0 s"),
        ({"yaw_rad": [0, np.inf, 0]}, ValueError, "yaw_rad must be finite"),
        ({"velocity_m_s": [1j, 0, 0]}, TypeError, "velocity_m_s must be real numbers"),
    ],
)
def test_bad_track(arguments, error, message):
    with pytest.raises(error, match=message):
        Track(**{"positions_m": np.zeros((3, 3)), "time_s": [0, 1, 2], **arguments})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"pings": 0}, ValueError, "pings must be at least 1, got 0"),
        ({"pings": 2.5}, TypeError, "pings must be a whole number, got 2.5"),
        ({"ping_interval_s": 0}, ValueError, "ping_interval_s must be finite and > 0 s, got 0"),
        (
            {"ping_interval_s": np.timedelta64(1, "s")},
            TypeError,
            r"ping_interval_s must be one real number in s, got np.timedelta64\(1,'s'\)",
        ),
        ({"sway_m": np.timedelta64(1, "s")}, TypeError, "sway_m must be real numbers"),
        ({"pings": np.timedelta64(5, "ms")}, TypeError, "pings must be a whole number"),
        ({"sway_m": [0.0, 1.0]}, ValueError, r"sway_m must have shape \(5\).* got \(2,\)"),
        ({"heave_m": lambda t: t[:2]}, ValueError, r"heave_m must have shape \(5\)"),
        ({"roll_rad": lambda t: np.full(5, np.nan)}, ValueError, "roll_rad must be finite"),
    ],
)
def test_bad_straight_track(arguments, error, message):
    good = {"start_m": [0, 0, 0], "velocity_m_s": [1, 0, 0], "pings": 5, "ping_interval_s": 1}
    with pytest.raises(error, match=message):
        Track.straight(**{**good, **arguments})


def test_bad_pointing():
    with pytest.raises(ValueError, match=r"squint_rad must have shape \(any\)"):
        Pointing.scan([])
    with pytest.raises(ValueError, match=r"point_m must have shape \(3\)"):
        Pointing.spot([1, 2])
    with pytest.raises(ValueError, match="depression_rad must be finite"):
        Pointing.broadside(depression_rad=np.nan)
    with pytest.raises(ValueError, match=r"spot_m must not lie straight ahead or astern.*ping 0"):
        Pointing.spot([9, 0, 0]).axes(one_ping())


def test_channels_and_axes_of_other_types():
    sonar, track = Sonar.edgetech(), one_ping()
    with pytest.raises(TypeError, match="sonar must be of type Sonar, got Track"):
        channels(track, sonar)
    with pytest.raises(TypeError, match="track must be of type Track, got NoneType"):
        channels(sonar, None)
    with pytest.raises(TypeError, match="motion_in_flight must be of type bool, got int"):
        channels(sonar, track, motion_in_flight=1)
    with pytest.raises(TypeError, match="track must be of type Track, got Sonar"):
        Pointing.broadside().axes(sonar)


@pytest.mark.parametrize(
    "angles", [{"yaw_rad": 90.0}, {"yaw_rad": -135}, {"pitch_rad": [0, 2.5, 1]}, {"roll_rad": 4.0}]
)
def test_angles_in_degrees_are_warned_of(angles):
    with pytest.warns(ClsasWarning, match="If it is in degrees, convert it with `numpy.radians`"):
        Track(np.zeros((3, 3)), [0, 1, 2], **angles)


def test_nothing_is_said_of_several_turns_or_of_a_sonar_upside_down():
    time_s = np.arange(50.0)
    Track(np.zeros((50, 3)), time_s, yaw_rad=time_s, pitch_rad=0.3, roll_rad=np.pi)
