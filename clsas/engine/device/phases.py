"""Polynomials for the sine and cosine of a phase, as short as the error of an image allows."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

TERMS = (4, 5, 6)
"""Numbers of terms that are available. Their relative rms errors are -61, -92 and -126 dB."""
PRECISE_TERMS = 7
"""Number of terms with which the error is that of single precision. It is used for phases on which
several parts of an image depend: those of upsampling and of stages."""

FACTORIZED_SHARE, EXACT_SHARE = 0.03, 0.08
"""Shares of the error power of an image that polynomials may add. Exact images may have the larger
one, because the errors of their many channels average out."""

_PHASES = (np.arange(2000) + 0.5) / 2000 - 0.5  # cycles


@functools.cache
def polynomials(terms: int) -> NDArray[np.float32]:
    """Return the coefficients for sine and cosine, float32 [2, terms], highest power first.

    They are least-squares fits of sin(2 pi r)/r and cos(2 pi r) by powers of r^2, where r is the
    phase in cycles, from -0.5 to 0.5.
    """
    powers = _powers(terms)
    sine = np.linalg.lstsq(_PHASES[:, None] * powers, np.sin(2 * np.pi * _PHASES), rcond=None)[0]
    cosine = np.linalg.lstsq(powers, np.cos(2 * np.pi * _PHASES), rcond=None)[0]
    return np.stack([sine, cosine]).astype(np.float32)


@functools.cache
def error(terms: int) -> float:
    """Return the relative rms error of exp(j 2 pi r)."""
    sine, cosine = polynomials(terms).astype(np.float64) @ _powers(terms).T
    found = cosine + 1j * _PHASES * sine
    return float(np.sqrt(np.mean(np.abs(found - np.exp(2j * np.pi * _PHASES)) ** 2)))


def terms_within(error_db: float, share: float) -> int:
    """Return the number of terms for an image with a given relative rms error, dB.

    `share` is the share of the error power that the polynomials may add.
    """
    most = np.sqrt(share) * 10 ** (error_db / 20)
    return next((terms for terms in TERMS if error(terms) <= most), TERMS[-1])


def _powers(terms: int) -> NDArray[np.float64]:
    return (_PHASES**2)[:, None] ** np.arange(terms)[::-1]
