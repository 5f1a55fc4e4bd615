"""Displacements of an array between all pings, measured in several passes until they settle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.navigation.advance import surge
from clsas.navigation.correlation import Correlator
from clsas.navigation.directions import ALL, MIDDLE
from clsas.navigation.displacement import Displacement, displacement
from clsas.navigation.overlap import Array, Overlap, moved, overlap
from clsas.navigation.pair_geometry import PairGeometry
from clsas.navigation.smoother import Step, integrated

LEAST_PAIRS = 3
"""Fewest pairs of channels from which yaw and sway can both be measured."""

LEAST_ECHOES = 8.0
"""Fewest independent samples with echoes from which yaw can be measured. Fewer echoes come from too
few directions."""

# Coherence that a window needs, over that of noise alone, 1/sqrt(independent samples).
_LEAST_COHERENCE = 3.0
_PASSES = 6  # most passes, at the start and again after each correction of the advance
_SETTLED = 0.1  # largest change in the last pass, in standard deviations
_LATER_LAGS = 4  # samples to either side that later passes search
_SURGES = 3  # most corrections of the advance, after which channels are paired anew
_LEAST_SURGE = 0.02  # spacings of the array; smaller corrections end the search
_LEFT = 0.75  # share of the remaining progress that a pass leaves; most runs take 3 to 8 passes
_PROGRESS = 1000  # steps of the progress that is reported


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements between consecutive pings, relative to the navigation.

    Attributes
    ----------
    moved : float64 [pings - 1, 2]
        Sway (m) at the middle of the overlap, and yaw (rad).
    covariance : float64 [pings - 1, 2, 2]
        Covariances of sway and yaw, from the coherence.
    surge_m, surge_sd_m : float64 [pings - 1]
        Advance along the array, and its standard deviation.
    levers_m : list of (first, second)
        See `Step.over`.
    coherence : float64 [pings - 1, windows]
    misfit : float64 [pings - 1]
    scatter : float64 [pings - 1, blocks]
    echoes, lasting : float64 [pings - 1]
        See `Displacement`.
    pairs : int64 [pings - 1]
        Number of pairs of channels that share a phase centre.
    coherent : bool [pings - 1]
        False where no window is more coherent than noise.
    sparse : bool [pings - 1]
        True where the echoes are coherent, but too few to measure yaw well.
    least_coherence : float64 [windows]
        Coherence that noise does not reach.
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
    array: Array,
    correlator: Correlator,
    unknowns: tuple[str, ...],
    accuracy: NDArray[np.float64],
    most_step_m: float,
    progress: Callable[[int, int], None] | None,
) -> Displacements:
    """Return the displacements between all pings of the correlator's lines.

    Each pass aligns the channels with everything found so far, so that the rest is small and linear
    in the displacement. If the advance differs from the navigation, channels are then paired anew.
    `accuracy` holds the standard deviations of the navigation's sway and yaw, [pings, 2].
    """
    yaw = "yaw" in unknowns
    # If yaw is not measured, the track as a whole does not turn either.
    accuracy = accuracy if yaw else accuracy * [1.0, 0.0]
    passes = _Passes(array, correlator, accuracy, progress)
    passes.settle(most_step_m)
    passes.narrow()
    deviation_m = np.zeros(array.pings - 1)
    if "surge" in unknowns:
        for _ in range(_SURGES):
            found_m, deviation_m = passes.surges_m()
            passes.surge_m = passes.surge_m + found_m
            passes.settle(passes.later_m)
            if np.abs(found_m).max() <= _LEAST_SURGE * array.spacing_m:
                break
    passes.progress.finished()
    return passes.result(deviation_m)


class _Progress:
    """Progress of work whose number of passes is not known in advance.

    Every pass takes the same share of what is left, so that the progress never decreases.
    """

    def __init__(self, callback: Callable[[int, int], None] | None) -> None:
        self.callback, self.left, self.reported = callback, 1.0, 0

    def done(self, number: int, count: int) -> None:
        """Report that a pass has finished `number` of `count` pairs of pings."""
        left = self.left * _LEFT ** (number / count)
        if number == count:
            self.left = left
        self._report(int(_PROGRESS * (1 - left)))

    def finished(self) -> None:
        """Report that all passes have finished."""
        self._report(_PROGRESS)

    def _report(self, steps: int) -> None:
        if self.callback is not None and steps > self.reported:
            self.reported = steps
            self.callback(steps, _PROGRESS)


class _Passes:
    """Displacements found so far, and the passes that measure what is left."""

    def __init__(
        self,
        array: Array,
        correlator: Correlator,
        accuracy: NDArray[np.float64],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.lines, self.array, self.correlator = correlator.readout.lines, array, correlator
        self.accuracy, self.yaw = accuracy, bool(np.any(accuracy[:, 1] > 0))
        self.progress = _Progress(progress)
        count = array.pings - 1
        self.moved, self.surge_m = np.zeros((count, 2)), np.zeros(count)
        self.coherent = np.ones(count, bool)
        self.steps: list[Displacement] = []
        self.half_width = ALL
        self.overlaps = self._paired(self.lines, array)

    @property
    def later_m(self) -> float:
        """Largest displacement that passes after the first one search."""
        return _LATER_LAGS * self.lines.range_step_m

    def settle(self, most_m: float) -> None:
        """Measure sway and yaw until they no longer change; search steps of up to `most_m`."""
        first = not self.steps
        for _ in range(_PASSES):
            self.steps = self._steps(most_m, self.half_width, first=first)
            self.coherent = np.array([self._is_coherent(step) for step in self.steps])
            changes = np.array([(step.sway_m, step.yaw_rad) for step in self.steps])
            changes[~self.coherent] = self.moved[~self.coherent] = 0.0
            self.moved = self.moved + changes
            deviations = np.stack([np.sqrt(np.diag(step.covariance)) for step in self.steps])
            first, most_m = False, self.later_m
            if np.all(np.abs(changes) <= _SETTLED * deviations):
                return

    def narrow(self) -> None:
        """Restrict the filters to the middle of the beam if that reduces the variance."""
        if self.correlator.swath.element_length_m is None or not self.coherent.any():
            return
        steps = self._steps(self.later_m, MIDDLE, first=False)
        if self._variance(steps) < self._variance(self.steps):
            self.half_width = MIDDLE
            self.settle(self.later_m)

    def _steps(self, most_m: float, half_width: float, *, first: bool) -> list[Displacement]:
        """Return the remaining displacements between all pings."""
        corrected, array = self._corrected()
        steps = []
        for ping, pairs in enumerate(self.overlaps):
            geometry = PairGeometry.of(corrected, array, pairs, self.correlator.swath)
            found = self.correlator.correlate(geometry, most_m, half_width)
            steps.append(displacement(found, first=first, yaw=self.yaw))
            self.progress.done(ping + 1, len(self.overlaps))
        return steps

    def _variance(self, steps: list[Displacement]) -> float:
        """Return the mean variance of the yaws between pings, or of the sways without yaw."""
        number = 1 if self.yaw else 0
        some = [step for step, coherent in zip(steps, self.coherent, strict=True) if coherent]
        variance = np.mean([step.covariance[number, number] for step in some])
        return float(variance * max(np.mean([step.misfit for step in some]), 1.0))

    def surges_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the remaining error of every advance, and its standard deviation.

        Both are 0 between pings that are not coherent.
        """
        corrected, array = self._corrected()
        found = np.zeros((len(self.overlaps), 2))
        for ping in np.flatnonzero(self.coherent).tolist():
            pairs = overlap(corrected, array, ping, self.correlator.live)
            if not pairs.pairs:
                sway_m, yaw_rad = self.moved[ping]
                raise ArgumentError(
                    "lines",
                    "have pings that overlap after correction",
                    f"no common phase centres of pings {ping} and {ping + 1} with the {sway_m:.3g} "
                    f"m of sway and {math.degrees(yaw_rad):.3g} degrees of yaw found between them",
                    f"check `range_step_m`, {self.lines.range_step_m:g} m, and `range_m`",
                )
            geometry = PairGeometry.of(corrected, array, pairs, self.correlator.swath)
            found[ping] = surge(self.correlator, geometry, array.spacing_m, self.half_width)
            self.progress.done(ping + 1, self.array.pings - 1)
        return found[:, 0], found[:, 1]

    def result(self, surge_sd_m: NDArray[np.float64]) -> Displacements:
        """Return the displacements found."""
        _, array = self._corrected()
        return Displacements(
            moved=self.moved,
            covariance=np.stack([step.covariance for step in self.steps]),
            surge_m=np.where(self.coherent, self.surge_m, 0.0),
            surge_sd_m=surge_sd_m,
            levers_m=self._levers_m(array),
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
        """Return the lines corrected by everything found so far, and their array.

        The channels are paired anew for the corrected advances.
        """
        surge_m = np.concatenate([[0.0], np.cumsum(self.surge_m)])
        none = np.zeros(self.array.pings)
        advanced = moved(self.lines, self.array, none, none, surge_m)
        array = Array.of(advanced)
        self.overlaps = self._paired(advanced, array)
        states = integrated(
            [
                Step.over(each, np.zeros((2, 2)), levers_m)
                for each, levers_m in zip(self.moved, self._levers_m(array), strict=True)
            ],
            self.accuracy,
        )
        corrected = moved(advanced, array, states[:, 0], states[:, 1], none)
        return corrected, Array.of(corrected)

    def _paired(self, lines: RangeLines, array: Array) -> list[Overlap]:
        """Return the overlaps of all pings; refuse those with too few channels."""
        live = self.correlator.live
        found = [overlap(lines, array, ping, live) for ping in range(array.pings - 1)]
        fewest = int(np.argmin([each.pairs for each in found]))
        if found[fewest].pairs < LEAST_PAIRS:
            advance_m = np.linalg.norm(np.diff(array.reference_m[fewest : fewest + 2], axis=0))
            along_m = lines.phase_centres_m[array.channels(fewest)] @ array.forward[fewest]
            raise ArgumentError(
                "lines",
                f"have at least {LEAST_PAIRS} phase centres that overlap from ping to ping",
                f"{found[fewest].pairs} between pings {fewest} and {fewest + 1}",
                f"the array advances by {advance_m:.3g} m, and its phase centres extend over "
                f"{np.ptp(along_m):.3g} m. Without overlap, use `clsas.autofocus`",
            )
        return found

    def _levers_m(self, array: Array) -> list[tuple[float, float]]:
        """Return the distances from the middles of two arrays forward to that of their overlap."""
        levers_m = []
        for ping, each in enumerate(self.overlaps):
            first_m, second_m = (
                float((each.pivot_m - array.reference_m[n]) @ array.forward[n])
                for n in (ping, ping + 1)
            )
            levers_m.append((first_m, second_m))
        return levers_m

    def _is_coherent(self, step: Displacement) -> bool:
        """Return whether any window is more coherent than noise."""
        return bool(np.any(step.coherence > self._least_coherence))

    def _is_sparse(self, step: Displacement) -> bool:
        """Return whether yaw is measured from too few echoes."""
        return self.yaw and self._is_coherent(step) and step.echoes < LEAST_ECHOES

    @property
    def _least_coherence(self) -> NDArray[np.float64]:
        """Coherence that noise does not reach, [windows]."""
        return _LEAST_COHERENCE / np.sqrt(self.correlator.independent)
