"""Micronavigation by displaced phase centres (DPCA): sway, yaw and surge from echoes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import reprs, validate
from clsas.core.conditioning import DEAD_DB
from clsas.core.lines import RangeLines
from clsas.navigation.accuracy import Accuracy, check_plausible
from clsas.navigation.checks import check_navigation, mean_wavelength_m
from clsas.navigation.displacement import Correlator
from clsas.navigation.overlap import Array, moved
from clsas.navigation.passes import LEAST_ECHOES, Displacements, measured
from clsas.navigation.smoother import Step, persistence, shape_deviation_m, smooth
from clsas.navigation.swath import Swath, check_sizes, checked_swath
from clsas.signal.compression import compress
from clsas.signal.echoes import Echoes
from clsas.sonar.track import Track

UNKNOWNS = ("sway", "yaw", "surge")
YAW_SD_RAD = math.radians(1.0)
"""Standard deviation of a navigation's yaw, unless given."""

_LEAST_BLOCKS = 4  # of range, whose scatter tells a variance
_LEAST_SHARE = 0.25  # of the pairs of pings, that must be coherent


@dataclass(frozen=True, eq=False)
class Micronavigation:
    """Result of micronavigation.

    Attributes
    ----------
    lines : RangeLines
        The lines given, with corrected positions.
    track : Track
        The array's mean phase centre and heading, ping by ping. `time_s` counts pings.
    sway_m, yaw_rad, surge_m : float64 [pings]
        Displacement of the array to port of its navigation, turn from forward to port, and
        displacement forward.
    sway_sd_m, yaw_sd_rad, surge_sd_m : float64 [pings]
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
    persistence : float
        Variance that errors of many steps add up to, over that of independent ones: echoes stay in
        the beam for many pings. It is measured between blocks of range, and is at least the number
        of pings times the share of the variance that few echoes make. Standard deviations of
        positions and of the shape contain it.
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

        An image is as sharp as this is small: a shift and a turn of the whole track move and turn
        the image. NaN if echoes of some pings were not coherent.

        It does not hold errors that all ranges share. Over 5000 points of speckle, 30 to 60 pings
        and a navigation that was right, errors were 0.4 to 2.6 times this.
        """
        deviations = self.sway_steps_sd_m, self.yaw_steps_sd_rad
        if not all(np.isfinite(each).all() for each in deviations):
            return np.full(len(self.sway_m), np.nan)
        advance_m = np.linalg.norm(np.diff(self.lines.ping_centres_m, axis=0), axis=1)
        sway_m, yaw_rad = (np.sqrt(self.persistence) * each for each in deviations)
        return shape_deviation_m(sway_m, yaw_rad, advance_m)

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
    yaw_sd_rad: ArrayLike = YAW_SD_RAD,
    surge_sd_m: ArrayLike = 0.1,
    correlation_pings: float | None = None,
    unknowns: Sequence[str] = UNKNOWNS,
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
        Where the seabed lies, seen in the direction in which the array advances. Echoes do not
        tell: the wrong side gives sway of the wrong sign.
    seabed_z_m : float, optional
        Height of the seabed. Rays then slope down to it, and sway is horizontal; without it rays
        are taken as horizontal.
    element_length_m : float or (transmitter, receiver), optional
        Lengths of the elements. Give them where the beam is wide: echoes far from broadside change
        their range less, and with separate transmitters and receivers they shift phases. Both pings
        are then aligned for every direction of the beam.
    sway_sd_m, yaw_sd_rad, surge_sd_m : float or array_like [pings]
        Standard deviation of the navigation's sway, yaw and surge.
    correlation_pings : float, optional
        Number of pings over which errors of the navigation persist. Unless given the whole
        recording, so that the navigation decides little but a common shift and turn.
    unknowns : sequence of {"sway", "yaw", "surge"}
        What to find; sway always. Leave out yaw and surge of an array at rest whose timing jitters.
        Surge, the advance, is told by where the coherence along the array is largest.
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
        If an argument is of the wrong kind or outside its limits; if there is one ping, positions
        are missing, or pings repeat a position; if fewer than three phase centres overlap; if
        hardly any two pings are coherent; or if yaw is looked for in the echoes of a few
        reflectors.

    Warns
    -----
    ClsasWarning
        If some pairs of pings are not coherent: the navigation bridges them. If some hold so few
        echoes that their yaw may err by more than its deviation. If channels are dead:
        they are left out. If what is found is far beyond the accuracy of the navigation. If the
        track turns back, so that pings may be out of order.

    Notes
    -----
    See `clsas.navigation.displacement` for the measurement. Standard deviations follow the bound
    for K pairs of coherence g over L independent samples (Bellettini and Pinto 2002):

        sigma_phase = sqrt((1 - g^2)/(2 L g^2)),
        sigma_sway = wavelength/(4 pi) sigma_phase/sqrt(K),
        sigma_yaw = wavelength/(4 pi) sigma_phase sqrt(12/(K (K^2 - 1)))/spacing.

    They follow from the phase of a product of two correlated complex Gaussian signals, averaged
    over L samples, and a straight line fitted to K such phases at equal steps. Where a window holds
    fewer echoes than speckle, phases are less certain by what filters leave of the directions of so
    few. Deviations are scaled by the misfit of that line over all pings, or by the contradiction
    between blocks of range, where either is more than expected; yaw's also by what neighbouring
    pairs have in common. Those of positions and of the track's shape are scaled by
    `Micronavigation.persistence` too.
    """
    if isinstance(lines, Echoes):
        lines = compress(lines)
    validate.instance("lines", lines, RangeLines)
    validate.progress(progress)
    names = _checked_unknowns(unknowns)
    check_navigation(lines, 2, "micronavigation", may_stand=False)
    array = Array.of(lines)
    swath = checked_swath(lines, range_m, window_m, side, seabed_z_m, element_length_m)
    accuracy = Accuracy.of(array.pings, sway_sd_m, yaw_sd_rad, surge_sd_m, correlation_pings)
    longest_m = float(np.diff(swath.edges_m).max())
    most_step_m = validate.number("most_step_m", most_step_m, "m", above=0.0, most=longest_m)
    correlator = Correlator(lines, swath)
    check_sizes(lines, array, swath, mean_wavelength_m(correlator.readout))
    dead = int((~correlator.heard).sum())
    if dead:
        validate.warn(
            f"{dead} of {lines.channels} channels hold no signal, or {-DEAD_DB:.0f} dB less than "
            f"others of their ping (the first is channel {int(np.argmin(correlator.heard))}): they "
            "are left out of what is correlated"
        )
    found = measured(
        lines, array, correlator, names, accuracy.deviations[:, :2], most_step_m, progress
    )
    return _result(lines, array, swath, found, accuracy)


def _checked_unknowns(unknowns: Sequence[str]) -> tuple[str, ...]:
    names = validate.named("unknowns", unknowns, UNKNOWNS)
    if "sway" not in names:
        raise ValueError(f"unknowns must hold 'sway', got {names}")
    return names


def _result(
    lines: RangeLines,
    array: Array,
    swath: Swath,
    found: Displacements,
    accuracy: Accuracy,
) -> Micronavigation:
    """Fuse displacements with the navigation."""
    _check_coherence(found)
    count = len(found.moved)
    misfit = max(float(found.misfit[found.coherent].mean()), _contradiction(found), 1.0)
    # A reflector is in the beam of many pings, and all blocks may have the same few directions.
    lasting = float(found.lasting[found.coherent].mean()) * int(found.coherent.sum())
    persist = max(persistence(found.scatter[found.coherent]), lasting)
    steps: list[Step | None] = [None] * count
    along: list[Step | None] = [None] * count
    for ping in np.flatnonzero(found.coherent).tolist():
        covariance = persist * misfit * found.covariance[ping]
        steps[ping] = Step.over(found.moved[ping], covariance, found.levers_m[ping])
        along[ping] = Step.along(found.surge_m[ping], found.surge_sd_m[ping])
    states, covariances = smooth(steps, accuracy.deviations[:, :2], accuracy.correlation_pings)
    surges, spreads = smooth(along, accuracy.deviations[:, 2:], accuracy.correlation_pings)
    check_plausible(np.concatenate([states, surges], axis=1), accuracy)
    corrected = moved(lines, array, states[:, 0], states[:, 1], surges[:, 0])
    at = Array.of(corrected)
    heading = np.arctan2(at.forward[:, 1], at.forward[:, 0])
    deviations = np.sqrt(misfit * np.stack([np.diag(each) for each in found.covariance]))
    deviations[~found.coherent] = np.inf
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
        coherence=found.coherence,
        range_m=swath.middles_m,
        overlap=found.pairs,
        persistence=persist,
    )


def _contradiction(found: Displacements) -> float:
    """Return the variance by which blocks of range contradict each other, over what is expected.

    Yaw's, or sway's where yaw is not looked for.
    """
    scatter, covariance = found.scatter[found.coherent], found.covariance[found.coherent]
    blocks = scatter.shape[1]
    if blocks < _LEAST_BLOCKS:
        return 1.0
    number = 1 if covariance[:, 1, 1].any() else 0
    variance = float(np.sum(scatter**2)) * blocks / (blocks - 1)
    return variance / max(float(np.sum(covariance[:, number, number])), 1e-300)


def _check_coherence(found: Displacements) -> None:
    """Refuse lines if hardly any pair of pings is usable; warn of those that are not."""
    count, without = len(found.coherent), int((~found.coherent).sum())
    few = int(found.sparse.sum())
    if count - without - few < max(1, _LEAST_SHARE * count):
        if few > without:
            raise ValueError(
                f"lines must hold echoes from all over a seabed; {few} of {count} pairs of pings "
                f"have those of about {np.median(found.echoes):.1f} reflectors, at least "
                f"{LEAST_ECHOES:g} are needed: they do not tell a yaw from their directions. "
                'Take more range, leave out yaw with unknowns=("sway",), or use clsas.autofocus'
            )
        raise ValueError(
            f"lines must be coherent from ping to ping; {without} of {count} pairs "
            f"of pings are not: their coherence is at most "
            f"{found.coherence[~found.coherent].max():.2f} in any window, and "
            f"{found.least_coherence.min():.2f} at least is needed to tell echoes from noise. "
            f"Check range_m, and the navigation's advance from ping to ping"
        )
    if without:
        validate.warn(
            f"{without} of {count} pairs of pings are not coherent (the first after "
            f"ping {int(np.argmin(found.coherent))}): the navigation's accuracy bridges them"
        )
    if few:
        validate.warn(
            f"{few} of {count} pairs of pings hold the echoes of fewer than {LEAST_ECHOES:g} "
            f"reflectors (the first after ping {int(np.argmax(found.sparse))}), which may all lie "
            f"in one direction: yaw may err by several of its standard deviations there"
        )
