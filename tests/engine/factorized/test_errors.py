"""Errors of channels that are replaced by positions on the mean track, against physics."""

import dataclasses

import exactly
import numpy as np
import pytest
from cases import along_x
from factorizing import around, over

from clsas.engine.data.beam import BeamWindow
from clsas.engine.factorized.errors import beam_weights, phase_error, relative_error, root_error
from clsas.engine.factorized.sampled import sampled_channels

TRACK = along_x(200, 0.02)
GRID = around(0, 40, shape=(64, 64))
ROOT = (32, 32)
ALTERNATING = np.where(np.arange(len(TRACK)) % 2, 1.0, -1.0)


def roots_of(tx, rx=None, beam=None, **more):
    lines, grid = over(GRID, tx, rx, **more)
    return exactly.sampled(lines, grid, beam)


def sampled(roots, offset_m):
    """Sampled channels, the sample points with a pixel beside each, and virtual positions."""
    channels = sampled_channels(roots, ROOT)
    centres_m = roots.sampled.points_m[channels.points]
    points_m = np.stack([centres_m, centres_m + offset_m], axis=1)
    return channels, points_m, channels.virtual_m(centres_m)


def swaying(sway_m, height_m=0.0):
    """Channels that lie alternately on either side of a straight mean track."""
    return TRACK + ALTERNATING[:, None] * [0.0, sway_m, height_m]


def test_channels_on_a_straight_track_have_no_phase_error():
    roots = roots_of(TRACK)
    assert phase_error(roots, *sampled(roots, [0.2, 0.3, 0.0])).max() < 1e-16


@pytest.mark.parametrize("height_m", [0.01, 0.04])
def test_the_phase_error_is_that_of_the_lines_of_sight(height_m):
    """To first order, ranges change by the offset times the change of the line of sight."""
    roots, offset_m = roots_of(swaying(0.0, height_m), band=0.001), np.array([0.0, 0.3, 0.2])
    channels, points_m, virtual_m = sampled(roots, offset_m)
    centre, pixel = (
        (each - virtual_m) / np.linalg.norm(each - virtual_m, axis=-1, keepdims=True)
        for each in np.moveaxis(points_m[:, :, None], 1, 0)
    )
    off_m = channels.phase_centres_m - virtual_m
    off_m -= np.einsum("pni,pni->pn", off_m, centre)[..., None] * centre
    cycles = roots.sampled.highest_cycles_per_m * np.einsum("pni,pni->pn", off_m, pixel - centre)
    found = phase_error(roots, channels, points_m, virtual_m)[:, 0]
    assert found.mean() == pytest.approx(((2 * np.pi * cycles) ** 2).mean(), rel=0.05)


def test_the_root_error_grows_with_the_square_of_the_track_error():
    """Rounding adds as much to each."""
    none, once, twice = (root_error(roots_of(swaying(y)), ROOT) for y in (0.0, 0.002, 0.004))
    assert twice - none == pytest.approx(4 * (once - none), rel=0.02)


def test_a_velocity_that_all_receivers_share_is_no_error():
    """Ranges change by the same for all channels: the mean track has that drift too."""
    velocity = np.tile([2.0, 0.0, 0.0], (len(TRACK), 1))
    roots, beside_m = roots_of(TRACK, velocity=velocity), [0.2, 0.3, 0.0]
    found = phase_error(roots, *sampled(roots, beside_m))
    other = velocity * ALTERNATING[:, None]
    differing = roots_of(TRACK, velocity=other)
    assert found.max() < 0.01 * phase_error(differing, *sampled(differing, beside_m)).max()


def turned(angle):
    """A beam whose direction is turned from the track's, channel by channel, rad."""
    return BeamWindow(30, "hann", along=np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))


def test_weights_are_those_of_the_headings():
    roots = roots_of(TRACK, beam=turned(0.05 * ALTERNATING))
    channels, points_m, virtual_m = sampled(roots, [0.0, 0.1, 0.0])
    weights, _ = beam_weights(roots.sampled.scene.beam, channels, points_m, virtual_m)
    away_m = points_m[:, 1:, None] - channels.phase_centres_m
    angle = np.arctan2(away_m[..., 0], away_m[..., 1])
    turn = 0.05 * ALTERNATING[channels.index]
    np.testing.assert_allclose(
        weights, roots.sampled.scene.beam.weights(np.sin(angle + turn)), atol=1e-9
    )


@pytest.mark.parametrize(("periods", "is_followed"), [(1, True), (100, False)])
def test_the_mean_track_follows_headings_that_turn_slowly(periods, is_followed):
    angle = 0.05 * np.sin(2 * np.pi * periods * (np.arange(len(TRACK)) + 0.25) / len(TRACK))
    roots = roots_of(TRACK, beam=turned(angle))
    channels, points_m, virtual_m = sampled(roots, [0.0, 0.1, 0.0])
    weights, of_virtual = beam_weights(roots.sampled.scene.beam, channels, points_m, virtual_m)
    assert (np.abs(weights - of_virtual).max() < 5e-3) == is_followed


def test_a_heading_that_alternates_adds_the_error_of_its_weights():
    straight, roots = (
        roots_of(TRACK, beam=turned(0 * ALTERNATING)),
        roots_of(TRACK, beam=turned(0.02 * ALTERNATING)),
    )
    channels, points_m, virtual_m = sampled(roots, [0.0, 0.1, 0.0])
    weights, of_virtual = beam_weights(roots.sampled.scene.beam, channels, points_m, virtual_m)
    power = channels.weight[:, None]
    expected = np.sum(power * (weights - of_virtual) ** 2) / np.sum(power * weights**2)
    added = root_error(roots, ROOT) - root_error(straight, ROOT)
    assert added == pytest.approx(expected, rel=0.05)


def test_errors_are_relative_to_the_power_of_the_image():
    rng = np.random.default_rng(0)
    power, weights = rng.random((3, 5)), rng.random((3, 2, 5))
    assert relative_error(power, 0.01 * weights**2, weights) == pytest.approx(0.01)


def test_loud_channels_count_by_their_power_and_invisible_ones_do_not():
    errors = np.array([[[0.0, 1.0, 0.0]]])
    power, seen = np.array([[1.0, 3.0, 5.0]]), np.array([[[1.0, 1.0, 0.0]]])
    assert relative_error(power, errors, seen) == pytest.approx(0.75)


def test_a_loud_channel_off_the_track_counts_more_than_others():
    roots = roots_of(TRACK)
    lines = roots.sampled.scene.lines
    tx = lines.tx_m.copy()
    tx[100, 1] += 0.05
    samples = lines.samples.copy()
    samples[100] *= 10
    quiet = dataclasses.replace(lines, tx_m=tx, rx_m=tx)
    loud = dataclasses.replace(quiet, samples=samples)
    none, few, many = (
        root_error(exactly.sampled(each, GRID), ROOT) for each in (lines, quiet, loud)
    )
    # Its share of the power grows from 1/200 to 100/299.
    assert many - none == pytest.approx(200 * 100 / 299 * (few - none), rel=0.1)
