"""Navigation that cannot be right: fixes far from all others, held over several pings, or rounded.

The checks of positions do not depend on the order of channels, which may be any.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.findings import Finding
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reprs import measured

LEAST_FIXES = 16
"""Fewest positions that show what is usual: a plain choice."""
_NEIGHBOURS = 4  # a group of up to so many stray fixes is found
_USUAL = 0.9  # quantile of distances that stands for a moving platform, which may also stand still
# Distance of a stray fix to its fourth neighbour, over that quantile. Ends of tracks reach 2, and a
# few pings beside ten lost ones 7. Half of it would report pings beside fifteen lost ones, and
# twice as much no jump of less than 80 advances.
_STRAY = 20.0
# Speed between two fixes over the usual one. Noise that hides the motion entirely reaches 7, since
# the median distance is then that of the noise. Wrong fixes reach thousands.
_FASTER = 10.0
_HELD = 0.2
"""Share of pings at a position that occurred before, above which fixes are held. Closed tracks
repeat one position, and fixes held over two pings half of all. A halt of one ping in five raises
what it sees by 2 dB."""
# Step of rounded positions over the wavelength, above which they are too coarse. Rounding to an
# eighth shifts two-way phases by 0.45 rad rms, which takes 1 dB off a point; to half, 14 dB.
_COARSE = 0.125
_DECIMALS = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
_WHOLE = 1e-6  # by which multiples of a step may differ from whole numbers
_REGULAR = 0.9  # share of equal steps, above which a track is one of equal steps with lost pings


def doubts_of_fixes(lines: RangeLines, wavelength_m: float | None = None) -> Iterator[Finding]:
    """Yield what cannot be right in the positions of channels.

    Without a wavelength, positions may be as coarse as they like.
    """
    moving_m = lines.tx_m if np.ptp(lines.tx_m, axis=0).any() else lines.rx_m
    fixes_m = np.unique(moving_m, axis=0)
    if len(fixes_m) >= LEAST_FIXES:
        yield from _stray(fixes_m, moving_m)
    if lines.channels >= LEAST_FIXES:
        coarse = [] if wavelength_m is None else list(_coarse(lines, wavelength_m))
        yield from coarse or _held(lines)  # what is rounded coarsely also repeats


def _stray(fixes_m: NDArray[np.float64], of_channels_m: NDArray[np.float64]) -> Iterator[Finding]:
    from scipy.spatial import cKDTree  # slow to import

    away_m = cKDTree(fixes_m).query(fixes_m, k=_NEIGHBOURS + 1)[0][:, -1]
    limit_m = _STRAY * float(np.quantile(away_m, _USUAL))
    stray = np.flatnonzero(away_m > limit_m)
    if not stray.size or stray.size > max(_NEIGHBOURS, (1 - _USUAL) / 2 * len(fixes_m)):
        return
    worst = stray[np.argmax(away_m[stray])]
    where = np.flatnonzero((of_channels_m[:, None] == fixes_m[stray[:16]]).all(axis=2).any(axis=1))
    place = ", ".join(f"{each:.10g}" for each in fixes_m[worst])
    yield Finding(
        "stray_fixes",
        f"{stray.size} of {len(fixes_m)} positions lie far from all others, the farthest "
        f"{measured(away_m[worst], 'm', 3)} away at ({place}) m, where "
        f"{measured(limit_m / _STRAY, 'm', 3)} is usual: probably wrong fixes "
        "of the navigation",
        float(away_m[worst]),
        limit_m,
        "interpolate the navigation over these pings, or leave them out with lines.select(...)",
        tuple(where.tolist()),
    )


def _held(lines: RangeLines) -> Iterator[Finding]:
    columns: list[NDArray] = [lines.tx_m, lines.rx_m]
    if lines.bank_numbers is not None:  # banks may share their antennas
        columns.append(lines.bank_numbers[:, None])
    pairs = np.ascontiguousarray(np.hstack(columns) + 0.0)  # without -0
    kinds = len(np.unique(pairs.view(f"V{pairs.itemsize * pairs.shape[1]}")))
    share = 1 - kinds / lines.channels
    if share > _HELD and kinds > 1:  # a single position is no track, and may be meant
        yield _of_held(f"{lines.channels - kinds} of {lines.channels} channels", share)


def _of_held(count: str, share: float) -> Finding:
    return Finding(
        "held_fixes",
        f"{count} have exactly the position of another one: either the navigation has fewer fixes "
        "than there are pings, and each was held over several, or the platform stood still",
        share,
        _HELD,
        "interpolate the navigation at the times of the pings, or leave out pings taken standing "
        "still with lines.without_still_pings()",
    )


def _coarse(lines: RangeLines, wavelength_m: float) -> Iterator[Finding]:
    """Yield that positions are rounded to steps that are no small part of the wavelength."""
    least_m = _COARSE * wavelength_m
    # Elements of an array lie at round numbers by design, transmitters along a track do not.
    columns = [(values, _DECIMALS) for values in lines.tx_m.T]
    for values, decimals in [*columns, *((values, ()) for values in lines.rx_m.T)]:
        step_m, how = _rounded_to(values, least_m, decimals)
        if step_m:
            step, wavelength = (measured(each, "m", 3) for each in (step_m, wavelength_m))
            yield Finding(
                "coarse_fixes",
                f"positions are rounded to {step}{how}, but should be known to an eighth of the "
                f"wavelength of {wavelength}",
                step_m,
                least_m,
                "keep positions in float64, subtract a common origin before they are stored in "
                "float32, and write more digits",
            )
            return


def _rounded_to(
    values: NDArray[np.float64], least: float, decimals: tuple[float, ...] = ()
) -> tuple[float, str]:
    """Return the step above `least` to which coordinates were rounded, and how; 0 if there is none.

    Equal steps are no rounding, even where pings were lost: a rail or a simulation has them.
    """
    unique, counts = np.unique(values, return_counts=True)
    if len(unique) < LEAST_FIXES or 4 * len(unique) * counts.min() < len(values):
        return 0.0, ""  # a coordinate that hardly changes
    single = float(np.spacing(np.float32(np.abs(values).max())))
    for step in (single, *decimals):
        numbers = (unique - unique[0]) / step  # also multiples if a lever arm was added
        if step <= least or np.abs(numbers - np.rint(numbers)).max() > _WHOLE:
            continue
        steps = np.diff(np.rint(numbers))
        kinds, of_kind = np.unique(steps.astype(np.int64), return_counts=True)
        if np.gcd.reduce(kinds) > 1 and not np.ptp(counts):
            return 0.0, ""  # equal steps, some of which are lost
        if step == single:
            if len(kinds) > 1 or np.ptp(counts):
                return single, ", as single precision (float32) does with numbers of this size"
        elif of_kind.max() < _REGULAR * len(steps):
            return step, ""
    return 0.0, ""


def doubts_of_track(
    positions_m: NDArray[np.float64],
    time_s: NDArray[np.float64],
    degrees: NDArray[np.float64] | None = None,
) -> Iterator[Finding]:
    """Yield what cannot be right in a track, from one fix per ping, in the order of time.

    `degrees` are the latitudes and longitudes of which the positions were made, [pings, 2].
    """
    count = len(positions_m)
    if count < LEAST_FIXES:
        return
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    speed_m_s, moves = steps_m / np.diff(time_s), steps_m > 0
    if moves.any():
        usual_m_s = float(np.median(speed_m_s[moves]))
        fast = np.flatnonzero(speed_m_s > _FASTER * usual_m_s)
        if fast.size:
            worst = int(np.argmax(speed_m_s))
            cause = "probably wrong fixes"
            if degrees is not None and (zero := np.flatnonzero(~degrees.any(axis=1))).size:
                cause = (
                    f"ping {zero[0]} is at latitude 0, longitude 0, as receivers report without a "
                    "fix. It also moves the origin of the track, the mean position"
                )
            yield Finding(
                "jumps",
                f"the track jumps at {fast.size} of {count - 1} steps, by up to "
                f"{measured(steps_m[worst], 'm')} after ping {worst}: a "
                f"speed of {speed_m_s[worst]:.4g} m/s, where {usual_m_s:.3g} m/s is usual; {cause}",
                float(speed_m_s[worst]),
                _FASTER * usual_m_s,
                "leave these fixes out, and interpolate the navigation over them",
                tuple(fast.tolist()),
            )
    held = int(np.count_nonzero(~moves))
    if held > _HELD * count and moves.any():
        yield _of_held(f"{held} of {count} pings", held / count)
    if degrees is not None and (degrees == degrees.astype(np.float32)).all():
        step, how = max(_rounded_to(each, 1e-6) for each in degrees.T)
        if step:
            yield Finding(
                "coarse_fixes",
                f"latitudes and longitudes are rounded to {step:.2g} degrees, "
                f"{measured(111e3 * step, 'm', 2)} on the ground{how}",
                step,
                1e-6,
                "keep latitudes and longitudes in float64",
            )
