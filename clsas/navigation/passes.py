"""Displacements of an array between all pings, measured pass by pass until they settle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.lines import RangeLines
from clsas.navigation.advance import surge
from clsas.navigation.directions import ALL, MIDDLE
from clsas.navigation.displacement import Correlator, Displacement, displacement
from clsas.navigation.overlap import Array, Overlap, moved, overlap
from clsas.navigation.smoother import Step, integrated

LEAST_PAIRS = 3
"""Fewest pairs of channels that tell yaw from sway."""

LEAST_ECHOES = 8.0
"""Fewest independent samples with echoes that tell yaw: fewer come from too few directions."""

_LEAST_COHERENCE = 3.0  # of a window, times that of noise alone, 1/sqrt(independent samples)
_PASSES = 6  # at most, and again after a surge
_SETTLED = 0.1  # changes of the last pass, over their standard deviations
_LATER_LAGS = 4  # samples to either side that later passes look at
_SURGES = 3  # times that the advance is corrected and channels are paired anew
_LEFT = 0.75  # of the progress that a pass leaves open; most runs take 3 to 8 passes
_PROGRESS = 1000  # steps that are told
_LEAST_SURGE = 0.02  # spacings of the array, for which that is worth it


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements between pings, beside what the navigation says.

    Attributes
    ----------
    moved : float64 [pings - 1, 2]
        Sway in metres at the middle of the overlap, and yaw in radians.
    covariance : float64 [pings - 1, 2, 2]
        Of both, from the coherence.
    surge_m, surge_sd_m : float64 [pings - 1]
        Advance along the array, and its standard deviation.
    levers_m : list of (here, there)
        See `Step.over`.
    coherence : float64 [pings - 1, windows]
    misfit : float64 [pings - 1]
    scatter : float64 [pings - 1, blocks]
    echoes, lasting : float64 [pings - 1]
        See `Displacement`.
    pairs : int64 [pings - 1]
        Pairs of channels that share a phase centre.
    coherent : bool [pings - 1]
        False where no window is more coherent than noise would be.
    sparse : bool [pings - 1]
        True where echoes are coherent, but too few to tell yaw well.
    least_coherence : float64 [windows]
        What noise would not reach.
    """

    moved: NDArray[np.float64]
    covariance: NDArray[np.float64]
    surge_m: NDArray[np.float64]
    surge_sd_m: NDArray[np.float64]
    levers_m: list[tuple[float, float]]
    coherence: NDArray[np.float64]
    misfit: NDArray[np.float64]
    scatter: NDArray[np.float64]
    echoes: NDArray[np.float64]
    lasting: NDArray[np.float64]
    pairs: NDArray[np.int64]
    coherent: NDArray[np.bool_]
    sparse: NDArray[np.bool_]
    least_coherence: NDArray[np.float64]


def measured(
    lines: RangeLines,
    array: Array,
    correlator: Correlator,
    unknowns: tuple[str, ...],
    accuracy: NDArray[np.float64],
    most_step_m: float,
    progress: Callable[[int, int], None] | None,
) -> Displacements:
    """Return the displacements between all pings.

    `accuracy` holds the navigation's standard deviations of sway and yaw, [pings, 2].

    Every pass aligns the channels by all that was found before it: what is left is small, and
    linear in the displacement. Where the advance differs from the navigation's, channels are then
    paired anew.
    """
    yaw = "yaw" in unknowns
    # Without yaw the track does not turn as a whole either.
    accuracy = accuracy if yaw else accuracy * [1.0, 0.0]
    passes = _Passes(lines, array, correlator, accuracy, progress)
    passes.settle(most_step_m)
    passes.narrow()
    deviation_m = np.zeros(array.pings - 1)
    if "surge" in unknowns:
        for _ in range(_SURGES):
            found_m, deviation_m = passes.surges_m()
            passes.surge_m = passes.surge_m + found_m
            passes.settle(_LATER_LAGS * lines.range_step_m)
            if np.abs(found_m).max() <= _LEAST_SURGE * array.spacing_m:
                break
    passes.progress.finished()
    return passes.result(deviation_m)


class _Progress:
    """Progress of a work whose number of passes is not known before.

    Every pass takes the same share of what is left, so that the bar never goes back.
    """

    def __init__(self, tell: Callable[[int, int], None] | None) -> None:
        self.tell, self.left, self.told = tell, 1.0, 0

    def done(self, number: int, count: int) -> None:
        """Tell that `number` of `count` pairs of pings are done."""
        left = self.left * _LEFT ** (number / count)
        if number == count:
            self.left = left
        self._tell(int(_PROGRESS * (1 - left)))

    def finished(self) -> None:
        """Tell that no pass is left."""
        self._tell(_PROGRESS)

    def _tell(self, steps: int) -> None:
        if self.tell is not None and steps > self.told:
            self.told = steps
            self.tell(steps, _PROGRESS)


class _Passes:
    """Displacements found so far, and the next measurement of what is left."""

    def __init__(
        self,
        lines: RangeLines,
        array: Array,
        correlator: Correlator,
        accuracy: NDArray[np.float64],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.lines, self.array, self.correlator = lines, array, correlator
        self.accuracy, self.yaw = accuracy, bool(np.any(accuracy[:, 1] > 0))
        self.progress = _Progress(progress)
        count = array.pings - 1
        self.moved, self.surge_m = np.zeros((count, 2)), np.zeros(count)
        self.coherent = np.ones(count, bool)
        self.steps: list[Displacement] = []
        self.directions = ALL
        self.overlaps = self._paired(lines, array)

    def settle(self, most_m: float) -> None:
        """Measure sway and yaw until they change no more; look for steps of up to `most_m`."""
        first = not self.steps
        for _ in range(_PASSES):
            self.steps = self._steps(most_m, self.directions, first=first)
            self.coherent = np.array([self._is_coherent(step) for step in self.steps])
            changes = np.array([(step.sway_m, step.yaw_rad) for step in self.steps])
            changes[~self.coherent] = self.moved[~self.coherent] = 0.0
            self.moved = self.moved + changes
            deviations = np.stack([np.sqrt(np.diag(step.covariance)) for step in self.steps])
            first, most_m = False, _LATER_LAGS * self.lines.range_step_m
            if np.all(np.abs(changes) <= _SETTLED * deviations):
                return

    def narrow(self) -> None:
        """Use the middle of the beam alone, if that makes the displacements more certain."""
        if self.correlator.swath.element_length_m is None or not self.coherent.any():
            return
        most_m = _LATER_LAGS * self.lines.range_step_m
        steps = self._steps(most_m, MIDDLE, first=False)
        if self._variance(steps) < self._variance(self.steps):
            self.directions = MIDDLE
            self.settle(most_m)

    def _steps(self, most_m: float, directions: float, *, first: bool) -> list[Displacement]:
        """Return what is left of the displacements between all pings."""
        corrected, here = self._corrected()
        steps = []
        for ping, each in enumerate(self.overlaps):
            found = self.correlator.correlate(corrected, here, each, most_m, directions)
            steps.append(displacement(found, first=first, yaw=self.yaw))
            self.progress.done(ping + 1, len(self.overlaps))
        return steps

    def _variance(self, steps: list[Displacement]) -> float:
        """Return the mean variance of the yaws between pings, or of the sways without yaw."""
        number = 1 if self.yaw else 0
        some = [step for step, kept in zip(steps, self.coherent, strict=True) if kept]
        variance = np.mean([step.covariance[number, number] for step in some])
        return float(variance * max(np.mean([step.misfit for step in some]), 1.0))

    def surges_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the rest of every advance, and its standard deviation; 0 without coherence."""
        corrected, here = self._corrected()
        found = np.zeros((len(self.overlaps), 2))
        for ping in np.flatnonzero(self.coherent).tolist():
            pairs = overlap(corrected, here, ping, self.correlator.heard)
            if not pairs.pairs:
                sway_m, yaw_rad = self.moved[ping]
                raise ValueError(
                    f"lines must have pings that overlap once they are corrected, but {sway_m:.3g} "
                    f"m of sway and {math.degrees(yaw_rad):.3g} degrees of yaw were found between "
                    f"pings {ping} and {ping + 1}, and no phase centres overlap with these. Check "
                    f"range_step_m, {self.lines.range_step_m:g} m, and range_m"
                )
            found[ping] = surge(self.correlator, corrected, here, pairs, self.directions)
            self.progress.done(ping + 1, self.array.pings - 1)
        return found[:, 0], found[:, 1]

    def result(self, surge_sd_m: NDArray[np.float64]) -> Displacements:
        """Return what was found."""
        _, here = self._corrected()
        return Displacements(
            moved=self.moved,
            covariance=np.stack([step.covariance for step in self.steps]),
            surge_m=np.where(self.coherent, self.surge_m, 0.0),
            surge_sd_m=surge_sd_m,
            levers_m=self._levers_m(here),
            coherence=np.stack([step.coherence for step in self.steps]),
            misfit=np.array([step.misfit for step in self.steps]),
            scatter=np.stack([step.scatter for step in self.steps]),
            echoes=np.array([step.echoes for step in self.steps]),
            lasting=np.array([step.lasting for step in self.steps]),
            pairs=np.array([each.pairs for each in self.overlaps]),
            coherent=self.coherent,
            sparse=np.array([self._is_sparse(step) for step in self.steps]),
            least_coherence=self._least_coherence,
        )

    def _corrected(self) -> tuple[RangeLines, Array]:
        """Return the lines moved by all that is known, and their array; pair their channels."""
        surge_m = np.concatenate([[0.0], np.cumsum(self.surge_m)])
        none = np.zeros(self.array.pings)
        advanced = moved(self.lines, self.array, none, none, surge_m)
        there = Array.of(advanced)
        self.overlaps = self._paired(advanced, there)
        states = integrated(
            [
                Step.over(each, np.zeros((2, 2)), levers_m)
                for each, levers_m in zip(self.moved, self._levers_m(there), strict=True)
            ],
            self.accuracy,
        )
        corrected = moved(advanced, there, states[:, 0], states[:, 1], none)
        return corrected, Array.of(corrected)

    def _paired(self, lines: RangeLines, array: Array) -> list[Overlap]:
        """Return the overlaps of all pings; refuse those of too few channels."""
        heard = self.correlator.heard
        found = [overlap(lines, array, ping, heard) for ping in range(array.pings - 1)]
        fewest = int(np.argmin([each.pairs for each in found]))
        if found[fewest].pairs < LEAST_PAIRS:
            advance_m = np.linalg.norm(np.diff(array.reference_m[fewest : fewest + 2], axis=0))
            along_m = lines.phase_centres_m[array.channels(fewest)] @ array.forward[fewest]
            raise ValueError(
                f"at least {LEAST_PAIRS} phase centres must overlap from ping to ping, got "
                f"{found[fewest].pairs} between pings {fewest} and {fewest + 1}: they advance by "
                f"{advance_m:.3g} m, the phase centres extend over {np.ptp(along_m):.3g} m; "
                f"without overlap use clsas.autofocus"
            )
        return found

    def _levers_m(self, array: Array) -> list[tuple[float, float]]:
        """Return distances forward from the middles of two arrays to that of their overlap."""
        levers_m = []
        for ping, each in enumerate(self.overlaps):
            here, there = (
                float((each.pivot_m - array.reference_m[n]) @ array.forward[n])
                for n in (ping, ping + 1)
            )
            levers_m.append((here, there))
        return levers_m

    def _is_coherent(self, step: Displacement) -> bool:
        """Return whether any window is more coherent than noise would be."""
        return bool(np.any(step.coherence > self._least_coherence))

    def _is_sparse(self, step: Displacement) -> bool:
        """Return whether yaw is looked for in too few echoes."""
        return self.yaw and self._is_coherent(step) and step.echoes < LEAST_ECHOES

    @property
    def _least_coherence(self) -> NDArray[np.float64]:
        return _LEAST_COHERENCE / np.sqrt(self.correlator.independent)
