"""Echoes that are known at every range, and sums of them in float64 that share nothing with clsas.

Of the library only the oracle's pulse is used. Frequencies are cycles per metre of range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import finufft
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from rays import rays

from clsas.engine.data.beam import BeamWindow
from clsas.selftest import oracle

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

SPEED_M_S = 1500.0
FLAT, EDGE = 0.8, 0.017  # of the band: its flat part, and the deviation of its Gaussian edges
FADED = 6.0  # standard deviations, after which a Gaussian is 1.5e-8
SPARE = 100  # samples of noise beyond the pixels, over half of which it fades


@dataclass(frozen=True, eq=False)
class Channels:
    """Antennas, and the gain of each channel."""

    tx_m: Floats
    rx_m: Floats
    velocity_m_s: Floats | None
    gain: Floats
    along: Floats

    @property
    def centres_m(self) -> Floats:
        """Phase centres, [channels, 3]."""
        return (self.tx_m + self.rx_m) / 2

    def ranges_m(self, points_m: Floats) -> Floats:
        """Return half the paths over points, [channels, points].

        |x - tx| + |x - rx - v tau| = c tau is a quadratic in tau, whose larger root is the delay.
        """
        q, d = (points_m[None] - each[:, None] for each in (self.tx_m, self.rx_m))
        out_m = np.linalg.norm(q, axis=-1)
        if self.velocity_m_s is None:
            return (out_m + np.linalg.norm(d, axis=-1)) / 2
        v = self.velocity_m_s[:, None] / SPEED_M_S
        a = 1 - np.sum(v * v, axis=-1)
        b = out_m - np.sum(d * v, axis=-1)
        c = out_m**2 - np.sum(d * d, axis=-1)
        return (b + np.sqrt(b * b - a * c)) / a / 2

    def sines(self, points_m: Floats) -> Floats:
        """Return the sines of the aspect angles of points, [channels, points]."""
        towards = points_m[None] - self.centres_m[:, None]
        return np.einsum("cpi,ci->cp", towards, self.along) / np.linalg.norm(towards, axis=-1)

    def select(self, some: NDArray[np.int64]) -> Channels:
        """Return some of the channels, at rest."""
        parts = (self.tx_m, self.rx_m, self.gain, self.along)
        tx_m, rx_m, gain, along = (each[some] for each in parts)
        return replace(self, tx_m=tx_m, rx_m=rx_m, velocity_m_s=None, gain=gain, along=along)


@dataclass(frozen=True, eq=False)
class BentChannels(Channels):
    """Channels in water whose sound speed is linear between some depths.

    Ranges are SPEED_M_S times half the delay, and sines those of rays at the phase centres.
    """

    depth_m: Floats
    speed_m_s: Floats
    surface_z_m: float

    def ranges_m(self, points_m: Floats) -> Floats:
        """Return half the delays to points as ranges, [channels, points]."""
        out_s = self._rays(self.tx_m[:, None], points_m)[0]
        if self.velocity_m_s is None and np.array_equal(self.tx_m, self.rx_m):
            return SPEED_M_S * out_s
        back_s = out_s
        for _ in range(1 if self.velocity_m_s is None else 6):  # each leaves v/c of the error
            rx_m = self.rx_m[:, None]
            if self.velocity_m_s is not None:
                rx_m = rx_m + self.velocity_m_s[:, None] * (out_s + back_s)[..., None]
            back_s = self._rays(rx_m, points_m)[0]
        return SPEED_M_S * (out_s + back_s) / 2

    def sines(self, points_m: Floats) -> Floats:
        """Return the sines of the aspect angles at which rays leave for points."""
        centres_m = self.centres_m
        offset_m = points_m[None] - centres_m[:, None]
        slowness = self._rays(centres_m[:, None], points_m)[1]
        speed = np.interp(self.surface_z_m - centres_m[:, 2], self.depth_m, self.speed_m_s)
        level = speed[:, None] * slowness
        distance_m = np.hypot(offset_m[..., 0], offset_m[..., 1])
        across = np.einsum("cpi,ci->cp", offset_m[..., :2], self.along[:, :2]) / distance_m
        down = np.sign(offset_m[..., 2]) * np.sqrt(1 - level**2)
        return across * level + down * self.along[:, None, 2]

    def _rays(self, antennas_m: Floats, points_m: Floats) -> tuple[Floats, Floats]:
        offset_m = points_m[None] - antennas_m
        found = rays(
            self.depth_m, self.speed_m_s, np.hypot(offset_m[..., 0], offset_m[..., 1]),
            self.surface_z_m - antennas_m[..., 2], self.surface_z_m - points_m[None, :, 2],
        )  # fmt: skip
        assert np.isfinite(found[0]).all(), "a ray is missing or turns"
        return found


@dataclass(frozen=True)
class Sampling:
    """How lines are sampled: the middle and the width of their band, the carrier that is mixed out,
    cycles per metre; and the range between samples.
    """  # fmt: skip

    centre: float
    width: float
    mixed: float
    step_m: float

    def mixer(self, range_m: Floats) -> Complex:
        """Return the factor that mixes the carrier out."""
        return np.exp(-2j * np.pi * np.mod(self.mixed * range_m, 1))


class Echoes(Protocol):
    """What channels receive."""

    first_m: float

    def samples(self) -> Complex:
        """Return the range lines, [channels, length]."""
        ...

    def received(self, range_m: Floats) -> Complex:
        """Return what is received from ranges, with its carrier, [channels, n]."""
        ...


@dataclass(frozen=True, eq=False)
class Points:
    """Echoes of points: pulses at ranges [channels, points], within lines of some length."""

    channels: Channels
    sampling: Sampling
    range_m: Floats
    amplitude: Complex
    tilt_db: float
    first_m: float
    length: int

    @classmethod
    def of(
        cls,
        channels: Channels,
        sampling: Sampling,
        points_m: Floats,
        amplitude: Complex,
        tilt_db: float,
        span_m: tuple[float, float],
    ) -> Points:
        """Return the echoes of points in lines that hold them and a span of ranges."""
        range_m = channels.ranges_m(points_m)
        fade_m = 1.02 * FADED / (2 * np.pi * EDGE * sampling.width)
        first_m = min(span_m[0], float(range_m.min())) - fade_m
        last_m = max(span_m[1], float(range_m.max())) + fade_m
        length = int((last_m - first_m) / sampling.step_m) + 1
        return cls(channels, sampling, range_m, amplitude, tilt_db, first_m, length)

    def within(self, sampling: Sampling, some: NDArray[np.bool_] | None = None) -> Points:
        """Return the echoes in a part of the band, in some of the channels, in lines as long.

        The sampling must have the step and the mixer of these echoes. Pulses of a narrower band
        are longer, and the lines then begin earlier by what they take.
        """
        more = int(1.02 * FADED / (2 * np.pi * EDGE * sampling.width) / sampling.step_m) + 1
        gain = self.channels.gain if some is None else self.channels.gain * some
        return replace(
            self, sampling=sampling, channels=replace(self.channels, gain=gain),
            first_m=self.first_m - more * sampling.step_m, length=self.length + 2 * more,
        )  # fmt: skip

    @property
    def _bands(self) -> list[oracle.Band]:
        width = self.sampling.width
        return [oracle.Band(self.sampling.centre, FLAT * width, EDGE * width, tilt_db=self.tilt_db)]

    def samples(self) -> Complex:
        """Return the range lines; pulses are evaluated where they have not faded."""
        step_m = self.sampling.step_m
        samples = np.zeros((len(self.range_m), self.length), np.complex128)
        rows = np.arange(len(samples))[:, None]
        fade_m = FADED / (2 * np.pi * EDGE * self.sampling.width)
        reach = np.arange(int(2 * fade_m / step_m) + 2)
        for range_m, value in zip(self.range_m.T[..., None], self.amplitude, strict=True):
            start = np.floor((range_m - fade_m - self.first_m) / step_m).astype(int)
            index = np.clip(start, 0, self.length - len(reach)) + reach
            at_m = self.first_m + step_m * index
            pulse = oracle.pulse(at_m - range_m, self._bands)
            samples[rows, index] += value * pulse * self.sampling.mixer(at_m)
        return samples * self.channels.gain[:, None]

    def received(self, range_m: Floats) -> Complex:
        """Return what is received from ranges, with its carrier."""
        amplitude = self.amplitude * self.channels.gain[:, None]
        return oracle.received([oracle.Echo(self.range_m, amplitude, self._bands)], range_m)


@dataclass(frozen=True, eq=False)
class Both:
    """Echoes in two parts of a band, in lines that begin together."""

    low: Points
    high: Points

    @property
    def first_m(self) -> float:
        return self.low.first_m

    def samples(self) -> Complex:
        """Return the range lines."""
        return self.low.samples() + self.high.samples()

    def received(self, range_m: Floats) -> Complex:
        """Return what is received from ranges, with its carrier."""
        return self.low.received(range_m) + self.high.received(range_m)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise in a band, periodic in range, that fades at both ends of the lines.

    `spectrum` [channels, n] begins at the multiple `lowest` of the lines' inverse length.
    """

    sampling: Sampling
    spectrum: Complex
    lowest: int
    first_m: float
    length: int

    @classmethod
    def of(
        cls, rng: Generator, channels: Channels, sampling: Sampling, span_m: tuple[float, float]
    ) -> Noise:
        """Return noise in lines that hold a span of ranges."""
        margin_m = SPARE * sampling.step_m + 0.05 * (span_m[1] - span_m[0])
        length = int((span_m[1] - span_m[0] + 2 * margin_m) / sampling.step_m) + 1
        per_cycle = length * sampling.step_m
        middle, half = sampling.centre - sampling.mixed, 0.475 * sampling.width
        lowest = int(np.ceil((middle - half) * per_cycle))
        count = max(int((middle + half) * per_cycle) - lowest, 1)
        spectrum = rng.normal(size=(len(channels.gain), count, 2)) @ [1, 1j]
        spectrum *= channels.gain[:, None]
        return cls(sampling, spectrum, lowest, span_m[0] - margin_m, length)

    def samples(self) -> Complex:
        """Return the range lines."""
        n, count = self.length, self.spectrum.shape[1]
        full = np.zeros((len(self.spectrum), n), np.complex128)
        full[:, (self.lowest + np.arange(count)) % n] = self.spectrum
        fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(SPARE // 2) + 0.5) / (SPARE // 2))
        envelope = np.ones(n)
        envelope[: len(fade)], envelope[n - len(fade) :] = fade, fade[::-1]
        # The first sample lies at `first_m`, where the carrier that was mixed out had some phase.
        return np.fft.ifft(full, axis=1) * n * envelope

    def received(self, range_m: Floats) -> Complex:
        """Return what is received from ranges where the lines have not faded, with its carrier."""
        turn = 2 * np.pi * (range_m - self.first_m) / (self.length * self.sampling.step_m)
        count = self.spectrum.shape[1]
        values = np.empty(range_m.shape, np.complex128)
        for line, (at, modes) in enumerate(zip(turn, self.spectrum, strict=True)):
            values[line] = finufft.nufft1d2(at % (2 * np.pi), modes, eps=1e-12, isign=1, nthreads=1)
        middle = self.lowest + count // 2  # finufft counts modes from -(count // 2)
        return values * np.exp(1j * middle * turn) / self.sampling.mixer(range_m)


def weights(beam: BeamWindow, sines: Floats, *, normalise: bool | None = None) -> Floats:
    """Return a beam's weights from their definition, [channels, points]."""
    u = (np.degrees(np.arcsin(np.clip(sines, -1, 1))) - beam.squint_deg) / beam.width_deg
    if beam.shape == "hann":
        inside = np.cos(np.pi * u) ** 2
    elif beam.shape == "hamming":
        inside = 0.54 + 0.46 * np.cos(2 * np.pi * u)
    elif beam.shape == "tukey":
        inside = np.sin(np.pi * np.clip((0.5 - np.abs(u)) / beam.taper, 0, 0.5)) ** 2
    else:
        inside = np.ones_like(u)
    found = np.where(np.abs(u) < 0.5, inside, 0.0)
    if beam.normalise if normalise is None else normalise:
        found = found * len(sines) / np.maximum(found.sum(axis=0), 0.01)
    return found
