"""Fourier integrals and smooth edges, for simulation and pulse compression."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfc

from clsas.core import validate
from clsas.core.extras import needed

# Half the width of a smooth edge in standard deviations. At its ends 6e-8 (-145 dB) remains.
_EDGE_SIGMAS = 5.3

EDGE_PRODUCT = _EDGE_SIGMAS**2 / np.pi
"""Width of a smooth edge times the extent of its Fourier transform, both down to -145 dB."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


def smooth_edge(position: ArrayLike) -> NDArray[np.float64]:
    """Return an edge that falls from 1 at position <= 0 to 0 at position >= 1.

    The edge is an integrated Gaussian and reaches both values to within 6e-8. For an edge of width
    w, the Fourier transform falls below 6e-8 at `EDGE_PRODUCT`/w.
    """
    return 0.5 * erfc(_EDGE_SIGMAS * (2 * np.asarray(position) - 1) / np.sqrt(2))


def fourier_integral(
    function: Callable[[NDArray], NDArray],
    edges: ArrayLike,
    at: ArrayLike,
    *,
    sign: int,
    rate: float,
) -> NDArray[np.complex128]:
    """Return the integral of function(u) exp(sign j 2 pi u v) over u, for every v of `at`.

    Parameters
    ----------
    function : callable
        Function of float64 [n] that returns values [n]. It must be smooth between neighbouring
        edges.
    edges : array_like, [m]
        Ends of the smooth pieces, ascending, in the unit of u.
    at : array_like
        Frequencies v, in cycles per unit of u.
    sign : int
        +1 or -1.
    rate : float
        Largest local frequency of `function` itself, in cycles per unit of u.

    Returns
    -------
    complex128 array of the shape of `at`
        Accurate to about twelve digits of the largest value.

    Notes
    -----
    The integral is a Gauss-Legendre quadrature with 16 points per panel of at most two cycles. A
    type-3 non-uniform FFT computes the sum.
    """
    with needed("simulation and pulse compression"):
        import finufft  # slow to import

    edges = np.asarray(edges, dtype=np.float64)
    at = np.asarray(at, dtype=np.float64)
    fastest = rate + np.max(np.abs(at), initial=0.0)
    validate.memory("frequency_hz", 400 * fastest * (edges[-1] - edges[0]))  # 16 points per panel
    panels = np.ceil(fastest * np.diff(edges) / 2).astype(int) + 1
    ends = np.concatenate(
        [
            np.linspace(low, high, n, endpoint=False)
            for low, high, n in zip(edges, edges[1:], panels, strict=False)
        ]
        + [edges[-1:]]
    )
    half = np.diff(ends)[:, None] / 2
    u = ((ends[:-1, None] + half) + half * _NODES).ravel()
    values = (half * _WEIGHTS).ravel() * function(u)
    # OpenMP's threads do not survive a later fork, and the child process would wait for them.
    result = finufft.nufft1d3(
        2 * np.pi * u, values.astype(np.complex128), at.ravel(), isign=sign, eps=1e-13, nthreads=1
    )
    return np.reshape(result, at.shape)
