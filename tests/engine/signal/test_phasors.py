"""Phasors of real phases."""

import numpy as np

from clsas.engine.signal.phasors import phasors


def test_phasors_are_complex_exponentials():
    phase_rad = np.linspace(-50, 50, 1001, dtype=np.float32).reshape(7, 143)
    expected = np.exp(1j * phase_rad.astype(np.float64))
    found = phasors(phase_rad)
    assert found.dtype == np.complex64
    assert np.abs(found - expected).max() < 2e-7
