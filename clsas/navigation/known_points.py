"""Calibration by known points: time offset, sound speed and lever arm from their responses.

Ranges of reflectors with known positions are measured in every channel, first by the envelope and
then, where the model is good enough to tell whole wavelengths, by the phase. All ranges enter one
least-squares fit, so that no reflector gets sharp at another's expense.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import reprs, validate
from clsas.core.lines import RangeLines
from clsas.navigation.range_fit import MOST_CONDITION, Alike, Fit, fitted
from clsas.navigation.range_model import Model
from clsas.navigation.reflectors import LEAST_SNR, Reader
from clsas.navigation.responses import displacement_axes
from clsas.signal.readout import Readout
from clsas.sonar.track import Track

UNKNOWNS = ("time_offset", "sound_speed", "forward", "port", "up")
DEFAULT_UNKNOWNS = UNKNOWNS[:2]

_UNITS = {"time_offset": "s", "sound_speed": "m/s", "forward": "m", "port": "m", "up": "m"}
_SEARCHED_CELLS = 50.0  # range resolution cells to either side, unless given
_OF_DISTANCE = 0.7  # of the distance in range between two points, that is searched at most
_LEAST_CELLS = 4.0  # that are searched in any case
_MOST_MISFIT = 1 / 3  # of a resolution cell, beyond which points may be mistaken for others
_LEAST_SEEN = 3  # channels, that a reflector must be seen by
_LEAST_SHARE = 0.05
"""Share of the channels from the first to the last that sees a reflector, in which it must be seen.
Noise alone reached 0.015 at most in 40 runs of 640 channels; reflectors in speckle of 40 dB less
have 0.8. A beam narrows the channels that see a reflector, but not this share."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration by known points. Values are corrections: what was added.

    Attributes
    ----------
    lines : RangeLines
        The lines given, with corrected first ranges, sound speed and positions.
    unknowns : tuple of str
        What was solved for.
    values : float64 [unknowns]
        Corrections of the unknowns, in s, m/s and m: time added to every sample's, speed added to
        the lines' sound speed, displacement added to all positions.
    covariance : float64 [unknowns, unknowns]
    held : tuple of str
        Unknowns that the points do not tell apart from others, and that were left as they were.
    residual_m : float64 [channels, points]
        Measured ranges less those of the corrected lines; NaN where a point was not seen.
    misfit_m : float
        Rms error of ranges beside the noise: of the track, the points or the model.
    phases : bool [points]
        Whether the phases of a point's response were used. If not, ranges are its envelope's.
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
        """Return every value with its standard deviation, and the residual."""
        return reprs.summary(self, self.describe())

    def describe(self) -> str:
        """Return the corrections with their standard deviations, in a line."""
        found = []
        for name, value, deviation in zip(self.unknowns, self.values, self.sd, strict=True):
            whole = self.sound_speed_m_s if name == "sound_speed" else float(value)
            shown = _with_deviation(whole, float(deviation), _UNITS[name])
            found.append(f"{name.replace('_', ' ')} {shown}")
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
        """Correlation of the values' errors, [unknowns, unknowns]."""
        sd = np.maximum(self.sd, 1e-300)
        return self.covariance / np.outer(sd, sd)

    @property
    def time_offset_s(self) -> float:
        """Time that was added to every sample's; 0 if it was not solved for."""
        return self._value("time_offset")

    @property
    def range_offset_m(self) -> float:
        """The time offset as a range at the corrected sound speed: a bias of ranges, removed."""
        return self.time_offset_s * self.sound_speed_m_s / 2

    @property
    def sound_speed_m_s(self) -> float:
        """Corrected sound speed."""
        return self.lines.sound_speed_m_s

    @property
    def lever_arm_m(self) -> NDArray[np.float64]:
        """Displacement forward, to port and up that was added to all positions, [3]."""
        return np.array([self._value(name) for name in UNKNOWNS[2:]])

    @property
    def seen(self) -> NDArray[np.int64]:
        """Number of channels in which each point was measured, [points]."""
        return np.isfinite(self.residual_m).sum(axis=0)

    @property
    def residual_rms_m(self) -> NDArray[np.float64]:
        """Rms residual of each point, [points]; NaN for one that was not seen."""
        count = np.maximum(self.seen, 1)
        square = np.nansum(self.residual_m**2, axis=0) / count
        return np.where(self.seen > 0, np.sqrt(square), np.nan)

    @property
    def figures(self) -> dict[str, Any]:
        """All numbers, in types of JSON."""
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
        return float(self.values[self.unknowns.index(name)]) if name in self.unknowns else 0.0


def calibrate_track(
    lines: RangeLines,
    points_m: ArrayLike,
    *,
    unknowns: Sequence[str] = DEFAULT_UNKNOWNS,
    search_m: float | None = None,
    track: Track | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Find time offset, sound speed and lever arm by reflectors whose positions are known.

    Parameters
    ----------
    lines : RangeLines
        Lines of any geometry, in at least three channels of which each reflector stands out by
        10 dB, and in 5 % of those from the first to the last of them: noise does so in 1 %.
    points_m : array_like, [points, 3]
        Positions of the reflectors.
    unknowns : sequence of {"time_offset", "sound_speed", "forward", "port", "up"}
        What to solve for, the most important first. A time offset is a bias of ranges too.
        "forward", "port" and "up" are the lever arm: a displacement of all transmitters and
        receivers that keeps its direction on the platform.
    search_m : float, optional
        Largest error of a range that is looked for, metres: less than the distance in range
        between two reflectors. Unless given, 50 range resolution cells, or 70 % of that distance.
    track : Track, optional
        The platform's attitude, ping by ping, in which the lever arm is measured. Unless given,
        forward is along the track, and up is perpendicular to it.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Calibration

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind or outside its limits; if fewer than three channels
        have samples where a point is expected; or if no point is seen.

    Warns
    -----
    ClsasWarning
        If the points do not tell two unknowns apart: the one named last is then left as it was. If
        a point is not seen: the others decide alone. If measured ranges contradict each other by
        more than a third of a resolution cell.

    Notes
    -----
    A response's range is measured by the peak of its envelope, with the Cramer-Rao bound as its
    standard deviation. Where the fit of all these ranges predicts phases to a fraction of a cycle,
    changes of phase from channel to channel enter a second fit. The phase that a reflector has
    itself is unknown, so that phases tell nothing about a constant range. Residuals beyond the
    noise are taken as an error of the same size for all reflectors. Standard deviations hold this
    error, and that it is common to the receivers of a ping and persists over pings, as far as the
    residuals show it. A displacement or bend of the whole track they do not hold.
    """
    validate.instance("lines", lines, RangeLines)
    points = validate.array("points_m", points_m, np.float64, (None, 3))
    names = validate.named("unknowns", unknowns, UNKNOWNS)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"unknowns must be one or several of {UNKNOWNS}, got {names}")
    validate.progress(progress)
    reader = Reader.of(Readout.of(lines))
    model = Model(lines, points, _axes(lines, names, track))
    search_m = _checked_search(model, reader, search_m)
    _check_within(model, search_m)
    steps = iter(range(1, 5))

    def step() -> None:
        if progress is not None:
            progress(next(steps, 4), 4)

    free = tuple(UNKNOWNS.index(name) for name in names)
    fit, alike, responses = fitted(model, reader, free, search_m, step)
    result = _result(model, fit, tuple(UNKNOWNS[each.held] for each in alike))
    _check_seen(result, responses.snr, search_m)
    for each in alike:
        _warn_of(each, lines)
    if result.misfit_m > _MOST_MISFIT * reader.cell_m:
        validate.warn(
            f"ranges of the points differ from those of the corrected lines by "
            f"{reprs.quantity(result.misfit_m, 'm')} rms beside the noise, more than a third of a "
            f"resolution cell: positions or track are wrong by as much, or search_m "
            f"({search_m:.3g} m) lets a reflector be mistaken for another"
        )
    if progress is not None:
        progress(4, 4)
    return result


def _checked_search(model: Model, reader: Reader, search_m: float | None) -> float:
    """Return the search given; by default reflectors are not mistaken for each other."""
    lines = reader.readout.lines
    longest_m = (lines.length - 1) * lines.range_step_m
    if search_m is not None:
        return validate.number("search_m", search_m, "m", least=reader.cell_m, most=longest_m)
    range_m = model.range_m(np.zeros(5))
    apart_m = [
        float(np.median(np.abs(range_m[:, one] - range_m[:, other])))
        for one in range(range_m.shape[1])
        for other in range(one)
    ]
    wanted_m = min([_SEARCHED_CELLS * reader.cell_m, *(_OF_DISTANCE * each for each in apart_m)])
    return min(max(wanted_m, _LEAST_CELLS * reader.cell_m), longest_m)


def _axes(lines: RangeLines, names: tuple[str, ...], track: Track | None) -> NDArray[np.float64]:
    """Return unit vectors forward, to port and up of every channel, [3, channels, 3]."""
    ping = lines.ping_numbers
    if track is not None:
        validate.instance("track", track, Track)
        pings = int(ping[-1]) + 1
        if track.pings != pings:
            raise ValueError(
                f"track must have a pose for each of the {pings} pings of lines, got {track.pings}"
            )
        return track.rotations.as_matrix()[ping].transpose(2, 0, 1)
    if not set(names) & set(UNKNOWNS[2:]):
        return np.zeros((3, lines.channels, 3))
    try:
        return displacement_axes(lines, ("surge", "sway", "heave"))[:, ping]
    except ValueError as error:
        raise ValueError(
            f"track must be given, with the platform's attitude, for a lever arm: the lines' "
            f"positions do not tell it ({error})"
        ) from error


def _check_within(model: Model, search_m: float) -> None:
    """Refuse points where hardly any channel has samples."""
    lines = model.lines
    expected_m = model.range_m(np.zeros(5))
    inside = expected_m > lines.first_range_m[:, None] - search_m
    inside &= expected_m < lines.last_range_m[:, None] + search_m
    counts = inside.sum(axis=0)
    worst = int(np.argmin(counts))
    if counts[worst] < min(_LEAST_SEEN, lines.channels):
        raise ValueError(
            f"points_m must lie where lines have samples; point {worst} is at ranges from "
            f"{expected_m[:, worst].min():.6g} to {expected_m[:, worst].max():.6g} m, lines reach "
            f"from {lines.first_range_m.min():.6g} to {lines.last_range_m.max():.6g} m"
        )


def _result(model: Model, fit: Fit, held: tuple[str, ...]) -> Calibration:
    return Calibration(
        lines=model.corrected(fit.state),
        unknowns=tuple(UNKNOWNS[n] for n in fit.free),
        values=fit.state[list(fit.free)],
        covariance=fit.covariance * _dependence(model.lines, fit.residual_m),
        held=held,
        residual_m=fit.residual_m,
        misfit_m=fit.misfit_m,
        phases=fit.phases,
    )


def _dependence(lines: RangeLines, residual_m: NDArray[np.float64]) -> float:
    """Return how many residuals are worth as much as one independent one, at least 1.

    An error of the track is common to the receivers of a ping, and lasts over many pings.
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
    alike = np.fft.irfft(spectrum.sum(axis=1))[:pings]
    alike /= max(alike[0], 1e-300)
    # Of independent residuals, correlations are below this limit but for one in 40.
    lasting = alike > 2 / math.sqrt(pings)
    last = int(np.argmin(lasting)) if not lasting.all() else pings
    return max(of_ping, 1.0) * float(1 + 2 * np.sum(alike[1:last]))


def _check_seen(result: Calibration, snr: NDArray[np.float64], search_m: float) -> None:
    """Refuse if no point is seen; warn of those that are not."""
    among = np.array([_among(np.isfinite(each)) for each in result.residual_m.T])
    missing = np.flatnonzero((result.seen < _LEAST_SEEN) | (result.seen < _LEAST_SHARE * among))
    where = (
        f"echoes stand out by {LEAST_SNR:g} times the noise in at least {_LEAST_SEEN} channels and "
        f"{100 * _LEAST_SHARE:g} % of those around them, within {search_m:.3g} m of where they are "
        "expected"
    )
    counts = ", ".join(
        f"{number} in {seen} of {around} channels"
        for number, seen, around in zip(missing, result.seen[missing], among[missing], strict=True)
    )
    if len(missing) == snr.shape[1]:
        raise ValueError(
            f"points_m must be seen, but of none {where}, as noise alone may do (point {counts}; "
            f"the largest is {snr.max():.3g} times the noise). Check positions, sound speed and "
            "search_m"
        )
    if len(missing):
        validate.warn(
            f"{len(missing)} of {snr.shape[1]} points are not seen (point {counts}): {where} of "
            "the others only, which decide alone"
        )


def _among(seen: NDArray[np.bool_]) -> int:
    """Return how many channels there are from the first to the last that sees a point."""
    channels = np.flatnonzero(seen)
    return int(np.ptp(channels)) + 1 if channels.size else 0


def _warn_of(alike: Alike, lines: RangeLines) -> None:
    names, held = [UNKNOWNS[n] for n in alike.unknowns], UNKNOWNS[alike.held]
    kept = f"{lines.sound_speed_m_s:g} m/s" if held == "sound_speed" else f"0 {_UNITS[held]}"
    one = len(names) == 1
    validate.warn(
        f"the points do not tell {' and '.join(names)} "
        f"{'at all' if one else 'apart'} (condition number {alike.condition:.2g}, at most "
        f"{MOST_CONDITION:g}): {held} is held at {kept}"
        + ("" if one else ", and what is found of the others holds for that value")
        + ". Reflectors at other ranges and in other directions tell more"
    )


def _with_deviation(value: float, deviation: float, unit: str) -> str:
    """Return "4.00 ± 0.15 mm": a value and its standard deviation, with the digits that count."""
    if not 0 < deviation < math.inf:
        return reprs.quantity(value, unit)
    larger = max(abs(value), deviation)
    shown, prefixed = reprs.quantity(larger, unit).split(maxsplit=1)
    factor = 10.0 ** round(math.log10(larger / float(shown)))
    digits = max(1 - math.floor(math.log10(deviation / factor)), 0)
    return f"{value / factor:.{digits}f} ± {deviation / factor:.{digits}f} {prefixed}"
