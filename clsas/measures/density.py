"""Weights that even out the density of phase centres along the track.

Imagers add up all channels alike. Where phase centres are closer together, their part of the
aperture counts more. Arrays that repeat some phase centres in every ping, as micronavigation
requires, thus weight their aperture periodically, which causes ghosts on both sides of every
target.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import decibels, reprs, validate
from clsas.engine.data.geometry import course, unit_vectors
from clsas.engine.data.lines import RangeLines, banks_of
from clsas.engine.data.pings import COURSE_STEPS, STILL, Transmissions, means
from clsas.engine.data.validate import ArgumentError

# Advance over `COURSE_STEPS`, relative to the length of these steps, below which a track has no
# course. If positions err by half a step rms, along and across, it is 0.6 or more among 400 pings;
# by a whole step, down to 0.3. At turns by 180 degrees it is 0.
_LEAST_STRAIGHT = 0.5
# Phase centres closer than this share of the usual spacing have equal weights. Without that, those
# in the middle of a group have hardly any: groups of three, scattered by 0.03 spacings, raise the
# noise by 1.6 dB (0.3 dB with half the value, 0.03 dB with this one, 0 with twice the value).
# Ghosts do not depend on it up to 0.2.
_COINCIDENT = 0.1
# Spacing, relative to the usual one, up to which the phase centres beside a gap stand for the whole
# gap. Nothing else samples it, so that larger weights only raise the side lobes.
_MOST_SPACING = 2.0
# Advance, relative to the usual one, as which a gap counts at most where the usual spacing is
# measured. Long gaps are up to 5 % of the steps, and thus up to 10 % of the length that counts.
_MOST_ADVANCE = 2.0
_MUCH_NOISE_DB = 3.0  # noise raised by weights that are worth a warning


def density_compensated(lines: RangeLines) -> RangeLines:
    """Return lines with weights that even out the density of their phase centres along the track.

    Arrays that repeat phase centres from ping to ping, as `micronavigate` needs, image without
    ghosts after this. Correct the track first, since the weights follow from positions.

    Parameters
    ----------
    lines : RangeLines
        Lines along a track.

    Returns
    -------
    RangeLines
        The lines, each multiplied by its weight.

    Raises
    ------
    TypeError, ValueError
        As for `density_weights`.

    See Also
    --------
    density_weights : The weights, with the equations.

    Examples
    --------
    Four receivers whose phase centres are 0.1 m apart advance by 0.3 m. The last phase centre of a
    ping is the first one of the next:

    >>> import clsas
    >>> import numpy as np
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    >>> sonar = clsas.Sonar(pulse, [[0.2 * n, 0, 0] for n in range(4)])
    >>> track = clsas.Track.straight([0, 0, 0], [1.5, 0, 0], pings=3, ping_interval_s=0.2)
    >>> echoes = clsas.simulate(sonar, track, clsas.PointTargets([[0.5, 40, 0]]))
    >>> lines = clsas.density_compensated(clsas.compress(echoes))
    """
    weights = density_weights(lines)  # checks that these are lines
    return lines.weighted(weights)


def density_weights(lines: RangeLines) -> NDArray[np.float64]:
    """Return the length of track that every phase centre stands for, relative to the mean.

    Parameters
    ----------
    lines : RangeLines
        Lines along a track, which may turn, sway and advance unevenly. If they have several
        receiver banks, each has weights of its own.

    Returns
    -------
    float64 [channels]
        Positive weights with mean 1 in every bank. Evenly spaced phase centres have weight 1.

    Raises
    ------
    TypeError
        If `lines` are no range lines.
    ValueError
        If the platform stands still, as with a single ping or a full matrix capture; or if the
        track turns back, or its positions are so noisy that they have no order along it.

    Warns
    -----
    ClsasWarning
        If the weights of a bank raise the noise by more than 3 dB.

    See Also
    --------
    density_compensated : Lines with these weights.
    noise_penalty_db : How much they raise the noise.

    Notes
    -----
    Distances are measured along the local course, the mean direction of about 11 pings. A phase
    centre stands for the track up to halfway to its neighbours on either side. Those that
    coincide, within a tenth of the usual spacing, share their part equally. A gap counts as at most
    twice the usual spacing, so that phase centres beside a lost ping weigh 1.5 times as much as
    others, and not more. At the ends of the track the first and the last spacing continue. Half of
    the track lies in spacings that are smaller than the usual one, where gaps count as at most
    twice the usual advance from ping to ping, however long they are. At most 5 % of the steps may
    be gaps of more than ten advances.

    With weights w of mean 1, equal weights would instead cause ghosts with the total power ::

        mean(1/w) - 1

    relative to the target, at distances of lambda R n / (2 D) along the track for pings D apart,
    as far as the beam reaches. The weights remove them, and raise the noise of the image relative
    to the target by ::

        mean(w^2)

    This is less than the noise of an image without the repeated channels. Phase centres that nearly
    coincide leave ghosts: with one of six repeated, -36, -28 and -22 dB at distances of 0.02, 0.05
    and 0.1 spacings, where equal weights have -9.5 dB.

    Examples
    --------
    The second and the third of four monostatic pings coincide:

    >>> import clsas
    >>> import numpy as np
    >>> centres_m = [[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]]
    >>> lines = clsas.RangeLines(
    ...     np.ones((4, 11), complex), first_range_m=40.0, range_step_m=0.05,
    ...     tx_m=centres_m, rx_m=centres_m, carrier_hz=100e3, sound_speed_m_s=1500.0,
    ... )
    >>> weights = clsas.density_weights(lines)
    >>> weights.round(3)
    array([1.333, 0.667, 0.667, 1.333])
    """
    validate.instance("lines", lines, RangeLines)
    if lines.bank_numbers is None:
        return _of_bank(lines)
    weights = np.empty(lines.channels)
    for number in banks_of(lines.bank_numbers):
        weights[lines.bank_numbers == number] = _of_bank(lines.bank(number), f"bank {number}")
    return weights


def noise_penalty_db(weights: NDArray[np.float64]) -> float:
    """Return the power of noise relative to targets with weights, over that without, dB."""
    return decibels.in_db(float(np.mean(weights**2) / np.mean(weights) ** 2))


def _of_bank(lines: RangeLines, bank: str = "") -> NDArray[np.float64]:
    """Return the weights of one bank, [channels], which messages call `bank`."""
    pings = Transmissions.of(lines.tx_m, lines.rx_m)
    try:
        along_m = _along_m(lines, pings)
    except ArgumentError as error:
        if bank:
            error.add_note(bank)
        raise
    lengths_m = _lengths_m(along_m, pings.usual_step_m)
    weights: NDArray[np.float64] = lengths_m / lengths_m.mean()
    penalty_db = noise_penalty_db(weights)
    if penalty_db > _MUCH_NOISE_DB:
        validate.warn(
            f"weights{f' of {bank}' if bank else ''} raise the noise by {penalty_db:.1f} dB, since "
            "phase centres crowd in parts of the track. If the platform stood still there, use "
            "`lines.without_still_pings()`"
        )
    return weights


def _along_m(lines: RangeLines, pings: Transmissions) -> NDArray[np.float64]:
    """Return the distance of every phase centre along the track, [channels].

    The track is a chain of the positions of the pings, without those that stand still. Each phase
    centre lies ahead of its ping, or of the last one that advanced before it, by as much as it is
    displaced along the course there.
    """
    numbers = np.flatnonzero(pings.advancing(STILL * pings.usual_step_m))
    moves_m = np.diff(pings.places_m[numbers], axis=0)
    receivers_m = means(lines.rx_m, pings.starts[:-1])[numbers]
    needed = "come from receivers that move along a track"
    if pings.count == 1:
        raise ArgumentError("lines", needed, "a single ping")
    moved_m = float(np.ptp(receivers_m, axis=0).max(initial=0.0))
    if len(receivers_m) < 2 or moved_m <= STILL * pings.usual_step_m:
        got = f"{pings.count} pings whose receivers move by {reprs.quantity(moved_m, 'm')} in all"
        raise ArgumentError("lines", needed, got, "receivers that stay in place need no weights")
    course = _courses(moves_m, numbers)
    # From ping to ping, the mean of both courses.
    steps_m = np.einsum("pi,pi->p", moves_m, course[:-1] + course[1:]) / 2
    knots_m = np.append(0.0, np.cumsum(steps_m))
    ping = np.repeat(np.arange(pings.count), pings.receivers)
    knot = np.searchsorted(numbers, ping, side="right") - 1
    ahead_m = lines.phase_centres_m - pings.places_m[numbers][knot]
    return knots_m[knot] + np.einsum("ci,ci->c", ahead_m, course[knot])


def _courses(moves_m: NDArray[np.float64], numbers: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the unit vector along the track at every ping, [pings, 3], from the moves between.

    `numbers` of the pings are for messages.
    """
    from scipy.ndimage import uniform_filter1d  # slow to import

    local = min(COURSE_STEPS, len(moves_m))
    mean_m = uniform_filter1d(moves_m, local, axis=0, mode="nearest")
    path_m = uniform_filter1d(np.linalg.norm(moves_m, axis=1), local, mode="nearest")
    advance_m = np.linalg.norm(mean_m, axis=1)
    least = int(np.argmin(advance_m / path_m))
    if advance_m[least] < _LEAST_STRAIGHT * path_m[least]:
        raise ArgumentError(
            "lines",
            "come along a track that advances",
            f"{local} steps of {reprs.quantity(float(path_m[least]), 'm')} on average around ping "
            f"{numbers[least]} that advance by "
            f"{reprs.quantity(float(local * advance_m[least]), 'm')} together",
            "sort pings by time, smooth noisy positions, or select passes in opposite directions "
            "one by one",
        )
    between = mean_m / advance_m[:, None]
    courses = np.concatenate([between[:1], between[:-1] + between[1:], between[-1:]])
    return unit_vectors(courses)


def _lengths_m(along_m: NDArray[np.float64], advance_m: float) -> NDArray[np.float64]:
    """Return the length of track that each phase centre stands for, metres; `density_weights`.

    `along_m` are the distances of the phase centres along the track, [channels], in any order, and
    `advance_m` is the usual one from ping to ping.
    """
    order = np.argsort(along_m, kind="stable")
    sorted_m = along_m[order]
    gaps_m = np.diff(sorted_m)
    usual_m = _usual(gaps_m, advance_m)
    # Phase centres that coincide share their part. A group of them begins after a gap, and again
    # where it would be longer than one.
    most_m = _COINCIDENT * usual_m
    begins = np.append(True, gaps_m > most_m)
    first_m = sorted_m[begins][np.cumsum(begins) - 1]
    if most_m:
        begins[1:] |= np.diff(np.floor((sorted_m - first_m) / most_m)) != 0
    group = np.cumsum(begins) - 1
    members = np.bincount(group)
    means_m = np.bincount(group, sorted_m) / members
    halves_m = np.minimum(np.diff(means_m), _MOST_SPACING * usual_m) / 2
    if not halves_m.size:
        return np.ones(len(along_m))
    parts_m = np.append(halves_m[0], halves_m) + np.append(halves_m, halves_m[-1])
    found = np.empty(len(along_m))
    found[order] = (parts_m / members)[group]
    return found


def usual_spacing_m(lines: RangeLines) -> float:
    """Return the usual spacing of the phase centres along the direction of the track, metres.

    Gaps in the track do not count, nor do coincident phase centres. It is 0 if all coincide.
    """
    centres_m = lines.phase_centres_m
    gaps_m = np.diff(np.sort(centres_m @ course(centres_m)))
    return _usual(gaps_m, Transmissions.of(lines.tx_m, lines.rx_m).usual_step_m)


def _usual(gaps_m: NDArray[np.float64], advance_m: float) -> float:
    """Return the median of ascending phase centres' gaps, weighted by length; 0 without any.

    A place on the track lies as often in a larger gap as in a smaller one. Coincident phase centres
    do not count, however many there are. Phase centres are no farther apart than pings, except
    beside gaps in the track. These count as a few pings' advance, so that a few do not outweigh the
    rest.
    """
    if not gaps_m.any():
        return 0.0
    ascending_m = np.sort(gaps_m)
    counted_m = np.minimum(ascending_m, _MOST_ADVANCE * advance_m) if advance_m else ascending_m
    covered_m = np.cumsum(counted_m)
    return float(ascending_m[np.searchsorted(covered_m, covered_m[-1] / 2)])
