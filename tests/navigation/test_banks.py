"""The track is estimated from one receiver bank, and all banks are corrected by it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import detrend

import clsas
from clsas.engine.data.system import line_array, stacked

PULSE = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
BASELINE_M = 0.2


def two_banks(receivers, element_m):
    rx_m, numbers = stacked(line_array(receivers, 0.015), (0.0, BASELINE_M))
    lengths = {"tx_length_m": element_m, "rx_length_m": element_m}
    return clsas.Sonar(PULSE, rx_m, bank_numbers=numbers, **lengths)


def navigated(lines, sonar, course):
    """The same lines with the positions of a straight track."""
    straight = clsas.channels(sonar, clsas.Track.straight(*course))
    return replace(lines, tx_m=straight.tx_m, rx_m=straight.rx_m)


def check_alike(both, alone, lines):
    """Every bank is displaced like the bank from which the track was estimated."""
    moved_m = both.tx_m - lines.tx_m
    np.testing.assert_allclose(moved_m[lines.bank_numbers == 0], alone.tx_m - lines.bank(0).tx_m)
    for number in range(2):
        np.testing.assert_array_equal(both.bank(number).ping_starts, alone.ping_starts)
    np.testing.assert_allclose(both.bank(0).rx_m, alone.rx_m, atol=1e-12)
    apart_m = both.bank(1).rx_m - both.bank(0).rx_m
    np.testing.assert_allclose(apart_m, np.tile([0, 0, BASELINE_M], (len(apart_m), 1)), atol=1e-12)


@pytest.mark.slow
def test_micronavigation_corrects_both_banks():
    sonar = two_banks(16, 0.03)
    random = np.random.default_rng(0)
    xyz_m = random.uniform([-3, 9, 0], [3, 13, 0], (800, 3))
    speckle = clsas.PointTargets(xyz_m, random.standard_normal((800, 2)) @ [1, 1j])
    course, sway_m = ((0, 0, 3), (0.045, 0, 0), 5, 1.0), np.array([0, 2e-3, 1e-3, 3e-3, 0])
    echoes = clsas.simulate(
        sonar, clsas.Track.straight(*course, sway_m=sway_m), speckle, range_m=(9.5, 13.5)
    )
    lines = navigated(clsas.compress(echoes), sonar, course)
    options = {"range_m": (10, 13), "element_length_m": 0.03, "seabed_z_m": 0.0}
    both = clsas.micronavigate(lines, **options)
    alone = clsas.micronavigate(lines.bank(0), **options)
    np.testing.assert_array_equal(both.sway_m, alone.sway_m)
    np.testing.assert_array_equal(both.track.positions_m, alone.track.positions_m)
    assert both.lines.banks == 2
    check_alike(both.lines, alone.lines, lines)
    np.testing.assert_allclose(both.sway_steps_m, np.diff(sway_m), atol=2e-4)
    # Channels of both banks never form a pair.
    assert both.overlap.max() <= 16


def test_a_ping_without_the_first_bank_is_refused():
    sonar = two_banks(16, 0.03)
    course = (0, 0, 3), (0.045, 0, 0), 5, 1.0
    point = clsas.PointTargets([[0.1, 10, 0]])
    lines = clsas.compress(clsas.simulate(sonar, clsas.Track.straight(*course), point))
    some = np.ones(lines.channels, bool)
    some[64:80] = False  # the third ping's first bank
    with pytest.raises(ValueError, match=r"bank 0 in only 4 of 5 pings: .*`lines.bank\(0\)`"):
        clsas.micronavigate(lines.select(some))


@pytest.mark.slow
def test_autofocus_corrects_both_banks():
    sonar = two_banks(1, 0.06)
    xyz_m = np.random.default_rng(0).uniform([0.6, 9.5, 0], [2.4, 11, 0], (30, 3))
    course = (0, 0, 1), (0.02, 0, 0), 150, 1.0
    sway_m = 3e-3 * np.sin(np.arange(150) / 20)
    true = clsas.Track.straight(*course, sway_m=sway_m)
    echoes = clsas.simulate(sonar, true, clsas.PointTargets(xyz_m), range_m=(9, 12))
    lines = navigated(clsas.compress(echoes), sonar, course)
    grid = clsas.Grid.plane(x=(0.4, 2.6, 100), y=(9.3, 11.2, 120))
    both, alone = clsas.autofocus(lines, grid), clsas.autofocus(lines.bank(0), grid)
    assert both.focused
    check_alike(both.lines, alone.lines, lines)
    np.testing.assert_array_equal(both.correction_m[1::2], alone.correction_m)
    np.testing.assert_array_equal(both.correction_sd_m[::2], alone.correction_sd_m)
    assert np.std(detrend(both.correction_m[1::2, 1] - sway_m)) < 1e-4
    upper = clsas.backproject(both.lines.bank(1), grid)
    assert (
        np.abs(upper.pixels).max()
        > 0.9 * np.abs(clsas.backproject(both.lines.bank(0), grid).pixels).max()
    )
