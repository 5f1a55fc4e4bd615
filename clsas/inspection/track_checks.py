"""Checks of a recording's track: order, halts, gaps, advance, and spacing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.pings import STILL, Transmissions
from clsas.inspection.result import runs
from clsas.sonar.beam import BeamWindow
from clsas.sonar.sampling import Finding, check_sampling

GAP = 1.75
"""Advance over that of the pings around it, above which pings are missing: one missing is 2."""
_SCATTER = 5.0  # standard deviations of steps that a gap exceeds, too: positions are noisy
_AROUND = 31  # steps in the running median, the usual advance near a ping
_MOST_WAVELENGTHS = 500.0
"""Advance of a channel above which a unit is wrong. A satellite's radar has about 120: its antenna
is as long. Positions in millimetres make 1000 times the advance."""
_LEAST_PER_WAVELENGTH = 50.0
"""Advances per wavelength and receiver above which a unit is wrong. Slow rails have 20; positions
in kilometres make 1000 times as many, of advances of up to 20 wavelengths."""


def check_track(pings: Transmissions, lines: RangeLines, wavelength_m: float) -> list[Finding]:
    """Return what is wrong with a track: its order first, which halts and gaps may follow from."""
    usual_m = pings.usual_step_m
    if not usual_m:
        return _check_aperture(pings)
    found = _check_order(pings) + _check_halts(pings)
    if not pings.disordered:
        found += _check_gaps(pings)
    return found + _check_advance(pings, lines, wavelength_m)


def _check_aperture(pings: Transmissions) -> list[Finding]:
    """Return that a platform never moves."""
    if pings.count > 1:
        return [
            Finding(
                "still_pings",
                f"all {pings.count} pings were taken at one place: there is no aperture",
                float(pings.count),
                0.0,
                "check the positions; they may be missing from the recording",
            )
        ]
    if pings.starts[-1] > 1:
        return []
    return [
        Finding(
            "aperture",
            "the recording has one channel: there is no aperture",
            1.0,
            2.0,
            "record several pings along a track, or several receivers",
        )
    ]


def _check_advance(pings: Transmissions, lines: RangeLines, wavelength_m: float) -> list[Finding]:
    """Return an advance that only a slip of units can explain."""
    usual_m, last_range_m = pings.usual_step_m, float(lines.last_range_m.max())
    receivers = float(np.median(pings.receivers))
    most_m = _MOST_WAVELENGTHS * wavelength_m * receivers
    # An array may advance by little; then it is long itself.
    first_ping = lines.rx_m[: pings.starts[1]]
    array_m = float(np.linalg.norm(np.ptp(first_ping, axis=0))) / 2
    least_m = wavelength_m / _LEAST_PER_WAVELENGTH
    if usual_m + array_m < least_m * receivers:
        of_array = ""
        if receivers > 1:
            of_array = f", and with its {receivers:g} receivers a ping is {array_m:.4g} m long"
        return [
            Finding(
                "advance",
                f"pings are {usual_m:.4g} m apart, less than 1/{_LEAST_PER_WAVELENGTH:g} of the "
                f"wavelength of {wavelength_m:.4g} m{of_array}: too little for an aperture",
                usual_m,
                least_m,
                "check units: positions in metres (not kilometres), carrier_hz in Hz (not kHz); of "
                "a platform as slow as that, keep every nth ping: lines.select(...)",
            )
        ]
    if usual_m > last_range_m > 0:
        limit_m, words = last_range_m, f"the last range of {last_range_m:.4g} m"
    elif usual_m > most_m:
        limit_m = most_m
        words = f"{_MOST_WAVELENGTHS:g} wavelengths of {wavelength_m:.4g} m for every receiver"
    else:
        return []
    return [
        Finding(
            "advance",
            f"pings are {usual_m:.4g} m apart, more than {words}",
            usual_m,
            limit_m,
            "check units: positions in metres (not millimetres), and ranges in metres",
        )
    ]


def _check_halts(pings: Transmissions) -> list[Finding]:
    still = np.flatnonzero(~pings.advancing())
    if not still.size:
        return []
    return [
        Finding(
            "still_pings",
            f"{still.size} of {pings.count} pings were taken standing still: they advance by "
            f"less than {STILL:g} of the usual {pings.usual_step_m:.4g} m. What they show alike "
            "adds up and hides the scene",
            float(still.size),
            0.0,
            "lines.without_still_pings(), or clsas convert --without-still-pings FILE OUTPUT",
            tuple(still.tolist()),
        )
    ]


def _check_gaps(pings: Transmissions) -> list[Finding]:
    numbers = np.flatnonzero(pings.advancing())
    if len(numbers) < 3:
        return []
    gaps, steps_m, limits_m = _gaps(pings.places_m[numbers])
    if not gaps.size:
        return []
    widest, several = gaps[np.argmax(steps_m[gaps])], "s" * (gaps.size > 1)
    return [
        Finding(
            "gaps",
            f"{gaps.size} gap{several} in the track, after ping{several} {runs(numbers[gaps])}: "
            f"the widest is {steps_m[widest]:.4g} m, over {limits_m[widest]:.4g} m",
            float(steps_m[widest]),
            float(limits_m[widest]),
            "targets beside a gap blur and get grating lobes: image the parts one by one, or "
            "look for lost pings in the recorder",
            tuple(numbers[gaps].tolist()),
        )
    ]


def _check_order(pings: Transmissions) -> list[Finding]:
    turns = pings.turns
    if not turns.size:
        return []
    unjudged = "; gaps are not looked for in such a track" if pings.disordered else ""
    return [
        Finding(
            "order",
            f"the track turns back {turns.size} time{'s' * (turns.size > 1)}, first after ping "
            f"{turns[0]}: pings are out of order, or positions are noisy{unjudged}",
            float(turns.size),
            0.0,
            "sort the pings by time: lines.select(order); smooth noisy positions; image passes to "
            "and fro one by one",
            tuple(turns.tolist()),
        )
    ]


def _gaps(
    centres_m: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the pings after which there are gaps, all steps, and the limit of each."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    around_m = median_filter(steps_m, size=min(_AROUND, len(steps_m)), mode="nearest")
    scatter_m = 1.48 * float(np.median(np.abs(steps_m - around_m)))  # of normal noise
    limits_m = np.maximum(GAP * around_m, around_m + _SCATTER * scatter_m)
    return np.flatnonzero(steps_m > limits_m), steps_m, limits_m


def check_spacing(
    lines: RangeLines,
    pings: Transmissions,
    grid: Grid | None,
    *,
    beam: BeamWindow | None,
    element_length_m: float | None,
    wavelength_m: float,
) -> list[Finding]:
    """Return a spacing beyond the limits of sampling, on the longest leg between gaps."""
    if grid is None and beam is None and element_length_m is None:
        return []
    judged = pings.count > 2 and not pings.disordered
    gaps = _gaps(pings.places_m)[0] if judged else np.zeros(0, np.int64)
    edges = [0, *(gaps + 1).tolist(), pings.count]
    longest = int(np.argmax(np.diff(edges)))
    leg = slice(int(pings.starts[edges[longest]]), int(pings.starts[edges[longest + 1]]))
    return check_sampling(
        lines.select(leg), grid, beam=beam, element_length_m=element_length_m,
        wavelength_m=wavelength_m,
    )  # fmt: skip
