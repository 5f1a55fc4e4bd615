"""Path lengths between transmitter, point and receiver, from which all ranges are computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data.validate import ArgumentError

SAME_PLACE_M = 1e-9
"""Distance up to which two points count as one, between which there is no direction."""

STRAIGHT = 0.1
"""Width of a track over its length up to which the track counts as straight."""


def course(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector, of either sign, along which positions extend farthest."""
    return np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=False)[2][0]


def unit_vectors(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors [..., 3] scaled to length 1; below `SAME_PLACE_M` they stay shorter."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), SAME_PLACE_M)


def legs_m(
    points_m: ArrayLike,
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    rx_velocity_m_s: ArrayLike | None = None,
    sound_speed_m_s: float | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the path lengths from transmitter to point and from point to receiver.

    Parameters
    ----------
    points_m, tx_m, rx_m : array_like, [..., 3]
        Positions, metres; leading axes broadcast. The receiver's position is that at transmission.
    rx_velocity_m_s : array_like, [..., 3], optional
        Velocity of the receiver while the sound travels, metres per second. None means
        stop-and-hop.
    sound_speed_m_s : float, optional
        Speed of sound, metres per second. Required with a velocity.

    Returns
    -------
    out_m, back_m : float64 arrays, [...]
        Path lengths, metres.

    Raises
    ------
    ValueError
        If a velocity is given without a sound speed or is not below it, or if a last axis does not
        have length 3.

    Notes
    -----
    When the sound reaches the point, the receiver has moved to rx + b R, with R the outward path
    length and b = v/c. With d = x - rx - b R, the return path length l satisfies |d - b l| = l, or
    (1 - b.b) l^2 + 2 (d.b) l - d.d = 0. The formula for its positive root is free of cancellation
    for speeds far below the sound speed, and equals |x - rx| exactly at rest.
    """
    points, tx, rx = (
        _vectors(name, value)
        for name, value in (("points_m", points_m), ("tx_m", tx_m), ("rx_m", rx_m))
    )
    out = _norm(points - tx)
    if rx_velocity_m_s is None:
        return out, np.broadcast_to(_norm(points - rx), out.shape)
    if sound_speed_m_s is None:
        raise ArgumentError("sound_speed_m_s", "be given with `rx_velocity_m_s`")
    beta = _vectors("rx_velocity_m_s", rx_velocity_m_s) / sound_speed_m_s
    beta2 = _dot(beta, beta)
    if not np.all(beta2 < 1):
        raise ArgumentError(
            "rx_velocity_m_s",
            f"be slower than sound ({sound_speed_m_s:g} m/s)",
            f"{sound_speed_m_s * np.sqrt(np.max(beta2)):g} m/s",
        )
    offset = points - rx - beta * out[..., None]
    along = _dot(offset, beta)
    back = (np.sqrt(along**2 + (1 - beta2) * _dot(offset, offset)) - along) / (1 - beta2)
    return out, back


def bistatic_range_m(
    points_m: ArrayLike,
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    rx_velocity_m_s: ArrayLike | None = None,
    sound_speed_m_s: float | None = None,
) -> NDArray[np.float64]:
    """Return the range, half the two-way path: rho = (|x - tx| + |x - rx|)/2, metres.

    The two-way delay is 2 rho/c. Parameters, exceptions and the treatment of motion during flight
    are those of `legs_m`. The result is float64 with the broadcast leading shape.
    """
    out, back = legs_m(points_m, tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s)
    return 0.5 * (out + back)


def pairwise_range_m(
    points_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    rx_velocity_m_s: NDArray[np.float64] | None = None,
    sound_speed_m_s: float | None = None,
) -> NDArray[np.float64]:
    """Return `bistatic_range_m` for every pair of a point and a channel, [points, channels].

    Points have the shape [points, 3], positions and velocities of channels [channels, 3]. For
    receivers at rest no intermediate array of shape [points, channels, 3] is needed.
    """
    if rx_velocity_m_s is not None:
        return bistatic_range_m(points_m[:, None], tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s)
    range_m = cdist(points_m, tx_m)
    if not np.array_equal(tx_m, rx_m):
        range_m += cdist(points_m, rx_m)
        range_m *= 0.5
    return range_m


def _vectors(name: str, value: ArrayLike) -> NDArray[np.float64]:
    vectors = np.asarray(value, dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ArgumentError(name, "have shape (..., 3)", str(vectors.shape))
    return vectors


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.einsum("...i,...i", a, b)


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(_dot(vectors, vectors))
