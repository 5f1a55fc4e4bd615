"""Micronavigation by displaced phase centres (DPCA): sway, yaw and surge from echoes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Choice, Names, Number, Span
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.track import Track
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.engine.water.ray_delays import at_speed
from clsas.navigation.accuracy import (
    CORRELATION,
    SURGE_SD,
    SWAY_SD,
    YAW_SD,
    Accuracy,
    check_plausible,
)
from clsas.navigation.checks import check_navigation, first_bank, mean_wavelength_m
from clsas.navigation.correlation import DEAD_DB, Correlator
from clsas.navigation.overlap import Array, moved
from clsas.navigation.passes import LEAST_ECHOES, Displacements, measured
from clsas.navigation.smoother import Step, persistence, shape_deviation_m, smooth
from clsas.navigation.swath import SIDES, Swath, check_sizes, checked_swath

UNKNOWNS = ("sway", "yaw", "surge")
"""Default standard deviation of a navigation's yaw."""

_LEAST_BLOCKS = 4  # blocks of range that are needed to estimate a variance from their scatter
_LEAST_SHARE = 0.25  # share of the pairs of pings that must be usable


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

    def __repr__(self) -> str:
        """Return the rms corrections and the median coherence."""
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
    most_step_m: Annotated[
        float, Number("m", above=0.0, help="Largest displacement between pings.")
    ] = 0.1,
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
    names = validate.named("unknowns", unknowns, UNKNOWNS)
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
    accuracy = Accuracy.of(array.pings, sway_sd_m, yaw_sd_deg, surge_sd_m, correlation_pings)
    longest_m = float(np.diff(swath.edges_m).max())
    most_step_m = validate.number("most_step_m", most_step_m, "m", above=0.0, most=longest_m)
    correlator = Correlator(array_lines, swath)
    check_sizes(array_lines, array, swath, mean_wavelength_m(correlator.readout))
    dead = int((~correlator.live).sum())
    if dead:
        of_bank = " of the first bank" * (lines.banks > 1)
        validate.warn(
            f"{dead} of {array_lines.channels} channels{of_bank} have no signal, or at least "
            f"{-DEAD_DB:.0f} dB less than the other channels of their ping (the first is channel "
            f"{int(np.argmin(correlator.live))}). They are left out"
        )
    found = measured(array, correlator, names, accuracy.deviations[:, :2], most_step_m, progress)
    return _result(lines, array, swath, found, accuracy)


def _result(
    lines: RangeLines,
    array: Array,
    swath: Swath,
    found: Displacements,
    accuracy: Accuracy,
) -> Micronavigation:
    """Return the displacements combined with the navigation; `lines` have all banks."""
    _check_coherence(found)
    count = len(found.moved)
    misfit = max(float(found.misfit[found.coherent].mean()), _contradiction(found), 1.0)
    # A reflector stays in the beam for many pings, and all blocks may share a few directions.
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
    at = Array.of(first_bank(corrected))
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
    """Return the variance of the scatter between blocks of range over its expectation.

    It is that of yaw, or of sway if yaw is not measured.
    """
    scatter, covariance = found.scatter[found.coherent], found.covariance[found.coherent]
    blocks = scatter.shape[1]
    if blocks < _LEAST_BLOCKS:
        return 1.0
    number = 1 if covariance[:, 1, 1].any() else 0
    variance = float(np.sum(scatter**2)) * blocks / (blocks - 1)
    return variance / max(float(np.sum(covariance[:, number, number])), 1e-300)


def _check_coherence(found: Displacements) -> None:
    """Refuse lines if hardly any pair of pings is usable; warn of pairs that are not."""
    count, without = len(found.coherent), int((~found.coherent).sum())
    few = int(found.sparse.sum())
    if count - without - few < max(1, _LEAST_SHARE * count):
        if few > without:
            raise ArgumentError(
                "lines",
                f"have echoes of at least {LEAST_ECHOES:g} reflectors, from all over a seabed, to "
                "measure yaw",
                f"about {np.median(found.echoes):.1f} in {few} of {count} pairs of pings",
                "use more range, leave out yaw with `unknowns=('sway',)`, or use `clsas.autofocus`",
            )
        raise ArgumentError(
            "lines",
            f"have a coherence of at least {found.least_coherence.min():.2f} from ping to ping, "
            "which distinguishes echoes from noise",
            f"at most {found.coherence[~found.coherent].max():.2f} in any window of {without} of "
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
            f"{few} of {count} pairs of pings have echoes of fewer than {LEAST_ECHOES:g} "
            f"reflectors (the first one after ping {int(np.argmax(found.sparse))}), which may all "
            "lie in one direction. The yaw of these pairs may be off by several standard deviations"
        )
