"""Oracle: analytic echoes and their ideal image in float64, against which imagers are tested.

This module shares no code with the library and imports only NumPy. An echo is an analytic function
of range. Its samples form the range lines, and its value at the range of a pixel contributes to the
ideal image. No sample is interpolated and no spectrum is measured.

Frequencies are in cycles per metre of range: f hertz correspond to 2 f / c, because range is half
the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_ITERATIONS = 16  # each multiplies the error of a delay by |velocity| / speed, at most 1/20


@dataclass(frozen=True)
class Band:
    """Part of a pulse's spectrum: flat or tilted over a width, with Gaussian edges.

    Attributes
    ----------
    centre, width : float
        Centre and width, cycles per metre of range. The centre includes the carrier. A width of 0
        gives a tone with a Gaussian envelope.
    edge : float
        Standard deviation of the edges, cycles per metre. The pulse decays like a Gaussian with a
        standard deviation of 1 / (2 pi edge) metres.
    level : complex
        Value of the pulse at its peak, before the tilt.
    tilt_db : float
        Rise of the spectrum over the width, dB.
    """

    centre: float | NDArray[np.float64]
    width: float
    edge: float
    level: complex = 1.0
    tilt_db: float = 0.0


@dataclass(frozen=True)
class Echo:
    """One pulse, received by every channel from one or more ranges.

    Attributes
    ----------
    range_m : array_like of float, shape [channels, echoes]
        Ranges of the peaks.
    amplitude : array_like of complex, broadcasts with [channels, echoes]
    bands : sequence of Band
        Bands whose sum is the spectrum of the pulse. Their centres may have shape [channels, 1].
    """

    range_m: NDArray[np.float64]
    amplitude: ArrayLike
    bands: Sequence[Band]


def ranges_m(
    points_m: ArrayLike,
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    speed_m_s: float = 1.0,
    rx_velocity_m_s: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return half the path from transmitter to point to receiver, metres [channels, points].

    `rx_m` are the positions of the receivers at the time of transmission. If they move, the delay
    tau is found by iterating c tau = |x - tx| + |x - rx - v tau|.
    """
    points = np.reshape(points_m, (1, -1, 3)).astype(np.float64)
    tx, rx, velocity = (
        np.reshape(np.asarray(each, np.float64) * np.ones(3), (-1, 1, 3))
        for each in (tx_m, rx_m, rx_velocity_m_s)
    )
    outward = np.linalg.norm(points - tx, axis=-1)
    delay_s = np.zeros(np.broadcast_shapes(outward.shape, (len(rx), 1)))
    for _ in range(_ITERATIONS if velocity.any() else 1):
        moved = (points - rx) - velocity * delay_s[..., None]
        delay_s = (outward + np.linalg.norm(moved, axis=-1)) / speed_m_s
    return speed_m_s * delay_s / 2


def pulse(offset_m: ArrayLike, bands: Sequence[Band]) -> NDArray[np.complex128]:
    """Return the value of a pulse at given ranges from its peak, including the carrier.

    The transform of a box is a sinc, which Gaussian edges multiply by a Gaussian. Multiplying the
    spectrum by exp(a f) gives the pulse at the complex range r - j a / (2 pi).
    """
    offset = np.asarray(offset_m, np.float64)
    total = np.zeros(offset.shape, np.complex128)
    for band in bands:
        growth = np.log(10) / 20 * band.tilt_db / band.width if band.tilt_db else 0.0
        shifted = offset - 1j * growth / (2 * np.pi) if growth else offset
        envelope = np.sinc(band.width * shifted) * np.exp(-2 * (np.pi * band.edge * shifted) ** 2)
        total += band.level * envelope * np.exp(2j * np.pi * band.centre * offset)
    return total


def samples(
    echoes: Sequence[Echo],
    first_range_m: ArrayLike,
    range_step_m: float,
    length: int,
    carrier_cycles_per_m: float,
) -> NDArray[np.complex128]:
    """Return range lines of echoes after mixing out the carrier, [channels, length].

    A pulse u(r - rho) is received as u(r - rho) exp(-j 2 pi K r) at range r, with K the carrier.
    """
    channels = len(echoes[0].range_m)
    first = np.broadcast_to(np.asarray(first_range_m, np.float64), (channels,))
    at_m = first[:, None] + range_step_m * np.arange(length)
    return received(echoes, at_m) * np.exp(-2j * np.pi * carrier_cycles_per_m * at_m)


def image(
    echoes: Sequence[Echo], range_m: NDArray[np.float64], weights: ArrayLike = 1.0
) -> NDArray[np.complex128]:
    """Return the ideal image, the weighted sum over channels, at ranges [channels, pixels].

    The carrier needs no correction: restoring its phase, exp(+j 2 pi K rho), cancels the mixing in
    `samples`.
    """
    return np.sum(np.asarray(weights) * received(echoes, range_m), axis=0)


def received(echoes: Sequence[Echo], at_m: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return what every channel receives from ranges [channels, n], including the carrier."""
    total = np.zeros(at_m.shape, np.complex128)
    for echo in echoes:
        amplitude = np.broadcast_to(echo.amplitude, np.shape(echo.range_m))
        for number in range(amplitude.shape[1]):
            offset = at_m - echo.range_m[:, number, None]
            total += amplitude[:, number, None] * pulse(offset, echo.bands)
    return total


def error_db(pixels: ArrayLike, ideal: ArrayLike) -> float:
    """Return the relative rms error of an image, dB."""
    ideal = np.ravel(ideal)
    difference = np.ravel(pixels).astype(np.complex128) - ideal
    return float(20 * np.log10(np.linalg.norm(difference) / np.linalg.norm(ideal) + 1e-300))
