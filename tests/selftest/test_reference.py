"""The references against closed forms that use none of the library's code."""

from functools import partial

import numpy as np
import pytest
from cases import CARRIER, STEP, along_x, bistatic, made, noise, patch, thesis_lines
from exactly import prepare, same_interpolator

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.selftest import reference
from clsas.selftest.reference import ideal, sampled_error_db

TRACK = along_x(7, 0.3)
RX = TRACK + np.array([0.1, -0.05, 0.2])
TARGET = np.array([0.2, 9.0, -1.0])


def burst(range_m, centre):
    """A Gaussian of four steps, turning by `centre` cycles per step."""
    u = range_m / STEP
    return np.exp(-((u / 4) ** 2) + 2j * np.pi * centre * u)


def scene(*centres, velocity=None, carrier=CARRIER):
    """Lines with one burst per centre frequency, points, and the image in closed form."""
    points = TARGET + np.random.default_rng(1).uniform(-0.01, 0.01, (50, 3))

    def paths(x):
        out = np.linalg.norm(x[..., None, :] - TRACK, axis=-1)
        if velocity is None:
            return (out + np.linalg.norm(x[..., None, :] - RX, axis=-1)) / 2
        delay = 2 * out / 1500
        for _ in range(30):  # until the receiver is where the echo is
            back = np.linalg.norm(x[..., None, :] - RX - velocity * delay[..., None], axis=-1)
            delay = (out + back) / 1500
        return 750 * delay

    rho, k = paths(TARGET), 2 * np.pi * carrier / 1500
    first = rho.min() - 100.3 * STEP + 0.1 * STEP * np.arange(7)
    r = first[:, None] + STEP * np.arange(230)
    samples = sum(burst(r - rho[:, None], c) for c in centres) * np.exp(-2j * k * rho)[:, None]
    lines = RangeLines(samples, first, STEP, TRACK, RX, carrier, 1500.0, velocity)
    change = paths(points) - rho
    wanted = (sum(burst(change, c) for c in centres) * np.exp(2j * k * change)).sum(axis=-1)
    return lines, points, wanted


@pytest.mark.parametrize("velocity", [None, np.array([5.0, -3, 2])])
@pytest.mark.parametrize("carrier", [0.0, CARRIER])
def test_the_ideal_sum_is_the_closed_form(velocity, carrier):
    lines, points, wanted = scene(0.0, velocity=velocity, carrier=carrier)
    assert relative_error_db(ideal(lines, points), wanted) <= -120


def test_frequencies_lie_about_the_spectral_centre():
    """Bursts at 0.22 and 0.68 cycles per step: the second is not folded to -0.32."""
    lines, points, wanted = scene(0.22, 0.68)
    assert relative_error_db(ideal(lines, points), wanted) <= -110


@pytest.mark.parametrize("centres", [(0.0,), (0.22, 0.68)])
def test_a_fine_interpolator_is_the_closed_form(centres):
    lines, points, wanted = scene(*centres, velocity=np.array([2.0, 0, 0]))
    preparation = prepare(lines, Grid.points(points), taps=8, upsampling=8)
    assert relative_error_db(same_interpolator(preparation, points), wanted) <= -110


def test_linear_interpolation_by_hand():
    """Without upsampling, a value between two samples is weighted by their distances."""
    samples = np.zeros((1, 31), complex)
    samples[0, 15:17] = 1, 3j
    lines = RangeLines(samples, 10.0, 0.25, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    points = [[10 + 0.25 * place, 0, 0] for place in (15.0, 15.25, 15.5, 16.0, 16.75)]
    preparation = prepare(lines, Grid.points(points), taps=2, upsampling=1)
    resampling = preparation.resampling
    turn = resampling.centre_cycles_per_sample
    place = np.array([15.0, 15.25, 15.5, 16.0, 16.75])
    back, forth = (np.exp(2j * np.pi * turn * (place - n)) for n in (15, 16))
    wanted = (
        np.maximum(1 - np.abs(place - 15), 0) * back
        + 3j * np.maximum(1 - np.abs(place - 16), 0) * forth
    )
    np.testing.assert_allclose(same_interpolator(preparation, points), wanted, atol=1e-12)


def test_lines_are_hit_at_their_samples():
    lines = RangeLines(noise(1, 300), 10.0, 0.25, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    points = np.stack([10 + 0.25 * np.arange(300), np.zeros(300), np.zeros(300)], axis=1)
    np.testing.assert_allclose(ideal(lines, points), lines.samples[0], atol=1e-8)


@pytest.mark.parametrize("place", [-1e-6, 299 + 1e-6, -40, 1e9])
def test_the_ideal_sum_holds_nothing_beyond_a_line(place):
    lines = RangeLines(np.ones((1, 300), complex), 10.0, 0.25, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    assert ideal(lines, [10 + 0.25 * place, 0, 0]) == 0
    inside = np.clip(place, 1e-6, 299 - 1e-6)
    assert abs(ideal(lines, [10 + 0.25 * inside, 0, 0]) - 1) < 1e-3


def test_an_interpolator_holds_nothing_beyond_a_filter():
    lines = RangeLines(np.ones((1, 300), complex), 10.0, 0.25, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    points = [[10 + 0.25 * place, 0, 0] for place in (-3.0, 302.0, 1e9)]
    preparation = prepare(lines, Grid.points([[50.0, 0, 0]]), taps=4, upsampling=2)
    assert not same_interpolator(preparation, points).any()


@pytest.mark.slow
def test_padding_does_not_matter_for_lines_that_fade():
    lines, grid = made(bistatic)
    points = grid.positions_m()[::7, ::7]
    near, far = (ideal(lines, points, padding=padding) for padding in (0, 3000))
    assert relative_error_db(ideal(lines, points), far) <= -90
    assert relative_error_db(near, far) <= -90


@pytest.mark.parametrize("which", ["ideal", "same_interpolator"])
def test_blocks_and_progress(which, monkeypatch):
    lines = thesis_lines(patch(1, 42, 3, 4), TRACK)
    points = patch(1, 42, 3, 4).positions_m()
    preparation = prepare(lines, Grid.points(points), taps=4, upsampling=3)
    evaluate = partial(ideal, lines, points)
    if which == "same_interpolator":
        evaluate = partial(same_interpolator, preparation, points)
    whole = evaluate()
    assert whole.shape == (4, 3)
    assert whole.dtype == np.complex128
    monkeypatch.setattr(reference, "_PAIRS_AT_ONCE", 24)  # two channels
    calls = []
    np.testing.assert_allclose(
        evaluate(progress=lambda *call: calls.append(call)), whole, rtol=1e-9
    )
    assert calls == [(2, 7), (4, 7), (6, 7), (7, 7)]


def test_an_error_is_measured_at_random_pixels():
    grid = patch(0, 40, 50, 40)
    seen = []

    def truth(points):
        seen.append(points)
        return np.exp(300j * points[:, 1]) * (1 + points[:, 0])

    wrong = truth(grid.positions_m().reshape(-1, 3)).reshape(grid.shape) * 1.001
    seen.clear()
    image = Image(wrong, grid)
    assert sampled_error_db(image, truth, pixels=300) == pytest.approx(-60, abs=0.01)
    assert seen[0].shape == (300, 3)
    assert len(np.unique(seen[0], axis=0)) == 300
    sampled_error_db(image, truth, pixels=300, seed=1)
    assert not np.array_equal(seen[0], seen[1])
    assert sampled_error_db(image, truth, pixels=10**6) == pytest.approx(-60, abs=0.01)
    assert seen[2].shape == (2000, 3)


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda lines: ideal(None, [0, 0, 0]), TypeError, "lines must be .*RangeLines"),
        (lambda lines: ideal(lines, [0, 0]), ValueError, "points_m"),
        (lambda lines: ideal(lines, [0, 0, np.nan]), ValueError, "points_m"),
        (lambda lines: ideal(lines, [0, 0, 1j]), TypeError, "points_m"),
        (lambda lines: ideal(lines, [0, 0, 0], beam=20), TypeError, "beam must be .*BeamWindow"),
        (lambda lines: ideal(lines, [0, 0, 0], padding=-1), ValueError, "padding"),
        (lambda lines: sampled_error_db(lines, None), TypeError, "image must be .*Image"),
    ],
)
def test_bad_arguments_are_named(call, error, says):
    with pytest.raises(error, match=says):
        call(made(bistatic)[0])
