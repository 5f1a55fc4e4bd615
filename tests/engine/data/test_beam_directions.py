import numpy as np
import pytest
from cases import along_x, track_lines
from scipy.signal import savgol_filter

from clsas.engine.data.beam import BeamWindow, _tangents, track_directions
from clsas.engine.data.lines import RangeLines

X = (1.0, 0, 0)
DEGREE = np.pi / 180


def test_the_direction_is_that_of_the_phase_centres():
    straight = along_x(50, 0.1) @ np.array([[0.6, 0.8, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        BeamWindow(10).directions(track_lines(straight)), [[0.6, 0.8, 0]] * 50, atol=1e-9
    )
    backwards = BeamWindow(10).directions(track_lines(straight[::-1]))
    np.testing.assert_allclose(backwards, [[-0.6, -0.8, 0]] * 50, atol=1e-9)
    few = BeamWindow(10).directions(track_lines(along_x(2, 1.0)))
    np.testing.assert_allclose(few, [X, X], atol=1e-9)


@pytest.mark.parametrize("pings", [2, 3, 4, 5, 6, 200])
def test_receivers_of_one_ping_do_not_turn_it(pings):
    tx = np.repeat(along_x(pings, 0.1), 6, axis=0)
    rx = tx + np.tile(along_x(6, 0.2, y=0.05), (pings, 1))
    np.testing.assert_allclose(
        BeamWindow(10).directions(track_lines(tx, rx)), [X] * 6 * pings, atol=1e-9
    )


def test_sway_and_bends_are_followed_smoothly():
    angle = np.linspace(0, 2 * np.pi, 400)
    circle = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    tangent = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    rough = circle + np.random.default_rng(0).normal(0, 0.01, circle.shape)
    found = BeamWindow(10).directions(track_lines(rough))
    assert np.arccos(np.einsum("ci,ci->c", found, tangent)).max() < 3 * DEGREE
    swaying = along_x(400, 0.05) + 0.02 * np.sin(np.arange(400) / 3)[:, None] * [0, 1, 1]
    found = BeamWindow(10).directions(track_lines(swaying))
    assert np.arccos(found[:, 0]).max() < 1 * DEGREE


def test_a_direction_that_is_given_is_made_a_unit():
    lines = track_lines(along_x(3, 1.0))
    np.testing.assert_allclose(
        BeamWindow(10, along=(0, 3, 4)).directions(lines), [[0, 0.6, 0.8]] * 3
    )
    each = BeamWindow(10, along=[[1, 0, 0], [0, 2, 0], [0, 0, 3]]).directions(lines)
    np.testing.assert_allclose(each, np.eye(3))


@pytest.mark.parametrize("apart_m", [4.5, 20])
def test_directions_of_legs(apart_m):
    """Each leg has its own direction up to its ends."""
    leg = np.zeros((60, 3))
    leg[:, 0] = np.linspace(0, 30, 60)
    across = leg[:, [1, 0, 2]] + [40, 5, 0]
    tx_m = np.concatenate([leg, leg[::-1] + [0, apart_m, 0], across])
    lines = RangeLines(np.ones((180, 1), complex), 0.0, 0.1, tx_m, tx_m, 1e5, 1500.0)
    directions = BeamWindow(10).directions(lines)
    expected = np.repeat([[1, 0, 0], [-1, 0, 0], [0, 1, 0]], 60, axis=0)
    np.testing.assert_allclose(directions, expected, atol=1e-9)


@pytest.mark.parametrize("pings", [3, 4, 6, 20, 300])
@pytest.mark.parametrize("span", [5, 25, 101])
def test_tangents_are_those_of_a_savitzky_golay_filter(pings, span):
    centres_m = np.cumsum(np.random.default_rng(0).standard_normal((pings, 3)), axis=0)
    window = min(2 * (span // 2) + 1, pings - 1 + pings % 2)
    expected = savgol_filter(centres_m, window, min(3, window - 1), deriv=1, axis=0, mode="interp")
    np.testing.assert_allclose(_tangents(centres_m, span), expected, atol=1e-12)


def shuffled(count):
    return np.random.default_rng(5).permutation(count)


def by_name(count):
    """Order of files ping_1, ping_10, ping_100, ping_2, ... whose numbers count as letters."""
    return np.array(sorted(range(count), key=lambda number: f"ping_{number + 1}"))


def swaying(count=240):
    x_m = np.linspace(-4, 4, count)
    return np.column_stack([x_m, 0.05 * np.sin(3 * x_m), 0 * x_m])


def arc(count=240):
    angle = np.linspace(0, 4, count)
    return 10 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])


def two_legs():
    return np.concatenate([swaying(120), swaying(120)[::-1] + [0, 3, 0]])


@pytest.mark.parametrize("reordered", [shuffled, by_name])
@pytest.mark.parametrize("track", [swaying, arc, two_legs])
@pytest.mark.parametrize("receivers", [1, 4])
def test_channels_may_be_in_any_order(track, reordered, receivers):
    tx_m = np.repeat(track(), receivers, axis=0)
    rx_m = tx_m + np.tile(0.01 * np.arange(receivers)[:, None] * [1, 0, 0], (len(track()), 1))
    order = reordered(len(tx_m))
    expected, found = (
        track_directions(
            RangeLines(
                np.ones((len(some), 2), complex), 5.0, 0.1, tx_m[some], rx_m[some], 1e5, 1500.0
            )
        )
        for some in (np.arange(len(tx_m)), order)
    )
    along = np.einsum("ci,ci->c", found, expected[order])
    # A shuffled track may as well run backwards.
    np.testing.assert_allclose(along, along[0], atol=1e-5)
    assert abs(along[0]) == pytest.approx(1, abs=1e-5)
    if reordered is by_name and receivers == 1:
        assert along[0] > 0
