"""Fixes of the navigation that cannot be right, in lines and in tracks."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.signal.doubts import doubts_of_fixes

PINGS = np.arange(120)
UTM_M = np.array([597_300.0, 6_643_100.0, -8.0])
LEVERS_M = np.array([[0.12, 0.03, -0.1], [0.18, 0.03, -0.1]])


def ahead(step_m=0.06, course_deg=0.0):
    """Positions of a swaying platform."""
    course = np.radians(course_deg)
    along_m, sway_m = step_m * PINGS, 0.05 * np.sin(PINGS / 9)
    return np.stack(
        [
            along_m * np.cos(course) - sway_m * np.sin(course),
            along_m * np.sin(course) + sway_m * np.cos(course),
            0.01 * np.cos(PINGS / 7),
        ],
        axis=1,
    )


def lines_at(position_m, levers_m=None):
    tx_m = rx_m = position_m
    if levers_m is not None:
        tx_m = np.repeat(position_m, len(levers_m), axis=0)
        rx_m = tx_m + np.tile(levers_m, (len(position_m), 1))
    return clsas.RangeLines(np.ones((len(tx_m), 4), complex), 20.0, 0.02, tx_m, rx_m, 100e3, 1500.0)


def found(position_m, levers_m=None, wavelength_m=0.015):
    """Names of the findings, which do not depend on the order of channels."""
    lines = lines_at(position_m, levers_m)
    shuffled = lines.select(np.random.default_rng(0).permutation(lines.channels))
    names, of_shuffled = (
        [each.name for each in doubts_of_fixes(any_order, wavelength_m)]
        for any_order in (lines, shuffled)
    )
    assert names == of_shuffled
    return names


def with_fix(position_m, numbers, fix_m):
    position_m = position_m.copy()
    position_m[numbers] = fix_m
    return position_m


@pytest.mark.parametrize("levers_m", [None, LEVERS_M], ids=["monostatic", "array"])
@pytest.mark.parametrize(
    ("position_m", "names"),
    [
        (ahead(), []),
        (ahead() + UTM_M, []),
        (ahead(0.5) + UTM_M, []),
        (np.delete(ahead(), [20, 21, 22, 23, 24, 70], axis=0), []),
        (np.concatenate([ahead(), ahead() + [0, 40, 0]]), []),
        (np.outer(PINGS[::3], [0.5, 0, 0]) + UTM_M, []),
        (np.outer(np.random.default_rng(1).permutation(PINGS)[:60], [0.02, 0, 0]), []),
        (with_fix(ahead() + UTM_M, 20, 0), ["stray_fixes"]),
        (with_fix(ahead(), [5, 6, 80], [[0, 3e3, 0], [0, 3e3, 0.1], [900, 0, 0]]), ["stray_fixes"]),
        (with_fix(ahead(), 119, [0, 12, 0]), ["stray_fixes"]),
        (ahead()[PINGS // 10 * 10], ["held_fixes"]),
        (ahead()[np.minimum(PINGS, 85)], ["held_fixes"]),
        ((ahead() + UTM_M).astype(np.float32), ["coarse_fixes"]),
        ((ahead(0.11, 90) + UTM_M).astype(np.float32), ["coarse_fixes"]),
        ((ahead(1.037, 30) + UTM_M).astype(np.float32), ["coarse_fixes"]),
        (ahead(0.0637).round(2), ["coarse_fixes"]),
        (ahead(0.0637).round(3), []),
    ],
)
def test_only_fixes_that_cannot_be_right_are_found(position_m, names, levers_m):
    assert found(np.asarray(position_m, float), levers_m) == names


def test_banks_may_share_their_antennas():
    lines = lines_at(np.concatenate([ahead(), ahead()]), [[0, 0, 0]])
    banks = np.repeat([0, 1], len(PINGS))
    assert [each.name for each in doubts_of_fixes(lines, 0.015)] == ["held_fixes"]
    assert list(doubts_of_fixes(replace(lines, bank_numbers=banks), 0.015)) == []


def test_positions_may_be_coarse_for_long_waves():
    position_m = (ahead() + UTM_M).astype(np.float32).astype(float)
    assert found(position_m, wavelength_m=7.5) == []


def test_a_stray_fix_is_named_with_its_channels_and_its_remedy():
    (finding,) = doubts_of_fixes(lines_at(with_fix(ahead(), 7, [0, 900, 0]), LEVERS_M), 0.015)
    assert finding.where == (14, 15)
    assert "1 of 120 positions lie far from all others" in finding.message
    assert "interpolate the navigation" in finding.remedy


def test_float32_at_the_size_of_utm_coordinates_defocuses_and_is_warned_of():
    target_m = UTM_M + [3.5, 25.0, 0]
    tx_m = ahead() + UTM_M
    truth = clsas.simulate_lines(
        tx_m, tx_m, clsas.PointTargets([target_m]), carrier_hz=100e3, bandwidth_hz=20e3
    )
    rounded = clsas.RangeLines(
        truth.samples, truth.first_range_m, truth.range_step_m, tx_m.astype(np.float32),
        tx_m.astype(np.float32), truth.carrier_hz, truth.sound_speed_m_s,
    )  # fmt: skip
    grid = clsas.Grid.points([target_m])
    sharp = abs(clsas.backproject(truth, grid).pixels[0])
    with pytest.warns(clsas.ClsasWarning, match="rounded to 62.5 mm, as single precision"):
        blurred = abs(clsas.backproject(rounded, grid).pixels[0])
    assert blurred < 0.7 * sharp
