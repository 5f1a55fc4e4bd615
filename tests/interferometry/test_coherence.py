import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.interferometry.coherence import (
    Moments,
    Window,
    debiased,
    effective_looks,
    noise_coherence,
    phase_sd_rad,
)


def speckle(random, count, rows, columns, band=1.0):
    """Images of circular Gaussian speckle, whose spectra fill a share of the band on both axes."""
    white = random.standard_normal((count, rows, columns, 2)) @ [1, 1j]
    kept = [np.abs(np.fft.fftfreq(n)) <= band / 2 for n in (rows, columns)]
    return np.fft.ifft2(np.fft.fft2(white) * np.outer(*kept)).astype(np.complex64)


def pair(random, coherence, rows, columns, band=1.0):
    first, second = speckle(random, 2, rows, columns, band)
    return first, coherence * first + np.sqrt(1 - coherence**2) * second


class TestWindow:
    def test_sides_are_odd_and_nearest(self):
        grid = Grid.plane((0, 1, 101), (0, 2, 101))  # 1 and 2 cm
        assert Window.of(grid, 0.09) == Window(5, 9)
        assert Window.of(grid, 0.11) == Window(5, 11)
        assert Window.of(grid, 1e-3) == Window(1, 1)

    def test_sums_equal_direct_sums(self):
        values = np.random.default_rng(1).standard_normal((2, 9, 11))
        window = Window(3, 5)
        sums, fullness = window.sums(values), window.fullness((9, 11))
        for row, column in ((0, 0), (4, 5), (8, 3)):
            part = values[:, max(row - 1, 0) : row + 2, max(column - 2, 0) : column + 3]
            assert sums[:, row, column] == pytest.approx(part.sum(axis=(1, 2)))
            assert fullness[row, column] == pytest.approx(part[0].size / 15)

    def test_scaled_windows_are_odd_and_never_smaller(self):
        assert Window(5, 9).scaled(2.0) == Window(11, 19)
        assert Window(5, 9).scaled(1.0) == Window(5, 9)


@pytest.mark.parametrize("band", [0.4, 0.75, 1.0])
def test_looks_of_speckle_with_a_known_autocorrelation(band):
    random = np.random.default_rng(2)
    window = Window(9, 7)
    images = tuple(speckle(random, 2, 200, 180, band))
    area = 1.0
    for side in (9, 7):
        lag = np.arange(1 - side, side)
        area *= np.sum((1 - np.abs(lag) / side) * np.sinc(band * lag) ** 2)
    assert effective_looks(images, window) == pytest.approx(63 / area, rel=0.05)


def test_looks_do_not_depend_on_a_carrier():
    images = tuple(speckle(np.random.default_rng(3), 2, 120, 120, 0.5))
    carrier = np.exp(2j * np.pi * (0.31 * np.arange(120)[:, None] + 0.17 * np.arange(120)))
    window = Window(9, 9)
    turned = tuple(each * carrier for each in images)
    assert effective_looks(turned, window) == pytest.approx(effective_looks(images, window))


@pytest.mark.parametrize("seed", range(3))
def test_looks_of_images_smaller_than_a_resolution_cell(seed):
    alike = tuple(speckle(np.random.default_rng(seed), 2, 800, 800, 0.01)[:, :21, :21])
    assert effective_looks(alike, Window(21, 21)) < 2.5


@pytest.mark.exhaustive
def test_looks_of_a_window_as_large_as_the_images():
    random = np.random.default_rng(7)
    images = speckle(random, 2, 1600, 1600, 0.05)
    window = Window(41, 41)
    expected = effective_looks(tuple(images), window)
    assert 4 < expected < 8
    tiles = images[:, :1558, :1558].reshape(2, 38, 41, 38, 41).swapaxes(2, 3).reshape(2, -1, 41, 41)
    found = np.median([effective_looks((a, b), window) for a, b in tiles.swapaxes(0, 1)])
    assert expected < found < 1.7 * expected  # a few samples do not show their correlation exactly


def test_looks_of_images_without_echoes():
    nothing = np.zeros((30, 30), np.complex64)
    assert effective_looks((nothing, nothing), Window(5, 5)) == 1.0


@pytest.mark.parametrize("coherence", [0.3, 0.6, 0.9])
def test_coherence_is_unbiased_and_its_phase_as_noisy_as_predicted(coherence):
    random = np.random.default_rng(4)
    window = Window(9, 9)
    found, looks = [], []
    for _ in range(4):
        a, b = pair(random, coherence, 200, 200, 0.6)
        found.append(Moments.of(a, b, window).coherence[4:-4:5, 4:-4:5])
        looks.append(effective_looks((a, b), window))
    sample, mean_looks = np.stack(found), float(np.mean(looks))
    assert np.sqrt(np.mean(debiased(sample, mean_looks) ** 2)) == pytest.approx(coherence, abs=0.02)
    predicted = phase_sd_rad(np.array(coherence), mean_looks)
    # Low coherences with few looks have phases that are not Gaussian, and noisier.
    assert np.std(np.angle(sample)) == pytest.approx(predicted, rel=0.3 if coherence < 0.5 else 0.1)


def test_noise_exceeds_the_threshold_as_often_as_it_should():
    random = np.random.default_rng(5)
    a, b = speckle(random, 2, 400, 400)
    sample = np.abs(Moments.of(a, b, Window(5, 5)).coherence[2:-2, 2:-2])
    assert np.mean(sample > noise_coherence(25, 0.02)) == pytest.approx(0.02, rel=0.1)


def test_windows_without_echoes_have_no_coherence():
    a, b = pair(np.random.default_rng(6), 0.9, 60, 60)
    a[30:], b[30:] = 0, 0
    coherence = Moments.of(a, b, Window(5, 5)).coherence
    assert not coherence[33:].any()
    assert np.abs(coherence).max() <= 1


def test_deviations_are_bounded_by_that_of_a_uniform_phase():
    assert phase_sd_rad(np.zeros(3), 50) == pytest.approx(np.pi / np.sqrt(3))
    assert phase_sd_rad(np.ones(1), 50) == 0
