"""Micronavigation by displaced phase centres (DPCA): sway, yaw and surge from echoes.

Channels of consecutive pings that share a phase centre receive the same speckle. Their correlation
determines how the array moved between the pings, relative to its navigation. All displacements are
measured in several passes until they settle: each pass aligns the channels with everything found so
far, so that the rest is small and linear in the displacement. A smoother combines the displacements
with the navigation and its accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Choice, Names, Number, Span, check_declared
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.track import Track
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.ray_delays import at_speed
from clsas.navigation.checks import check_navigation, first_bank, mean_wavelength_m
from clsas.navigation.correlation import ALL, DEAD_DB, MIDDLE, Correlator
from clsas.navigation.displacement import Displacement, displacement, surge
from clsas.navigation.overlap import Array, Overlap, PairGeometry, Swath, moved, overlap
from clsas.navigation.smoother import Step, integrated, persistence, shape_deviation_m, smooth

UNKNOWNS = ("sway", "yaw", "surge")

# Limits of arguments.
SIDES = ("port", "starboard")
"""Sides of the track on which the seabed may lie."""
SWAY_SD = Number(
    "m", least=1e-9, most=1e3, help="Standard deviation of the sway in the navigation data."
)
YAW_SD = Number(
    "degrees", least=1e-7, most=180.0, help="Standard deviation of the yaw in the navigation data."
)
SURGE_SD = Number(
    "m", least=1e-9, most=1e3, help="Standard deviation of the surge in the navigation data."
)
"""Declare the accuracy of the navigation that is corrected."""
STEP = Number("m", above=0.0, help="Largest displacement between pings.")
"""Declares the largest displacement, at most the length of a window."""
CORRELATION = Number(
    "pings",
    least=0.5,
    help="Pings over which errors of the navigation persist.",
    default="the whole recording",
)
"""Declares for how long errors of the navigation persist."""

_LEAST_WINDOW = 16  # samples
_WINDOW_CELLS = 150.0  # default length of a window, range resolution cells
_LONGEST_ARRAY = 4.0  # farthest ranges
_SHORTEST_ARRAY, _SHORTEST_ELEMENT = 0.5, 0.05  # wavelengths

# Limits of results.
_LEAST_PAIRS = 3  # fewest pairs of channels from which yaw and sway can both be measured
# Fewest independent samples with echoes from which yaw can be measured. Fewer echoes come from too
# few directions.
_LEAST_ECHOES = 8.0
# Coherence that a window needs, over that of noise alone, 1/sqrt(independent samples).
_LEAST_COHERENCE = 3.0
_LEAST_BLOCKS = 4  # blocks of range that are needed to estimate a variance from their scatter
_LEAST_SHARE = 0.25  # share of the pairs of pings that must be usable
_IMPLAUSIBLE = 3.0  # rms correction above which a warning is given, in standard deviations

# Passes.
_PASSES = 6  # most passes, at the start and again after each correction of the advance
_SETTLED = 0.1  # largest change in the last pass, in standard deviations
_LATER_LAGS = 4  # samples to either side that later passes search
_SURGES = 3  # most corrections of the advance, after which channels are paired anew
_LEAST_SURGE = 0.02  # spacings of the array; smaller corrections end the search
_LEFT = 0.75  # share of the remaining progress that a pass leaves; most runs take 3 to 8 passes
_PROGRESS = 1000  # steps of the progress that is reported


def micronavigate(
    lines: RangeLines | Echoes,
    *,
    range_m: Annotated[
        tuple[float, float] | None,
        Span(
            "m",
            least=0.0,
            help="Nearest and farthest range to use.",
            default="nearly all that the channels share",
        ),
    ] = None,
    window_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            help="Length of a window in range.",
            default="about 150 resolution cells",
        ),
    ] = None,
    side: Annotated[str, Choice(SIDES, help="Side on which the seabed lies.")] = "port",
    seabed_z_m: Annotated[
        float | None,
        Number("m", help="Height of the seabed.", default="rays are horizontal"),
    ] = None,
    element_length_m: Annotated[
        float | tuple[float, float] | None,
        Number(
            "m",
            above=0.0,
            help="Length of the elements, which wide beams need for accurate yaw.",
            default="a narrow beam",
        ),
    ] = None,
    sway_sd_m: Annotated[ArrayLike, SWAY_SD] = 0.1,
    yaw_sd_deg: Annotated[ArrayLike, YAW_SD] = 1.0,
    surge_sd_m: Annotated[ArrayLike, SURGE_SD] = 0.1,
    correlation_pings: Annotated[float | None, CORRELATION] = None,
    unknowns: Annotated[
        Sequence[str], Names(UNKNOWNS, help="Displacements between pings to solve for.")
    ] = UNKNOWNS,
    most_step_m: Annotated[float, STEP] = 0.1,
    progress: Callable[[int, int], None] | None = None,
) -> Micronavigation:
    """Return the track of an array, corrected by echoes that consecutive pings have in common.

    Parameters
    ----------
    lines : RangeLines or Echoes
        Data of an array whose phase centres overlap from ping to ping, by at least three. Echoes
        are compressed first. The positions are those of the navigation. Of several receiver banks,
        the first one is used, and all of them are corrected.
    range_m : (near, far), optional
        Ranges to use, metres. By default nearly all ranges that every channel has.
    window_m : float, optional
        Length of a window of range, metres. By default about 150 range resolution cells.
    side : {"port", "starboard"}
        Side on which the seabed lies, as seen in the direction in which the array advances. The
        echoes do not show it, and the wrong side gives sway of the wrong sign.
    seabed_z_m : float, optional
        Height of the seabed. Rays then slope down to it, and sway is horizontal. By default, rays
        are horizontal.
    element_length_m : float or (transmitter, receiver), optional
        Lengths of the elements, which are needed if the beam is wide: far from broadside, echoes
        change their range less, and separate transmitters and receivers shift their phases. Both
        pings are then aligned for every direction of the beam.
    sway_sd_m, yaw_sd_deg, surge_sd_m : float or array_like [pings]
        Standard deviations of the navigation's sway, yaw and surge.
    correlation_pings : float, optional
        Number of pings over which errors of the navigation persist. By default they persist over
        the whole recording, so that the navigation determines little but a common shift and turn.
    unknowns : sequence of {"sway", "yaw", "surge"}
        What to measure; must include sway. Leave out yaw and surge for an array at rest whose
        timing jitters. Surge, an error of the advance, is measured by where the coherence along the
        array is largest.
    most_step_m : float
        Largest displacement in range between two pings, relative to the navigation, that is
        searched.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Micronavigation

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits; if there is only one ping,
        positions are missing, or pings repeat a position; if fewer than three phase centres
        overlap; if hardly any two pings are coherent; or if yaw is to be measured from the echoes
        of a few reflectors.

    Warns
    -----
    ClsasWarning
        If some pairs of pings are not coherent and the navigation bridges them; if some contain so
        few echoes that their yaw may be off by more than its standard deviation; if channels are
        dead and left out; if the corrections are far larger than the accuracy of the navigation;
        or if the track turns back, so that pings may be out of order.

    See Also
    --------
    autofocus : Corrects a track from the bright responses of an image.
    calibrate_track : Corrects timing, sound speed and lever arm from known reflectors.

    Notes
    -----
    Both channels of a pair that shares a phase centre receive the same speckle. Sway and yaw follow
    from a straight line fitted to their phase differences along the array, and surge from the
    coherence of neighbouring channels [1]_. The standard deviations follow the bound for K pairs
    with coherence g over L independent samples,

        sigma_phase = sqrt((1 - g^2)/(2 L g^2)),
        sigma_sway = wavelength/(4 pi) sigma_phase/sqrt(K),
        sigma_yaw = wavelength/(4 pi) sigma_phase sqrt(12/(K (K^2 - 1)))/spacing.

    It is derived from the phase of a product of two correlated complex Gaussian signals, averaged
    over L samples, and from a straight line fitted to K such phases at equal steps.

    Several effects increase these values. If a window contains fewer echoes than speckle has,
    phases are less certain because the alignment of the few directions is not exact. All
    deviations are scaled by the misfit of the line over all pings, or by the contradiction between
    blocks of range, if either is larger than expected. Those of yaw are also scaled because
    neighbouring pairs share errors. The standard deviations of positions and of the track's shape
    are scaled by `Micronavigation.persistence` as well.

    References
    ----------
    .. [1] Bellettini, Pinto, "Theoretical accuracy of synthetic aperture sonar micronavigation
       using a displaced phase-center antenna", IEEE Journal of Oceanic Engineering 27, 2002.

    Examples
    --------
    An array over speckle sways by some millimetres, and its navigation does not contain the sway:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    >>> rx_m = [[0.015 * n, 0, 0] for n in range(16)]
    >>> sonar = clsas.Sonar(pulse, rx_m, tx_length_m=0.03, rx_length_m=0.03)
    >>> random = np.random.default_rng(0)
    >>> xyz_m = random.uniform([-3, 9, 0], [3, 13, 0], (800, 3))
    >>> speckle = clsas.PointTargets(xyz_m, random.standard_normal((800, 2)) @ [1, 1j])
    >>> course = (0, 0, 0), (0.045, 0, 0), 5, 1.0
    >>> true = clsas.Track.straight(*course, sway_m=[0, 2e-3, 1e-3, 3e-3, 0])
    >>> lines = clsas.compress(clsas.simulate(sonar, true, speckle, range_m=(9.5, 12.5)))
    >>> navigated = clsas.channels(sonar, clsas.Track.straight(*course))
    >>> lines = replace(lines, tx_m=navigated.tx_m, rx_m=navigated.rx_m)
    >>> found = clsas.micronavigate(lines, range_m=(10, 12), element_length_m=0.03)
    >>> (1e3 * found.sway_steps_m).round(1).tolist()
    [2.0, -1.0, 2.0, -3.0]
    """
    if isinstance(lines, Echoes):
        lines = compress(lines)
    validate.instance("lines", lines, RangeLines)
    validate.progress(progress)
    names = check_declared(micronavigate, {"unknowns": unknowns})["unknowns"]
    if "sway" not in names:
        raise ArgumentError("unknowns", "include 'sway'", names)
    check_navigation(lines, 2, "micronavigation", may_stand=False)
    array_lines = first_bank(lines)
    if lines.sound_speed is not None:
        # Echoes arrive with the wavelength of the water at the array.
        speed_m_s = float(lines.sound_speed.at(array_lines.rx_m[:, 2]).mean())
        if range_m is not None:
            scale = speed_m_s / lines.sound_speed_m_s
            near_m, far_m = validate.array("range_m", range_m, np.float64, (2,))
            range_m = scale * float(near_m), scale * float(far_m)
        array_lines = at_speed(array_lines, speed_m_s)
    array = Array.of(array_lines)
    swath = checked_swath(array_lines, range_m, window_m, side, seabed_z_m, element_length_m)
    pings = float(array.pings) if correlation_pings is None else correlation_pings
    correlation_pings = CORRELATION.check("correlation_pings", pings)
    accuracy = _checked_deviations(array.pings, sway_sd_m, yaw_sd_deg, surge_sd_m)
    longest_m = float(np.diff(swath.edges_m).max())
    most_step_m = replace(STEP, most=longest_m).check("most_step_m", most_step_m)
    correlator = Correlator(array_lines, swath)
    _check_sizes(array_lines, array, swath, mean_wavelength_m(correlator.readout))
    dead = int((~correlator.live).sum())
    if dead:
        of_bank = " of the first bank" * (lines.banks > 1)
        validate.warn(
            f"{dead} of {array_lines.channels} channels{of_bank} have no signal, or at least "
            f"{-DEAD_DB:.0f} dB less than the other channels of their ping (the first is channel "
            f"{int(np.argmin(correlator.live))}). They are left out"
        )
    found = _Passes(array, correlator, names, accuracy[:, :2], progress)
    found.measure(most_step_m)
    _check_coherence(found)
    return _combined(lines, found, accuracy, correlation_pings)


def _checked_deviations(
    pings: int, sway_sd_m: ArrayLike, yaw_sd_deg: ArrayLike, surge_sd_m: ArrayLike
) -> NDArray[np.float64]:
    """Return the standard deviations of sway (m), yaw (rad) and surge (m), [pings, 3]."""
    deviations = []
    for name, value, what in (
        ("sway_sd_m", sway_sd_m, SWAY_SD),
        ("yaw_sd_deg", yaw_sd_deg, YAW_SD),
        ("surge_sd_m", surge_sd_m, SURGE_SD),
    ):
        checked = validate.array(name, value, np.float64, (pings,), broadcast=True)
        for end in (checked.min(), checked.max()):
            what.check(name, end)
        deviations.append(checked)
    sway_m, yaw_deg, surge_m = deviations
    return np.stack([sway_m, np.radians(yaw_deg), surge_m], axis=1)


def checked_swath(
    lines: RangeLines,
    range_m: tuple[float, float] | None,
    window_m: float | None,
    side: str,
    seabed_z_m: float | None,
    element_length_m: float | tuple[float, float] | None,
) -> Swath:
    """Return the swath that the arguments of `micronavigate` describe, after checking them."""
    side = validate.one_of("side", side, SIDES)
    nearest_m, farthest_m = float(lines.first_range_m.max()), float(lines.last_range_m.min())
    if range_m is None:
        # A margin keeps displaced rays within the samples of every channel.
        margin_m = 0.02 * (farthest_m - nearest_m)
        near_m, far_m = nearest_m + margin_m, farthest_m - margin_m
    else:
        near_m, far_m = map(float, validate.array("range_m", range_m, np.float64, (2,)))
    if not nearest_m <= near_m < far_m <= farthest_m:
        raise ArgumentError(
            "range_m",
            f"lie within the ranges that all channels have, {nearest_m:.6g} to {farthest_m:.6g} m, "
            "with the nearest first",
            (near_m, far_m),
        )
    least_m = _LEAST_WINDOW * lines.range_step_m
    if far_m - near_m < least_m:
        allowed = f"be at least {_LEAST_WINDOW} samples long, {least_m:.4g} m"
        raise ArgumentError("range_m", allowed, f"{far_m - near_m:.4g} m")
    if window_m is None:
        cell_m = lines.range_step_m * max(measure_spectrum(lines).oversampling, 1.0)
        window_m = min(_WINDOW_CELLS * cell_m, far_m - near_m)
    most_m = (far_m - near_m) * (1 + 1e-9)
    window_m = validate.number("window_m", window_m, "m", least=least_m, most=most_m)
    windows = max(int((far_m - near_m) / window_m + 1e-9), 1)
    edges_m = np.linspace(near_m, far_m, windows + 1)
    if seabed_z_m is not None:
        seabed_z_m = validate.number("seabed_z_m", seabed_z_m, "m")
        height_m = float(np.abs(lines.phase_centres_m[:, 2] - seabed_z_m).max())
        if height_m >= near_m:
            raise ArgumentError(
                "seabed_z_m",
                "differ from the height of the sonar by less than the nearest range, "
                f"{near_m:.4g} m, so that rays reach the seabed",
                f"a difference of {height_m:.4g} m",
            )
    lengths_m = None
    if element_length_m is not None:
        given = validate.array("element_length_m", element_length_m, np.float64, None).ravel()
        if not 1 <= given.size <= 2 or given.min() <= 0:
            raise ArgumentError(
                "element_length_m",
                "be one or two lengths above 0 m",
                validate.shown(element_length_m),
            )
        lengths_m = float(given[0]), float(given[-1])
    return Swath(edges_m, 1 if side == "port" else -1, seabed_z_m, lengths_m)


def _check_sizes(lines: RangeLines, array: Array, swath: Swath, wavelength_m: float) -> None:
    """Refuse arrays and elements of impossible sizes, which indicate lengths in other units."""
    centres_m = lines.phase_centres_m[array.channels(0)]
    length_m, farthest_m = float(np.ptp(centres_m @ array.forward[0])), float(swath.edges_m[-1])
    least_m, most_m = _SHORTEST_ARRAY * wavelength_m, _LONGEST_ARRAY * farthest_m
    if not least_m <= length_m <= most_m:
        raise ArgumentError(
            "lines",
            f"have phase centres that extend over {least_m:.3g} to {most_m:.3g} m in a ping (half "
            f"a wavelength to {_LONGEST_ARRAY:g} times the farthest range)",
            f"{length_m:.3g} m",
            "are their positions in metres?",
        )
    least_m, most_m = _SHORTEST_ELEMENT * wavelength_m, 2 * length_m
    for each_m in swath.element_length_m or ():
        if not least_m <= each_m <= most_m:
            raise ArgumentError(
                "element_length_m",
                f"be from {least_m:.3g} m (a twentieth of a wavelength) to {most_m:.3g} m (twice "
                "the length of the array)",
                f"{each_m:.3g} m",
            )


class _Passes:
    """Displacements found so far, and the passes that measure what is left.

    Attributes
    ----------
    moved : float64 [pings - 1, 2]
        Sway (m) at the middle of the overlap, and yaw (rad).
    surge_m, surge_sd_m : float64 [pings - 1]
        Advance along the array beyond that of the navigation, and its standard deviation.
    steps : list of Displacement
        Results of the last pass.
    coherent : bool [pings - 1]
        False where no window is more coherent than noise.
    overlaps : list of Overlap
    levers_m : list of (first, second)
        See `Step.over`.
    least_coherence : float64 [windows]
        Coherence that noise does not reach.
    """

    def __init__(
        self,
        array: Array,
        correlator: Correlator,
        unknowns: tuple[str, ...],
        accuracy: NDArray[np.float64],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.lines, self.array, self.correlator = correlator.readout.lines, array, correlator
        self.swath, self.unknowns = correlator.swath, unknowns
        self.yaw = "yaw" in unknowns
        # If yaw is not measured, the track as a whole does not turn either.
        self.accuracy = accuracy if self.yaw else accuracy * [1.0, 0.0]
        self.progress, self.left, self.reported = progress, 1.0, 0
        self.later_m = _LATER_LAGS * self.lines.range_step_m
        self.least_coherence = _LEAST_COHERENCE / np.sqrt(correlator.independent)
        self.half_width = ALL
        count = array.pings - 1
        self.moved, self.coherent = np.zeros((count, 2)), np.ones(count, bool)
        self.surge_m, self.surge_sd_m = np.zeros((2, count))
        self.steps: list[Displacement] = []
        self.overlaps = self._paired(self.lines, array)
        self.levers_m: list[tuple[float, float]] = []

    def measure(self, most_step_m: float) -> None:
        """Measure the displacements between all pings; search steps of up to `most_step_m`.

        If the advance differs from the navigation, channels are paired anew.
        """
        self._settle(most_step_m)

        # The filters are restricted to the middle of the beam if that reduces the variance.
        if self.swath.element_length_m is not None and self.coherent.any():
            number = 1 if self.yaw else 0
            narrow = self._pass(self.later_m, MIDDLE, first=False)
            variances = []
            for steps in (narrow, self.steps):
                some = [step for step, use in zip(steps, self.coherent, strict=True) if use]
                variance = np.mean([step.covariance[number, number] for step in some])
                variances.append(variance * max(np.mean([step.misfit for step in some]), 1.0))
            if variances[0] < variances[1]:
                self.half_width = MIDDLE
                self._settle(self.later_m)

        if "surge" in self.unknowns:
            for _ in range(_SURGES):
                found_m, self.surge_sd_m = self._surges_m()
                self.surge_m = self.surge_m + found_m
                self._settle(self.later_m)
                if np.abs(found_m).max() <= _LEAST_SURGE * self.array.spacing_m:
                    break
        _, array, self.overlaps = self._corrected()
        self.levers_m = _levers_m(array, self.overlaps)
        self.surge_m = np.where(self.coherent, self.surge_m, 0.0)
        self._report(0.0)

    def _settle(self, most_m: float) -> None:
        """Measure sway and yaw until they no longer change; search steps of up to `most_m`."""
        for _ in range(_PASSES):
            self.steps = self._pass(most_m, self.half_width, first=not self.steps)
            self.coherent = np.array(
                [np.any(step.coherence > self.least_coherence) for step in self.steps]
            )
            changes = np.array([(step.sway_m, step.yaw_rad) for step in self.steps])
            changes[~self.coherent] = self.moved[~self.coherent] = 0.0
            self.moved = self.moved + changes
            deviations = np.stack([np.sqrt(np.diag(step.covariance)) for step in self.steps])
            most_m = self.later_m
            if np.all(np.abs(changes) <= _SETTLED * deviations):
                return

    def _pass(self, most_m: float, half_width: float, *, first: bool) -> list[Displacement]:
        """Return the remaining displacements between all pings."""
        corrected, array, overlaps = self._corrected()
        steps = []
        for ping, pairs in enumerate(overlaps):
            geometry = PairGeometry.of(corrected, array, pairs, self.swath)
            found = self.correlator.correlate(geometry, most_m, half_width)
            steps.append(displacement(found, first=first, yaw=self.yaw))
            self._done(ping + 1)
        return steps

    def _surges_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the remaining error of every advance, and its standard deviation.

        Both are 0 between pings that are not coherent.
        """
        corrected, array, overlaps = self._corrected()
        found = np.zeros((len(overlaps), 2))
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
            geometry = PairGeometry.of(corrected, array, pairs, self.swath)
            found[ping] = surge(self.correlator, geometry, array.spacing_m, self.half_width)
            self._done(ping + 1)
        return found[:, 0], found[:, 1]

    def _corrected(self) -> tuple[RangeLines, Array, list[Overlap]]:
        """Return the lines corrected by everything found so far, and their array.

        The third result is the pairs of channels, paired anew for the corrected advances.
        """
        surge_m = np.concatenate([[0.0], np.cumsum(self.surge_m)])
        none = np.zeros(self.array.pings)
        advanced = moved(self.lines, self.array, none, none, surge_m)
        array = Array.of(advanced)
        overlaps = self._paired(advanced, array)
        exact = np.zeros((2, 2))
        steps = zip(self.moved, _levers_m(array, overlaps), strict=True)
        states = integrated([Step.over(each, exact, lever) for each, lever in steps], self.accuracy)
        corrected = moved(advanced, array, states[:, 0], states[:, 1], none)
        return corrected, Array.of(corrected), overlaps

    def _paired(self, lines: RangeLines, array: Array) -> list[Overlap]:
        """Return the overlaps of all pings; refuse those with too few channels."""
        live = self.correlator.live
        found = [overlap(lines, array, ping, live) for ping in range(array.pings - 1)]
        fewest = int(np.argmin([each.pairs for each in found]))
        if found[fewest].pairs < _LEAST_PAIRS:
            advance_m = np.linalg.norm(np.diff(array.reference_m[fewest : fewest + 2], axis=0))
            along_m = lines.phase_centres_m[array.channels(fewest)] @ array.forward[fewest]
            raise ArgumentError(
                "lines",
                f"have at least {_LEAST_PAIRS} phase centres that overlap from ping to ping",
                f"{found[fewest].pairs} between pings {fewest} and {fewest + 1}",
                f"the array advances by {advance_m:.3g} m, and its phase centres extend over "
                f"{np.ptp(along_m):.3g} m. Without overlap, use `clsas.autofocus`",
            )
        return found

    def _done(self, number: int) -> None:
        """Report that a pass has finished `number` pairs of pings.

        The number of passes is not known in advance. Every pass takes the same share of what is
        left, so that the progress never decreases.
        """
        count = self.array.pings - 1
        left = self.left * _LEFT ** (number / count)
        if number == count:
            self.left = left
        self._report(left)

    def _report(self, left: float) -> None:
        steps = int(_PROGRESS * (1 - left))
        if self.progress is not None and steps > self.reported:
            self.reported = steps
            self.progress(steps, _PROGRESS)


def _levers_m(array: Array, overlaps: Sequence[Overlap]) -> list[tuple[float, float]]:
    """Return the distances from the middles of two arrays forward to that of their overlap."""
    pivots_m = np.stack([each.pivot_m for each in overlaps])
    first_m, second_m = (
        np.einsum("pi,pi->p", pivots_m - array.reference_m[pings], array.forward[pings])
        for pings in (slice(None, -1), slice(1, None))
    )
    return list(zip(first_m.tolist(), second_m.tolist(), strict=True))


def _check_coherence(found: _Passes) -> None:
    """Refuse lines if hardly any pair of pings is usable; warn of pairs that are not."""
    count, without = len(found.coherent), int((~found.coherent).sum())
    coherence = np.stack([step.coherence for step in found.steps])
    echoes = np.array([step.echoes for step in found.steps])
    sparse = found.yaw & found.coherent & (echoes < _LEAST_ECHOES)
    few = int(sparse.sum())
    if count - without - few < max(1, _LEAST_SHARE * count):
        if few > without:
            raise ArgumentError(
                "lines",
                f"have echoes of at least {_LEAST_ECHOES:g} reflectors, from all over a seabed, to "
                "measure yaw",
                f"about {np.median(echoes):.1f} in {few} of {count} pairs of pings",
                "use more range, leave out yaw with `unknowns=('sway',)`, or use `clsas.autofocus`",
            )
        raise ArgumentError(
            "lines",
            f"have a coherence of at least {found.least_coherence.min():.2f} from ping to ping, "
            "which distinguishes echoes from noise",
            f"at most {coherence[~found.coherent].max():.2f} in any window of {without} of "
            f"{count} pairs of pings",
            "check `range_m`, and the advance from ping to ping in the navigation",
        )
    if without:
        validate.warn(
            f"{without} of {count} pairs of pings are not coherent (the first one after ping "
            f"{int(np.argmin(found.coherent))}). The navigation bridges them, with its accuracy"
        )
    if few:
        validate.warn(
            f"{few} of {count} pairs of pings have echoes of fewer than {_LEAST_ECHOES:g} "
            f"reflectors (the first one after ping {int(np.argmax(sparse))}), which may all "
            "lie in one direction. The yaw of these pairs may be off by several standard deviations"
        )


def _combined(
    lines: RangeLines, found: _Passes, accuracy: NDArray[np.float64], correlation_pings: float
) -> Micronavigation:
    """Return the displacements combined with the navigation; `lines` have all banks."""
    coherent = found.coherent
    used = [step for step, use in zip(found.steps, coherent, strict=True) if use]
    scatter = np.stack([step.scatter for step in used])
    covariance = np.stack([step.covariance for step in found.steps])

    # All deviations are scaled by the misfit of the line or by the contradiction between blocks of
    # range: the variance of their scatter in yaw, or in sway if yaw is not measured, over its
    # expectation.
    misfit, blocks = max(float(np.mean([step.misfit for step in used])), 1.0), scatter.shape[1]
    if blocks >= _LEAST_BLOCKS:
        variances = covariance[coherent][:, 1, 1]
        if not variances.any():
            variances = covariance[coherent][:, 0, 0]
        variance = float(np.sum(scatter**2)) * blocks / (blocks - 1)
        misfit = max(misfit, variance / max(float(np.sum(variances)), 1e-300))

    # A reflector stays in the beam for many pings, and all blocks may share a few directions.
    lasting = float(np.mean([step.lasting for step in used])) * len(used)
    persist = max(persistence(scatter), lasting)

    steps: list[Step | None] = [None] * len(coherent)
    along: list[Step | None] = [None] * len(coherent)
    for ping in np.flatnonzero(coherent).tolist():
        spread = persist * misfit * covariance[ping]
        steps[ping] = Step.over(found.moved[ping], spread, found.levers_m[ping])
        along[ping] = Step.along(found.surge_m[ping], found.surge_sd_m[ping])
    states, covariances = smooth(steps, accuracy[:, :2], correlation_pings)
    surges, spreads = smooth(along, accuracy[:, 2:], correlation_pings)

    ratios = np.concatenate([states, surges], axis=1) / accuracy
    ratio = np.sqrt(np.mean(ratios**2, axis=0))
    worst = int(np.argmax(ratio))
    if ratio[worst] > _IMPLAUSIBLE:
        option = ("sway_sd_m", "yaw_sd_deg", "surge_sd_m")[worst]
        validate.warn(
            f"the {UNKNOWNS[worst]} found is {ratio[worst]:.3g} times the accuracy given for the "
            f"navigation (`{option}`), rms over the pings. Check `{option}`, `side` and "
            "`element_length_m`, and run `clsas inspect`, which detects samples with the wrong "
            "sign of phase"
        )
    corrected = moved(lines, found.array, states[:, 0], states[:, 1], surges[:, 0])
    at = Array.of(first_bank(corrected))
    heading = np.arctan2(at.forward[:, 1], at.forward[:, 0])
    deviations = np.sqrt(misfit * np.stack([np.diag(each) for each in covariance]))
    deviations[~coherent] = np.inf
    return Micronavigation(
        lines=corrected,
        track=Track(at.reference_m, np.arange(at.pings, dtype=np.float64), yaw_rad=heading),
        sway_m=states[:, 0],
        yaw_rad=states[:, 1],
        surge_m=surges[:, 0],
        sway_sd_m=np.sqrt(covariances[:, 0, 0]),
        yaw_sd_rad=np.sqrt(covariances[:, 1, 1]),
        surge_sd_m=np.sqrt(spreads[:, 0, 0]),
        sway_steps_m=found.moved[:, 0],
        yaw_steps_rad=found.moved[:, 1],
        sway_steps_sd_m=deviations[:, 0],
        yaw_steps_sd_rad=deviations[:, 1],
        coherence=np.stack([step.coherence for step in found.steps]),
        range_m=found.swath.middles_m,
        overlap=np.array([each.pairs for each in found.overlaps]),
        persistence=persist,
    )


@dataclass(frozen=True, eq=False)
class Micronavigation:
    """Result of micronavigation.

    Attributes
    ----------
    lines : RangeLines
        The given lines with corrected positions.
    track : Track
        Mean phase centre and heading of the array, ping by ping. Its `time_s` counts pings.
    sway_m, yaw_rad, surge_m : float64 [pings]
        Corrections of the navigation: displacement of the array to port, turn from forward to port,
        and displacement forward.
    sway_sd_m, yaw_sd_rad, surge_sd_m : float64 [pings]
        Standard deviations of the corrections. A common shift and turn of the whole track come from
        the navigation and have its accuracy.
    sway_steps_m, yaw_steps_rad : float64 [pings - 1]
        Displacements from ping to ping relative to the navigation, at the middle of the overlap.
    sway_steps_sd_m, yaw_steps_sd_rad : float64 [pings - 1]
        Standard deviations of the displacements; infinite where the echoes are not coherent.
    coherence : float64 [pings - 1, windows]
        Mean coherence of the pairs of channels, by window of range.
    range_m : float64 [windows]
        Ranges in the middle of the windows.
    overlap : int64 [pings - 1]
        Number of pairs of channels that share a phase centre.
    persistence : float
        Variance of the sum of the errors of many steps, divided by the variance that independent
        errors would have. It exceeds 1 because echoes stay in the beam for many pings. It is
        estimated from the scatter between blocks of range, and is at least the number of pings
        times the share of the variance that is due to having few echoes. The standard deviations
        of positions and of the track's shape include it.

    See Also
    --------
    micronavigate : Function that returns this result.
    """

    lines: RangeLines
    track: Track
    sway_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    surge_m: NDArray[np.float64]
    sway_sd_m: NDArray[np.float64]
    yaw_sd_rad: NDArray[np.float64]
    surge_sd_m: NDArray[np.float64]
    sway_steps_m: NDArray[np.float64]
    yaw_steps_rad: NDArray[np.float64]
    sway_steps_sd_m: NDArray[np.float64]
    yaw_steps_sd_rad: NDArray[np.float64]
    coherence: NDArray[np.float64]
    range_m: NDArray[np.float64]
    overlap: NDArray[np.int64]
    persistence: float = 1.0

    @cached_property
    def shape_sd_m(self) -> NDArray[np.float64]:
        """Standard deviation of the sway without a common shift and turn, metres, [pings].

        This part of the sway determines how sharp an image is. A shift and a turn of the whole
        track only shift and turn the image. NaN if the echoes of some pings are not coherent.

        It does not include errors that all ranges have in common. With 5000 points of speckle, 30
        to 60 pings and a correct navigation, errors were 0.4 to 2.6 times this value.
        """
        deviations = self.sway_steps_sd_m, self.yaw_steps_sd_rad
        if not all(np.isfinite(each).all() for each in deviations):
            return np.full(len(self.sway_m), np.nan)
        advance_m = np.linalg.norm(np.diff(self.lines.ping_centres_m, axis=0), axis=1)
        sway_m, yaw_rad = (np.sqrt(self.persistence) * each for each in deviations)
        return shape_deviation_m(sway_m, yaw_rad, advance_m)

    @property
    def figures(self) -> dict[str, Any]:
        """Size and uncertainty of the corrections, as numbers."""
        measured = np.isfinite(self.sway_steps_sd_m)
        return {
            "pings": len(self.sway_m),
            "overlap": int(self.overlap.min()),
            "coherence": float(np.median(self.coherence)),
            "sway_rms_m": float(np.std(self.sway_m)),
            "yaw_rms_rad": float(np.std(self.yaw_rad)),
            "surge_rms_m": float(np.std(self.surge_m)),
            "shape_sd_m": float(np.max(self.shape_sd_m)),
            "sway_step_sd_m": float(np.median(self.sway_steps_sd_m[measured])),
            "yaw_step_sd_rad": float(np.median(self.yaw_steps_sd_rad[measured])),
        }

    def __repr__(self) -> str:
        """Return the rms corrections and the median coherence."""
        return reprs.summary(
            self,
            f"{len(self.sway_m)} pings",
            f"sway {reprs.quantity(float(np.std(self.sway_m)), 'm')} rms",
            f"yaw {reprs.quantity(float(np.std(self.yaw_rad)), 'rad')} rms",
            f"coherence {np.median(self.coherence):.2f}",
        )
