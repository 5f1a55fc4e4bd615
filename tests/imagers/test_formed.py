"""What images say of how they were formed."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

import clsas
from clsas.engine.data.digests import samples_digest

TRACK_M = np.outer(np.arange(64), [0.02, 0, 0])
LINES = clsas.simulate_lines(
    TRACK_M, TRACK_M, clsas.PointTargets([[0.6, 20, 0]]), carrier_hz=100e3, bandwidth_hz=20e3
)
GRID = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
BEAM = clsas.BeamWindow(20, "hann")
SILENT = replace(LINES, samples=np.zeros_like(LINES.samples))


@pytest.fixture(scope="module")
def plan():
    return clsas.plan(LINES, GRID, tolerance_db=-40, depth=1, beam=BEAM)


def test_a_factorized_image_names_its_plan(plan):
    formed = clsas.factorize(LINES, GRID, plan).formed
    assert (formed.method, formed.tolerance_db) == ("factorized", -40)
    assert formed.predicted_error_db == plan.predicted_error_db
    assert formed.beam is BEAM
    assert formed.left_out == plan.left_out
    assert formed.device == plan.prediction.device
    assert formed.version == clsas.__version__
    side = plan.sides[0][0]
    assert f"subimages of {side} x" in formed.plan
    assert f"{plan.factorization.final.taps} taps at the end" in formed.plan


def test_an_exact_image_names_its_interpolation():
    formed = clsas.backproject(LINES, GRID, accuracy_db=-50).formed
    assert (formed.method, formed.tolerance_db, formed.beam) == ("exact", -50, None)
    assert formed.predicted_error_db <= -50
    fixed = clsas.backproject(LINES, GRID, taps=4, upsampling=2).formed
    assert fixed.tolerance_db is None
    assert fixed.plan == "4 taps on lines upsampled 2 times"
    # The plan of an exact image forms one.
    planned = clsas.factorize(LINES, GRID, -40).formed
    assert (planned.method, planned.tolerance_db) == ("exact", -40)


def test_a_wavenumber_image_names_its_beam():
    formed = clsas.wavenumber(LINES, GRID, beam=BEAM).formed
    assert (formed.method, formed.beam) == ("wavenumber", BEAM)
    assert formed.tolerance_db is formed.predicted_error_db is None


def test_silence_has_no_relative_error():
    assert clsas.backproject(SILENT, GRID).formed.predicted_error_db is None


def test_sums_are_not_one_image(plan):
    image = clsas.backproject(LINES, GRID)
    assert clsas.backproject(LINES, GRID, accumulate=image).formed is None


def test_images_of_the_same_lines_have_the_same_digest(plan):
    images = [
        clsas.factorize(LINES, GRID, plan),
        clsas.backproject(LINES, GRID),
        clsas.wavenumber(LINES, GRID),
        clsas.Imager(SILENT, GRID, accuracy_db=-40)(LINES),
    ]
    assert len({image.formed.lines_digest for image in images}) == 1


@pytest.mark.parametrize(
    "other",
    [
        replace(LINES, samples=-LINES.samples),
        replace(LINES, samples=LINES.samples[::-1]),
        replace(LINES, first_range_m=LINES.first_range_m + 1e-6),
        LINES.select(np.arange(63)),
    ],
)
def test_other_lines_have_another_digest(other):
    assert samples_digest(other) != samples_digest(LINES)


@pytest.mark.parametrize("shape", [(7, 4096), (300, 1000), (1000, 64), (1, 100_000)])
def test_the_digest_covers_samples_of_every_range_and_channel(shape):
    channels, length = shape
    silent = replace(LINES.select(np.zeros(channels, int)), samples=np.zeros(shape, np.complex64))
    # Neighbours of every sample that counts: a block of this size contains at least one.
    side = -(-channels * length // 2048)
    for first in np.linspace(0, channels * length - side, 5).astype(int):
        samples = np.zeros(shape, np.complex64)
        samples.reshape(-1)[first : first + side] = 1
        assert samples_digest(replace(silent, samples=samples)) != samples_digest(silent)
    if channels > 100:  # an echo at one range of all channels
        for column in (0, length // 3, length - 1):
            samples = np.zeros(shape, np.complex64)
            samples[:, column] = 1
            assert samples_digest(replace(silent, samples=samples)) != samples_digest(silent)


def test_files_keep_it(tmp_path):
    image = clsas.backproject(LINES, GRID, beam=BEAM)
    clsas.save(tmp_path / "image.h5", image)
    loaded = clsas.load(tmp_path / "image.h5").formed
    assert repr(loaded) == repr(image.formed)
    assert isinstance(loaded.beam, clsas.BeamWindow)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("method", "guessed", "method must be one of 'exact'"),
        ("method", 3, "method must be one of 'exact'"),
        ("plan", 1.5, "plan must be text, got 1.5"),
        ("left_out", "relief", "left_out must be names of effects"),
        ("tolerance_db", "much", "tolerance_db must be one real number in dB"),
        ("lines_digest", None, "lacks lines_digest of the formed"),
    ],
)
def test_damaged_files_are_refused(name, value, message, tmp_path):
    clsas.save(tmp_path / "image.h5", clsas.backproject(LINES, GRID))
    with h5py.File(tmp_path / "image.h5", "r+") as file:
        del file["formed"].attrs[name]
        if value is not None:
            file["formed"].attrs[name] = value
    with pytest.raises(clsas.FileFormatError, match=message):
        clsas.load(tmp_path / "image.h5")


def test_the_description_is_one_line():
    described = clsas.backproject(LINES, GRID, accuracy_db=-50, beam=BEAM).formed.describe()
    assert described.startswith("exact, tolerance -50 dB, predicted error -5")
    assert "width 20 deg" in described
    assert "\n" not in described
