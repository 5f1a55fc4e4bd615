"""Reading range lines between their samples, and turning what was read."""

import numpy as np
import pytest
from cases import lines_over

from clsas.engine.data.fourier import phasors
from clsas.engine.data.grid import Grid
from clsas.engine.signal import interpolation
from clsas.engine.signal.interpolation import Readout


@pytest.fixture(scope="module")
def lines():
    at = np.stack([np.linspace(-1, 1, 7), np.zeros(7), np.zeros(7)], axis=1)
    grid = Grid.plane(x=(-1, 1, 20), y=(10, 12, 20))
    return lines_over(grid, at, carrier_hz=100e3, step_m=0.02, centre=0.1)


def test_samples_are_read_as_they_are(lines):
    some = np.array([1, 4, 2])
    at_m = lines.first_range_m[some, None] + lines.range_step_m * np.arange(100, 200)
    read = Readout.of(lines, -60).read(some, at_m)
    error = np.linalg.norm(read - lines.samples[some, 100:200])
    assert error <= 1e-3 * np.linalg.norm(lines.samples[some, 100:200])


def test_upsampled_lines_are_kept_only_where_they_are_small(lines, monkeypatch):
    range_m = np.random.default_rng(0).uniform(9.0, 13.0, (lines.channels, 50))
    kept = Readout.of(lines)
    read = kept.read(np.arange(lines.channels), range_m)
    assert kept._upsampled is not None
    monkeypatch.setattr(interpolation, "_READOUT_BYTES", 0)
    anew = Readout.of(lines)
    np.testing.assert_allclose(anew.read(np.arange(lines.channels), range_m), read, rtol=1e-5)
    assert anew._upsampled is None


def test_nothing_lies_beyond_the_ends(lines):
    last_m = float(lines.last_range_m[0])
    read = Readout.of(lines).read(np.array([0]), np.array([[last_m - 0.5, last_m + 1e-3, -5.0]]))
    assert read[0, 0] != 0
    assert not read[0, 1:].any()


def test_phasors_are_complex_exponentials():
    phase_rad = np.linspace(-50, 50, 1001, dtype=np.float32).reshape(7, 143)
    expected = np.exp(1j * phase_rad.astype(np.float64))
    found = phasors(phase_rad)
    assert found.dtype == np.complex64
    assert np.abs(found - expected).max() < 2e-7
