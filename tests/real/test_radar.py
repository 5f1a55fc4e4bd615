import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import radar
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.io import loadmat

import clsas

BRIGHTEST_M = (-15.6, 21.6)


@dataclass(frozen=True, eq=False)
class PhaseHistory:
    """What the radar measured, read without clsas.

    A point of amplitude A at range R of the antenna gives A exp(-j 4 pi f (R - r0)/c). The range r0
    is the antenna's distance from the origin.
    """

    echo: NDArray[np.complex64]  # [pulses, frequencies]
    frequency_hz: NDArray[np.float64]
    antenna_m: NDArray[np.float64]
    reference_range_m: NDArray[np.float64]

    @property
    def weights(self):
        """Hamming window over the frequencies, of sum 1."""
        window = np.hamming(len(self.frequency_hz))
        return window / window.sum()


def read(path):
    data = loadmat(path, simplify_cells=True)["data"]
    frequency_hz = data["freq"].astype(np.float64)
    antenna_m = np.stack([data[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    reference_range_m = np.linalg.norm(antenna_m, axis=1)
    assert np.abs(reference_range_m - data["r0"]).max() < 2e-3
    return PhaseHistory(
        echo=data["fp"].T,
        # The steps are equal; float32 rounds each frequency to 1 kHz.
        frequency_hz=np.linspace(frequency_hz[0], frequency_hz[-1], len(frequency_hz)),
        antenna_m=antenna_m,
        reference_range_m=reference_range_m,
    )


@pytest.fixture(scope="module")
def histories(recording):
    return [read(recording(name)) for name in radar.RECORDINGS]


@pytest.fixture(scope="module")
def passes(recording):
    return [radar.range_lines(recording(name)) for name in radar.RECORDINGS]


@pytest.fixture(scope="module")
def images(passes):
    """Each degree by itself."""
    return [clsas.backproject(lines, radar.GRID, accuracy_db=-60) for lines in passes]


@pytest.fixture(scope="module")
def total(passes):
    """All degrees, one after another."""
    image = None
    for lines in passes:
        image = clsas.backproject(lines, radar.GRID, accuracy_db=-60, accumulate=image)
    return image


def resolution_m(histories):
    """Widths at -3 dB along x (ground range, Hamming) and y (cross-range, rectangular), metres."""
    antenna_m = np.concatenate([history.antenna_m for history in histories])
    frequency_hz = histories[0].frequency_hz
    direction = antenna_m / np.linalg.norm(antenna_m, axis=1, keepdims=True)
    bandwidth_hz = len(frequency_hz) * (frequency_hz[1] - frequency_hz[0])
    x_m = 1.30 * speed_of_light / (2 * bandwidth_hz * direction[:, 0].mean())
    y_m = 0.886 * speed_of_light / (2 * frequency_hz.mean() * np.ptp(direction[:, 1]))
    return x_m, y_m


def direct_sum(history, points_m):
    """The image at some points, straight from the measured phase history, in float64."""
    image = np.zeros(len(points_m), complex)
    echo = history.echo * history.weights
    wavenumber = 2 * np.pi * history.frequency_hz / speed_of_light
    for antenna_m, reference_m, values in zip(
        history.antenna_m, history.reference_range_m, echo, strict=True
    ):
        range_m = np.linalg.norm(points_m - antenna_m, axis=1) - reference_m
        image += (np.exp(2j * np.outer(range_m, wavenumber)) * values).sum(axis=1)
    return image


def test_phase_history_is_of_the_track(histories):
    azimuth_deg = [np.degrees(np.arctan2(*h.antenna_m[:, 1::-1].T)) for h in histories]
    for degree, azimuth in enumerate(azimuth_deg):
        assert np.all((azimuth > degree) & (azimuth < degree + 1))
    assert [len(h.echo) for h in histories] == [117, 117, 118]
    assert histories[0].frequency_hz[[0, -1]] == pytest.approx([9.28808e9, 9.910441e9], rel=1e-7)


def test_brightest_reflector_is_where_it_is_in_every_image(histories, images, total):
    sets = [*([history] for history in histories), histories]
    for used, image in zip(sets, [*images, total], strict=True):
        point = radar.find_brightest(image)
        cell_m = resolution_m(used)
        assert point.x_m == pytest.approx(BRIGHTEST_M[0], abs=cell_m[0] / 2)
        assert point.y_m == pytest.approx(BRIGHTEST_M[1], abs=cell_m[1] / 2)


def test_brightest_reflector_is_as_sharp_as_the_theory(histories, images, total):
    sets = [*([history] for history in histories), histories]
    for used, image in zip(sets, [*images, total], strict=True):
        point = radar.find_brightest(image)
        widths_m = point.azimuth.resolution_m, point.range.resolution_m
        assert widths_m == pytest.approx(resolution_m(used), rel=0.05)


def test_cross_range_response_is_a_sinc(total):
    """Only where every pulse has its right phase has the reflector the side lobes of theory."""
    cut = radar.find_brightest(total).range
    assert cut.pslr_nearest_db == pytest.approx((-13.26, -13.26), abs=0.5)
    assert cut.islr_db == pytest.approx(-10.0, abs=0.5)


def test_a_pass_that_went_through_cphd_gives_the_same_image(passes, images, tmp_path):
    pytest.importorskip("sarkit", reason="sarkit (extra radar) is not installed")
    clsas.save(tmp_path / "pass.cphd", passes[0])
    again = clsas.load(tmp_path / "pass.cphd")
    grid = radar.GRID.window(slice(600, 800, 2), slice(250, 450, 2))
    both = (clsas.backproject(lines, grid, accuracy_db=-80) for lines in (again, passes[0]))
    assert clsas.relative_error_db(*both) < -80


def test_degrees_add_up_coherently(images, total):
    peaks = [radar.find_brightest(image).amplitude for image in images]
    assert radar.find_brightest(total).amplitude == pytest.approx(sum(peaks), rel=0.02)
    summed = sum(image.pixels.astype(np.complex128) for image in images)
    assert clsas.relative_error_db(total, summed) < -120


@pytest.mark.slow
def test_accumulated_image_is_that_of_all_pulses_at_once(histories, total):
    antenna_m = np.concatenate([h.antenna_m for h in histories])
    frequency_hz = histories[0].frequency_hz
    every = clsas.from_phase_history(
        np.concatenate([h.echo for h in histories]),
        first_frequency_hz=frequency_hz[0],
        frequency_step_hz=frequency_hz[1] - frequency_hz[0],
        reference_range_m=np.concatenate([h.reference_range_m for h in histories]),
        tx_m=antenna_m,
        rx_m=antenna_m,
        sound_speed_m_s=speed_of_light,
        window="hamming",
    )
    at_once = clsas.backproject(every.tapered_ends(1.0), radar.GRID, accuracy_db=-60)
    assert clsas.relative_error_db(total, at_once) < -60


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(708, 725, 2), slice(336, 353, 2)),
        (slice(None, None, 50), slice(None, None, 50)),
    ],
    ids=["brightest reflector", "all over the scene"],
)
def test_image_is_the_direct_sum_of_the_phase_history(histories, total, rows, columns):
    points_m = total.grid.positions_m(rows, columns)
    reference = sum(direct_sum(h, points_m.reshape(-1, 3)) for h in histories)
    reference = reference.reshape(points_m.shape[:-1])
    assert clsas.relative_error_db(total.pixels[rows, columns], reference) < -60


def test_cars_stand_out_of_the_tarmac(total):
    """Mean power of a row of parked cars over that of the empty lane beside it."""
    x_m, y_m = total.grid.axes_m

    def power(x, y):
        rows, columns = ((axis >= a) & (axis <= b) for axis, (a, b) in ((y_m, y), (x_m, x)))
        return np.mean(np.abs(total.pixels[np.ix_(rows, columns)]) ** 2)

    cars, lane = power((-32, -6), (-4, 0)), power((-32, -6), (-12, -8))
    assert 10 * np.log10(cars / lane) > 10


@pytest.mark.watches("scripts/real")
def test_program_draws_every_image_and_says_what_is_in_it(recording, tmp_path):
    pytest.importorskip("matplotlib")
    path = recording(radar.RECORDINGS[0])
    done = subprocess.run(
        [sys.executable, radar.__file__, path, "--out", tmp_path],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "x = -15.60 m, y = 21.59 m" in done.stdout
    for name in (path.stem, "radar_sum", "radar_sum_brightest"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.watches("scripts/real")
def test_program_refuses_a_recording_that_is_not_there(tmp_path):
    done = subprocess.run(
        [sys.executable, radar.__file__, tmp_path / "nowhere.mat"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "there is no recording" in done.stderr
    assert "nowhere.mat" in done.stderr
