"""Navigation from lines in water whose sound speed varies with depth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import detrend

import clsas
from clsas import SoundSpeed

PROFILE = SoundSpeed([0, 6, 8, 40], [1510, 1510, 1500, 1497])
PULSE = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)


def navigated(sonar, course, scene, range_m, sway_m, **motion):
    """Lines of a swaying sonar, with the positions of a straight track."""
    true = clsas.Track.straight(*course, sway_m=sway_m)
    echoes = clsas.simulate(sonar, true, scene, range_m=range_m, sound_speed=PROFILE)
    positions = clsas.channels(sonar, clsas.Track.straight(*course))
    return replace(clsas.compress(echoes), tx_m=positions.tx_m, rx_m=positions.rx_m)


@pytest.mark.slow
def test_autofocus_finds_the_sway():
    sonar = clsas.Sonar(PULSE, [[0, 0, 0]], tx_length_m=0.06, rx_length_m=0.06)
    xyz_m = np.random.default_rng(0).uniform([0.6, 28.5, -12], [2.4, 30, -12], (30, 3))
    sway_m = 3e-3 * np.sin(np.arange(150) / 20)
    course = (0, 0, -4), (0.02, 0, 0), 150, 1.0
    lines = navigated(sonar, course, clsas.PointTargets(xyz_m, np.ones(30)), (28, 33), sway_m)
    grid = clsas.Grid.plane((0.4, 2.6, 100), (28.3, 30.2, 120), -12)
    found = clsas.autofocus(lines, grid)
    assert found.focused
    assert np.std(detrend(found.correction_m[:, 1] - sway_m)) < 2e-4
    assert found.lines.sound_speed is PROFILE
    assert found.lines.samples is lines.samples or np.shares_memory(
        found.lines.samples, lines.samples
    )
    moved = found.lines.tx_m - lines.tx_m
    assert np.abs(moved - found.correction_m).max() < 1e-9


@pytest.mark.slow
def test_micronavigation_finds_the_sway():
    rx_m = [[0.015 * n, 0, 0] for n in range(16)]
    sonar = clsas.Sonar(PULSE, rx_m, tx_length_m=0.03, rx_length_m=0.03)
    random = np.random.default_rng(0)
    xyz_m = random.uniform([-3, 19, -12], [3, 23, -12], (800, 3))
    speckle = clsas.PointTargets(xyz_m, random.standard_normal((800, 2)) @ [1, 1j])
    course = (0, 0, -4), (0.045, 0, 0), 5, 1.0
    lines = navigated(sonar, course, speckle, (20, 25), [0, 2e-3, 1e-3, 3e-3, 0])
    found = clsas.micronavigate(lines, range_m=(20.8, 24), element_length_m=0.03, seabed_z_m=-12)
    assert 1e3 * found.sway_steps_m == pytest.approx([2.0, -1.0, 2.0, -3.0], abs=0.1)
    assert found.lines.sound_speed is PROFILE
    assert found.lines.sound_speed_m_s == lines.sound_speed_m_s
    assert np.array_equal(found.lines.first_range_m, lines.first_range_m)
    assert np.abs(found.lines.tx_m - lines.tx_m).max() > 1e-3


def test_calibration_is_for_a_constant_speed():
    sonar = clsas.Sonar(PULSE, [[0, 0, 0]])
    course = (0, 0, -4), (0.05, 0, 0), 20, 1.0
    target = clsas.PointTargets([[0.5, 20, -12]], [1])
    lines = navigated(sonar, course, target, (20, 23), np.zeros(20))
    with pytest.raises(ValueError, match="lines must have no `sound_speed`"):
        clsas.calibrate_track(lines, [[0.5, 20, -12]])
