"""Multi-look images: means of power over windows, sub-bands and parts of the beam."""

from dataclasses import replace

import numpy as np
import pytest

import clsas

GRID = clsas.Grid.plane((0, 3, 151), (40, 42, 101))


def speckle(seed, grid=GRID):
    random = np.random.default_rng(seed)
    return clsas.Image(random.standard_normal((*grid.shape, 2)) @ [1, 1j], grid)


def test_a_window_averages_power():
    image = speckle(0)
    found = clsas.multilook(image, window_m=0.1)
    power = np.abs(image.pixels.astype(complex)) ** 2
    assert np.abs(found.pixels[50, 70]) ** 2 == pytest.approx(power[48:53, 68:73].mean(), rel=1e-5)
    # At a corner, only pixels inside count.
    assert np.abs(found.pixels[0, 0]) ** 2 == pytest.approx(power[:3, :3].mean(), rel=1e-5)
    assert not found.pixels.imag.any()
    assert found.pixels.real.min() > 0


def test_a_window_follows_the_steps_of_either_axis():
    grid = clsas.Grid.plane((0, 3, 31), (40, 42, 101))
    point = np.zeros(grid.shape, complex)
    point[50, 15] = 1
    spread = clsas.multilook(clsas.Image(point, grid), window_m=0.3).pixels.real > 1e-3
    assert spread.any(axis=1).sum() == 15
    assert spread.any(axis=0).sum() == 3


def test_looks_average_power_and_reduce_speckle():
    images = [speckle(seed) for seed in range(4)]
    found = clsas.multilook(images)
    power = np.mean([np.abs(image.pixels) ** 2 for image in images], axis=0)
    np.testing.assert_allclose(np.abs(found.pixels) ** 2, power, rtol=1e-5)
    assert clsas.contrast(found) == pytest.approx(0.5, abs=0.03)
    assert clsas.contrast(clsas.multilook(images, window_m=0.06)) == pytest.approx(1 / 6, abs=0.02)


def test_only_what_was_received_counts():
    """Edges, seams and single pixels that nothing reached leave the power of 1 beside them."""
    looks = []
    for seam in (30, 60, 61):
        pixels = np.exp(1j * np.random.default_rng(seam).uniform(0, 9, GRID.shape))
        pixels[:, seam] = pixels[:, :7] = pixels[50, 100] = 0
        looks.append(clsas.Image(pixels, GRID))
    found = np.abs(clsas.multilook(looks).pixels)
    np.testing.assert_allclose(found[found > 0], 1, rtol=1e-6)
    assert np.count_nonzero(found == 0) == 7 * len(found) + 1
    for images in (looks, looks[0]):
        found = np.abs(clsas.multilook(images, window_m=0.1).pixels)
        np.testing.assert_allclose(found[:, 5:], 1, rtol=1e-6)
        assert not found[:, :5].any()  # no pixel of these windows received anything


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_levels_of_any_unit(scale):
    image = speckle(1)
    scaled = clsas.Image((image.pixels * scale).astype(np.complex64), GRID)
    found, expected = (clsas.multilook(each, window_m=0.1).pixels for each in (scaled, image))
    np.testing.assert_allclose(found / np.float32(scale), expected, rtol=1e-5)


def test_a_bright_point_leaves_no_trail():
    """Sums that run past a point keep the power of dark pixels, down to -120 dB."""
    pixels = np.full(GRID.shape, 1e-6, complex)
    pixels[50, 20] = 1
    found = clsas.multilook(clsas.Image(pixels, GRID), window_m=0.1).pixels.real
    np.testing.assert_allclose(found[50, 30:], 1e-6, rtol=0.01)
    zero = clsas.Image(np.zeros(GRID.shape, complex), GRID)
    assert not clsas.multilook(zero, window_m=0.1).pixels.any()


@pytest.mark.parametrize(
    ("images", "window_m", "error", "message"),
    [
        (speckle(0), None, ValueError, "window_m must be given"),
        ([], 0.1, ValueError, "images must have at least one"),
        ([speckle(0), 3], 0.1, TypeError, "every entry of images must be"),
        ([speckle(0), speckle(0, clsas.Grid.plane((0, 3, 9), (0, 1, 9)))], None, ValueError,
         r"images must lie on one grid, got shapes \(101, 151\) and \(9, 9\)"),
        (speckle(0), 2.5, ValueError, "at most the extent of the grid, 2.02 m"),
        (speckle(0), -1.0, ValueError, "window_m must be"),
        (clsas.Image(np.ones(3, complex), clsas.Grid.points(np.eye(3))), 0.1, ValueError,
         "left out: the images have points"),
    ],
)  # fmt: skip
def test_wrong_looks_are_refused(images, window_m, error, message):
    with pytest.raises(error, match=message):
        clsas.multilook(images, window_m=window_m)


def recorded(seed):
    """Range lines of noise within a band, which images as speckle, and a grid beside the track."""
    random = np.random.default_rng(seed)
    spectrum = random.standard_normal((120, 480, 2)) @ [1, 1j]
    samples = np.fft.ifft(spectrum * (np.abs(np.fft.fftfreq(480)) < 0.3), axis=1)
    tx_m = np.outer(np.arange(-60, 60) * 0.03, [1.0, 0, 0])
    lines = clsas.RangeLines(samples, 17.0, 0.0125, tx_m, tx_m, 100e3, 1500.0)
    return lines.tapered_ends(1.0), clsas.Grid.plane((-0.6, 0.6, 41), (19, 21, 81))


@pytest.fixture(scope="module")
def seabed():
    return recorded(2)


@pytest.mark.parametrize("carrier_hz", [100e3, 96e3])
def test_sub_bands_add_up_and_hardly_overlap(seabed, carrier_hz):
    lines = replace(seabed[0], carrier_hz=carrier_hz)
    parts = clsas.sub_bands(lines, 3)
    np.testing.assert_allclose(
        sum(each.samples for each in parts), lines.samples, atol=1e-6 * np.abs(lines.samples).max()
    )
    spectra = [np.abs(np.fft.fft(each.samples, 8 * 480)) ** 2 for each in parts]
    shares = [each.sum() for each in spectra]
    assert min(shares) > 0.3 * sum(shares)
    norms = [np.linalg.norm(each.samples) for each in parts]
    for one, other, most in ((0, 1, 0.2), (1, 2, 0.2), (0, 2, 0.02)):
        overlap = abs(np.vdot(parts[one].samples, parts[other].samples))
        assert overlap < most * norms[one] * norms[other]


def test_sub_bands_have_low_side_lobes():
    """Four to eight resolution cells beside a point, levels are at least 26 dB lower."""
    tx_m = np.zeros((2, 3))
    point = clsas.PointTargets([[0, 40, 0]])
    lines = clsas.simulate_lines(
        tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=30e3, window="hamming"
    )
    for part in clsas.sub_bands(lines, 3):
        range_m = part.first_range_m[0] + np.arange(part.length) * part.range_step_m
        level = np.abs(part.samples[0])
        away = np.abs(range_m - 40) / (3 * 0.025)
        assert level[(away > 4) & (away < 8)].max() < 0.05 * level.max()
        assert np.abs(range_m[level.argmax()] - 40) < 0.02


@pytest.mark.slow
def test_looks_of_a_survey_are_independent():
    """The speckle of N sub-bands, and of N parts of the beam, varies by 1/sqrt(N)."""
    beam, squares = clsas.BeamWindow(8.0), []
    for seed in range(4):
        lines, grid = recorded(seed)
        one = clsas.backproject(lines, grid, beam=beam)
        bands = [clsas.backproject(each, grid, beam=beam) for each in clsas.sub_bands(lines, 4)]
        aspects = [clsas.backproject(lines, grid, beam=each) for each in beam.divided(4)]
        images = one, clsas.multilook(bands), clsas.multilook(aspects)
        squares.append([clsas.contrast(image) ** 2 for image in images])
        # Together, the aspects have what the whole beam has, but for a channel at their borders.
        total = sum(image.pixels for image in aspects)
        norms = np.linalg.norm(total) * np.linalg.norm(one.pixels)
        assert abs(np.vdot(total, one.pixels)) > 0.98 * norms
    whole, of_bands, of_aspects = np.sqrt(np.mean(squares, axis=0))
    assert whole == pytest.approx(1, abs=0.1)
    # Neighbouring sub-bands share 1/36 of their intensities.
    assert of_bands == pytest.approx(np.sqrt((4 + 6 / 36) / 16), abs=0.06)
    assert of_aspects == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(("count", "message"), [(1, "count must be"), (65, "count must be")])
def test_wrong_numbers_of_bands_are_refused(seabed, count, message):
    with pytest.raises(ValueError, match=message):
        clsas.sub_bands(seabed[0], count)
    short = clsas.RangeLines(
        np.ones((2, 8), complex), 0, 0.1, np.zeros((2, 3)), [0, 0, 0], 1e5, 1500
    )
    with pytest.raises(ValueError, match="count must leave a cycle per line"):
        clsas.sub_bands(short, 60)


def test_a_beam_is_divided_along_the_track():
    beam = clsas.BeamWindow(60.0, "hann", squint_deg=10.0, track_pings=7)
    parts = beam.divided(3)
    edges = [part.limits for part in parts]
    assert edges[0][0] == pytest.approx(beam.limits[0])
    assert edges[-1][1] == pytest.approx(beam.limits[1])
    widths = [high - low for low, high in edges]
    np.testing.assert_allclose(widths, np.ptp(beam.limits) / 3)
    assert {(part.shape, part.track_pings) for part in parts} == {("hann", 7)}
    assert clsas.BeamWindow(180.0).divided(2)[0].width_deg == pytest.approx(90)
    with pytest.raises(ValueError, match="shape must not be 'inverse'"):
        clsas.BeamWindow(10.0, "inverse", element_length_m=0.05).divided(2)
    with pytest.raises(ValueError, match=r"count must leave parts of at least 0.001"):
        clsas.BeamWindow(0.01).divided(20)
