"""Calibration with known points: time offset, sound speed and lever arm from their responses.

The ranges of reflectors at known positions are measured in every channel: first by the envelope,
and by the phase where the model is accurate enough to resolve whole wavelengths. All ranges enter
one least-squares fit, so that no reflector is focused at the expense of another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Names, Number, Positions, check_declared
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.track import Track
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.checks import displacement_axes
from clsas.navigation.range_fit import (
    LEAST_SNR,
    MOST_CONDITION,
    UNKNOWNS,
    Ambiguity,
    Reflectors,
    fitted,
)

DEFAULT_UNKNOWNS = UNKNOWNS[:2]

UNITS = {"time_offset": "s", "sound_speed": "m/s", "forward": "m", "port": "m", "up": "m"}
"""Units of the unknowns."""

_STEPS = 4  # steps of the progress
_SEARCHED_CELLS = 50.0  # default half width of the search, range resolution cells
_OF_DISTANCE = 0.7  # most of the distance in range between two points that is searched by default
_LEAST_CELLS = 4.0  # least that is searched by default
_MOST_MISFIT = 1 / 3  # range cells, above which points may be mistaken for each other
_LEAST_SEEN = 3  # channels in which a reflector must be seen
_LEAST_SHARE = 0.05
"""Share of the channels between the first and the last that see a reflector in which it must be
seen. Noise alone reached at most 0.015 in 40 runs of 640 channels. Reflectors in speckle that is 40
dB weaker have 0.8. A beam limits the channels that see a reflector, but does not lower this
share."""


def calibrate_track(
    lines: RangeLines,
    points_m: Annotated[ArrayLike, Positions(help="Positions of reflectors.")],
    *,
    unknowns: Annotated[
        Sequence[str], Names(UNKNOWNS, help="Unknowns to solve for, the most important first.")
    ] = DEFAULT_UNKNOWNS,
    search_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            help="Largest range error to search for.",
            default="50 resolution cells, or 70 % of the smallest distance in range between two "
            "reflectors if that is less",
        ),
    ] = None,
    track: Track | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Return lines corrected in time offset, sound speed and lever arm, from known reflectors.

    Parameters
    ----------
    lines : RangeLines
        Lines of any geometry. Each reflector must exceed the noise by 10 dB in at least three
        channels, and in 5 % of the channels between the first and the last of them. Noise alone
        does so in 1 %.
    points_m : array_like, [points, 3]
        Positions of the reflectors.
    unknowns : sequence of {"time_offset", "sound_speed", "forward", "port", "up"}
        Unknowns to solve for, the most important first. A time offset is equivalent to a bias of
        all ranges. "forward", "port" and "up" are the lever arm, a displacement of all transmitters
        and receivers in the frame of the platform.
    search_m : float, optional
        Largest range error to search for, metres. It should be less than the distance in range
        between any two reflectors. The default is 50 range resolution cells, or 70 % of the
        smallest such distance if that is less.
    track : Track, optional
        Attitude of the platform, ping by ping, which orients the lever arm. By default, forward is
        along the track, and up is perpendicular to it.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Calibration

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits; if fewer than three channels
        have samples where a point is expected; if no point is seen; or if lines have a profile of
        the sound speed.

    Warns
    -----
    ClsasWarning
        If the points do not distinguish two unknowns; the one named last is then not changed. If a
        point is not seen; only the others are then used. If measured ranges contradict each other
        by more than a third of a range resolution cell.

    See Also
    --------
    micronavigate : Corrects the track of an array from overlapping phase centres.
    autofocus : Corrects a track from the bright responses of an image.

    Notes
    -----
    The range of a response is measured by the peak of its envelope, and its standard deviation is
    the Cramer-Rao bound. Where the fit of all these ranges predicts phases to a fraction of a
    cycle, a second fit includes the changes of phase from channel to channel. Because the phase of
    a reflector itself is unknown, phases contain no information about a bias of its ranges.

    Residuals in excess of the noise are attributed to an error of the same size for all reflectors.
    The standard deviations include this error. They also take into account that the receivers
    of a ping share this error, and that it persists over several pings as far as the residuals show
    it. They do not include a displacement or a bend of the whole track.

    Examples
    --------
    All ranges of a recording are too large by 10 cm, and two reflectors show it:

    >>> from dataclasses import replace
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    >>> sonar = clsas.Sonar(pulse, [[0, 0, 0]], tx_length_m=0.03, rx_length_m=0.03)
    >>> track = clsas.Track.straight((0, 0, 0), (0.05, 0, 0), 60, 1.0)
    >>> points_m = [[1.0, 8.0, 0.0], [1.5, 15.0, 0.0]]
    >>> targets = clsas.PointTargets(points_m, [1, 1])
    >>> lines = clsas.compress(clsas.simulate(sonar, track, targets, range_m=(7, 17)))
    >>> lines = replace(lines, first_range_m=lines.first_range_m + 0.1)
    >>> found = clsas.calibrate_track(lines, points_m)
    >>> found.unknowns
    ('time_offset', 'sound_speed')
    >>> round(found.range_offset_m, 3), round(found.sound_speed_m_s, 1)
    (-0.1, 1500.0)
    """
    validate.instance("lines", lines, RangeLines)
    if lines.sound_speed is not None:
        raise ArgumentError(
            "lines",
            "have no `sound_speed`",
            hint="ranges of known points determine a constant speed; calibrate near the sonar, "
            "without the profile, and add it then",
        )
    given = {"points_m": points_m, "unknowns": unknowns}
    points, names = check_declared(calibrate_track, given).values()
    validate.progress(progress)
    reflectors = Reflectors(Readout.of(lines), points, _axes(lines, names, track))
    search_m = _checked_search(reflectors, search_m)
    steps = iter(range(1, _STEPS + 1))

    def step() -> None:
        if progress is not None:
            progress(next(steps), _STEPS)

    free = tuple(UNKNOWNS.index(name) for name in names)
    fit, ambiguities, largest_snr = fitted(reflectors, free, search_m, step)
    result = Calibration(
        lines=reflectors.corrected(fit.state),
        unknowns=tuple(UNKNOWNS[n] for n in fit.free),
        values=fit.state[list(fit.free)],
        covariance=fit.covariance * _dependence(lines, fit.residual_m),
        held=tuple(UNKNOWNS[each.held] for each in ambiguities),
        residual_m=fit.residual_m,
        misfit_m=fit.misfit_m,
        phases=fit.phases,
    )
    _check_seen(result, largest_snr, search_m)
    for each in ambiguities:
        _warn_of(each, lines)
    if result.misfit_m > _MOST_MISFIT * reflectors.cell_m:
        validate.warn(
            "the measured ranges of the points differ from those of the corrected lines by "
            f"{reprs.quantity(result.misfit_m, 'm')} rms in addition to the noise, which is more "
            "than a third of a range resolution cell. Positions of points or track are off by as "
            f"much, or `search_m` ({search_m:.3g} m) is so large that reflectors are mistaken "
            "for each other"
        )
    step()
    return result


def _axes(lines: RangeLines, names: tuple[str, ...], track: Track | None) -> NDArray[np.float64]:
    """Return unit vectors forward, to port and up of every channel, [3, channels, 3]."""
    ping = lines.ping_numbers
    if track is not None:
        validate.instance("track", track, Track)
        pings = int(ping[-1]) + 1
        if track.pings != pings:
            allowed = f"have a pose for each of the {pings} pings of lines"
            raise ArgumentError("track", allowed, track.pings)
        return track.rotations.as_matrix()[ping].transpose(2, 0, 1)
    if not set(names) & set(UNKNOWNS[2:]):
        return np.zeros((3, lines.channels, 3))
    try:
        return displacement_axes(lines, ("surge", "sway", "heave"))[:, ping]
    except ValueError as error:
        raise ArgumentError(
            "track",
            "be given for a lever arm, with the platform's attitude, which does not follow from "
            "the positions of lines",
            hint=str(error),
        ) from error


def _checked_search(reflectors: Reflectors, search_m: float | None) -> float:
    """Return the half width of the search; refuse points where hardly any channel has samples."""
    lines, cell_m = reflectors.lines, reflectors.cell_m
    expected_m = reflectors.range_m(np.zeros(5))
    longest_m = (lines.length - 1) * lines.range_step_m
    if search_m is None:
        # By default, no reflector is searched where another one is expected.
        apart_m = [
            float(np.median(np.abs(expected_m[:, one] - expected_m[:, other])))
            for one in range(len(reflectors.points_m))
            for other in range(one)
        ]
        search_m = min([_SEARCHED_CELLS * cell_m, *(_OF_DISTANCE * each for each in apart_m)])
        search_m = min(max(search_m, _LEAST_CELLS * cell_m), longest_m)
    else:
        search_m = validate.number("search_m", search_m, "m", least=cell_m, most=longest_m)
    inside = expected_m > lines.first_range_m[:, None] - search_m
    inside &= expected_m < lines.last_range_m[:, None] + search_m
    counts = inside.sum(axis=0)
    worst = int(np.argmin(counts))
    if counts[worst] < min(_LEAST_SEEN, lines.channels):
        raise ArgumentError(
            "points_m",
            "lie where lines have samples, at ranges from "
            f"{lines.first_range_m.min():.6g} to {lines.last_range_m.max():.6g} m",
            f"point {worst} at ranges from {expected_m[:, worst].min():.6g} to "
            f"{expected_m[:, worst].max():.6g} m",
        )
    return search_m


def _dependence(lines: RangeLines, residual_m: NDArray[np.float64]) -> float:
    """Return how many residuals contain as much information as one independent one, at least 1.

    An error of the track is common to the receivers of a ping, and persists over many pings.
    """
    ping, seen = lines.ping_numbers, np.isfinite(residual_m)
    pings = int(ping[-1]) + 1
    total, count = np.zeros((2, pings, residual_m.shape[1]))
    np.add.at(total, ping, np.where(seen, residual_m, 0.0))
    np.add.at(count, ping, seen)
    power = float(np.sum(residual_m[seen] ** 2))
    if not power:
        return 1.0
    # The variance of a sum over neighbouring pings, relative to that of independent residuals.
    scaled = total / np.sqrt(np.maximum(count, 1))
    of_ping = float(np.sum(scaled**2)) * int(seen.sum()) / (power * int(np.sum(count > 0)))
    spectrum = np.abs(np.fft.rfft(scaled, 2 * pings, axis=0)) ** 2
    correlation = np.fft.irfft(spectrum.sum(axis=1))[:pings]
    correlation /= max(correlation[0], 1e-300)
    # Correlations of independent residuals exceed this limit in 1 of 40 cases.
    lasting = correlation > 2 / math.sqrt(pings)
    last = int(np.argmin(lasting)) if not lasting.all() else pings
    return max(of_ping, 1.0) * float(1 + 2 * np.sum(correlation[1:last]))


def _check_seen(result: Calibration, largest_snr: float, search_m: float) -> None:
    """Refuse if no point is seen; warn of points that are not."""
    count = len(result.seen)
    between = np.zeros(count, np.int64)
    for number, seen in enumerate(np.isfinite(result.residual_m).T):
        if seen.any():
            between[number] = np.ptp(np.flatnonzero(seen)) + 1
    missing = np.flatnonzero((result.seen < _LEAST_SEEN) | (result.seen < _LEAST_SHARE * between))
    criterion = (
        f"echoes must exceed the noise by {10 * math.log10(LEAST_SNR):g} dB in at least "
        f"{_LEAST_SEEN} channels, and in {100 * _LEAST_SHARE:g} % of the channels between the "
        f"first and the last of them, within {search_m:.3g} m of the expected range"
    )
    counts = ", ".join(
        f"{number} in {seen} of {around} channels"
        for number, seen, around in zip(
            missing, result.seen[missing], between[missing], strict=True
        )
    )
    if len(missing) == count:
        raise ArgumentError(
            "points_m",
            "be seen",
            "none that is",
            f"{criterion}; those of point {counts} do, which noise alone may reach. The largest is "
            f"{largest_snr:.3g} times the noise. Check positions, sound speed and `search_m`",
        )
    if len(missing):
        validate.warn(
            f"{len(missing)} of {count} points are not seen, and only the others are used: "
            f"{criterion}; those of point {counts} do"
        )


def _warn_of(ambiguity: Ambiguity, lines: RangeLines) -> None:
    """Warn of unknowns that the points do not distinguish."""
    names, held = [UNKNOWNS[n] for n in ambiguity.unknowns], UNKNOWNS[ambiguity.held]
    kept = f"{lines.sound_speed_m_s:g} m/s" if held == "sound_speed" else f"0 {UNITS[held]}"
    if len(names) == 1:
        fault, others = f"do not determine {names[0]}", ""
    else:
        fault = f"do not distinguish {' and '.join(names)}"
        others = ", and the values found for the others depend on that"
    validate.warn(
        f"the points {fault} (condition number {ambiguity.condition:.2g}, at most "
        f"{MOST_CONDITION:g}): {held} is held at {kept}{others}. Use reflectors at more ranges and "
        "in more directions"
    )


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration with known points. Its values are the corrections that were added.

    Attributes
    ----------
    lines : RangeLines
        The given lines with corrected first ranges, sound speed and positions.
    unknowns : tuple of str
        Names of the unknowns that were solved for.
    values : float64 [unknowns]
        Corrections in s, m/s and m: time added to that of every sample, speed added to the lines'
        sound speed, and displacement added to all positions.
    covariance : float64 [unknowns, unknowns]
        Covariance matrix of the values, in the products of their units.
    held : tuple of str
        Unknowns that the points cannot distinguish from others. They were not changed.
    residual_m : float64 [channels, points]
        Measured ranges minus those of the corrected lines; NaN where a point was not seen.
    misfit_m : float
        Rms error of ranges in addition to the noise, due to the track, the points or the model.
    phases : bool [points]
        True where the phases of a point's response were used. Elsewhere, the ranges are those of
        the peak of the envelope.

    See Also
    --------
    calibrate_track : Function that returns this result.
    """

    lines: RangeLines
    unknowns: tuple[str, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    held: tuple[str, ...]
    residual_m: NDArray[np.float64]
    misfit_m: float
    phases: NDArray[np.bool_]

    def __repr__(self) -> str:
        """Return the corrections with their standard deviations, and the residual."""
        return reprs.summary(self, self.describe())

    def describe(self) -> str:
        """Return the corrections with their standard deviations, on one line."""
        found = []
        for name, value, deviation in zip(self.unknowns, self.values, self.sd, strict=True):
            whole = self.sound_speed_m_s if name == "sound_speed" else float(value)
            found.append(in_words(name, whole, float(deviation)))
        found += [f"{name.replace('_', ' ')} held" for name in self.held]
        residual_m = float(np.sqrt(np.nanmean(self.residual_m**2)))
        found.append(f"residual {reprs.quantity(residual_m, 'm')} rms")
        return ", ".join(found) + f" at {self.residual_m.shape[1]} points"

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations of the values, [unknowns]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation of the errors of the values, [unknowns, unknowns]."""
        sd = np.maximum(self.sd, 1e-300)
        return self.covariance / np.outer(sd, sd)

    @property
    def time_offset_s(self) -> float:
        """Time that was added to that of every sample, s; 0 if it was not solved for."""
        return self._value("time_offset")

    @property
    def range_offset_m(self) -> float:
        """Time offset as a range at the corrected sound speed, m."""
        return self.time_offset_s * self.sound_speed_m_s / 2

    @property
    def sound_speed_m_s(self) -> float:
        """Corrected sound speed, m/s."""
        return self.lines.sound_speed_m_s

    @property
    def lever_arm_m(self) -> NDArray[np.float64]:
        """Displacement forward, to port and up that was added to all positions, m, [3]."""
        return np.array([self._value(name) for name in UNKNOWNS[2:]])

    @property
    def seen(self) -> NDArray[np.int64]:
        """Number of channels in which each point was measured, [points]."""
        return np.isfinite(self.residual_m).sum(axis=0)

    @property
    def residual_rms_m(self) -> NDArray[np.float64]:
        """Rms residual of each point, m, [points]; NaN for a point that was not seen."""
        count = np.maximum(self.seen, 1)
        square = np.nansum(self.residual_m**2, axis=0) / count
        return np.where(self.seen > 0, np.sqrt(square), np.nan)

    @property
    def figures(self) -> dict[str, Any]:
        """All numbers, in types that JSON can represent."""
        return {
            "unknowns": list(self.unknowns),
            "values": self.values.tolist(),
            "sd": self.sd.tolist(),
            "correlation": self.correlation.tolist(),
            "held": list(self.held),
            "time_offset_s": self.time_offset_s,
            "sound_speed_m_s": self.sound_speed_m_s,
            "lever_arm_m": self.lever_arm_m.tolist(),
            "seen": self.seen.tolist(),
            "residual_rms_m": [n if math.isfinite(n) else None for n in self.residual_rms_m],
            "misfit_m": self.misfit_m,
            "phases": self.phases.tolist(),
        }

    def _value(self, name: str) -> float:
        """Return the correction of an unknown, 0 if it was not solved for."""
        return float(self.values[self.unknowns.index(name)]) if name in self.unknowns else 0.0


def in_words(name: str, value: float, sd: float) -> str:
    """Return a value and its standard deviation, such as "time offset 10.0 ± 1.5 µs"."""
    return f"{name.replace('_', ' ')} {reprs.with_deviation(value, sd, UNITS[name])}"
