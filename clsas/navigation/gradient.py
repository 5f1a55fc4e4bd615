"""Fine errors of a track, from the phase steps of responses between pings.

Phase gradient autofocus (Wahl, Eichel, Ghiglia and Jakowatz 1994) takes one phase per ping. Here a
position per ping is solved for, which gives every response the phase of its own direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.core.phasors import phasors
from clsas.navigation.responses import Contributions, Passage

_PASSES = 3  # of alternating least squares: steps of the track, and the responses' own slopes
_TRIED = 9  # displacements within half a wavelength: 4 per cycle of the sharpness
_NEWTON = 3  # steps from the best of them
_SWEEPS = 2  # over all pings
_DEVIATION_PER_MEDIAN = 1.4826  # of the magnitude of normal errors
_BLOCKS = 16  # of pings that are moved together: few enough to leave the sum over the others


def phase_gradient_m(
    passage: Passage, found: Contributions, neighbourhood_m: float
) -> NDArray[np.float64]:
    """Return displacements of the pings, [unknowns, pings], that straighten responses' phases.

    Contributions are smoothed along the track so that they hold echoes within about
    `neighbourhood_m` of a response.
    """
    values = passage.by_ping(found.values[..., 0])
    turns = _turns(passage, found)
    spacing_m = float(np.median(np.diff(passage.along_m)))
    smoothed_m = passage.fresnel_length_m(found) ** 2 / neighbourhood_m
    width = min(smoothed_m / max(spacing_m, 1e-12) / 2, passage.pings)
    smooth = gaussian_filter1d(values, width, axis=0, mode="constant")
    product = smooth[1:] * smooth[:-1].conj()
    weights = np.abs(product).astype(np.float64)  # of which 1e-300 is no zero
    product = (product / np.maximum(weights, 1e-300)).astype(np.complex64)
    turns = (turns[:, 1:] + turns[:, :-1]) / 2
    slope = np.angle(np.sum(weights * product, axis=0))
    steps_m = np.zeros((len(turns), len(product)))
    normal = np.einsum("sp,usp,vsp->suv", weights, turns, turns)
    # Keeps the matrix regular where unknowns are much alike, or where nothing is received at all.
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(turns))
    normal += 1e-300 * np.eye(len(turns))
    total = np.maximum(weights.sum(axis=0), 1e-300)
    for _ in range(_PASSES):
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        slope = slope + np.sum(weights * _phase(product, expected), axis=0) / total
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        right = np.einsum("sp,usp,sp->su", weights, turns, _phase(product, expected))
        steps_m -= np.linalg.solve(normal, right[..., None])[..., 0].T
    # The steps are the error's; they are taken back.
    return np.concatenate([np.zeros((len(turns), 1)), np.cumsum(steps_m, axis=1)], axis=1)


def _phase(product: NDArray[np.complex64], expected: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.angle(product * phasors(-expected.astype(np.float32)))


def _turns(passage: Passage, found: Contributions) -> NDArray[np.float64]:
    """Return the phase per displacement of a ping, rad/m, [unknowns, pings, points]."""
    counts = np.bincount(passage.ping)[:, None]
    gradient = np.stack([passage.by_ping(each) / counts for each in found.gradient])
    return 4 * np.pi / passage.wavelength_m * gradient


def sharpest_m(
    passage: Passage, found: Contributions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return displacements of single pings that make responses sharpest.

    Sharpness is the sum of squared intensities of the responses. With all other pings held, it
    depends on the displacement of one ping only, as in closed-form backprojection autofocus (Ash
    2012), where it depends on one phase. With several unknowns a ping is moved along one direction
    after another, chosen so that responses see it move independently along each.

    Returns
    -------
    moved_m : float64 [unknowns, pings]
    deviation_m : float64 [pings]
        Standard deviation of the displacement's length, from the scatter of a ping's contributions
        around those of the others.
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
                mine = turned[some] * phasors(-turn * moved_m[axis, some, None])
                level = np.abs(others) ** 2 + np.abs(mine) ** 2
                best_m = _sharpest(level, others.conj() * mine, turn, furthest_m)
                mine *= phasors(turn * best_m[:, None])
                total = total + np.sum(mine - turned[some], axis=0)
                moved_m[axis, some], turned[some] = best_m, mine
    mean = total / pings
    noise = np.mean(np.abs(turned - mean) ** 2, axis=1)
    information = 2 * np.einsum("apk,k->ap", turns**2, np.abs(mean) ** 2).astype(np.float64)
    variance = np.sum(noise / np.maximum(information, 1e-300), axis=0)
    return np.einsum("pau,ap->up", directions, moved_m), np.sqrt(variance)


def disagreement_m(passage: Passage, found: Contributions) -> float:
    """Return how far apart in range two halves of the responses want single pings, metres.

    Responses of a scene agree, as they all see the one track. Brightest pixels of speckle can be
    made brighter, but every one in its own way. It is a median over ways to halve them: a single
    one may put most of the bright ones into one half.
    """
    quarter = np.arange(found.points) % 4
    gradient = found.gradient[:, passage.lines.ping_starts]
    apart_m = []
    for other in (1, 2, 3):
        first = (quarter == 0) | (quarter == other)
        moved_m = [sharpest_m(passage, found.of(some))[0] for some in (first, ~first)]
        apart = moved_m[0] - moved_m[1]
        apart -= np.median(apart, axis=1, keepdims=True)
        # This median passes over single pings that one half puts half a wavelength of path off.
        apart_m.append(np.median(np.abs(np.einsum("up,upk->pk", apart, gradient))))
    return float(np.median(apart_m)) * _DEVIATION_PER_MEDIAN / 2


def _directions(turns: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors of independent displacements, [pings, directions, unknowns].

    Responses see most of the first one.
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

    The intensity of a response is level + 2 Re(cross exp(j turn displacement)); `level`, `cross`
    and `turn` are [pings, points].
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
        # Only where the sharpness is curved downwards does Newton's step lead up.
        moved_m += np.where(bend < 0, -gain / np.where(bend < 0, bend, 1.0), 0.0)
        moved_m = np.clip(moved_m, first_m - step_m, first_m + step_m)
    return moved_m
