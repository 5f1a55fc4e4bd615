"""First heights of a seabed: where along curves of equal range the two banks agree.

Every curve of equal range (`clsas.interferometry.curves`) shows the same speckle at all heights, so
its coherence is largest at the height of the scatterers: there the phase is zero, and the ranges of
both banks agree to a fraction of the resolution. On horizontal planes, by contrast, a wrong height
shows the speckle of another place, which may be brighter and therefore more coherent.

The phase repeats with the height of ambiguity, and the magnitude of the coherence falls so slowly
that a window of tens of looks may not tell the cycles apart. So the heights at which the phase is
zero are candidates, and a larger window decides between them: for every height, the largest
coherence within half a height of ambiguity is averaged over that window. The relief may therefore
vary by most of a height of ambiguity within the large window, and the resolution of heights remains
that of the small one. Nothing is unwrapped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from clsas.engine.data import validate
from clsas.engine.data.threads import in_threads
from clsas.interferometry.coherence import Window
from clsas.interferometry.curves import CurveImages

STEPS_PER_CYCLE = 6
"""Heights per height of ambiguity. 4 and 8 give the same rms errors on the dunes and on the tall
relief of tests/interferometry, to 1 % where the relief is several heights of ambiguity high."""

_CANDIDATE_RAD = (
    1.3 * math.pi / STEPS_PER_CYCLE
)  # phase at the height nearest to a zero, and margin


@dataclass(frozen=True, eq=False)
class Sweep:
    """Most likely height of the scatterers on every curve.

    Attributes
    ----------
    height_m : float64 [rows, columns]
        Height above the plane of the curves.
    coherence : float64 [rows, columns]
        Magnitude of the sample coherence at the height.
    profile : float64 [heights]
        Mean square of the coherence of all curves at every height, weighted by that at their most
        likely height.
    """

    height_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    profile: NDArray[np.float64]


def sweep(
    images: CurveImages,
    start_m: NDArray[np.float64],
    offset_m: NDArray[np.float64],
    window: Window,
    coarse: Window,
    progress: Callable[[int], None],
) -> Sweep:
    """Return the most likely height on every curve, from heights relative to those where it starts.

    Large windows decide between cycles of the phase.
    """
    coherence = np.empty((len(offset_m), *images.first.shape), np.complex64)
    start = start_m if np.ptp(start_m) > 0 else float(start_m[0, 0])  # a number is faster

    def seen(height_m: float) -> NDArray[np.complexfloating]:
        return images.products(start + height_m).within(window).coherence

    for number, found in enumerate(in_threads(seen, offset_m)):
        coherence[number] = found
        progress(number + 1)
    best = likeliest(coherence, coarse)
    found = np.take_along_axis(coherence, best[None], axis=0)[0].astype(np.complex128)
    height_m = start_m + offset_m[best]
    height_m = height_m - np.angle(found) / images.curves.rad_m(height_m)
    weight = np.abs(found) ** 2
    profile = np.array([np.vdot(weight, np.abs(each) ** 2) for each in coherence])
    return Sweep(height_m, np.abs(found), profile / max(float(weight.sum()), 1e-9))


def likeliest(coherence: NDArray[np.complex64], coarse: Window) -> NDArray[np.intp]:
    """Return the index of the most likely height for every pixel, [rows, columns].

    The coherence in small windows is given at `STEPS_PER_CYCLE` heights per cycle of the phase.
    Large windows decide between cycles.
    """
    magnitude = np.abs(coherence)
    candidate = np.abs(np.angle(coherence)) <= _CANDIDATE_RAD
    score = np.where(candidate, magnitude, coherence.real)
    cycle = maximum_filter1d(score, STEPS_PER_CYCLE + 1, axis=0, mode="nearest")
    support = coarse.sums(cycle) / (coarse.pixels * coarse.fullness(score.shape[1:]))
    # Where two neighbouring heights are candidates of the same cycle, the closer one counts.
    return np.where(candidate, support + 1e-3 * coherence.real, -1).argmax(axis=0)


def end_of(found: Sweep) -> str | None:
    """Return the end of the search at which the banks agree best; one height beyond was imaged."""
    best = int(found.profile.argmax())
    if 0 < best < len(found.profile) - 1:
        return None
    return "lower" if best == 0 else "upper"


BEYOND = {"lower": "below", "upper": "above"}
"""Where the seabed seems to lie if the banks agree best at an end of the search."""


class Doubts(NamedTuple):
    """Signs that cycles of the phase may be wrong.

    The phase cannot show that the seabed lies outside the search, but the magnitude of the
    coherence falls with the distance from the seabed. Averaged over an image, it does so clearly,
    even within a sixth of a cycle.

    Attributes
    ----------
    end : {"lower", "upper"} or None
        End of the search at which the banks agree best.
    large_m : float or None
        Side of the windows that decide between cycles, metres, if the grid is smaller.
    ambiguity_m : float
        Height of ambiguity.
    """

    end: str | None
    large_m: float | None
    ambiguity_m: float

    def warn(self) -> None:
        """Warn of each."""
        if self.large_m is not None:
            validate.warn(
                f"`grid` is smaller than the windows of {self.large_m:.2g} m that tell heights "
                f"apart which differ by the height of ambiguity, {self.ambiguity_m:.3g} m, where "
                "the coherence is low: make the grid larger or `search_m` smaller"
            )
        if self.end is not None:
            beyond = BEYOND[self.end]
            validate.warn(
                f"`search_m` may not contain the seabed: the banks agree best at its {self.end} "
                f"end, so that most of the seabed seems to lie {beyond} it. Heights may be wrong "
                f"by multiples of the height of ambiguity, {self.ambiguity_m:.3g} m: search "
                f"farther {beyond}"
            )


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights of places above a plane.

    Attributes
    ----------
    height_m : float64 [rows, columns]
        The only or the highest surface; NaN where there is none.
    surfaces : int [rows, columns]
        Number of surfaces: 0 in shadow and where images are not coherent, several in layover.
    """

    height_m: NDArray[np.float64]
    surfaces: NDArray[np.int64]


def relief_of(
    moved: NDArray[np.float64],
    height_m: NDArray[np.float64],
    reliable: NDArray[np.bool_],
    ambiguity_m: float,
) -> Relief:
    """Return the heights of places, from those of the scatterers on curves.

    Neighbouring reliable curves across the track form a surface between the places to which they
    have moved, unless their heights differ by more than half a height of ambiguity. A place lies on
    none in shadow, and on several in layover.
    """
    rows, columns = height_m.shape
    place = np.arange(rows)[:, None] + moved[0]
    column = np.clip(np.arange(columns) + np.rint(moved[1]), 0, columns - 1).astype(int)[:-1]
    near, far = place[:-1], place[1:]
    one = reliable[:-1] & reliable[1:] & (np.abs(np.diff(height_m, axis=0)) < ambiguity_m / 2)
    first, last = (np.ceil(edge(near, far)).astype(int) for edge in (np.minimum, np.maximum))
    first, last = np.maximum(first, 0), np.minimum(last, rows)
    found_m, surfaces = np.full((rows, columns), -np.inf), np.zeros((rows, columns), int)
    for step in range(int((last - first)[one].max(initial=0))):
        some = np.nonzero(one & (first + step < last))
        row = first[some] + step
        share = (row - near[some]) / (far - near)[some]
        at = row, column[some]
        np.add.at(surfaces, at, 1)
        np.maximum.at(found_m, at, height_m[some] + share * (height_m[1:][some] - height_m[some]))
    return Relief(np.where(surfaces > 0, found_m, np.nan), surfaces)
