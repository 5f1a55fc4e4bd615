"""Refusals and warnings for navigation that is missing, repeated or out of order."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.navigation.overlap import Array

PINGS, RECEIVERS, ADVANCE = 12, 24, 12
SPACING_M = 0.0075
GRID = clsas.Grid.plane((0, 1.2, 48), (19.4, 20.9, 60))


def along_x(*number):
    """Return positions along x."""
    x = np.concatenate([np.atleast_1d(each) for each in number])
    return np.stack([x, 0 * x, 0 * x], axis=1)


def array_lines(advance=ADVANCE):
    """Return lines of an array whose samples depend on the phase centre alone."""
    rng = np.random.default_rng(0)
    tx_m = np.repeat(along_x(np.arange(PINGS) * advance * SPACING_M), RECEIVERS, axis=0)
    rx_m = tx_m + np.tile(along_x(2 * SPACING_M * np.arange(RECEIVERS)), (PINGS, 1))
    centre = np.rint((tx_m + rx_m)[:, 0] / 2 / SPACING_M).astype(int)
    spectrum = rng.standard_normal((centre.max() + 1, 400, 2)) @ [1, 1j]
    spectrum[:, np.abs(np.fft.fftfreq(400)) > 0.25] = 0
    return clsas.RangeLines(np.fft.ifft(spectrum)[centre], 20.0, 0.02, tx_m, rx_m, 100e3, 1500.0)


def point_lines(pings=60):
    """Return lines of a monostatic pass by some points."""
    rng = np.random.default_rng(0)
    tx_m = along_x(0.02 * np.arange(pings))
    points_m = np.c_[rng.uniform([0, 19.5], [1.2, 20.8], (17, 2)), np.zeros(17)]
    range_m = np.linalg.norm(points_m - tx_m[:, None], axis=-1)[..., None]
    at_m = 18.5 + 0.0125 * np.arange(300)
    samples = np.sinc((at_m - range_m) / 0.025) * np.exp(-4j * np.pi / 0.015 * range_m)
    return clsas.RangeLines(samples.sum(axis=1), 18.5, 0.0125, tx_m, tx_m, 100e3, 1500.0)


def channels_of(pings):
    return (np.asarray(pings)[:, None] * RECEIVERS + np.arange(RECEIVERS)).ravel()


def at_one_position(lines):
    return replace(lines, tx_m=np.zeros(3), rx_m=np.zeros(3))


ORDER = np.r_[0:5, 7, 6, 5, 8:12]
REFUSED = {
    "missing": (at_one_position, "got 288 transmissions from 1 position: positions are missing"),
    "at rest": (
        lambda lines: replace(lines, tx_m=np.zeros(3), rx_m=np.tile(lines.rx_m[:24], (12, 1))),
        "got 12 transmissions from 1 position: .* or the platform stood still",
    ),
    "one ping": (lambda lines: lines.select(channels_of([0])), "at least 2 pings .* got one "),
    "repeated": (
        lambda lines: lines.select(channels_of(np.r_[0:4, 3:12])),
        r"1 ping repeats the position of the ping before \(the first is ping 4\); "
        r"`lines\.without_still_pings\(\)` drops them",
    ),
    "without overlap": (
        lambda lines: array_lines(30),
        "at least 3 phase centres that overlap from ping to ping, got 0 between pings 0 and 1",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_micronavigation_refuses(case):
    change, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        clsas.micronavigate(change(array_lines()))


def test_micronavigation_warns_of_pings_out_of_order():
    lines = array_lines(6).select(channels_of(ORDER))
    with pytest.warns(ClsasWarning, match=r"turns back \d times \(first after ping 5\).* order"):
        found = clsas.micronavigate(lines, unknowns=("sway",))
    assert np.abs(found.sway_m).max() <= 3e-3
    lines = array_lines().select(channels_of(np.r_[0:4, 8, 5:8, 4, 9:12]))
    with (
        pytest.warns(ClsasWarning, match="the track turns back"),
        pytest.raises(ValueError, match="phase centres that overlap"),
    ):
        clsas.micronavigate(lines)


@pytest.mark.parametrize(
    "function", [clsas.micronavigate, lambda lines: clsas.autofocus(lines, GRID)]
)
def test_positions_that_are_not_finite_are_refused(function):
    lines = array_lines()
    position_m = np.array(lines.tx_m)
    position_m[5] = np.nan
    with pytest.raises(ValueError, match=r"tx_m must be finite, got 3 NaN .* first at \[5, 0\]"):
        function(replace(lines, tx_m=position_m))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (at_one_position, "at least 10 pings for autofocus, got 60 transmissions from 1 position"),
        (lambda lines: lines.select([0]), "at least 10 pings for autofocus, got one"),
        (
            lambda lines: lines.select(np.repeat(np.arange(5), 12)),
            "got 60 transmissions from 5 positions: positions are missing",
        ),
        (
            lambda lines: replace(
                lines,
                tx_m=(jittered := along_x(
                    lines.tx_m[:21, 0], lines.tx_m[20, 0] + 1e-6 * np.arange(1, 20),
                    lines.tx_m[40:, 0],
                )),
                rx_m=jittered,
            ),
            r"stand still around ping \d+; `lines\.without_still_pings\(\)` drops such pings",
        ),
    ],
)  # fmt: skip
def test_autofocus_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        clsas.autofocus(change(point_lines()), GRID)


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (np.r_[0:30, 30, 30, 30:60], "2 pings repeat .* ping 31.: they are corrected as one ping"),
        (np.r_[0:20, 25, 21:25, 20, 26:60], r"track turns back 2 times \(first after ping 20\)"),
    ],
)
def test_autofocus_warns_and_goes_on(order, message, platform):
    lines = point_lines().select(order)
    with pytest.warns(ClsasWarning, match=message):
        found = clsas.autofocus(lines, GRID, device=platform)
    assert np.abs(found.correction_m).max() < 1e-3


def test_an_array_at_rest_has_too_few_pings():
    lines = at_one_position(array_lines())
    with pytest.raises(ValueError, match="lines must have at least 2 pings"):
        Array.of(lines)
