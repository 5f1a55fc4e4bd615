"""Checks of a recording's samples: dead and clipped channels, offsets, backgrounds, ends, band."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal.windows import hann

from clsas.core import decibels
from clsas.core.conditioning import DEAD_DB, are_dead
from clsas.core.lines import RangeLines, some_channels
from clsas.core.pings import Transmissions
from clsas.inspection.result import runs
from clsas.signal.ambiguity import end_powers
from clsas.signal.spectrum import NEEDED_OVERSAMPLING, Spectrum
from clsas.sonar.sampling import Finding

_SILENT_DB = -300.0  # stands for no signal
_SAME_LEVEL = 1e-5
"""Of the largest level: samples within this are equal but for rounding. Within 1e-3 the beats of
overlapping chirps have a dozen samples."""
_LEAST_CLIPPED = 8  # samples at the largest level; echoes have one, or two
_CLIPPED_OVER_NEXT = 5.0  # times as many samples as at the next lower level: peaks have 1 to 3
_SPIKE = 2.0  # of power at a constant's frequency over the largest beside it; speckle has 1.2
_BESIDE = 8  # bins on either side of a constant's
_MAIN_LOBE = 2  # bins on either side that a Hann window fills
OFFSET_DB = -40.0
"""Power of a constant relative to the echoes above which it is reported: in an image of N channels
it grows by N times as much as echoes do."""
_LEAST_PINGS = 4 * _BESIDE
_EQUAL_RANGE = 1e-3  # steps by which first ranges of pings may differ
ENDS_DB = -20.0
"""Power at an end relative to whole lines above which it is reported."""
_BLOCK = 1 << 22  # samples processed at a time


@dataclass(frozen=True, eq=False)
class Levels:
    """Level of every channel.

    Attributes
    ----------
    power : float64 [channels]
        Mean power about the channel's mean, relative to the square of the largest sample.
    clipped : int64 [channels]
        Samples at the largest level, 0 if they are no more than echoes have there.
    """

    power: NDArray[np.float64]
    clipped: NDArray[np.int64]

    @classmethod
    def of(cls, samples: NDArray, magnitudes: bool) -> Levels:
        """Measure samples [channels, length], real or complex.

        With `magnitudes` clipped magnitudes count, as well as clipped real and imaginary parts.
        """
        scale = max(float(np.abs(block).max()) for block in _blocks(samples)) or 1.0
        power, clipped = [], []
        for block in _blocks(samples):
            scaled = block / np.float32(scale)
            if scaled.shape[1] == 1:  # has no variance
                scaled = np.concatenate([scaled, -scaled], axis=1)
            power.append(scaled.var(axis=1, dtype=np.complex128 if scaled.dtype.kind == "c" else
                                    np.float64))  # fmt: skip
            parts = np.maximum(np.abs(scaled.real), np.abs(scaled.imag))
            found = _clipped_samples(parts)
            if magnitudes:
                found = np.maximum(found, _clipped_samples(np.abs(scaled)))
            clipped.append(found)
        return cls(np.concatenate(power).real, np.concatenate(clipped))


def _blocks(samples: NDArray) -> Iterator[NDArray]:
    rows = max(1, _BLOCK // samples.shape[1])
    for first in range(0, len(samples), rows):
        yield samples[first : first + rows]


def _clipped_samples(level: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return how many samples of a channel lie at its largest level, 0 if that is no ceiling."""
    largest = level.max(axis=1, keepdims=True)
    at_top = level >= (1 - _SAME_LEVEL) * largest
    counts = at_top.sum(axis=1) * (largest[:, 0] > 0)
    for channel in np.flatnonzero(counts >= _LEAST_CLIPPED):
        lower = level[channel][~at_top[channel]]
        margin = _SAME_LEVEL * largest[channel, 0]
        beside = int((lower >= lower.max() - margin).sum()) if lower.size and lower.any() else 0
        if counts[channel] < _CLIPPED_OVER_NEXT * beside:
            counts[channel] = 0
    counts[counts < _LEAST_CLIPPED] = 0
    return counts


def check_levels(levels: Levels, receivers: int | None) -> list[Finding]:
    """Return dead and clipped channels; `receivers` is their number per ping if always the same."""
    found = []
    alive = levels.power[levels.power > 0]
    usual = float(np.median(alive)) if alive.size else 0.0
    dead = are_dead(levels.power, usual)
    if dead.all():
        found.append(
            Finding(
                "dead_channels",
                f"all {dead.size} channels hold no signal",
                _SILENT_DB,
                DEAD_DB,
                "check the recorder and how its samples were read",
                tuple(range(dead.size)),
            )
        )
    elif dead.any():
        least = float(levels.power.min())
        least_db = decibels.in_db(least / usual) if least else _SILENT_DB
        faintest = f"{least_db:.0f} dB" if least else "no signal"
        found.append(
            Finding(
                "dead_channels",
                f"{dead.sum()} of {dead.size} channels hold no signal, or {-DEAD_DB:.0f} dB less "
                f"than the median channel and below (the faintest: {faintest})"
                f"{_by_receiver(dead, receivers)}",
                least_db,
                DEAD_DB,
                "leave them out: lines.select(...) with the others, or lines.weighted(...) with 0",
                tuple(np.flatnonzero(dead).tolist()),
            )
        )
    clipped = levels.clipped > 0
    if clipped.any():
        worst = int(levels.clipped.max())
        found.append(
            Finding(
                "clipped_channels",
                f"{clipped.sum()} of {clipped.size} channels are clipped: up to {worst} samples "
                f"of a channel have its largest level{_by_receiver(clipped, receivers)}",
                float(worst),
                float(_LEAST_CLIPPED),
                "record with less gain; of a recording as it is, leave the channels out "
                "(lines.select) or silence what overdrives them, such as the transmission",
                tuple(np.flatnonzero(clipped).tolist()),
            )
        )
    return found


def _by_receiver(wrong: NDArray[np.bool_], receivers: int | None) -> str:
    """Name receivers that are wrong in every ping."""
    if not receivers or receivers == 1 or len(wrong) <= receivers:
        return ""
    always = wrong.reshape(-1, receivers).all(axis=0)
    if not always.any():
        return ""
    return f"; receivers {runs(np.flatnonzero(always))} of {receivers} (from 0) in every ping"


def check_offset(lines: RangeLines) -> list[Finding]:
    """Return constants that a recorder added: at 0 Hz of the lines, or of what was recorded."""
    part = lines.select(some_channels(lines.channels))
    if lines.length < _LEAST_PINGS:
        return []
    rate_hz = lines.sound_speed_m_s / (2 * lines.range_step_m)
    places = {"0 Hz of the lines": 0.0}
    if 0 < lines.carrier_hz < rate_hz / 2:
        places["0 Hz of the recorded signal"] = -lines.carrier_hz / rate_hz
    for name, frequency in places.items():
        share = _constant_share(part.samples.T, frequency)
        if share > decibels.power(OFFSET_DB):
            recorded = frequency or not lines.carrier_hz
            least_hz = 4 * rate_hz / lines.length
            remedy = (
                f"lines.high_passed(hz) with a cutoff of {least_hz:.3g} Hz or more, below the band"
                if recorded
                else "subtract each channel's mean before compression; where pings have it in "
                "common, lines.without_background()"
            )
            found_db = decibels.in_db(share)
            return [
                Finding(
                    "offset",
                    f"a constant at {name} has {found_db:.1f} dB of the echoes' power, more than "
                    f"{OFFSET_DB:.0f} dB",
                    found_db,
                    OFFSET_DB,
                    remedy,
                )
            ]
    return []


def check_background(lines: RangeLines, pings: Transmissions) -> list[Finding]:
    """Return what all pings have in common, if lines of a receiver always begin at one range."""
    receivers = pings.receivers
    if pings.count < _LEAST_PINGS or np.ptp(receivers):
        return []
    shape = pings.count, int(receivers[0])
    first_m = lines.first_range_m.reshape(shape)
    if np.ptp(first_m, axis=0).max() > _EQUAL_RANGE * lines.range_step_m:
        return []
    samples = lines.samples.reshape(*shape, lines.length)
    some = some_channels(shape[1], 8)
    share = float(np.mean([_constant_share(samples[:, receiver], 0.0) for receiver in some]))
    if share <= decibels.power(OFFSET_DB):
        return []
    found_db = decibels.in_db(share)
    return [
        Finding(
            "background",
            f"all pings have {100 * share:.3g} % of their power in common, more than "
            f"{100 * decibels.power(OFFSET_DB):.2g} %: direct arrivals, ringing, an offset, or a "
            "reflector at constant range",
            found_db,
            OFFSET_DB,
            'lines.without_background("median")',
        )
    ]


def _constant_share(samples: NDArray, frequency: float) -> float:
    """Share of the power of columns that oscillates at one frequency (cycles per sample) alone.

    The power at the frequency counts as far as it exceeds that beside it, which echoes have too. It
    is 0 unless it stands out like a line of a spectrum.
    """
    count = len(samples)
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


def check_ends(lines: RangeLines) -> list[Finding]:
    """Return ends of lines that do not fade."""
    found_db = decibels.in_db(max(end_powers(lines)))
    if found_db <= ENDS_DB:
        return []
    extent_m = (lines.length - 1) * lines.range_step_m
    return [
        Finding(
            "ends",
            f"lines do not fade towards their ends: samples there have {found_db:.1f} dB of the "
            f"lines' mean power, more than {ENDS_DB:.0f} dB. Lines cut in echoes cannot be "
            "interpolated near the cut, and those of samples over frequency wrap around there",
            found_db,
            ENDS_DB,
            f"lines.tapered_ends({extent_m / 50:.2g}) fades a fiftieth at either end; keep the "
            "grid inside",
        )
    ]


def check_band(
    lines: RangeLines, spectrum: Spectrum, band_hz: tuple[float, float]
) -> list[Finding]:
    """Return a band that fills what is sampled, or is wider than its carrier allows."""
    found = []
    if spectrum.oversampling < NEEDED_OVERSAMPLING:
        found.append(
            Finding(
                "oversampling",
                f"the band fills all that is sampled: oversampling is "
                f"{spectrum.oversampling:.3g}, less than {NEEDED_OVERSAMPLING:g}, so that its "
                "edges may have aliased",
                spectrum.oversampling,
                NEEDED_OVERSAMPLING,
                "sample more finely, or compress with a smaller bandwidth_hz; "
                "noise alone fills the band too",
            )
        )
    width_hz = band_hz[1] - band_hz[0]
    if lines.carrier_hz and width_hz > 2 * lines.carrier_hz:
        found.append(
            Finding(
                "band",
                f"the band of {width_hz:.4g} Hz reaches below 0 Hz: it is more than twice the "
                f"carrier of {lines.carrier_hz:.4g} Hz",
                width_hz,
                2 * lines.carrier_hz,
                "check units: range_step_m in metres (not millimetres or samples), carrier_hz in "
                "Hz (not kHz), sound_speed_m_s in m/s",
            )
        )
    return found
