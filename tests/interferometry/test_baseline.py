"""Sensitivities against the ranges themselves, along curves of equal range found by a solver."""

from dataclasses import replace

import numpy as np
import pytest
from reliefs import GRID, flat_banks
from scipy.optimize import least_squares

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import bistatic_range_m
from clsas.interferometry.baseline import Baseline, sight_lattice
from clsas.interferometry.coherence import Window
from clsas.interferometry.refinement import View, sensitivity

CYCLES_PER_M = 2 * 100e3 / 1500.0


def ranges_m(lines, points_m):
    """Mean range of all channels, and the mean of its slope along x."""

    def mean(at_m):
        return bistatic_range_m(at_m[:, None], lines.tx_m, lines.rx_m).mean(axis=1)

    step = np.array([1e-4, 0, 0])
    return mean(points_m), (mean(points_m + step) - mean(points_m - step)) / 2e-4


def raised(lines, point_m, height_m):
    """The place at a height with the range and the Doppler of a point."""

    def of(at_m):
        range_m, slope = ranges_m(lines, at_m[None])
        return np.array([range_m[0], 10 * slope[0]])

    wanted = of(point_m)
    xy = least_squares(
        lambda xy: of(np.array([*xy, height_m])) - wanted, point_m[:2], xtol=1e-14, ftol=1e-14
    ).x
    return np.array([*xy, height_m])


@pytest.fixture(scope="module")
def baseline():
    return Baseline.of(*flat_banks(), None, CYCLES_PER_M)


def test_phase_changes_along_curves_of_equal_range(baseline):
    a, b = flat_banks()
    for point_m in np.array([[0.0, 32.0, 0.0], [0.7, 31.0, 0.5]]):
        above_m = raised(a, point_m, point_m[2] + 0.05)
        sight = baseline.sight(point_m[None])
        assert (above_m - point_m)[:2] / 0.05 == pytest.approx(sight.tangent[0], abs=2e-3)
        apart_m = [ranges_m(a, each[None])[0] - ranges_m(b, each[None])[0] for each in
                   (point_m, above_m)]  # fmt: skip
        change_rad = 2 * np.pi * CYCLES_PER_M * (apart_m[1] - apart_m[0])[0]
        assert sight.rad_m[0] == pytest.approx(change_rad / 0.05, rel=5e-3)


def test_roll_turns_the_second_bank_about_the_first(baseline):
    a, b = flat_banks()
    points_m = np.array([[0.0, 32.0, 0.0], [0.7, 31.0, 0.5], [0.0, -20.0, 1.0]])
    arm_m = np.array([0.0, -0.25e-4, 0.25])  # the port side, at positive y, rises by 0.1 mrad
    turned = replace(b, rx_m=a.rx_m + arm_m)
    nearer_m = ranges_m(b, points_m)[0] - ranges_m(turned, points_m)[0]
    change_rad = 2 * np.pi * CYCLES_PER_M * nearer_m / 1e-4
    assert baseline.rad_per_roll(points_m) == pytest.approx(change_rad, rel=1e-3)
    assert change_rad[0] < 0 < change_rad[2]  # the bank moves away from what lies to port


def test_slopes_change_the_sensitivity(baseline):
    sights = sight_lattice(baseline, GRID, (-1, 1))
    view = View(GRID, sights, Window(9, 9), 20.0, 0.5, 2.06)
    level, facing = sensitivity(view, np.zeros(GRID.shape), np.zeros((2, *GRID.shape)))
    assert facing == pytest.approx(1)
    slope_m = np.zeros((2, *GRID.shape))
    slope_m[0] = 0.5 * 0.02
    steep, facing = sensitivity(view, np.zeros(GRID.shape), slope_m)
    # The depression at 32 m and an altitude of 12.06 m has a tangent of 0.377.
    assert facing[60, 40] == pytest.approx(1 - 0.5 * 0.377, abs=0.01)
    assert steep == pytest.approx(level / facing)


def test_a_beam_selects_the_channels_that_count():
    a, b = flat_banks()
    point_m = np.array([[0.8, 32.0, 0.0]])
    wide, narrow = (
        Baseline.of(a, b, beam, CYCLES_PER_M).sight(point_m) for beam in (None, BeamWindow(6.0))
    )
    # Within a narrow beam the line of sight is broadside, and the curve rises across the track.
    assert abs(narrow.tangent[0, 0]) < 0.3 * abs(wide.tangent[0, 0])
    assert narrow.rad_m == pytest.approx(wide.rad_m, rel=0.03)
