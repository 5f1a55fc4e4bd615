"""The checks of an inspection: one function for each kind of defect, and the list of all.

A check takes a `Recording` and yields its findings. To add one, write such a function, add it to
`CHECKS`, and describe its findings in the table of "Look before you image" in the guide to
recordings. A test compares that table with the findings here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from clsas.engine.data import decibels
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import behind
from clsas.engine.data.findings import Finding
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import SAMPLED_PIXELS, Grid
from clsas.engine.data.lines import (
    EQUAL_RANGE,
    RangeLines,
    banks_of,
    some_channels,
    wavelength_between_m,
)
from clsas.engine.data.pings import STILL, Transmissions
from clsas.engine.data.reprs import measured
from clsas.engine.device.device import Device
from clsas.engine.signal.ambiguity import end_powers
from clsas.engine.signal.doubts import MOST_WAVELENGTHS, doubts
from clsas.engine.signal.echoes import Echoes
from clsas.engine.signal.spectrum import NEEDED_OVERSAMPLING, Spectrum, measure_spectrum
from clsas.inspection.phase_sign import CLEAR, PhaseSign, phase_sign
from clsas.inspection.sampling import check_sampling
from clsas.navigation.correlation import DEAD_DB, are_dead

_LEAST_CLIPPED = 8
"""Fewest samples at its largest level that make a channel count as clipped. Echoes have one or
two."""
_SAME_LEVEL = 1e-5
"""Relative difference up to which two levels count as equal, to allow for rounding. Within 1e-3 of
the largest level, the beats of overlapping chirps have a dozen samples."""
_CLIPPED_OVER_NEXT = 5.0
"""Least ratio of the samples at a ceiling to those at the next lower level. Peaks of echoes have
ratios of 1 to 3."""
_CONSTANT_DB = -40.0
"""Power of a constant relative to the echoes above which it is reported. In an image of N channels,
the power of a constant grows N times as much as that of echoes."""
_BESIDE = 8  # frequencies on either side of a constant that it is compared with
_LEAST_COUNT = 4 * _BESIDE  # samples or pings in which a constant can be measured
_MAIN_LOBE = 2  # frequencies on either side of a constant that a Hann window fills
_SPIKE = 2.0  # least power of a constant relative to the largest beside it; speckle reaches 1.2
_BLOCK = 1 << 22  # samples processed at a time
_GAP = 1.75
"""Advance relative to that of the pings around, above which pings are missing. One missing ping
doubles the advance."""
_SCATTER = 5.0  # standard deviations of steps that a gap must also exceed, for noisy positions
_AROUND = 31  # steps in the running median that gives the usual advance near a ping
_LEAST_PER_WAVELENGTH = 50.0
"""Advances of a receiver per wavelength above which a unit must be wrong. Slow rails reach 20.
Positions in kilometres multiply it by 1000, which finds advances of up to 20 wavelengths."""
_ENDS_DB = -20.0  # power at the ends relative to whole lines, above which it is reported
_FARTHEST = 1e4
"""First range relative to the length of a line, above which a unit must be wrong. Satellites reach
100."""
_TOO_EARLY = 0.25
"""Share of the power at impossible ranges, above which it is reported. First ranges that are off by
a quarter of a line exceed it. A full matrix capture reaches 0.12 by surface waves, which travel
along the array and arrive before any echo."""
_OUTSIDE = 0.01  # share of the pixels that no line reaches, above which it is reported
_SLIPPED = 0.25  # such a share, above which slips of units are tried
_EXPLAINED = 0.5  # least share of the uncovered grid that a slip must explain
_LONGEST = 30.0
"""Length of corrected lines relative to the farthest range of the grid, at most. Longer lines would
cover any grid."""
_ALIKE = 0.05  # slips that differ by less than this share of the grid explain it equally well
_MOST_RUNS = 12  # runs of indices that are written out


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, its measures, and what is known of the image to come.

    Attributes
    ----------
    recorded : RangeLines or Echoes
        The data as given.
    lines : RangeLines
        The given lines, or the echoes after compression.
    grid, beam, element_length_m, device
        As for `inspect`.
    """

    recorded: RangeLines | Echoes
    lines: RangeLines
    grid: Grid | None
    beam: BeamWindow | None
    element_length_m: float | None
    device: Device | None

    @cached_property
    def pings(self) -> Transmissions:
        """Pings of the lines."""
        return Transmissions.of(self.lines.tx_m, self.lines.rx_m)

    @cached_property
    def moving(self) -> RangeLines:
        """Lines of the pings during which the platform advances, or all lines if it never does.

        A halt of hundreds of equal pings would outweigh the rest of the track.
        """
        advancing = self.pings.advancing()
        if not self.pings.usual_step_m or advancing.all():
            return self.lines
        return self.lines.select(self.pings.channels(advancing))

    @cached_property
    def moving_pings(self) -> Transmissions:
        """Pings of the moving lines."""
        if self.moving is self.lines:
            return self.pings
        return Transmissions.of(self.moving.tx_m, self.moving.rx_m)

    @property
    def receivers(self) -> int | None:
        """Channels per ping if all pings have the same number, else None."""
        counts = self.pings.receivers
        return None if np.ptp(counts) else int(counts[0])

    @cached_property
    def spectrum(self) -> Spectrum:
        """Mean power spectrum of the moving lines."""
        return measure_spectrum(self.moving)

    @property
    def rate_hz(self) -> float:
        """Sample rate of the lines."""
        return self.lines.sound_speed_m_s / (2 * self.lines.range_step_m)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lower and upper end of the occupied band."""
        middle_hz = self.lines.carrier_hz + self.spectrum.centre * self.rate_hz
        half_hz = self.rate_hz / max(self.spectrum.oversampling, 1.0) / 2
        return middle_hz - half_hz, middle_hz + half_hz

    @property
    def wavelength_m(self) -> float:
        """Wavelength at the mean magnitude of the frequencies of the band.

        That is the middle of the band unless it reaches below 0 Hz. The middle of such a band is
        arbitrary: it may be 0 Hz, where the wavelength is infinite.
        """
        return wavelength_between_m(self.lines, *self.band_hz)

    @cached_property
    def levels(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Power and clipped samples of every channel, [channels] each; see `levels_of`.

        They are those of the data as recorded: compression spreads clipped samples over a line.
        """
        is_echoes = isinstance(self.recorded, Echoes)
        return levels_of(self.recorded.samples, magnitudes=not is_echoes)

    @cached_property
    def background(self) -> float:
        """Share of the power that is the same in all moving pings.

        It is 0 if there are too few pings, or the lines of a receiver begin at different ranges.
        """
        lines, pings = self.moving, self.moving_pings
        if pings.count < _LEAST_COUNT or np.ptp(pings.receivers):
            return 0.0
        shape = pings.count, int(pings.receivers[0])
        first_m = lines.first_range_m.reshape(shape)
        if np.ptp(first_m, axis=0).max() > EQUAL_RANGE * lines.range_step_m:
            return 0.0
        samples = lines.samples.reshape(*shape, lines.length)
        some = some_channels(shape[1], 8)
        return float(np.mean([_constant_share(samples[:, receiver], 0.0) for receiver in some]))

    @cached_property
    def sign(self) -> tuple[PhaseSign | None, str]:
        """Comparison of both signs of the phase; see `phase_sign`."""
        # Of the first bank, since those of several may cancel in an image.
        lines = self.moving.bank(banks_of(self.moving.bank_numbers)[0])
        if self.background > decibels.power(_CONSTANT_DB):
            # It is equally bright in every ping, and would be taken for the brightest echoes.
            per_bank = None if self.receivers is None else self.receivers // self.lines.banks
            lines = lines.without_background("median", receivers=per_bank)
        cell_m = lines.range_step_m * max(self.spectrum.oversampling, 1.0)
        return phase_sign(lines, self.grid, self.wavelength_m, cell_m, self.device)


def levels_of(samples: NDArray, magnitudes: bool) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the power and the number of clipped samples of every channel.

    The power is the variance, relative to the squared magnitude of the largest sample of all.
    Clipped samples lie at the largest level of a channel; their number is 0 if it is no more than
    echoes have there. Real and imaginary parts may be clipped and, with `magnitudes`, magnitudes
    too.
    """
    scale = max(float(np.abs(block).max()) for block in _blocks(samples)) or 1.0
    precision = np.complex128 if np.iscomplexobj(samples) else np.float64
    power, clipped = [], []
    for block in _blocks(samples):
        scaled = block / np.float32(scale)
        if scaled.shape[1] == 1:  # a single sample has no variance
            scaled = np.concatenate([scaled, -scaled], axis=1)
        power.append(scaled.var(axis=1, dtype=precision).real)
        count = _clipped_samples(np.maximum(np.abs(scaled.real), np.abs(scaled.imag)))
        if magnitudes:
            count = np.maximum(count, _clipped_samples(np.abs(scaled)))
        clipped.append(count)
    return np.concatenate(power), np.concatenate(clipped)


def _blocks(samples: NDArray) -> Iterator[NDArray]:
    rows = max(1, _BLOCK // samples.shape[1])
    for first in range(0, len(samples), rows):
        yield samples[first : first + rows]


def _clipped_samples(level: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return how many samples of each channel lie at its largest level, or 0 without clipping."""
    largest = level.max(axis=1, keepdims=True)
    at_top = level >= (1 - _SAME_LEVEL) * largest
    counts = at_top.sum(axis=1) * (largest[:, 0] > 0)
    counts[counts < _LEAST_CLIPPED] = 0
    for channel in np.flatnonzero(counts):
        lower = level[channel][~at_top[channel]]
        margin = _SAME_LEVEL * largest[channel, 0]
        beside = int((lower >= lower.max() - margin).sum()) if lower.size and lower.any() else 0
        if counts[channel] < _CLIPPED_OVER_NEXT * beside:
            counts[channel] = 0
    return counts


def _constant_share(samples: NDArray, frequency: float) -> float:
    """Return the share of the power of columns at a single frequency, in cycles per sample.

    Echoes have power at this frequency as well, so only what exceeds the power at the frequencies
    beside it counts. The share is 0 unless the frequency stands out like a spectral line.
    """
    count = len(samples)
    from scipy.signal.windows import hann  # slow to import

    window = hann(count, sym=False)
    offsets = np.arange(-_BESIDE, _BESIDE + 1)
    turns = np.exp(-2j * np.pi * np.outer(frequency + offsets / count, np.arange(count))) * window
    largest = float(np.abs(samples).max()) or 1.0
    power, total = np.zeros(len(offsets)), 0.0
    columns = max(1, _BLOCK // count)
    for first in range(0, samples.shape[1], columns):
        block = samples[:, first : first + columns] / np.float32(largest)
        power += (np.abs(turns.astype(np.complex64) @ block) ** 2).sum(axis=1, dtype=np.float64)
        total += float((np.abs(block) ** 2).sum(dtype=np.float64)) / count
    others = power[np.abs(offsets) > _MAIN_LOBE]
    beside, at = float(np.median(others)), float(power[_BESIDE])
    if not total or at <= _SPIKE * float(others.max()):
        return 0.0
    return (at - beside) / float(window.sum()) ** 2 / total


def check_aperture(recording: Recording) -> Iterator[Finding]:
    """Yield that a recording has a single channel."""
    if recording.lines.channels == 1:
        message = "the recording has one channel: there is no aperture"
        remedy = "record several pings along a track, or several receivers"
        yield Finding("aperture", message, 1.0, 2.0, remedy)


def check_order(recording: Recording) -> Iterator[Finding]:
    """Yield that the track turns back, which may also cause halts and gaps."""
    turns = recording.pings.turns
    if not turns.size:
        return
    message = (
        f"the track turns back {turns.size} time{'s' * (turns.size > 1)}, first after ping "
        f"{turns[0]}: pings are out of order, or their positions are noisy"
    )
    if recording.pings.disordered:
        message += ". Gaps are not searched for in such a track"
    remedy = (
        "sort the pings by time with `lines.select(order)`, or smooth noisy positions; image "
        "passes in opposite directions separately"
    )
    yield Finding("order", message, float(turns.size), 0.0, remedy, tuple(turns.tolist()))


def check_halts(recording: Recording) -> Iterator[Finding]:
    """Yield pings taken while the platform stood still."""
    pings = recording.pings
    if pings.count > 1 and not pings.usual_step_m:
        message = f"all {pings.count} pings were taken at one position: there is no aperture"
        remedy = "check the positions, which may be missing from the recording"
        yield Finding("still_pings", message, float(pings.count), 0.0, remedy)
    elif (still := np.flatnonzero(~pings.advancing())).size:
        message = (
            f"{still.size} of {pings.count} pings were taken while the platform stood still: it "
            f"advanced by less than {STILL:g} of the usual {measured(pings.usual_step_m, 'm')}. "
            "The equal echoes of these pings add up and hide the scene"
        )
        remedy = "drop them with `lines.without_still_pings()`"
        yield Finding("still_pings", message, float(still.size), 0.0, remedy, tuple(still.tolist()))


def check_gaps(recording: Recording) -> Iterator[Finding]:
    """Yield gaps in a track whose pings are in order."""
    pings = recording.pings
    numbers = np.flatnonzero(pings.advancing())
    if pings.disordered or len(numbers) < 3:
        return
    gaps, steps_m, limits_m = _gaps(pings.places_m[numbers])
    if not gaps.size:
        return
    widest, several = gaps[np.argmax(steps_m[gaps])], "s" * (gaps.size > 1)
    widest_m, limit_m = float(steps_m[widest]), float(limits_m[widest])
    message = (
        f"the track has {gaps.size} gap{several}, after ping{several} {runs(numbers[gaps])}. The "
        f"widest is {measured(widest_m, 'm')}; the limit there is {measured(limit_m, 'm')}"
    )
    remedy = (
        "look for lost pings in the recorder, or image the parts of the track separately: targets "
        "beside a gap blur and get grating lobes"
    )
    yield Finding("gaps", message, widest_m, limit_m, remedy, tuple(numbers[gaps].tolist()))


def _gaps(
    centres_m: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the pings after which there are gaps, all steps, and the largest step allowed."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    around_m = median_filter(steps_m, size=min(_AROUND, len(steps_m)), mode="nearest")
    scatter_m = decibels.DEVIATION_PER_MEDIAN * float(np.median(np.abs(steps_m - around_m)))
    limits_m = np.maximum(_GAP * around_m, around_m + _SCATTER * scatter_m)
    return np.flatnonzero(steps_m > limits_m), steps_m, limits_m


def check_advance(recording: Recording) -> Iterator[Finding]:
    """Yield an advance that only a slip of units can explain."""
    pings, lines, wavelength_m = recording.pings, recording.lines, recording.wavelength_m
    usual_m, last_range_m = pings.usual_step_m, float(lines.last_range_m.max())
    receivers = float(np.median(pings.receivers)) / lines.banks
    # A long array may advance by little: its own length counts as well.
    first_ping = lines.rx_m[: pings.starts[1]]
    if lines.bank_numbers is not None:  # banks lie above each other
        first_ping = first_ping[lines.bank_numbers[: pings.starts[1]] == lines.bank_numbers[0]]
    array_m = float(np.linalg.norm(np.ptp(first_ping, axis=0))) / 2
    least_m = wavelength_m / _LEAST_PER_WAVELENGTH
    most_m = MOST_WAVELENGTHS * wavelength_m * receivers
    wavelength = measured(wavelength_m, "m")
    remedy = "check units: positions in metres (not millimetres), and ranges in metres"
    if 0 < usual_m < least_m * receivers - array_m:
        limit_m, limit = least_m, f"less than 1/{_LEAST_PER_WAVELENGTH:g} of the wavelength of "
        limit += wavelength
        if receivers > 1:
            limit += f", and a ping of {receivers:g} receivers spans {measured(array_m, 'm')}"
        limit += ": this is too little for an aperture"
        remedy = (
            "check units: positions in metres (not kilometres), `carrier_hz` in Hz (not kHz). If "
            "the platform is as slow as that, keep every nth ping with `lines.select(...)`"
        )
    elif usual_m > last_range_m > 0:
        limit_m, limit = last_range_m, f"more than the last range of {measured(last_range_m, 'm')}"
    elif usual_m > most_m:
        limit_m = most_m
        limit = f"more than {MOST_WAVELENGTHS:g} wavelengths of {wavelength} per receiver"
    else:
        return
    message = f"pings are {measured(usual_m, 'm')} apart, {limit}"
    yield Finding("advance", message, usual_m, limit_m, remedy)


def check_dead(recording: Recording) -> Iterator[Finding]:
    """Yield channels without a signal."""
    power, _ = recording.levels
    usual = float(np.median(power[power > 0])) if power.any() else 0.0
    dead, least = are_dead(power, usual), float(power.min())
    if not dead.any():
        return
    least_db = decibels.in_db(least / usual if least else 0.0)
    weakest = f"{least_db:.0f} dB" if least else "no signal"
    message = (
        f"{_of_channels(dead)} dead: at least {-DEAD_DB:.0f} dB below the median channel "
        f"(weakest: {weakest}){_in_every_ping(dead, recording.receivers)}"
    )
    remedy = "leave them out: `lines.select(...)` with the others, or `lines.weighted(...)` with 0"
    if dead.all():
        message = f"all {dead.size} channels are silent"
        remedy = "check the recorder, and how its samples were read"
    where = tuple(np.flatnonzero(dead).tolist())
    yield Finding("dead_channels", message, least_db, DEAD_DB, remedy, where)


def check_clipping(recording: Recording) -> Iterator[Finding]:
    """Yield clipped channels."""
    _, samples = recording.levels
    clipped, worst = samples > 0, int(samples.max())
    if not worst:
        return
    message = (
        f"{_of_channels(clipped)} clipped: up to {worst} samples of a channel are at its largest "
        f"level{_in_every_ping(clipped, recording.receivers)}"
    )
    remedy = (
        "record with less gain. In an existing recording, leave these channels out "
        "(`lines.select(...)`), or silence what overdrives them, such as the transmission"
    )
    where = tuple(np.flatnonzero(clipped).tolist())
    yield Finding("clipped_channels", message, float(worst), float(_LEAST_CLIPPED), remedy, where)


def _of_channels(defective: NDArray[np.bool_]) -> str:
    count = int(defective.sum())
    return f"{count} of {defective.size} channels {'is' if count == 1 else 'are'}"


def _in_every_ping(defective: NDArray[np.bool_], receivers: int | None) -> str:
    """Return words that name the receivers with a defect in every ping, or ""."""
    if not receivers or receivers == 1 or len(defective) <= receivers:
        return ""
    always = np.flatnonzero(defective.reshape(-1, receivers).all(axis=0))
    if not always.size:
        return ""
    return f"; in every ping receivers {runs(always)} of {receivers} (from 0)"


def check_offset(recording: Recording) -> Iterator[Finding]:
    """Yield a constant that a recorder added, at 0 Hz of the lines or of the recorded signal."""
    lines, rate_hz = recording.moving, recording.rate_hz
    if lines.length < _LEAST_COUNT:
        return
    part = lines.select(some_channels(lines.channels))
    remove_mean = (
        "subtract each channel's mean before compression; `lines.without_background()` also "
        "removes a constant that is the same in all pings"
    )
    least = measured(4 * rate_hz / lines.length, "Hz")
    high_pass = f"`lines.high_passed(hz)` with a cutoff of at least {least}, and below the band"
    constants = [("the lines", 0.0, remove_mean if lines.carrier_hz else high_pass)]
    if 0 < lines.carrier_hz < rate_hz / 2:
        constants.append(("the recorded signal", -lines.carrier_hz / rate_hz, high_pass))
    for signal, frequency, remedy in constants:
        share = _constant_share(part.samples.T, frequency)
        if share > decibels.power(_CONSTANT_DB):
            found_db = decibels.in_db(share)
            message = (
                f"a constant at 0 Hz of {signal} has {found_db:.1f} dB of the echoes' power; it "
                f"should be below {_CONSTANT_DB:.0f} dB"
            )
            yield Finding("offset", message, found_db, _CONSTANT_DB, remedy)
            return


def check_background(recording: Recording) -> Iterator[Finding]:
    """Yield power that is the same in all pings."""
    share, limit = recording.background, decibels.power(_CONSTANT_DB)
    if share > limit:
        message = (
            f"{100 * share:.3g} % of the power is the same in all pings; it should be below "
            f"{100 * limit:.2g} %. Direct arrivals, ringing, an offset, or a reflector at constant "
            "range can cause this"
        )
        remedy = "remove it with `lines.without_background('median')`"
        yield Finding("background", message, decibels.in_db(share), _CONSTANT_DB, remedy)


def check_ends(recording: Recording) -> Iterator[Finding]:
    """Yield ends of lines that do not fade."""
    lines = recording.moving
    found_db = decibels.in_db(max(end_powers(lines)))
    if found_db > _ENDS_DB:
        message = (
            f"power at the ends of the lines is {found_db:.1f} dB relative to the mean; it should "
            f"be below {_ENDS_DB:.0f} dB. Lines that are cut within echoes cannot be interpolated "
            "near the cut, and lines computed from samples over frequency wrap around there"
        )
        fiftieth_m = (lines.length - 1) * lines.range_step_m / 50
        remedy = (
            f"fade a fiftieth of the lines at each end with `lines.tapered_ends` ({fiftieth_m:.2g} "
            "m), and keep the grid inside the rest"
        )
        yield Finding("ends", message, found_db, _ENDS_DB, remedy)


def check_oversampling(recording: Recording) -> Iterator[Finding]:
    """Yield a band that fills the whole sampled band."""
    oversampling, least = recording.spectrum.oversampling, NEEDED_OVERSAMPLING
    if oversampling < least:
        message = (
            f"oversampling is {oversampling:.3g}; it should be at least {least:g}. The signal "
            "fills the whole sampled band, and its edges may be aliased"
        )
        remedy = (
            "sample more finely, or compress with a smaller `bandwidth_hz`. Noise without a signal "
            "fills the band as well"
        )
        yield Finding("oversampling", message, oversampling, least, remedy)


def check_band(recording: Recording) -> Iterator[Finding]:
    """Yield a band that is wider than its carrier allows."""
    carrier_hz, (low_hz, high_hz) = recording.lines.carrier_hz, recording.band_hz
    width_hz = high_hz - low_hz
    is_wide = carrier_hz and width_hz > 2 * carrier_hz
    if is_wide and recording.moving.samples.any():  # silent lines have no band
        message = (
            f"the band of {measured(width_hz, 'Hz')} is wider than twice the carrier of "
            f"{measured(carrier_hz, 'Hz')}, and so reaches below 0 Hz"
        )
        remedy = (
            "check units: `range_step_m` in metres (not millimetres or samples), `carrier_hz` in "
            "Hz (not kHz), `sound_speed_m_s` in m/s"
        )
        yield Finding("band", message, width_hz, 2 * carrier_hz, remedy)


def check_spacing(recording: Recording) -> Iterator[Finding]:
    """Yield a spacing beyond the limits of sampling, on the longest leg between gaps."""
    grid, beam, length_m = recording.grid, recording.beam, recording.element_length_m
    if grid is None and beam is None and length_m is None:
        return
    pings = recording.moving_pings
    searched = pings.count > 2 and not pings.disordered
    gaps = _gaps(pings.places_m)[0] if searched else np.zeros(0, np.int64)
    edges = [0, *(gaps + 1).tolist(), pings.count]
    longest = int(np.argmax(np.diff(edges)))
    leg = slice(int(pings.starts[edges[longest]]), int(pings.starts[edges[longest + 1]]))
    yield from check_sampling(
        recording.moving.select(leg), grid, beam=beam, element_length_m=length_m,
        wavelength_m=recording.wavelength_m,
    )  # fmt: skip


def check_first_range(recording: Recording) -> Iterator[Finding]:
    """Yield ranges that no recording can have, or echoes closer than the antennas allow."""
    lines = recording.lines
    first_m, last_m = float(lines.first_range_m.min()), float(lines.last_range_m.max())
    if _beyond_any_range(lines):
        limit_m, limit = 0.0, "no range is positive"
        if last_m > 0:
            extent_m = max(lines.length - 1, 1) * lines.range_step_m
            limit_m = _FARTHEST * extent_m
            limit = f"more than {_FARTHEST:g} times their length of {measured(extent_m, 'm')}"
        message = f"the lines begin at {first_m:.6g} m and end at {last_m:.6g} m: {limit}"
        remedy = (
            "check the time of the first sample, which must be in seconds, not in samples; "
            "`first_range_m` is half the sound speed times it"
        )
        yield Finding("range_offset", message, first_m, limit_m, remedy)
        return
    part = lines.select(some_channels(lines.channels))
    least_m = np.linalg.norm(part.tx_m - part.rx_m, axis=1) / 2
    count = np.ceil((least_m - part.first_range_m) / part.range_step_m)
    power = np.abs(part.samples / (np.abs(part.samples).max() or np.float32(1))) ** 2
    early = np.arange(part.length) < count[:, None]
    share = float(power[early].sum(dtype=np.float64) / (power.sum(dtype=np.float64) or 1.0))
    if share > _TOO_EARLY:
        message = (
            f"{100 * share:.3g} % of the power lies at impossible ranges, shorter than half the "
            f"distance from transmitter to receiver (up to {measured(least_m.max(), 'm')}); it "
            f"should be below {100 * _TOO_EARLY:g} %. The lines begin at {measured(first_m, 'm')}"
        )
        remedy = (
            "check the time of the first sample, and the units of positions and ranges. Periodic "
            "lines of phase histories may have echoes from beyond their far end there"
        )
        yield Finding("range_offset", message, share, _TOO_EARLY, remedy)


def _beyond_any_range(lines: RangeLines) -> bool:
    """Return True if no range is positive, or all lie far beyond those of any recording."""
    nearest_m = float(np.abs(lines.first_range_m).min())
    extent_m = max(lines.length - 1, 1) * lines.range_step_m
    return bool(lines.last_range_m.max() <= 0) or nearest_m > _FARTHEST * extent_m


def check_grid(recording: Recording) -> Iterator[Finding]:
    """Yield that parts of the grid lie beyond all lines, and the slip that may explain it."""
    lines, grid = recording.lines, recording.grid
    if grid is None or _beyond_any_range(lines):
        return
    points_m = grid.spread().reshape(-1, 3)
    share = _covered(lines, points_m)
    if share >= 1 - _OUTSIDE:
        return
    part = lines.select(some_channels(lines.channels))
    range_m = pairwise_range_m(points_m, part.tx_m, part.rx_m)
    near_m, far_m = float(range_m.min()), float(range_m.max())
    message = (
        f"{100 * (1 - share):.3g} % of the grid lies beyond all lines: the grid has ranges from "
        f"{near_m:.4g} m to {far_m:.4g} m, the lines from {lines.first_range_m.min():.4g} m to "
        f"{lines.last_range_m.max():.4g} m"
    )
    low_m, high_m = grid.bounds_m
    remedy = "choose another grid, or check the time of the first sample and the sound speed"
    if near_m <= float(np.linalg.norm(high_m - low_m)) / SAMPLED_PIXELS:
        remedy = "choose another grid: the track runs through this one"
    elif 1 - share > _SLIPPED and (likely := _likely_slip(lines, points_m, share, far_m)):
        slip, corrected = likely
        remedy = (
            f"check units: {slip}. Corrected, the lines would cover {100 * corrected:.3g} % of "
            "the grid"
        )
    yield Finding("grid_outside", message, 1 - share, _OUTSIDE, remedy)


def _likely_slip(
    lines: RangeLines, points_m: NDArray[np.float64], share: float, far_m: float
) -> tuple[str, float] | None:
    """Return the slip of units or time that best explains why lines reach only a share of points.

    With it comes the share that the corrected lines reach; None if no slip explains it. Among slips
    that explain it equally well, those that leave the lines shortest come first, since long lines
    reach any grid; among these, the most common.
    """
    half_speed = lines.sound_speed_m_s / 2
    # The most common first, with the factors of first ranges, range step and positions.
    slips = [
        ("`first_range_m` seems to be a time in seconds, not half the sound speed times it",
         half_speed, 1.0, 1.0),
        ("the time of the first sample seems to be in milliseconds, not in seconds",
         1e-3, 1.0, 1.0),
        ("`first_range_m` seems to be in samples, not in metres", lines.range_step_m, 1.0, 1.0),
        ("the time of the first sample seems to be in samples, not in seconds",
         lines.range_step_m / half_speed, 1.0, 1.0),
        ("ranges seem to be in millimetres, not in metres", 1e-3, 1e-3, 1.0),
        ("ranges seem to be in kilometres, not in metres", 1e3, 1e3, 1.0),
        ("ranges seem to be the two-way path, not half of it", 0.5, 0.5, 1.0),
        ("positions seem to be in millimetres, not in metres", 1.0, 1.0, 1e-3),
        ("positions seem to be in kilometres, not in metres", 1.0, 1.0, 1e3),
    ]  # fmt: skip
    found = [
        (step, words, _covered(lines, points_m, first, step, positions))
        for words, first, step, positions in slips
        if step * lines.range_step_m * lines.length <= _LONGEST * far_m
    ]
    most = max((corrected for *_, corrected in found), default=0.0)
    if most < share + _EXPLAINED * (1 - share):
        return None
    alike = [each for each in found if each[2] >= most - _ALIKE]
    _, words, corrected = min(alike, key=lambda each: each[0])
    return words, corrected


def _covered(
    lines: RangeLines,
    points_m: NDArray[np.float64],
    first: float = 1.0,
    step: float = 1.0,
    positions: float = 1.0,
) -> float:
    """Return the share of points that some line reaches, once factors correct a slip."""
    part = lines.select(some_channels(lines.channels))
    first_m = first * part.first_range_m
    last_m = first_m + (lines.length - 1) * step * lines.range_step_m
    range_m = pairwise_range_m(points_m, positions * part.tx_m, positions * part.rx_m)
    return float(((range_m >= first_m) & (range_m <= last_m)).any(axis=1).mean())


def check_side(recording: Recording) -> Iterator[Finding]:
    """Yield that parts of the grid lie behind the elements."""
    grid = recording.grid
    if grid is not None and (found := behind(recording.lines, grid)) is not None:
        yield found


def check_phase_sign(recording: Recording) -> Iterator[Finding]:
    """Yield a phase of the opposite sign, if the sign can be determined."""
    sign, undetermined = recording.sign
    if sign is None or undetermined or sign.ratio < CLEAR:
        return
    x, y, z = sign.centre_m
    message = (
        f"the phase has the opposite sign of exp(-j 4 pi carrier range/c): about ({x:.4g}, "
        f"{y:.4g}, {z:.4g}) m the image of the conjugate lines has a sharpness of "
        f"{sign.conjugate:.3g}, that of the lines as given {sign.as_given:.3g} (mean squared "
        "intensity over the squared mean, along the track)"
    )
    remedy = (
        "conjugate the samples, as `dataclasses.replace(lines, samples=lines.samples.conj())` "
        "does, or read phase histories with `sign=+1`"
    )
    yield Finding("phase_sign", message, sign.ratio, CLEAR, remedy)


def check_doubts(recording: Recording) -> Iterator[Finding]:
    """Yield what imagers warn of, unless another check describes it in more detail."""
    detailed = ("advance", "held_fixes", "phase_sign")
    found = doubts(recording.lines, recording.grid, recording.beam)
    yield from (each for each in found if each.name not in detailed)


def runs(indices: Iterable[int]) -> str:
    """Return ascending indices as runs, such as "0-12, 40"; at most the first dozen runs."""
    ordered = np.unique(np.fromiter(indices, np.int64))
    breaks = [0, *(np.flatnonzero(np.diff(ordered) > 1) + 1).tolist(), len(ordered)]
    parts = []
    for start, stop in pairwise(breaks):
        first, last = ordered[start], ordered[stop - 1]
        parts.append(f"{first}" if first == last else f"{first}-{last}")
    rest = len(parts) - _MOST_RUNS
    return ", ".join(parts[:_MOST_RUNS]) + (f" and {rest} more runs" if rest > 0 else "")


CHECKS: tuple[Callable[[Recording], Iterator[Finding]], ...] = (
    # The track first, in the order of cause and effect.
    check_aperture,
    check_order,
    check_halts,
    check_gaps,
    check_advance,
    # What imagers warn of, too.
    check_doubts,
    # Channels as they were recorded.
    check_dead,
    check_clipping,
    # Samples and spacing of the moving pings.
    check_offset,
    check_background,
    check_ends,
    check_oversampling,
    check_band,
    check_spacing,
    # Ranges of the lines as given.
    check_first_range,
    check_grid,
    check_side,
    # The sign of the phase, from images of the moving pings.
    check_phase_sign,
)
"""All checks, in the order of their findings."""
