"""Doubts about lines before they are imaged: input that cannot be right, and its likely cause.

Every imager calls `warn_before_imaging`, and `clsas.inspect` lists the same findings. The checks
take milliseconds, also for the largest recordings: they look at a few channels and pixels. Their
limits lie where no healthy recording comes close, since a warning must mean something. They accept
channels in any order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import behind
from clsas.engine.data.findings import Finding, warn_of
from clsas.engine.data.fourier import turned
from clsas.engine.data.geometry import STRAIGHT, pairwise_range_m, unit_vectors
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, band_wavelength_m, banks_of, some_channels
from clsas.engine.data.lines import wavelength_m as carrier_wavelength_m
from clsas.engine.data.reprs import measured
from clsas.engine.data.track import LEAST_FIXES, MOST_HELD, held_fixes, rounded_to
from clsas.engine.data.visibility import is_within, sine_width, sines

# Speeds of waves outside of which there is no medium, m/s: nothing that one looks into is slower
# than air (330 m/s) by a factor of six, solids stay below 20 km/s, and light in water has 3e7.
_SLOWEST, _FASTEST_SOUND, _SLOWEST_LIGHT = 50.0, 2e4, 1e7
MOST_WAVELENGTHS = 500.0
"""Advance per receiver, in wavelengths, above which a unit must be wrong. Radar satellites, whose
antennas are as long, reach 120. Positions in millimetres multiply it by 1000."""
_SHORTEST = 0.5  # wavelengths: a shorter aperture resolves nothing, and the smallest arrays have 8
_DENSEST = 1 / 200  # wavelengths between phase centres; slow rails reach 1/20, and slips 1/1000
_SEARCHED = 512  # phase centres whose spacing is measured
_NEIGHBOURS = 4  # a group of up to so many stray fixes is found
_USUAL = 0.9  # quantile of distances that stands for a moving platform, which may also stand still
# Distance of a stray fix to its fourth neighbour, over that quantile. Ends of tracks reach 2, and a
# few pings beside ten lost ones 7. Half of it would report pings beside fifteen lost ones, and
# twice as much no jump of less than 80 advances.
_STRAY = 20.0
# Step of rounded positions over the wavelength, above which they are too coarse. Rounding to an
# eighth shifts two-way phases by 0.45 rad rms, which takes 1 dB off a point; to half, 14 dB.
_COARSEST = 0.125
_DECIMALS = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
# Widest beam that may be meant in radians, degrees; resolution along the track over the spacing of
# pixels, and over what the aperture allows, from which on it is suspected. Radians mistaken for
# degrees make 57 times the resolution that was meant.
_RADIANS, _COARSER, _NARROWED = 3.2, 30.0, 4.0
_END_FIRE = math.cos(math.radians(20))  # no sonar squints by more than 60 degrees from broadside
_CHANNELS = 16  # channels whose samples are looked at
_CHIRPED = 0.15
"""Part of the phase steps along a line that grow evenly. Chirps of one point have 0.54, of three
that overlap 0.17 to 0.55, and 210 random scenes of compressed lines up to 0.06."""
_PHASED = 128  # channels whose phases show whether a point is in focus
_BRIGHTEST = 64  # channels among whose samples the brightest is searched
_LEAST_PHASED = 32  # as many equal ones: chance then reaches 0.46 for any of a thousand directions
# Sum of phasors over the sum of their magnitudes: of a point in focus, of one that shows how lines
# should be read, and by how much more it must be. A step of c/fs leaves up to 0.7 of a point.
_FOCUS, _CLEAR, _SHARPER = 0.7, 0.9, 1.25
_BLUR = 100.0  # aperture over its resolution by which the wrong sign blurs a point
_ARC = 64  # grid points along either side among which the brightest echo is searched


def warn_before_imaging(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None = None,
    *,
    last_range_m: NDArray[np.float64] | None = None,
) -> None:
    """Warn of input that cannot be right, once for each of its faults.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid
    beam : BeamWindow, optional
    last_range_m : float64 [channels], optional
        Range of each channel's last sample, for lines that are geometry without samples.
    """
    if lines.bank_numbers is not None and lines.banks > 1:
        of_bank = [lines.rx_m[lines.bank_numbers == n] for n in banks_of(lines.bank_numbers)]
        heights_m = [float(rx_m[:, 2].mean()) for rx_m in of_bank]
        apart_m = max(heights_m) - min(heights_m)
        validate.warn(
            f"the lines have {lines.banks} banks, {measured(apart_m, 'm', 3)} apart in height. In "
            "one image of all, their echoes cancel wherever the seabed is not at the height of the "
            "grid. `lines.bank(0)` selects the first bank; without `bank_numbers`, all channels "
            "count as one array"
        )
    found = behind(lines, grid, last_range_m)
    warn_of([] if found is None else [found])
    warn_of(doubts(lines, grid, beam, last_range_m))


def doubts(
    lines: RangeLines,
    grid: Grid | None = None,
    beam: BeamWindow | None = None,
    last_range_m: NDArray[np.float64] | None = None,
) -> Iterator[Finding]:
    """Yield what cannot be right about lines, and about a grid and a beam for them."""
    # Lines on their carrier have about the wavelength of the highest frequency sampled.
    on_carrier_m = band_wavelength_m(lines, 0.0)
    wavelength_m = carrier_wavelength_m(lines) if lines.carrier_hz else on_carrier_m
    wrong_units = list(_speed(lines)) or list(_units(lines, wavelength_m))
    yield from wrong_units
    yield from doubts_of_fixes(lines, None if wrong_units or not lines.carrier_hz else wavelength_m)
    wrong_samples = list(_samples(lines))
    yield from wrong_samples
    if grid is None or wrong_units:
        return
    if beam is not None and lines.channels > 1:
        yield from _beam(lines, grid, beam, wavelength_m)
    last_m = lines.last_range_m if last_range_m is None else last_range_m
    wrong_way = list(_end_fire(lines, grid, last_m))
    yield from wrong_way
    if not wrong_way and not wrong_samples:  # which blur the image, too
        yield from _focus(lines, grid)


def _speed(lines: RangeLines) -> Iterator[Finding]:
    speed_m_s = lines.sound_speed_m_s
    if speed_m_s < _SLOWEST or _FASTEST_SOUND < speed_m_s < _SLOWEST_LIGHT:
        yield Finding(
            "sound_speed",
            f"`sound_speed_m_s` is {speed_m_s:g} m/s, but no medium has less than {_SLOWEST:g} "
            f"m/s, or between {_FASTEST_SOUND:g} and {_SLOWEST_LIGHT:g} m/s",
            speed_m_s,
            _SLOWEST if speed_m_s < _SLOWEST else _FASTEST_SOUND,
            "give it in m/s: water has 1500, air 340, and light 299 792 458",
        )


def _units(lines: RangeLines, wavelength_m: float) -> Iterator[Finding]:
    """Yield a spacing of phase centres that only a wrong unit explains."""
    from scipy.spatial import cKDTree  # slow to import

    centres_m = lines.phase_centres_m
    extent_m = float(np.linalg.norm(np.ptp(centres_m, axis=0)))
    if lines.channels < LEAST_FIXES or not extent_m:
        return
    wavelength = measured(wavelength_m, "m", 3)
    # Those closer than a thousandth of a wavelength are one: arrays repeat phase centres.
    cells = np.rint((centres_m - centres_m[0]) / (1e-3 * wavelength_m))
    _, first = np.unique(cells, axis=0, return_index=True)
    places_m = centres_m[first]
    usual_m = extent_m / lines.channels
    if len(places_m) > 2:
        asked_m = places_m[some_channels(len(places_m), _SEARCHED)]
        usual_m = float(np.median(cKDTree(places_m).query(asked_m, k=2)[0][:, 1]))
    remedy = (
        "check the units: positions in metres (not kilometres, or degrees of latitude and "
        "longitude), `carrier_hz` in Hz (not kHz)"
    )
    if extent_m < _SHORTEST * wavelength_m:
        yield Finding(
            "advance",
            f"all {lines.channels} phase centres lie within "
            f"{measured(extent_m, 'm', 3)}, less than half the wavelength of "
            f"{wavelength}: this is too little for an aperture",
            extent_m,
            _SHORTEST * wavelength_m,
            remedy,
        )
    elif usual_m < _DENSEST * wavelength_m:
        yield Finding(
            "advance",
            f"phase centres are {measured(usual_m, 'm', 3)} apart, less than "
            f"1/{1 / _DENSEST:g} of the wavelength of {wavelength}",
            usual_m,
            _DENSEST * wavelength_m,
            remedy,
        )
    elif usual_m > MOST_WAVELENGTHS * wavelength_m:
        yield Finding(
            "advance",
            f"phase centres are {measured(usual_m, 'm', 3)} apart, more than "
            f"{MOST_WAVELENGTHS:g} wavelengths of {wavelength}",
            usual_m,
            MOST_WAVELENGTHS * wavelength_m,
            "check the units: positions in metres (not millimetres), `carrier_hz` in Hz, "
            "`sound_speed_m_s` in m/s (not km/s)",
        )


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
        "interpolate the navigation over these pings, or leave them out with `lines.select(...)`",
        tuple(where.tolist()),
    )


def _coarse(lines: RangeLines, wavelength_m: float) -> Iterator[Finding]:
    """Yield that positions are rounded to steps that are no small part of the wavelength."""
    least_m = _COARSEST * wavelength_m
    # Elements of an array lie at round numbers by design, transmitters along a track do not.
    columns = [(values, _DECIMALS) for values in lines.tx_m.T]
    for values, decimals in [*columns, *((values, ()) for values in lines.rx_m.T)]:
        step_m, how = rounded_to(values, least_m, decimals)
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


def _held(lines: RangeLines) -> Iterator[Finding]:
    columns: list[NDArray] = [lines.tx_m, lines.rx_m]
    if lines.bank_numbers is not None:  # banks may share their antennas
        columns.append(lines.bank_numbers[:, None])
    pairs = np.ascontiguousarray(np.hstack(columns) + 0.0)  # without -0
    kinds = len(np.unique(pairs.view(f"V{pairs.itemsize * pairs.shape[1]}")))
    share = 1 - kinds / lines.channels
    if share > MOST_HELD and kinds > 1:  # a single position is no track, and may be meant
        yield held_fixes(f"{lines.channels - kinds} of {lines.channels} channels", share)


def _beam(
    lines: RangeLines, grid: Grid, beam: BeamWindow, wavelength_m: float
) -> Iterator[Finding]:
    """Yield that a beam is so narrow that hardly any channels lie within it, or so coarse."""
    try:
        along = beam.directions(lines)
    except ValueError:  # a platform that stands still, which imagers refuse
        return
    points_m = grid.spread(4)
    sine = sines(points_m, lines.phase_centres_m, along)
    seen = is_within(sine, beam.limits).sum(axis=0)
    if seen.any() and (usual := float(np.median(seen[seen > 0]))) < 2:
        yield Finding(
            "beam",
            f"the beam of {beam.width_deg:g} degrees holds a single channel in most pixels: "
            "there is no aperture",
            usual,
            2.0,
            "use a wider beam (`width_deg` is in degrees, not in radians), or more pings",
        )
    elif beam.width_deg < _RADIANS and grid.is_planar:
        course = along.mean(axis=0)
        pitch_m = max(abs(float(step @ course)) for step in grid.vectors_m[1:])
        range_m = float(np.median(pairwise_range_m(points_m, lines.tx_m[:1], lines.rx_m[:1])))
        aperture_m = float(np.ptp(lines.phase_centres_m @ course))
        cell_m = wavelength_m / (2 * sine_width(beam.limits))
        of_aperture_m = wavelength_m * range_m / (2 * aperture_m or 1.0)
        coarse = 0 < _COARSER * pitch_m < cell_m and cell_m > _NARROWED * of_aperture_m
        if coarse:
            yield Finding(
                "beam",
                f"the beam of {beam.width_deg:g} degrees resolves "
                f"{measured(cell_m, 'm', 3)} along the track, "
                f"{cell_m / pitch_m:.3g} times the spacing of the pixels",
                cell_m,
                _COARSER * pitch_m,
                f"give `width_deg` in degrees: {beam.width_deg:g} radians are "
                f"{math.degrees(beam.width_deg):.3g} degrees",
            )


def _samples(lines: RangeLines) -> Iterator[Finding]:
    """Yield that samples are real numbers, or echoes of a chirp that was not compressed."""
    part = lines.samples[some_channels(lines.channels, _CHANNELS)]
    largest = float(np.abs(part).max())
    if not largest or part.shape[1] < LEAST_FIXES:
        return
    part = (part / np.float64(largest)).astype(np.complex64)  # float32 overflows for denormals
    if not part.imag.any() and part.real.min() < 0 < part.real.max():
        yield Finding(
            "real_samples",
            "samples are real numbers: their imaginary parts are all 0, and so are half of the "
            "phases",
            0.0,
            0.0,
            "form the analytic signal first, `scipy.signal.hilbert(samples, axis=1)` with "
            "`carrier_hz=0`, or mix the samples down and filter them",
        )
        return
    # The phase of z steps from sample to sample; in a chirp these steps grow evenly.
    z = part[:, 1:] * part[:, :-1].conj()
    lags = [2**n for n in range(1, 10) if 4 * 2**n < z.shape[1]]
    power = (np.abs(z) ** 2).sum(axis=1) + 1e-30
    turned = [np.mean((z[:, lag:] * z[:, :-lag].conj()).imag.sum(axis=1) / power) for lag in lags]
    if lags and (share := float(np.abs(turned).max())) > _CHIRPED:
        yield Finding(
            "uncompressed",
            f"the frequency of echoes changes evenly with range ({100 * share:.0f} % of it; it "
            f"should be below {100 * _CHIRPED:.0f} %): they seem to be chirps that were not "
            "compressed",
            share,
            _CHIRPED,
            "compress them with `clsas.compress`, or correlate them with the transmitted pulse",
        )


def _end_fire(lines: RangeLines, grid: Grid, last_m: NDArray[np.float64]) -> Iterator[Finding]:
    """Yield that a straight track leads to the pixels that it reaches, instead of passing them."""
    some = some_channels(lines.channels, _PHASED)
    centres_m = lines.phase_centres_m[some]
    away_m = centres_m - centres_m.mean(axis=0)
    _, sizes_m, axes = np.linalg.svd(away_m, full_matrices=False)
    if len(sizes_m) < 2 or not sizes_m[0] or sizes_m[1] > STRAIGHT * sizes_m[0]:
        return
    points_m = grid.spread(8)
    ahead_m, passed_m = (
        (each - centres_m.mean(axis=0)) @ axes[0] for each in (points_m, centres_m)
    )
    if ahead_m.min() <= passed_m.max() and ahead_m.max() >= passed_m.min():
        return  # the track passes some pixels
    look_m = points_m[:, None] - centres_m
    distance_m = np.linalg.norm(look_m, axis=-1)
    reached = (distance_m >= lines.first_range_m[some]) & (distance_m <= last_m[some])
    reached &= distance_m > 0
    if not reached.any():
        return
    cosine = float(np.median(np.abs(look_m[reached] @ axes[0]) / distance_m[reached]))
    if cosine > _END_FIRE:
        yield Finding(
            "end_fire",
            f"the track leads to the grid, {math.degrees(math.acos(min(cosine, 1.0))):.0f} degrees "
            "off its direction, instead of passing it: such an aperture resolves nothing across "
            "the line of sight",
            cosine,
            _END_FIRE,
            "check that x and y of positions and grid are in the same order, (x, y, z)",
        )


def _focus(lines: RangeLines, grid: Grid) -> Iterator[Finding]:
    """Yield that the brightest echo focuses only if the lines are read in another way."""
    if not lines.carrier_hz or lines.sound_speed is not None or lines.length < LEAST_FIXES:
        return
    given = _focused(lines, grid, lines.first_range_m, lines.range_step_m)
    if given is None or given[0] > _FOCUS:
        return
    as_given, conjugate = given
    least = max(_CLEAR, _SHARPER * as_given)

    def message(cause: str, found: float) -> str:
        return (
            f"the brightest echo is not in focus, and would be if {cause}: its channels would add "
            f"up to {100 * found:.0f} % of their magnitudes, instead of {100 * as_given:.0f} %"
        )

    if conjugate > least:
        remedy = "conjugate the samples: `dataclasses.replace(lines, samples=lines.samples.conj())`"
        what = message("its phase had the opposite sign", conjugate)
        yield Finding("phase_sign", what, conjugate, least, remedy)
        return
    for cause, first in (
        ("`range_step_m` were half as large, c/(2 fs) instead of c/fs", 1.0),
        ("all ranges were half as large, since they are half the two-way path", 0.5),
    ):
        other = _focused(lines, grid, first * lines.first_range_m, lines.range_step_m / 2)
        if other is not None and other[0] > least:
            remedy = "check `range_step_m` and `first_range_m`: an echo at the time t is at c t/2"
            yield Finding("ranges", message(cause, other[0]), other[0], least, remedy)
            return


def blurred_aperture_m(wavelength_m: float, range_m: float) -> float:
    """Return the aperture over which the wrong sign blurs a point by `_BLUR`."""
    return math.sqrt(_BLUR / 2 * wavelength_m * range_m)


def _focused(
    lines: RangeLines, grid: Grid, first_m: NDArray[np.float64], step_m: float
) -> tuple[float, float] | None:
    """Return how well the channels of the brightest echo add up, and their conjugates; or None.

    It is the sum of phasors over that of magnitudes, at the best of nearby places along the track.
    """
    centres_m = lines.phase_centres_m
    points_m = grid.spread(_ARC)
    wavelength_m = carrier_wavelength_m(lines)

    def at(places_m: NDArray[np.float64], some: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
        range_m = pairwise_range_m(places_m, lines.tx_m[some], lines.rx_m[some])
        number = np.rint((range_m - first_m[some]) / step_m)
        inside = (number >= 0) & (number < lines.length)
        found = lines.samples[some, np.where(inside, number, 0).astype(np.int64)] * inside
        return range_m, found

    # The brightest sample, of channels spread over all, at ranges that the grid has.
    searched = some_channels(lines.channels, _BRIGHTEST)
    range_m = pairwise_range_m(points_m[:: max(len(points_m) // 256, 1)], lines.tx_m[searched],
                               lines.rx_m[searched])  # fmt: skip
    places_m = first_m[searched, None] + step_m * np.arange(lines.length)
    there = (places_m >= range_m.min(axis=0)[:, None]) & (places_m <= range_m.max(axis=0)[:, None])
    level = np.abs(lines.samples[searched]) * there
    row, sample = np.unravel_index(int(level.argmax()), level.shape)
    if not level[row, sample]:
        return None
    channel, far_m = int(searched[row]), float(places_m[row, sample])
    # Channels that see it over an aperture in which the wrong sign blurs a point.
    reach_m = blurred_aperture_m(wavelength_m, far_m) / 2
    near = np.flatnonzero(np.linalg.norm(centres_m - centres_m[channel], axis=1) <= reach_m)
    near = near[some_channels(len(near), _PHASED)]
    if len(near) < _LEAST_PHASED:
        return None
    # Among points at its range, the one from which all of these receive most.
    away_m = pairwise_range_m(points_m, lines.tx_m[[channel]], lines.rx_m[[channel]])[:, 0]
    spread = float(np.linalg.norm(np.ptp(points_m, axis=0))) / _ARC
    arc_m = points_m[np.abs(away_m - far_m) <= 2 * spread]
    if not len(arc_m):
        return None
    _, sizes_m, axes = np.linalg.svd(
        centres_m[near] - centres_m[near].mean(axis=0), full_matrices=False
    )
    if sizes_m[1] > STRAIGHT * sizes_m[0]:  # an error across the track would blur the point, too
        return None
    course = axes[0]
    best_m = arc_m[:1]
    while True:
        for _ in range(2):  # moves them to the range of the echo
            ranges_m = pairwise_range_m(arc_m, lines.tx_m[[channel]], lines.rx_m[[channel]])
            arc_m = centres_m[channel] + (arc_m - centres_m[channel]) * (far_m / ranges_m)
        energy = np.abs(at(arc_m, near)[1]).sum(axis=1)
        best_m = arc_m[[int(energy.argmax())]]
        if spread < step_m:
            break
        arc_m = best_m + np.linspace(-spread, spread, 17)[:, None] * course
        spread /= 6
    range_m, found = (each[0] for each in at(best_m, near))
    found = found.astype(np.complex128)
    found /= np.abs(found).max() or 1.0  # squares stay within floating point
    level = np.abs(found)
    total, square = float(level.sum()), float((level**2).sum())
    if not total or total**2 < _LEAST_PHASED * square:
        return None
    # An error along the track adds a linear phase over the directions; search all that are likely.
    looks_m = np.stack([best_m - lines.tx_m[near], best_m - lines.rx_m[near]])
    directions = unit_vectors(looks_m).sum(axis=0) @ course
    extent = float(np.ptp(directions))
    if not extent:
        return None
    cells = min(2 * (2 * step_m / wavelength_m + 4), 128)
    errors_m = np.linspace(-1, 1, int(8 * cells) + 1) * cells * wavelength_m / extent
    linear = np.exp(2j * np.pi / wavelength_m * np.outer(errors_m, directions - directions.mean()))
    aligned = turned(2 / wavelength_m * range_m)
    sums = [np.abs(linear @ (each * aligned)).max() for each in (found, found.conj())]
    return float(sums[0]) / total, float(sums[1]) / total
