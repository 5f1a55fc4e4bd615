"""Micronavigation by displaced phase centres (DPCA): sway and yaw from the echoes themselves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import reprs, validate
from clsas.core.lines import RangeLines
from clsas.navigation.displacement import Correlator, Displacement, Swath, displacement
from clsas.navigation.overlap import Array, Overlap, moved, overlap
from clsas.navigation.smoother import Step, integrated, smooth
from clsas.signal.compression import compress
from clsas.signal.echoes import Echoes
from clsas.sonar.track import Track

LEAST_PAIRS = 3
"""Fewest pairs of channels that tell yaw from sway."""

_LEAST_COHERENCE = 3.0
"""Coherence of noise alone, 1/sqrt(independent samples), times which a window must have."""
_LEAST_SHARE = 0.25  # of the pairs of pings, that must be coherent
_PASSES, _SETTLED = 6, 0.1  # at most; changes of the last pass over their standard deviations
_LATER_LAGS = 4  # samples to either side that later passes look at
_LEAST_WINDOW = 16  # samples
_WINDOW_CELLS = 150.0  # range resolution cells of a window, unless given


@dataclass(frozen=True, eq=False)
class Micronavigation:
    """What micronavigation found.

    Attributes
    ----------
    lines : RangeLines
        The lines given, with corrected positions.
    track : Track
        The array's mean phase centre and heading, ping by ping. `time_s` counts pings.
    sway_m, yaw_rad : float64 [pings]
        Displacement of the array to port of its navigation, and turn from forward to port.
    sway_sd_m, yaw_sd_rad : float64 [pings]
        Their standard deviations. A common shift and turn of the whole track stem from the
        navigation and have its accuracy.
    sway_steps_m, yaw_steps_rad : float64 [pings - 1]
        Displacement from ping to ping beside the navigation's, at the middle of the overlap.
    sway_steps_sd_m, yaw_steps_sd_rad : float64 [pings - 1]
        Their standard deviations; infinite where the echoes were not coherent.
    coherence : float64 [pings - 1, windows]
        Mean coherence of the pairs by window of range.
    range_m : float64 [windows]
        Middles of the windows.
    overlap : int64 [pings - 1]
        Number of pairs of channels that share a phase centre.
    """

    lines: RangeLines
    track: Track
    sway_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    sway_sd_m: NDArray[np.float64]
    yaw_sd_rad: NDArray[np.float64]
    sway_steps_m: NDArray[np.float64]
    yaw_steps_rad: NDArray[np.float64]
    sway_steps_sd_m: NDArray[np.float64]
    yaw_steps_sd_rad: NDArray[np.float64]
    coherence: NDArray[np.float64]
    range_m: NDArray[np.float64]
    overlap: NDArray[np.int64]

    def __repr__(self) -> str:
        """Return the size of what was found, and how coherent the echoes are."""
        return reprs.summary(
            self,
            f"{len(self.sway_m)} pings",
            f"sway {reprs.quantity(float(np.std(self.sway_m)), 'm')} rms",
            f"yaw {reprs.quantity(float(np.std(self.yaw_rad)), 'rad')} rms",
            f"coherence {np.median(self.coherence):.2f}",
        )


def micronavigate(
    lines: RangeLines | Echoes,
    *,
    range_m: tuple[float, float] | None = None,
    window_m: float | None = None,
    side: str = "port",
    seabed_z_m: float | None = None,
    element_length_m: float | tuple[float, float] | None = None,
    sway_sd_m: ArrayLike = 0.1,
    yaw_sd_rad: ArrayLike = math.radians(1.0),
    correlation_pings: float | None = None,
    yaw: bool = True,
    most_step_m: float = 0.1,
    progress: Callable[[int, int], None] | None = None,
) -> Micronavigation:
    """Correct an array's track by echoes that consecutive pings have in common.

    Parameters
    ----------
    lines : RangeLines or Echoes
        Of an array whose phase centres overlap from ping to ping, at least three of them. Echoes
        are compressed first. Positions are those of the navigation.
    range_m : (near, far), optional
        Ranges to use, metres. All that every channel has, unless given.
    window_m : float, optional
        Length of a window of range, metres. About 150 resolution cells unless given.
    side : {"port", "starboard"}
        Where the seabed lies, seen forward along the array.
    seabed_z_m : float, optional
        Height of the seabed. Rays then slope down to it, and sway is horizontal; without it rays
        are taken as horizontal.
    element_length_m : float or (transmitter, receiver), optional
        Lengths of the elements. Give them where the beam is wide: echoes far from broadside change
        their range less, and the expected phase of separate transmitters and receivers is a mean
        over the beam.
    sway_sd_m, yaw_sd_rad : float or array_like [pings]
        Standard deviation of the navigation's sway and yaw.
    correlation_pings : float, optional
        Number of pings over which errors of the navigation persist. Unless given the whole
        recording, so that the navigation decides little but a common shift and turn.
    yaw : bool
        False where the array does not turn from ping to ping, such as one at rest whose timing
        jitters: only sway is found.
    most_step_m : float
        Largest displacement in range that is looked for between two pings, beside the
        navigation's.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Micronavigation

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind or outside its limits; if there is one ping, or fewer
        than three phase centres overlap; or if hardly any two pings are coherent.

    Warns
    -----
    ClsasWarning
        If some pairs of pings are not coherent. The navigation bridges them.

    Notes
    -----
    See `clsas.navigation.displacement` for the measurement. Standard deviations follow the bound
    for K pairs of coherence g over L independent samples (Bellettini and Pinto 2002):

        sigma_phase = sqrt((1 - g^2)/(2 L g^2)),
        sigma_sway = wavelength/(4 pi) sigma_phase/sqrt(K),
        sigma_yaw = wavelength/(4 pi) sigma_phase sqrt(12/(K (K^2 - 1)))/spacing.

    They follow from the phase of a product of two correlated complex Gaussian signals, averaged
    over L samples, and a straight line fitted to K such phases at equal steps. They are scaled by
    the misfit of that line over all pings, where that is more than expected.
    """
    if isinstance(lines, Echoes):
        lines = compress(lines)
    validate.instance("lines", lines, RangeLines)
    validate.progress(progress)
    array = Array.of(lines)
    swath = _swath(lines, range_m, window_m, side, seabed_z_m, element_length_m)
    fixes = _fixes(array.pings, sway_sd_m, yaw_sd_rad, correlation_pings)
    most_step_m = validate.positive("most_step_m", most_step_m, "m")
    correlator = Correlator(lines, swath)
    overlaps = [overlap(lines, array, ping) for ping in range(array.pings - 1)]
    fewest = int(np.argmin([each.pairs for each in overlaps]))
    if overlaps[fewest].pairs < LEAST_PAIRS:
        raise ValueError(
            f"at least {LEAST_PAIRS} phase centres must overlap from ping to ping, got "
            f"{overlaps[fewest].pairs} between pings {fewest} and {fewest + 1}: they advance by "
            f"{_advance_m(array, fewest):.3g} m, the phase centres extend over "
            f"{_extent_m(lines, array, fewest):.3g} m; without overlap use clsas.autofocus"
        )
    found = _measured(correlator, lines, array, overlaps, most_step_m, yaw, progress)
    return _result(lines, array, swath, overlaps, found, fixes)


@dataclass(frozen=True)
class _Measured:
    """Displacements between pings, and which of them are coherent."""

    steps: list[Displacement]
    coherent: NDArray[np.bool_]


def _measured(
    correlator: Correlator,
    lines: RangeLines,
    array: Array,
    overlaps: list[Overlap],
    most_step_m: float,
    yaw: bool,
    progress: Callable[[int, int], None] | None,
) -> _Measured:
    """Measure all displacements, pass by pass until they settle.

    Every pass aligns the channels by all that was found before it: what is left is small, and
    linear in the displacement.
    """
    count = len(overlaps)
    total = np.zeros((count, 2))
    steps: list[Displacement] = []
    for number in range(_PASSES):
        states = integrated([
            Step(moved_by, np.zeros((2, 2)), _levers_m(array, each, ping))
            for ping, (moved_by, each) in enumerate(zip(total, overlaps, strict=True))
        ])  # fmt: skip
        corrected = moved(lines, array, *states.T)
        here = Array.of(corrected)
        most_m = most_step_m if number == 0 else _LATER_LAGS * lines.range_step_m
        steps, changes = [], np.zeros((count, 2))
        for ping, each in enumerate(overlaps):
            correlation = correlator.correlate(corrected, here, each, most_m)
            step = displacement(correlation, first=number == 0, yaw=yaw)
            steps.append(step)
            changes[ping] = step.sway_m, step.yaw_rad
            if progress is not None and number == 0:
                progress(ping + 1, count)
        coherent = np.array([_is_coherent(step, correlator) for step in steps])
        changes[~coherent] = 0.0
        total[~coherent] = 0.0
        total += changes
        deviations = np.stack([np.sqrt(np.diag(step.covariance)) for step in steps])
        if np.all(np.abs(changes) <= _SETTLED * deviations):
            break
    steps = [
        replace(step, sway_m=float(sway), yaw_rad=float(yaw))
        for step, (sway, yaw) in zip(steps, total, strict=True)
    ]
    return _Measured(steps, coherent)


def _is_coherent(step: Displacement, correlator: Correlator) -> bool:
    """Return whether any window is more coherent than noise would be."""
    noise = 1 / np.sqrt(correlator.independent)
    return bool(np.any(step.coherence > _LEAST_COHERENCE * noise))


def _result(
    lines: RangeLines,
    array: Array,
    swath: Swath,
    overlaps: list[Overlap],
    found: _Measured,
    fixes: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> Micronavigation:
    """Fuse displacements with the navigation."""
    coherent, count = found.coherent, len(overlaps)
    if coherent.sum() < max(1, _LEAST_SHARE * count):
        best = max(float(step.coherence.max()) for step in found.steps)
        raise ValueError(
            f"lines must be coherent from ping to ping; {count - int(coherent.sum())} of {count} "
            f"pairs of pings are not: their coherence is at most {best:.2f} in any window. Check "
            f"side, range_m, and that the navigation's advance from ping to ping is right"
        )
    if not coherent.all():
        validate.warn(
            f"{int((~coherent).sum())} of {count} pairs of pings are not coherent (the first "
            f"after ping {int(np.argmin(coherent))}): the navigation's accuracy bridges them"
        )
    misfit = max(float(np.mean([s.misfit for s, ok in zip(found.steps, coherent) if ok])), 1.0)
    sway_sd, yaw_sd, fix = fixes[0], fixes[1], None
    steps, deviations = [], np.full((count, 2), np.inf)
    for ping, (step, each) in enumerate(zip(found.steps, overlaps, strict=True)):
        covariance = misfit * step.covariance
        if coherent[ping]:
            deviations[ping] = np.sqrt(np.diag(covariance))
        else:
            covariance = 2 * np.diag([float(sway_sd[ping]), float(yaw_sd[ping])]) ** 2
        moved_by = np.array([step.sway_m, step.yaw_rad])
        steps.append(Step(moved_by, covariance, _levers_m(array, each, ping)))
    del fix
    states, covariances = smooth(steps, *fixes)
    corrected = moved(lines, array, *states.T)
    at = Array.of(corrected)
    heading = np.arctan2(at.forward[:, 1], at.forward[:, 0])
    return Micronavigation(
        lines=corrected,
        track=Track(at.reference_m, np.arange(at.pings, dtype=np.float64), yaw_rad=heading),
        sway_m=states[:, 0],
        yaw_rad=states[:, 1],
        sway_sd_m=np.sqrt(covariances[:, 0, 0]),
        yaw_sd_rad=np.sqrt(covariances[:, 1, 1]),
        sway_steps_m=np.array([step.sway_m for step in found.steps]),
        yaw_steps_rad=np.array([step.yaw_rad for step in found.steps]),
        sway_steps_sd_m=deviations[:, 0],
        yaw_steps_sd_rad=deviations[:, 1],
        coherence=np.stack([step.coherence for step in found.steps]),
        range_m=swath.middles_m,
        overlap=np.array([each.pairs for each in overlaps]),
    )


def _levers_m(array: Array, pairs: Overlap, ping: int) -> tuple[float, float]:
    """Return the distances forward from the middles of two arrays to that of their overlap."""
    return tuple(
        float((pairs.pivot_m - array.reference_m[each]) @ array.forward[each])
        for each in (ping, ping + 1)
    )  # type: ignore[return-value]


def _advance_m(array: Array, ping: int) -> float:
    return float(np.linalg.norm(array.reference_m[ping + 1] - array.reference_m[ping]))


def _extent_m(lines: RangeLines, array: Array, ping: int) -> float:
    return float(np.ptp(lines.phase_centres_m[array.channels(ping)] @ array.forward[ping]))


def _swath(
    lines: RangeLines,
    range_m: tuple[float, float] | None,
    window_m: float | None,
    side: str,
    seabed_z_m: float | None,
    element_length_m: float | tuple[float, float] | None,
) -> Swath:
    """Return the swath of checked arguments."""
    validate.one_of("side", side, ("port", "starboard"))
    nearest, farthest = float(lines.first_range_m.max()), float(lines.last_range_m.min())
    if range_m is None:
        # Rays are read where every channel has samples, whatever it is displaced.
        spare = 0.02 * (farthest - nearest)
        near, far = nearest + spare, farthest - spare
    else:
        near, far = map(float, validate.array("range_m", range_m, np.float64, (2,)))
    if not nearest <= near < far <= farthest:
        raise ValueError(
            f"range_m must lie within what every channel has, {nearest:.6g} to {farthest:.6g} m, "
            f"got ({near:.6g}, {far:.6g})"
        )
    if window_m is None:
        from clsas.signal.spectrum import measure_spectrum

        cell_m = lines.range_step_m * max(measure_spectrum(lines).oversampling, 1.0)
        window_m = min(_WINDOW_CELLS * cell_m, far - near)
    window_m = validate.number(
        "window_m", window_m, "m", least=_LEAST_WINDOW * lines.range_step_m, most=(far - near) * (1 + 1e-9)
    )
    if seabed_z_m is not None:
        seabed_z_m = validate.number("seabed_z_m", seabed_z_m, "m")
    lengths = None
    if element_length_m is not None:
        given = np.atleast_1d(validate.array(
            "element_length_m", np.ravel(element_length_m), np.float64, (None,)))  # fmt: skip
        if given.size > 2 or given.min() <= 0:
            raise ValueError(
                "element_length_m must be one or two lengths above 0 m, got "
                f"{validate.shown(element_length_m)}"
            )
        lengths = float(given[0]), float(given[-1])
    windows = max(int((far - near) / window_m + 1e-9), 1)
    edges = np.linspace(near, far, windows + 1)
    return Swath(edges, 1 if side == "port" else -1, seabed_z_m, lengths)


def _fixes(
    pings: int, sway_sd_m: ArrayLike, yaw_sd_rad: ArrayLike, correlation_pings: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the navigation's standard deviations as one independent measurement per ping.

    Errors that persist over n pings average out like white ones that are sqrt(2 n) times as large.
    """
    persist = float(pings)
    if correlation_pings is not None:
        persist = validate.number("correlation_pings", correlation_pings, "pings", least=0.5)
    found = []
    for name, value in (("sway_sd_m", sway_sd_m), ("yaw_sd_rad", yaw_sd_rad)):
        checked = validate.array(name, value, np.float64, (pings,), broadcast=True)
        if checked.min() <= 0:
            raise ValueError(f"{name} must be above 0, got {checked.min():g}")
        found.append(checked * math.sqrt(2 * persist))
    return found[0], found[1]
