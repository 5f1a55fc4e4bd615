"""Fine errors of a track, from the phase steps of responses between pings.

Phase gradient autofocus (Wahl, Eichel, Ghiglia and Jakowatz 1994) takes one phase per ping. Here a
position per ping is solved for, which gives every response the phase of its own direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.core.lines import wavelength_m
from clsas.navigation.responses import Contributions, Passage

_PASSES = 6  # of alternating least squares: steps of the track, and the responses' own slopes
_TRIED = 33  # displacements of a ping within half a wavelength of path that are tried
_SWEEPS = 2  # over all pings


def phase_gradient_m(
    passage: Passage, found: Contributions, neighbourhood_m: float
) -> NDArray[np.float64]:
    """Return displacements of the pings, [unknowns, pings], that straighten responses' phases.

    Contributions are smoothed along the track so that they hold echoes within about
    `neighbourhood_m` of a response.
    """
    wave_m = wavelength_m(passage.lines)
    values = passage.by_ping(found.values[..., 0])
    counts = np.bincount(passage.ping)[:, None]
    gradient = np.stack([passage.by_ping(each) / counts for each in found.gradient])
    spacing_m = float(np.median(np.diff(passage.along_m)))
    smoothed_m = wave_m * float(np.median(found.range_m)) / (2 * neighbourhood_m)
    width = min(smoothed_m / max(spacing_m, 1e-12) / 2, passage.pings)
    smooth = gaussian_filter1d(values.real, width, axis=0, mode="constant") + 1j * (
        gaussian_filter1d(values.imag, width, axis=0, mode="constant")
    )
    product = smooth[1:] * smooth[:-1].conj()
    weights = np.abs(product)
    turns = 4 * np.pi / wave_m * (gradient[:, 1:] + gradient[:, :-1]) / 2
    slope = np.angle(product.sum(axis=0))
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


def _phase(product: NDArray[np.complex128], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.angle(product * np.exp(-1j * expected))


def sharpest_m(
    passage: Passage, found: Contributions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return displacements of the first unknown, ping by ping, that make responses sharpest.

    Sharpness is the sum of squared intensities of the responses. With all other pings held, it
    depends on one displacement only, as in closed-form backprojection autofocus (Ash 2012), where
    it depends on one phase.

    Returns
    -------
    moved_m, deviation_m : float64 [pings]
        And the standard deviation of each, from the scatter of its contributions around those of
        the other pings.
    """
    wave_m = wavelength_m(passage.lines)
    values = passage.by_ping(found.values[..., 0])
    counts = np.bincount(passage.ping)[:, None]
    turns = 4 * np.pi / wave_m * passage.by_ping(found.gradient[0]) / counts
    tried_m = wave_m * np.linspace(-0.25, 0.25, _TRIED)
    step_m = tried_m[1] - tried_m[0]
    moved_m, total = np.zeros(passage.pings), values.sum(axis=0)
    for sweep in range(_SWEEPS):
        for ping in np.random.default_rng(sweep).permutation(passage.pings):
            mine, turn = values[ping], turns[ping]
            others = total - mine * np.exp(1j * turn * moved_m[ping])
            cross = others.conj() * mine
            level = np.abs(others) ** 2 + np.abs(mine) ** 2
            angle = turn * tried_m[:, None]
            intensity = level + 2 * (cross.real * np.cos(angle) - cross.imag * np.sin(angle))
            sharpness = np.sum(intensity**2, axis=1)
            best = int(np.clip(np.argmax(sharpness), 1, _TRIED - 2))
            before, at, after = sharpness[best - 1 : best + 2]
            bend = before - 2 * at + after
            shift = np.clip(0.5 * (before - after) / bend, -1, 1) if bend < 0 else 0.0
            moved_m[ping] = tried_m[best] + shift * step_m
            total = others + mine * np.exp(1j * turn * moved_m[ping])
    turned = values * np.exp(1j * turns * moved_m[:, None])
    mean = total / np.maximum(passage.pings, 1)
    noise = np.mean(np.abs(turned - mean) ** 2, axis=1)
    information = 2 * np.sum(turns**2 * np.abs(mean) ** 2, axis=1)
    return moved_m, np.sqrt(noise / np.maximum(information, 1e-300))
