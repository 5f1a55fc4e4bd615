"""Stretch of lines against closed forms, and the bands that range filters must pass for it."""

import dataclasses

import numpy as np
import pytest
from cases import along_x
from exactly import sampled
from factorizing import around, over

from clsas.engine.data.beam import BeamWindow
from clsas.engine.factorized.errors import uncompensated
from clsas.engine.signal import interpolation
from clsas.engine.signal.spectrum import shares_of_bins

TRACK = along_x(200, 0.02)
GRID = around(0, 40, shape=(32, 32))


def roots_of(rx=None, *, band=0.02, **more):
    lines, grid = over(GRID, TRACK, rx, band=band, **more)
    return sampled(lines, grid, None)


def test_channels_on_the_mean_track_have_none():
    roots = roots_of()
    found = roots.stretch
    assert abs(found.mean) < 1e-12
    assert found.shares is None
    assert roots.stretch.spectrum(roots.sampled.scene.spectrum) is roots.sampled.scene.spectrum


def test_a_receiver_above_the_transmitter():
    """The gradient of range is the cosine of half the angle between both lines of sight."""
    roots = roots_of(TRACK + [0, 0, 8.0])
    from_tx, from_rx = np.array([0, 40, 0]), np.array([0, 40, -8])
    cosine = from_tx @ from_rx / np.linalg.norm(from_tx) / np.linalg.norm(from_rx)
    # The plane is level: only the gradient's part along it can be made up for.
    gradient = (from_tx / np.linalg.norm(from_tx) + from_rx / np.linalg.norm(from_rx)) / 2
    of_middle = np.array([0, 40, -4]) / np.hypot(40, 4)
    assert np.linalg.norm(gradient) == pytest.approx(np.sqrt((1 + cosine) / 2), rel=1e-12)
    assert roots.stretch.mean == pytest.approx(gradient[1] / of_middle[1] - 1, rel=0.02)


def test_velocities_that_differ_widen_the_band():
    velocity = np.zeros((len(TRACK), 3))
    velocity[:, 1] = np.random.default_rng(0).normal(0, 5, len(TRACK))
    roots = roots_of(velocity=velocity)
    # Towards the grid at v, ranges grow by v/c less: the carrier's share of a cycle per sample.
    shift = velocity[:, 1].std() / 1500 * roots.sampled.scene.lines.carrier_cycles_per_m
    wide, narrow = (
        np.sqrt(each.share @ each.frequency**2) / roots.sampled.scene.lines.range_step_m
        for each in (
            roots.stretch.spectrum(roots.sampled.scene.spectrum),
            roots.sampled.scene.spectrum,
        )
    )
    assert np.sqrt(wide**2 - narrow**2) == pytest.approx(shift, rel=0.1)


def test_shifts_keep_the_power():
    spectrum = roots_of().sampled.scene.spectrum
    shares = shares_of_bins(np.array([[-3.25, 2.0]]), np.array([[1.0, 3.0]]))
    # Of bins -4 to 4: a quarter lies between -4 and -3, nearer to the latter.
    assert shares == pytest.approx([0.0625, 0.1875, 0, 0, 0, 0, 0.75, 0, 0])
    shifted = spectrum.shifted(shares)
    assert shifted.power.sum() == pytest.approx(spectrum.power.sum())
    assert shifted.share.sum() == pytest.approx(1.0)
    assert len(shifted.frequency) == len(shifted.power) == len(spectrum.power) + len(shares) // 2


@pytest.mark.parametrize("position", [-3.25, 0.0, 0.5, 4.0])
def test_shares_of_bins_have_the_mean_of_the_positions(position):
    shares = shares_of_bins(np.array([position]), np.array([2.0]))
    bins = np.arange(len(shares)) - len(shares) // 2
    assert shares.sum() == pytest.approx(1.0)
    assert shares @ bins == pytest.approx(position)
    assert (shares >= 0).all()


def test_a_gain_for_another_band_errs():
    """A gain that makes up for filters at one frequency is wrong at a shifted one."""
    still, moving = roots_of(), roots_of(velocity=[[0, 8.0, 0], [0, -8.0, 0]] * 100)
    align = interpolation.design(4, 1.25, still.sampled.scene.spectrum)
    gain = lambda frequency: 1 / align.response(frequency / 1.25) ** 3  # noqa: E731
    assert uncompensated(still, align, align, 2, 1.25, gain) == 0
    assert uncompensated(moving, align, align, 2, 1.25, gain) > 1e-5


def test_silent_channels_have_none():
    """Those that the beam sees received nothing; others did."""
    lines, grid = over(around(0, 40, shape=(32, 32)), along_x(400, 0.2))
    samples = lines.samples.copy()
    samples[100:300] = 0
    silent = dataclasses.replace(lines, samples=samples, rx_m=lines.rx_m + [0, 0, 20])
    roots = sampled(silent, grid, BeamWindow(20, "hann"))
    assert roots.stretch.shares is None
    assert np.isfinite(roots.stretch.spectrum(roots.sampled.scene.spectrum).power).all()
