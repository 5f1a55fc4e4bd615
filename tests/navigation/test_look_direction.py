"""Corrections of the navigation keep where the elements look, and turn it with the array."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.data import coverage
from clsas.navigation.overlap import Array, moved

LOOK = np.array([0.0, np.cos(0.3), -np.sin(0.3)])


def recorded(points_m, advance_m, pings, sway_m=0.0):
    """Lines of points, recorded by one receiver that looks to port."""
    pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    sonar = clsas.Sonar(pulse, [[0, 0, 0]], tx_length_m=0.06, rx_length_m=0.06)
    track = clsas.Track.straight((0, 0, 0), (advance_m, 0, 0), pings, 1.0, sway_m=sway_m)
    pointing = clsas.Pointing.broadside(depression_rad=0.3)
    targets = clsas.PointTargets(points_m)
    return clsas.compress(clsas.simulate(sonar, track, targets, pointing=pointing, range_m=(7, 17)))


def check(corrected, lines):
    """The corrected lines warn of the same side, and still look the same way."""
    np.testing.assert_array_equal(corrected.look_direction, lines.look_direction)
    grid = clsas.Grid.plane((1, 2, 9), (-9, -8, 9))
    found = coverage.behind(corrected, grid)
    assert found.value == 1
    assert found.remedy.endswith("--y=8:9:9")


def test_known_points_keep_it():
    points_m = [[1.0, 8.0, 0.0], [1.5, 15.0, 0.0]]
    lines = recorded(points_m, 0.05, 60)
    late = replace(lines, first_range_m=lines.first_range_m + 0.1)
    check(clsas.calibrate_track(late, points_m).lines, lines)


@pytest.mark.slow
def test_autofocus_keeps_it():
    points_m = np.random.default_rng(0).uniform([0.6, 9.5, 0], [2.4, 11, 0], (30, 3))
    sway_m = 3e-3 * np.sin(np.arange(150) / 20)
    lines = recorded(points_m, 0.02, 150, sway_m)
    straight_m = lines.tx_m * [1, 0, 1]
    unknown = replace(lines, tx_m=straight_m, rx_m=straight_m)
    found = clsas.autofocus(unknown, clsas.Grid.plane((0.4, 2.6, 100), (9.3, 11.2, 120)))
    assert found.focused
    check(found.lines, lines)


def test_an_array_that_turns_looks_elsewhere():
    tx_m = np.repeat([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], 4, axis=0)
    rx_m = tx_m + np.tile(0.05 * np.arange(4), 3)[:, None] * [1, 0, 0]
    lines = clsas.RangeLines(
        np.ones((12, 9), complex), 0, 0.1, tx_m, rx_m, 1e5, 1500.0, look_direction=LOOK
    )
    array = Array.of(lines)
    none, yaw_rad = np.zeros(3), np.array([0.0, 0.1, -0.2])
    turned = moved(lines, array, none, yaw_rad, none)
    along = turned.rx_m[3::4] - turned.rx_m[::4]
    np.testing.assert_allclose(np.arctan2(along[:, 1], along[:, 0]), yaw_rad, atol=1e-12)
    look = turned.look_direction[::4]
    np.testing.assert_allclose(np.arctan2(-look[:, 0], look[:, 1]), yaw_rad, atol=1e-12)
    np.testing.assert_allclose(look[:, 2], LOOK[2], atol=1e-12)
    assert moved(replace(lines, look_direction=None), array, none, yaw_rad, none).rx_m is not None
