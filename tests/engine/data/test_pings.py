"""Pings, also several from one position, and pings taken standing still."""

import numpy as np
import pytest

from clsas.engine.data.lines import RangeLines
from clsas.engine.data.pings import Transmissions


def lines_at(x, receivers=1):
    """Return lines of pings at positions along x, each with receivers 0.1 m apart."""
    tx_m = np.repeat(np.stack([x, 0 * x, 0 * x], axis=1), receivers, axis=0)
    rx_m = tx_m + np.tile(np.outer(np.arange(receivers), [0.1, 0, 0]), (len(x), 1))
    samples = np.arange(len(tx_m))[:, None] * np.ones(3) + 1j
    return RangeLines(samples, 1.0, 0.1, tx_m, rx_m, 1e5, 1500.0)


def antennas(lines):
    return lines.tx_m, lines.rx_m


def kept(lines, **options):
    return lines.without_still_pings(**options).samples[:, 0].real.astype(int).tolist()


@pytest.mark.parametrize("receivers", [1, 3])
def test_a_halt_leaves_its_first_ping(receivers):
    x = np.array([0, 1, 2, 2, 2, 2, 3, 4, 5.0])
    lines = lines_at(x, receivers)
    pings = Transmissions.of(lines.tx_m, lines.rx_m)
    assert pings.count == 9
    np.testing.assert_array_equal(pings.receivers, receivers)
    expected = [0, 1, 2, 6, 7, 8]
    assert kept(lines)[::receivers] == [receivers * ping for ping in expected]
    assert lines.without_still_pings().channels == receivers * len(expected)


def test_lines_without_halts_are_returned_as_they_are():
    lines = lines_at(np.arange(20.0) + np.random.default_rng(0).uniform(-0.3, 0.3, 20))
    assert lines.without_still_pings() is lines


def test_the_usual_advance_is_that_of_the_pings_that_move():
    """355 of 608 pings are at rest, with jitter of their positions, and there is a gap."""
    x = np.concatenate([np.full(355, 0.0), 0.01 * np.arange(1, 254)])
    x[500:] += 3.0
    x[:355] += 1e-5 * np.random.default_rng(0).standard_normal(355)
    pings = Transmissions.of(*antennas(lines_at(x)))
    assert pings.usual_step_m == pytest.approx(0.01, rel=1e-6)
    assert pings.advancing().sum() == 254


def test_slow_pings_stay_and_the_distance_may_be_chosen():
    lines = lines_at(np.array([0, 1, 2, 2.3, 2.6, 3, 4, 5]))
    assert kept(lines) == list(range(8))
    assert kept(lines, least_advance_m=0.5) == [0, 1, 2, 4, 6, 7]
    for wrong in (0, -1, np.nan):
        with pytest.raises(ValueError, match="least_advance_m must be finite and > 0 m"):
            lines.without_still_pings(wrong)
    with pytest.raises(TypeError, match="least_advance_m must be one real number in m"):
        lines.without_still_pings("a")


def test_a_platform_that_never_moves_and_a_single_ping():
    for receivers, options in ((1, {}), (3, {}), (1, {"least_advance_m": 7.0})):
        lines = lines_at(np.arange(5.0) if options else np.zeros(5), receivers)
        with pytest.raises(
            ValueError, match=rf"of 5 pings \({5 * receivers} lines\) only the first"
        ):
            lines.without_still_pings(**options)
    assert kept(lines_at(np.zeros(1))) == [0]
    assert Transmissions.of(*antennas(lines_at(np.zeros(1)))).turns.size == 0


def test_turns_are_found_on_any_course():
    x = np.arange(40.0)
    assert Transmissions.of(*antennas(lines_at(x[::-1]))).turns.size == 0
    x[[20, 24]] = x[[24, 20]]
    np.testing.assert_array_equal(Transmissions.of(*antennas(lines_at(x))).turns, [20, 23])
    angle = np.linspace(0, 2 * np.pi, 90)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    lines = lines_at(np.arange(90.0))
    lines = RangeLines(lines.samples, 1.0, 0.1, circle, circle, 1e5, 1500.0)
    assert Transmissions.of(lines.tx_m, lines.rx_m).turns.size == 0
