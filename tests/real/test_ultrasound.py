import subprocess
import sys

import numpy as np
import pytest
import ultrasound
from scipy.io import loadmat

import clsas

NOTCH_TIP_M = (6.75e-3, 19.6e-3)


@pytest.fixture(scope="module")
def echoes(recording):
    """The samples, read without clsas: a pair of two elements counts twice."""
    capture = loadmat(recording(ultrasound.RECORDING), simplify_cells=True)["exp_data"]
    x_m = capture["array"]["el_xc"]
    elements_m = np.stack([x_m, np.zeros_like(x_m), np.zeros_like(x_m)], axis=-1)
    tx, rx = (capture[name].astype(int) - 1 for name in ("tx", "rx"))
    time_s = capture["time"]
    return clsas.Echoes(
        capture["time_data"].T * np.where(tx == rx, 1.0, 2.0)[:, None],
        start_time_s=time_s[0],
        sample_rate_hz=(len(time_s) - 1) / (time_s[-1] - time_s[0]),
        carrier_hz=capture["array"]["centre_freq"],
        tx_m=elements_m[tx],
        rx_m=elements_m[rx],
        sound_speed_m_s=ultrasound.SOUND_SPEED_M_S,
    )


@pytest.fixture(scope="module")
def lines(recording):
    return ultrasound.range_lines(recording(ultrasound.RECORDING))


@pytest.fixture(scope="module")
def image(lines):
    return clsas.backproject(lines, ultrasound.GRID, accuracy_db=-60)


@pytest.fixture(scope="module")
def tip(image):
    return ultrasound.find_notch_tip(image)


def direct_sum(echoes, points_m):
    """The image at some points, straight from the recorded samples, in float64.

    I = sum over channels and samples of 2/fs x_n h(tau - t_n) exp(j 2 pi fc (tau - t_n)), where h
    is the inverse Fourier transform of a Hann window of mean 1 over the band B:
    h(t) = B sinc(Bt) / (1 - (Bt)^2).
    """
    band = 2 * echoes.carrier_hz
    image = np.zeros(len(points_m), complex)
    for start, tx_m, rx_m, samples in zip(
        echoes.start_time_s, echoes.tx_m, echoes.rx_m, echoes.samples, strict=True
    ):
        time = start + np.arange(echoes.length) / echoes.sample_rate_hz
        path_m = np.linalg.norm(points_m - tx_m, axis=1) + np.linalg.norm(points_m - rx_m, axis=1)
        delay = path_m / echoes.sound_speed_m_s
        u = band * (delay[:, None] - time)
        kernel = np.sinc(u) / (1 - u**2)
        mixed = samples * np.exp(-2j * np.pi * echoes.carrier_hz * time)
        image += np.exp(2j * np.pi * echoes.carrier_hz * delay) * (kernel * mixed).sum(axis=1)
    return 2 * band / echoes.sample_rate_hz * image


def pixels_about(image, x_m, depth_m):
    """Rows and columns of 5 by 5 pixels, every fourth, about a place."""
    all_x_m, all_depth_m = image.grid.axes_m
    row, column = np.argmin(np.abs(all_depth_m - depth_m)), np.argmin(np.abs(all_x_m - x_m))
    return slice(row - 8, row + 9, 4), slice(column - 8, column + 9, 4)


def test_recording_is_the_whole_matrix_with_pairs_of_two_counted_twice(recording, echoes):
    raw = loadmat(recording(ultrasound.RECORDING), simplify_cells=True)["exp_data"]
    assert echoes.channels == 64 * 65 // 2
    assert echoes.sample_rate_hz == pytest.approx(25e6)
    same = (echoes.tx_m == echoes.rx_m).all(axis=1)
    assert same.sum() == 64
    np.testing.assert_array_equal(echoes.samples[same], raw["time_data"].T[same])
    np.testing.assert_array_equal(echoes.samples[~same], 2 * raw["time_data"].T[~same])
    assert np.ptp(echoes.tx_m[:, 0]) == pytest.approx(63 * 0.3e-3)


def test_lines_are_the_compressed_samples_of_every_pair(echoes, lines):
    compressed = clsas.compress(echoes, window="hann", bandwidth_hz=2 * echoes.carrier_hz)
    np.testing.assert_allclose(lines.samples, compressed.samples, atol=1e-5)
    np.testing.assert_array_equal(lines.tx_m, echoes.tx_m)
    np.testing.assert_array_equal(lines.rx_m, echoes.rx_m)
    np.testing.assert_array_equal(lines.first_range_m, compressed.first_range_m)


def test_notch_tip_is_where_it_is(tip):
    assert tip.x_m == pytest.approx(NOTCH_TIP_M[0], abs=0.3e-3)
    assert tip.y_m == pytest.approx(NOTCH_TIP_M[1], abs=0.3e-3)


def test_notch_tip_is_as_narrow_as_the_aperture_allows(echoes, tip):
    # Transmitting and receiving, an aperture of sines of the angle S gives a pattern of sinc^2, at
    # -3 dB 0.638 lambda/S wide. The tip, a scatterer to all sides, is seen by the whole array.
    across_m = echoes.tx_m[:, 0] - NOTCH_TIP_M[0]
    sines = np.ptp(across_m / np.hypot(across_m, NOTCH_TIP_M[1]))
    width_m = 0.638 * echoes.sound_speed_m_s / echoes.carrier_hz / sines
    assert tip.azimuth.resolution_m == pytest.approx(width_m, rel=0.2)
    # In depth the Hann window alone would give 1.44 c/(2 B); the array's own band is narrower.
    depth_m = 1.44 * echoes.sound_speed_m_s / (4 * echoes.carrier_hz)
    assert depth_m < tip.range.resolution_m < 1.6 * depth_m


def test_back_wall_is_flat_and_where_it_is(image):
    depth_m = ultrasound.back_wall_depth_m(image)
    assert len(depth_m) > 50
    # The pulse is not compressed, so that depths include its own delay: 0.3 mm for 0.1 us.
    assert np.all((depth_m > 39.5e-3) & (depth_m < 41.5e-3))
    assert np.ptp(depth_m) <= 0.2e-3


@pytest.mark.slow
@pytest.mark.parametrize("place", [NOTCH_TIP_M, (0.0, 40.9e-3)], ids=["notch tip", "back wall"])
def test_image_is_the_direct_sum_of_the_recorded_samples(echoes, image, place):
    rows, columns = pixels_about(image, *place)
    points_m = image.grid.positions_m(rows, columns)
    reference = direct_sum(echoes, points_m.reshape(-1, 3)).reshape(points_m.shape[:-1])
    assert clsas.relative_error_db(image.pixels[rows, columns], reference) < -60


@pytest.mark.slow
def test_lines_still_on_their_carrier_give_the_same_image(lines, image):
    """A p(r - rho) exp(-j 2 k rho) times exp(+j 2 k r) is a line of carrier 0."""
    range_m = lines.first_range_m[:, None] + np.arange(lines.length) * lines.range_step_m
    on_carrier = clsas.RangeLines(
        lines.samples * np.exp(2j * lines.wavenumber_rad_m * range_m),
        lines.first_range_m,
        lines.range_step_m,
        lines.tx_m,
        lines.rx_m,
        carrier_hz=0.0,
        sound_speed_m_s=lines.sound_speed_m_s,
    )
    again = clsas.backproject(on_carrier, image.grid, accuracy_db=-60)
    assert clsas.relative_error_db(again, image) < -60


@pytest.mark.slow
def test_a_pair_stands_for_its_reverse(lines, image):
    """The 4096 channels of the full matrix give the image of the 2080 weighted ones."""
    both = clsas.RangeLines(
        np.concatenate([lines.samples, lines.samples]) / 2,
        np.concatenate([lines.first_range_m, lines.first_range_m]),
        lines.range_step_m,
        np.concatenate([lines.tx_m, lines.rx_m]),
        np.concatenate([lines.rx_m, lines.tx_m]),
        lines.carrier_hz,
        lines.sound_speed_m_s,
    )
    grid = image.grid.window(*pixels_about(image, *NOTCH_TIP_M))
    full, weighted = (clsas.backproject(each, grid, accuracy_db=-60) for each in (both, lines))
    assert clsas.relative_error_db(full, weighted) < -75


@pytest.mark.watches("scripts/real")
def test_program_draws_the_section_and_says_what_is_in_it(recording, tmp_path):
    pytest.importorskip("matplotlib")
    path = recording(ultrasound.RECORDING)
    done = subprocess.run(
        [sys.executable, ultrasound.__file__, path, "--out", tmp_path],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "notch tip: x = 6.7" in done.stdout
    assert (tmp_path / f"{path.stem}.png").read_bytes().startswith(b"\x89PNG")
