"""Systematic errors of a pair of banks, from known heights or from two views of one seabed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import Names, Number, Positions, check_declared
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.planner import TOLERANCE
from clsas.engine.signal.spectrum import middle_cycles_per_m
from clsas.interferometry.checks import HEIGHTS_TOLERANCE_DB, KNOWN_HEIGHT, check_pair
from clsas.interferometry.comparisons import Comparison, Displaced, at_pixels, at_points, in_overlap
from clsas.interferometry.error_fit import Equations, Fit, fitted
from clsas.interferometry.misregistration import ConstantPhase, constant_phase
from clsas.interferometry.pair import Pair
from clsas.interferometry.pair_errors_result import UNKNOWNS, PairErrors
from clsas.interferometry.result import Heights

_MRAD = 1e-3
# Deviations by which heights may differ from expected ones without a warning; dunes reach 2.
_MOST_MISFIT = 5.0
# Largest standard deviation of an error that is observable, as a phase: a plain choice.
_MOST_SD_RAD = 0.5
# Deviation of an error relative to what it would be if the others were known. The errors of the
# model, some milliradians that vary over the swath, grow by as much.
_MOST_AMPLIFICATION = 30.0
_UNLIKE = 5.0  # ratio of sensitivities that no slope of the seabed explains


def pair_errors(
    a: RangeLines,
    b: RangeLines,
    found: Heights,
    *,
    known_height_m: Annotated[ArrayLike | None, KNOWN_HEIGHT] = None,
    points_m: Annotated[
        ArrayLike | None, Positions(help="Positions of control points on the seabed.")
    ] = None,
    other: tuple[RangeLines, RangeLines, Heights] | None = None,
    known_sd_m: Annotated[
        float,
        Number(
            "m", least=0.0, most=validate.FARTHEST_M, help="Standard deviation of known heights."
        ),
    ] = 0.0,
    unknowns: Annotated[
        Sequence[str], Names(UNKNOWNS, help="Errors to estimate, the most important first.")
    ] = UNKNOWNS,
    tolerance_db: Annotated[float, TOLERANCE] = HEIGHTS_TOLERANCE_DB,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
) -> PairErrors:
    """Return the errors in phase, delay and roll of two banks that their heights reveal.

    Give one of `known_height_m`, `points_m` and `other`. The errors are those of b relative to a;
    `PairErrors.corrected` removes them.

    Parameters
    ----------
    a, b : RangeLines
        Range lines of the two banks.
    found : Heights
        Heights that `heights` measured from them. Of a mosaic of heights, `Store.sampled_heights`
        are enough.
    known_height_m : float or array_like, [rows, columns], optional
        Known heights above the plane of `found`, metres, at its pixels, NaN where they are not
        known. A number stands for a level seabed.
    points_m : array_like, [points, 3], optional
        Control points on the seabed, x, y and z, metres.
    other : (RangeLines, RangeLines, Heights), optional
        Lines of both banks of the same sonar on another track, in the same order, and heights of
        the same seabed that were measured from them.
    known_sd_m : float
        Standard deviation of known heights, metres, independent at places that are a window apart.
    unknowns : sequence of {"phase", "delay", "roll"}
        Errors to estimate, the most important first.
    tolerance_db : float
        Largest relative rms error of images, dB. Images are formed only to tell a phase and a delay
        apart.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle: those of `heights`.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.

    Returns
    -------
    PairErrors

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits; if not exactly one of
        `known_height_m`, `points_m` and `other` is given; if the heights are not those of the
        lines; if no valid height lies at a place of known height or in the overlap; if heights
        differ by more than the pair's errors explain; or if no error is observable.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If an error is not observable, which is then in `PairErrors.held`; if control points lie
        where no height is valid; or if heights remain that differ by more than 5 deviations.

    See Also
    --------
    heights : Heights of a seabed.
    calibrate_track : Timing, sound speed and lever arm, from reflectors.

    Notes
    -----
    An error psi of the phase of b displaces a scatterer along the curve on which its range is
    constant, by psi/K in height (see `heights`). At the middle frequency f0 of the band ::

        psi = phase - 2 pi f0 delay + roll k u.(v x B)

    with the direction u from the receivers to the scatterer, the direction v of the track, and the
    baseline B from a to b. With B vertical and the seabed to port, the last term is
    -roll k B cos(depression): if the port side is up, the seabed seems lower.
    The phase and the roll that bring heights closest to those expected are found by least squares,
    weighted by the deviations of the heights, without heights that differ by more than 4
    deviations. The deviations of the estimates account for windows of neighbouring heights that
    overlap, and for 0.05 deviations of error that heights have in common over the swath.

    Phase and roll can be told apart only if the depression varies. An error is held if its
    deviation exceeds 0.5 rad of phase, or 30 times the one it would have if the others were known.

    A phase and a delay displace heights alike, but on the relief that was found a phase leaves
    phase (1 - f/f0) at the frequency f. It is measured from both halves of the band. Heights
    follow the delay over any number of cycles, since the magnitude of the coherence decides
    between cycles. With a phase of nearly half a cycle, as from a bank of inverted polarity,
    heights scatter over two cycles. The sum of phase and delay is then right, but not its parts:
    estimate again from heights of the corrected lines.

    Two tracks show the differences of their displacements only. Those are not constant where the
    tracks see a place at different ranges. On opposite tracks that look at the strip between them
    at the ground ranges y and Y - y, the difference is phase (R1 - R2)/(k B) - roll (2 y - Y).

    Examples
    --------
    A level seabed 6 m below a sonar whose second bank has a phase of 0.5 rad:

    >>> import clsas
    >>> import numpy as np
    >>> random = np.random.default_rng(1)
    >>> places_m = random.uniform([-0.6, 19.4, 0], [0.6, 21.2, 0], (6000, 3))
    >>> scene = clsas.PointTargets(places_m, random.standard_normal((6000, 2)) @ [1, 1j])
    >>> tx_m = np.outer(np.linspace(-2, 2, 81), [1, 0, 0]) + [0, 0, 6]
    >>> lower, upper = (
    ...     clsas.simulate_lines(
    ...         tx_m, tx_m + [0, 0, up_m], scene, carrier_hz=100e3, bandwidth_hz=30e3
    ...     )
    ...     for up_m in (0.0, 0.2)
    ... )
    >>> upper = upper.weighted(np.full(81, np.exp(0.5j)))
    >>> grid = clsas.Grid.plane((-0.4, 0.4, 33), (19.8, 20.6, 33))
    >>> found = clsas.heights(lower, upper, grid, search_m=(-0.5, 0.5))
    >>> errors = clsas.pair_errors(lower, upper, found, known_height_m=0.0, unknowns=["phase"])
    >>> print(f"{errors.phase_rad:.1f} rad")
    0.5 rad
    >>> right = clsas.heights(lower, errors.corrected(lower, upper), grid, search_m=(-0.5, 0.5))
    >>> print(f"{np.median(found.height_m[found.mask]):.1f} m before")
    0.1 m before
    >>> print(f"{abs(np.median(right.height_m[right.mask])):.1f} m after")
    0.0 m after
    """
    options = {"known_sd_m": known_sd_m, "unknowns": unknowns, "tolerance_db": tolerance_db}
    known_sd_m, names, tolerance_db = check_declared(pair_errors, options).values()
    validate.instance("beam", beam, BeamWindow, type(None))
    control_m = check_declared(pair_errors, {"points_m": points_m})["points_m"]
    given = {"known_height_m": known_height_m, "points_m": points_m, "other": other}
    used = [name for name, value in given.items() if value is not None]
    if len(used) != 1:
        raise ArgumentError(
            "known_height_m",
            "be given, or one of `points_m` and `other`, and only one",
            " and ".join(f"`{name}`" for name in used) or "none",
        )
    measured = [(a, b, found)]
    _check_measured(a, b, found, "found")
    if other is not None:
        measured.append(_checked_other(other, a))
    opened = open_device(device)
    pairs = [Pair(low, high, tolerance_db, None, beam, opened) for low, high, _ in measured]
    surfaces = [
        Displaced.of(pair, heights) for pair, (_, _, heights) in zip(pairs, measured, strict=True)
    ]
    for surface, name in zip(surfaces, ("found", "other"), strict=False):
        _check_belongs(surface, name)
    if other is not None:
        comparison = in_overlap(*surfaces)
    elif control_m is not None:
        comparison = at_points(surfaces[0], control_m, known_sd_m)
        _warn_of_points(comparison)
    else:
        assert known_height_m is not None
        comparison = at_pixels(surfaces[0], known_height_m, known_sd_m)
    estimate = _estimated(comparison, names, used[0])
    constant = None
    if {"phase", "delay"} <= set(names) and 0 in estimate.columns:
        constant = _mean_phase(
            [constant_phase(pair, each.found) for pair, each in zip(pairs, surfaces, strict=True)]
        )
    errors = _errors(estimate, names, constant, _middle_hz(a), surfaces[0])
    for sentence in errors.held_in_words():
        validate.warn(sentence)
    if errors.misfit > _MOST_MISFIT:
        validate.warn(
            f"heights still differ from those expected by {errors.residual_m:.2g} m rms, "
            f"{errors.misfit:.0f} of their standard deviations: `{used[0]}` may not be that of "
            "this seabed, and the estimates may be wrong"
        )
    return errors


def _warn_of_points(comparison: Comparison) -> None:
    """Warn of control points that are not used, unless none is, which is refused later."""
    usable = comparison.equations_at(np.zeros(2)).usable
    if usable.any() and not usable.all():
        validate.warn(
            f"{np.count_nonzero(~usable)} of {usable.size} `points_m` lie where no height is "
            "valid, and are left out"
        )


def _check_measured(a: RangeLines, b: RangeLines, found: Heights, name: str) -> None:
    check_pair(a, b)
    validate.instance(name, found, Heights)
    if not found.mask.any():
        raise ArgumentError(name, "have valid heights", "a mask that is all False")


def _checked_other(
    other: tuple[RangeLines, RangeLines, Heights], a: RangeLines
) -> tuple[RangeLines, RangeLines, Heights]:
    kinds = RangeLines, RangeLines, Heights
    meaning = "(a, b, found) of another track"
    parts = validate.entries("other", other, meaning)
    if len(parts) != 3:
        raise ArgumentError("other", f"be {meaning}", f"{len(parts)} entries")
    for part, kind in zip(parts, kinds, strict=True):
        validate.instance("every entry of other", part, kind)
    low, high, found = parts
    try:
        _check_measured(low, high, found, "found")
    except ArgumentError as error:
        raise error.within("other:") from None
    if not math.isclose(low.carrier_hz, a.carrier_hz, rel_tol=1e-9):
        allowed = "be lines of the same sonar, with the same `carrier_hz`"
        raise ArgumentError("other", allowed, f"{low.carrier_hz:.9g} and {a.carrier_hz:.9g} Hz")
    return low, high, found


def _check_belongs(surface: Displaced, name: str) -> None:
    """Raise ValueError if heights cannot be those of the lines."""
    found = surface.found
    expected = -1 / np.median(surface.sights.values[..., 0])
    ratio = float(np.median(found.m_per_rad[found.mask])) / expected
    if not 1 / _UNLIKE < ratio < _UNLIKE:
        raise ArgumentError(
            name,
            "be measured from the lines given, in the same order, whose `m_per_rad` is about "
            f"{expected:.3g} m",
            f"{expected * ratio:.3g} m",
        )


@dataclass(frozen=True, eq=False)
class _Estimate:
    """A phase, a roll or both: which (columns 0 and 1), their values and covariance, [2, 2].

    These are 0 where not estimated. An estimate of the phase alone would absorb `absorbed` of it
    per radian of roll.
    """

    columns: list[int]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    absorbed: float
    fit: Fit


def _estimated(comparison: Comparison, unknowns: tuple[str, ...], given: str) -> _Estimate:
    """Return the errors of phase and roll; those that are not observable are left out."""
    columns = list(dict.fromkeys(int(name == "roll") for name in unknowns))
    while True:
        fit = _fit(comparison, columns)
        if fit is None:
            raise _incomparable(comparison, given)
        if _is_observable(fit.covariance, columns, comparison.roll_rad):
            break
        if len(columns) == 1:
            raise _unobservable(fit, unknowns, columns[0], comparison)
        columns = columns[:-1]
    both = comparison.equations_at(_embedded(fit.values, columns))
    phase, roll = (both.per_unknown_m[fit.used] / both.sd_m[fit.used, None]).T
    absorbed = float(phase @ roll / (phase @ phase)) if 0 in columns else 0.0
    spread = np.eye(2)[:, columns]
    return _Estimate(
        columns, spread @ fit.values, spread @ fit.covariance @ spread.T, absorbed, fit
    )


def _fit(comparison: Comparison, columns: list[int]) -> Fit | None:
    def equations_at(values: NDArray[np.float64]) -> Equations:
        full = comparison.equations_at(_embedded(values, columns))
        return full._replace(per_unknown_m=full.per_unknown_m[:, columns])

    return fitted(equations_at, len(columns), comparison.places)


def _embedded(values: NDArray[np.float64], columns: list[int]) -> NDArray[np.float64]:
    full = np.zeros(2)
    full[columns] = values
    return full


def _is_observable(covariance: NDArray[np.float64], columns: list[int], roll_rad: float) -> bool:
    """Return whether all estimates are accurate, and not because errors of several cancel."""
    if not np.isfinite(covariance).all():
        return False
    scale = np.array([1.0, roll_rad])[columns]
    sd_rad = scale * np.sqrt(np.diag(covariance))
    amplification = np.sqrt(np.diag(covariance) * np.diag(np.linalg.inv(covariance)))
    return bool((sd_rad <= _MOST_SD_RAD).all() and (amplification <= _MOST_AMPLIFICATION).all())


def _incomparable(comparison: Comparison, given: str) -> ArgumentError:
    equations = comparison.equations_at(np.zeros(2))
    some = equations.usable
    if not some.any():
        allowed = "share places with the valid heights"
        return ArgumentError(given, allowed, hint=f"no valid height lies at {comparison.what}")
    typical_m = float(np.median(np.abs(equations.residual_m[some])))
    return ArgumentError(
        given,
        "lie close enough to the heights for errors of the pair to explain the difference",
        f"{typical_m:.3g} m",
        "or give more places, since the estimate from these does not settle",
    )


def _unobservable(
    fit: Fit, unknowns: tuple[str, ...], column: int, comparison: Comparison
) -> ArgumentError:
    name = next(each for each in unknowns if (each == "roll") == bool(column))
    sd_rad = float(np.sqrt(fit.covariance[0, 0])) * (comparison.roll_rad if column else 1.0)
    return ArgumentError(
        "unknowns",
        "be observable from these heights, with a standard deviation up to "
        f"{_MOST_SD_RAD:g} rad of phase",
        f"{name} with {sd_rad:.2g} rad",
        "more places or a smaller `known_sd_m` show it, or two tracks at different ranges",
    )


def _mean_phase(each: list[ConstantPhase]) -> ConstantPhase:
    """Return the mean of phases, weighted by their deviations."""
    weight = np.array([1 / max(one.sd_rad, 1e-9) ** 2 for one in each])
    if not weight.any():
        return ConstantPhase(0.0, math.inf)
    mean = float(weight @ [one.phase_rad for one in each] / weight.sum())
    return ConstantPhase(mean, float(1 / np.sqrt(weight.sum())))


def _middle_hz(lines: RangeLines) -> float:
    """Return the frequency in the middle of the occupied band."""
    return middle_cycles_per_m(lines) * lines.sound_speed_m_s / 2


def _errors(
    estimate: _Estimate,
    unknowns: tuple[str, ...],
    constant: ConstantPhase | None,
    middle_hz: float,
    surface: Displaced,
) -> PairErrors:
    """Return the result: the phase of the estimate divided into a phase and a delay."""
    held = {"roll"} & set(unknowns) if 1 not in estimate.columns else set()
    if 0 not in estimate.columns:
        held |= {"phase", "delay"} & set(unknowns)
    elif constant is not None and constant.sd_rad > _MOST_SD_RAD:
        # Heights that are off by more than half a cycle followed a delay.
        shifted = abs(estimate.values[0]) > math.pi
        held.add(
            "phase" if shifted or unknowns.index("delay") < unknowns.index("phase") else "delay"
        )
        constant = None
    kept = tuple(name for name in unknowns if name not in held)
    delay_s = -1 / (2 * math.pi * middle_hz)  # per radian
    whole = constant is None
    of = {  # of the phase and the roll of the heights, and the phase that no delay explains
        "phase": [1.0, 0.0, 0.0] if whole else [0.0, 0.0, 1.0],
        "delay": [delay_s, 0.0, 0.0] if whole else [delay_s, 0.0, -delay_s],
        "roll": [0.0, 1.0, 0.0],
    }
    share = np.array([of[name] for name in kept])
    phase, sd = (0.0, 0.0) if constant is None else constant
    covariance = np.zeros((3, 3))
    covariance[:2, :2], covariance[2, 2] = estimate.covariance, sd**2
    ends = surface.near, surface.far
    seen = [np.array([1.0, end.rad_per_roll]) for end in ends]
    near_sd_m, far_sd_m = (
        float(np.sqrt(each @ estimate.covariance @ each)) / abs(end.rad_m)
        for each, end in zip(seen, ends, strict=True)
    )
    near_m, far_m = (_MRAD * (end.rad_per_roll - estimate.absorbed) / end.rad_m for end in ends)
    return PairErrors(
        unknowns=kept,
        values=share @ np.append(estimate.values, phase),
        covariance=share @ covariance @ share.T,
        held=tuple(name for name in unknowns if name in held),
        residual_m=estimate.fit.residual_m,
        misfit=estimate.fit.misfit,
        samples=estimate.fit.samples,
        range_m=(surface.near.range_m, surface.far.range_m),
        height_sd_m=(near_sd_m, far_sd_m),
        roll_cost_m=(near_m, far_m),
    )
