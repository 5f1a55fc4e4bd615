"""Fine errors of a track, from the phases of responses in single pings.

Phase-gradient autofocus (Wahl, Eichel, Ghiglia and Jakowatz 1994) solves for one phase per ping.
Here a position per ping is solved for instead, so that every response receives the phase of its own
direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.engine.signal.interpolation import phasors
from clsas.navigation.responses import Contributions, Passage

_PASSES = 3  # alternations between steps of the track and slopes of the responses
_TRIED = 9  # displacements tried within half a wavelength: 4 per cycle of the sharpness
_NEWTON = 3  # Newton steps from the best of them
_SWEEPS = 2  # sweeps over all pings
_DEVIATION_PER_MEDIAN = 1.4826  # standard deviation over median magnitude of normal errors
# Blocks of pings that move together. With fewer blocks, the sum over the other pings would change
# too much while a block moves.
_BLOCKS = 16


def phase_gradient_m(
    passage: Passage, found: Contributions, neighbourhood_m: float
) -> NDArray[np.float64]:
    """Return displacements of the pings, [unknowns, pings], that make phases of responses linear.

    Contributions are smoothed along the track so that only echoes within about `neighbourhood_m` of
    a response remain.
    """
    values = passage.by_ping(found.values[..., 0])
    turns = _turns(passage, found)
    spacing_m = float(np.median(np.diff(passage.along_m)))
    smoothed_m = passage.fresnel_length_m(found) ** 2 / neighbourhood_m
    width = min(smoothed_m / max(spacing_m, 1e-12) / 2, passage.pings)
    smooth = gaussian_filter1d(values, width, axis=0, mode="constant")
    product = smooth[1:] * smooth[:-1].conj()
    weights = np.abs(product).astype(np.float64)  # 1e-300 is 0 in single precision
    product = (product / np.maximum(weights, 1e-300)).astype(np.complex64)
    turns = (turns[:, 1:] + turns[:, :-1]) / 2
    slope = np.angle(np.sum(weights * product, axis=0))
    steps_m = np.zeros((len(turns), len(product)))
    normal = np.einsum("sp,usp,vsp->suv", weights, turns, turns)
    # Keeps the matrix regular where unknowns are nearly alike, or where nothing is received.
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(turns))
    normal += 1e-300 * np.eye(len(turns))
    total = np.maximum(weights.sum(axis=0), 1e-300)
    for _ in range(_PASSES):
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        slope = slope + np.sum(weights * _phase(product, expected), axis=0) / total
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        right = np.einsum("sp,usp,sp->su", weights, turns, _phase(product, expected))
        steps_m -= np.linalg.solve(normal, right[..., None])[..., 0].T
    # The steps lead from the assumed track to the true one, so that adding them corrects it.
    return np.concatenate([np.zeros((len(turns), 1)), np.cumsum(steps_m, axis=1)], axis=1)


def _phase(product: NDArray[np.complex64], expected: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the phases of `product` relative to the expected ones."""
    return np.angle(product * phasors(-expected.astype(np.float32)))


def _turns(passage: Passage, found: Contributions) -> NDArray[np.float64]:
    """Return the phase per displacement of a ping, rad/m, [unknowns, pings, points]."""
    gradient = np.stack([passage.mean_by_ping(each) for each in found.gradient])
    return 4 * np.pi / passage.wavelength_m * gradient


def sharpest_m(
    passage: Passage, found: Contributions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return displacements of single pings that maximise the sharpness of the responses.

    Sharpness is the sum of the squared intensities of the responses. If all other pings are fixed,
    it is a function of the displacement of one ping alone. In closed-form backprojection autofocus
    (Ash 2012), it is a function of one phase. With several unknowns, a ping is moved along one
    direction after another; the directions are chosen so that their effects on the responses are
    independent.

    Returns
    -------
    moved_m : float64 [unknowns, pings]
    deviation_m : float64 [pings]
        Standard deviation of the length of the displacement, from the scatter of the contributions
        of a ping around their mean over all pings.
    """
    values = passage.by_ping(found.values[..., 0])
    turns = _turns(passage, found)
    directions = _directions(turns, np.abs(values) ** 2)
    turns = np.einsum("pau,upk->apk", directions, turns).astype(np.float32)
    furthest_m = passage.wavelength_m / 4
    unknowns, pings, _ = turns.shape
    moved_m = np.zeros((unknowns, pings), np.float32)
    turned, total = values.copy(), values.sum(axis=0)
    for sweep in range(_SWEEPS):
        order = np.random.default_rng(sweep).permutation(pings)
        for some in np.array_split(order, min(_BLOCKS, pings)):
            for axis, turn in enumerate(turns[:, some]):
                others = total - turned[some]
                own = turned[some] * phasors(-turn * moved_m[axis, some, None])
                level = np.abs(others) ** 2 + np.abs(own) ** 2
                best_m = _sharpest(level, others.conj() * own, turn, furthest_m)
                own *= phasors(turn * best_m[:, None])
                total = total + np.sum(own - turned[some], axis=0)
                moved_m[axis, some], turned[some] = best_m, own
    mean = total / pings
    noise = np.mean(np.abs(turned - mean) ** 2, axis=1)
    information = 2 * np.einsum("apk,k->ap", turns**2, np.abs(mean) ** 2).astype(np.float64)
    variance = np.sum(noise / np.maximum(information, 1e-300), axis=0)
    return np.einsum("pau,ap->up", directions, moved_m), np.sqrt(variance)


def disagreement_m(passage: Passage, found: Contributions) -> float:
    """Return how much two halves of the responses disagree about the ranges of single pings.

    The responses of a scene agree because one track explains all of them. The brightest pixels of
    speckle can also be made brighter, but each by a different track. The result is the median over
    three ways to divide the responses, because a single one may put most of the bright ones into
    one half.
    """
    quarter = np.arange(found.points) % 4
    gradient = found.gradient[:, passage.lines.ping_starts]
    apart_m = []
    for other in (1, 2, 3):
        first = (quarter == 0) | (quarter == other)
        moved_m = [sharpest_m(passage, found.of(some))[0] for some in (first, ~first)]
        apart = moved_m[0] - moved_m[1]
        apart -= np.median(apart, axis=1, keepdims=True)
        # The median ignores single pings for which one half is off by half a wavelength of path.
        apart_m.append(np.median(np.abs(np.einsum("up,upk->pk", apart, gradient))))
    return float(np.median(apart_m)) * _DEVIATION_PER_MEDIAN / 2


def _directions(turns: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors of independent displacements, [pings, directions, unknowns].

    The responses are most sensitive to the first direction.
    """
    normal = np.einsum("upk,vpk,pk->puv", turns, turns, weights)
    return np.linalg.eigh(normal)[1].swapaxes(1, 2)[:, ::-1]


def _sharpest(
    level: NDArray[np.float32],
    cross: NDArray[np.complex64],
    turn: NDArray[np.float32],
    furthest_m: float,
) -> NDArray[np.float32]:
    """Return the displacements of some pings that maximise the sharpness, [pings].

    The intensity of a response is level + 2 Re(cross exp(j turn displacement)), where `level`,
    `cross` and `turn` are [pings, points].
    """
    step_m = 2 * furthest_m / (_TRIED - 1)
    rotation = phasors(turn * np.float32(step_m))
    tried = cross * phasors(-turn * np.float32(furthest_m))
    sharpness = np.empty((_TRIED, len(cross)), np.float32)
    for number in range(_TRIED):
        sharpness[number] = np.sum((level + 2 * tried.real) ** 2, axis=1)
        tried = tried * rotation
    first_m = np.float32(step_m) * np.argmax(sharpness, axis=0).astype(np.float32) - furthest_m
    moved_m = first_m.copy()
    for _ in range(_NEWTON):
        at = cross * phasors(turn * moved_m[:, None])
        intensity = level + 2 * at.real
        slope = -2 * turn * at.imag
        bend = np.sum(slope**2 - 2 * intensity * turn**2 * at.real, axis=1)
        gain = np.sum(intensity * slope, axis=1)
        # A Newton step increases the sharpness only where the curvature is negative.
        moved_m += np.where(bend < 0, -gain / np.where(bend < 0, bend, 1.0), 0.0)
        moved_m = np.clip(moved_m, first_m - step_m, first_m + step_m)
    return moved_m
