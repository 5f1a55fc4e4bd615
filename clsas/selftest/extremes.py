"""Scenes with a known ideal image, at the extremes of what clsas images.

Lines and ideal images come from `clsas.selftest.oracle`. The library contributes only the
containers `RangeLines`, `Grid` and `BeamWindow`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.selftest import oracle
from clsas.selftest.oracle import Band, Echo

LIGHT_M_S = 299_792_458.0
_FLAT = 0.94  # share of the bandwidth over which the spectrum of a pulse is flat
_EDGE = 0.01  # standard deviation of the edges of the spectrum, over the bandwidth
_FADED = 6.0  # standard deviations at which a Gaussian has fallen to 1.5e-8
_TONES = 24  # number of tones that make up the noise of a channel
_QUANTUM_M = 2.0**-29  # float64 represents multiples of this exactly up to 1.6e7 m


@dataclass(frozen=True, eq=False)
class Known:
    """Range lines, a grid, and the ideal image on it.

    Attributes
    ----------
    lines : RangeLines
    grid : Grid
    ideal : complex128 [rows, columns]
        Ideal image.
    beam : BeamWindow or None
    """

    lines: RangeLines
    grid: Grid
    ideal: NDArray[np.complex128]
    beam: BeamWindow | None = None

    def error_db(self, pixels: ArrayLike) -> float:
        """Return the relative rms error of an image of this scene, dB."""
        return oracle.error_db(pixels, self.ideal)


def along_x(channels: int, spacing_m: float, sway_m: float = 0.0) -> NDArray[np.float64]:
    """Return positions along x about the origin with random deviations across, [channels, 3]."""
    x_m = (np.arange(channels) - (channels - 1) / 2) * spacing_m
    across_m = sway_m * np.random.default_rng(1).normal(size=(channels, 2))
    return np.column_stack([x_m, across_m])


def circle(channels: int, radius_m: float, height_m: float = 0.0) -> NDArray[np.float64]:
    """Return positions on a circle around the origin, [channels, 3]."""
    angle = 2 * np.pi * np.arange(channels) / channels
    return np.column_stack(
        [radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(channels, height_m)]
    )


def scene(
    tx_m: NDArray[np.float64],
    centre_m: Sequence[float],
    *,
    carrier_hz: float,
    bandwidth_hz: float,
    pixel_m: tuple[float, float],
    shape: tuple[int, int] = (40, 40),
    speed_m_s: float = 1500.0,
    rx_m: NDArray[np.float64] | None = None,
    rx_velocity_m_s: ArrayLike | None = None,
    gains: ArrayLike = 1.0,
    beam: BeamWindow | None = None,
    targets: int = 5,
    within: tuple[float, float] = (0.1, 0.9),
    oversampling: float = 1.5,
    colour: Callable[[float, float], Sequence[Band]] | None = None,
    tilt_db: float = 0.0,
    on_carrier: bool = False,
    offset: float = 0.0,
    tail: float = 0.0,
    noise: float = 0.0,
    origin_m: Sequence[float] = (0.0, 0.0, 0.0),
    own_starts: bool = False,
    relief_m: float = 0.0,
    seed: int = 0,
) -> Known:
    """Return a scene of random points on a horizontal grid.

    Parameters
    ----------
    tx_m, rx_m : float64 [channels, 3]
        Antennas; by default monostatic.
    centre_m : (x, y, z)
        Centre of the grid.
    carrier_hz, bandwidth_hz, speed_m_s : float
    pixel_m : (dx, dy)
        Pixel spacing.
    shape : (rows, columns)
        Pixels of the grid.
    rx_velocity_m_s : array_like, optional
        Velocity of the receivers during flight.
    gains : array_like, broadcasts with [channels]
        Amplitude of the echoes in every channel.
    beam : BeamWindow, optional
        Shape "hann" or "rectangular", with `along`.
    targets : int
        Number of points.
    within : (from, to)
        Part of the columns in which the points lie, as shares of the width.
    oversampling : float
        Sample rate over bandwidth.
    colour : callable, optional
        Called with centre and width in cycles per metre; returns the bands of the pulse. By
        default the pulse's spectrum is flat, or tilted by `tilt_db`.
    on_carrier : bool
        True if lines keep their carrier. The sampled band must then include the pulse's band.
    offset : float
        Constant in every line, relative to the rms of its echoes.
    tail : float
        Noise from 0 Hz up to the band, relative to the rms of the echoes.
    noise : float
        Noise in nine tenths of the sampled band, relative to the rms of the echoes.
    origin_m : (x, y, z)
        Offset added to all coordinates.
    own_starts : bool
        True if lines begin at different ranges.
    relief_m : float
        Standard deviation of the pixels' heights, which are independent of each other.
    seed : int

    Returns
    -------
    Known
    """
    rng = np.random.default_rng(seed)
    tx, rx = (_quantised(tx_m if each is None else each) for each in (tx_m, rx_m))
    velocity = 0.0 if rx_velocity_m_s is None else rx_velocity_m_s

    # The pixels. The corner is the first one without relief.
    height_m = relief_m * np.random.default_rng(seed).normal(size=shape)
    rows, columns = shape
    x_m = pixel_m[0] * (np.arange(columns) - (columns - 1) / 2)
    y_m = pixel_m[1] * (np.arange(rows) - (rows - 1) / 2)
    corner = _quantised(np.add(centre_m, [x_m[0], y_m[0], 0]))
    plane = np.broadcast_arrays(x_m - x_m[0], (y_m - y_m[0])[:, None], height_m)
    pixels = corner + np.stack(plane, axis=-1)

    extent_m = pixels[-1, -1, :2] - corner[:2]
    # No points near the border, so that their main lobes are in the image.
    low, high = np.array([within, (0.1, 0.9), (0.1, 0.9)]).T
    points = corner + rng.uniform(low, high, (targets, 3)) * [*extent_m, 0]
    amplitude = rng.normal(size=(targets, 2)) @ [1, 1j]

    per_m = 2 / speed_m_s
    centre, width = per_m * carrier_hz, per_m * bandwidth_hz
    step_m = 1 / (width * oversampling)
    flat = [Band(centre, _FLAT * width, _EDGE * width, tilt_db=tilt_db)]
    bands = flat if colour is None else colour(centre, width)
    at_m = oracle.ranges_m(points, tx, rx, speed_m_s, velocity)
    of_pixels_m = oracle.ranges_m(pixels, tx, rx, speed_m_s, velocity)
    fade_m = _FADED / (2 * np.pi * min(band.edge for band in bands))
    levels = np.array([offset, tail, noise])
    if levels.any():  # disturbances extend over the whole line, and fade like a Gaussian
        fade_m = max(fade_m, np.ptp(of_pixels_m, axis=1).max())

    # Lines cover the ranges of points and pixels, and a margin. They have one first range, unless
    # they would then be mostly zeros.
    covered_m = np.hstack([at_m, of_pixels_m])
    nearest_m, farthest_m = covered_m.min(axis=1), covered_m.max(axis=1)
    first_m = nearest_m - fade_m
    length = int(np.ceil(((farthest_m - nearest_m).max() + 2 * fade_m) / step_m)) + 1
    if own_starts:
        first_m = first_m - rng.uniform(0, step_m, len(tx))
    elif np.ptp(first_m) < length * step_m:
        length += int(np.ceil(np.ptp(first_m) / step_m))
        first_m = np.full(len(first_m), first_m.min())

    of_channels = np.broadcast_to(np.asarray(gains, np.float64), len(tx))
    echoes = [Echo(at_m, of_channels[:, None] * amplitude, bands)]
    mixed = partial(
        oracle.samples, first_range_m=first_m, range_step_m=step_m, length=length,
        carrier_cycles_per_m=0.0 if on_carrier else centre,
    )  # fmt: skip
    if levels.any():
        rms = np.sqrt(np.mean(np.abs(mixed(echoes)) ** 2))
        echoes += _disturbances(rng, first_m, step_m, length, levels * rms, centre)

    weights = 1.0 if beam is None else _weights(beam, pixels, (tx + rx) / 2)
    origin = np.asarray(origin_m, np.float64)
    grid = Grid.oriented(corner + origin, [0, pixel_m[1], 0], [pixel_m[0], 0, 0], shape)
    lines = RangeLines(
        mixed(echoes), first_m, step_m, tx + origin, rx + origin,
        0.0 if on_carrier else carrier_hz, speed_m_s, rx_velocity_m_s,
    )  # fmt: skip
    ideal = oracle.image(echoes, of_pixels_m, weights).reshape(shape)
    return Known(lines, grid.with_height(height_m) if relief_m else grid, ideal, beam)


def _quantised(positions_m: ArrayLike) -> NDArray[np.float64]:
    """Return rounded positions, to which a distant origin can be added exactly."""
    return np.round(np.asarray(positions_m, np.float64) / _QUANTUM_M) * _QUANTUM_M


def _disturbances(
    rng: np.random.Generator,
    first_m: NDArray[np.float64],
    step_m: float,
    length: int,
    levels: NDArray[np.float64],
    centre: float,
) -> list[Echo]:
    """Return echoes that represent a constant, a tail below the band, and noise.

    `levels` are the rms values of the three over a line.
    """
    offset, tail, noise = levels
    channels = len(first_m)
    middle_m = (first_m + (length - 1) / 2 * step_m)[:, None]
    edge = _FADED / (np.pi * length * step_m)  # envelopes fade at both ends of the line
    # Rms value of the envelope over the line.
    fullness = np.sqrt(np.sqrt(np.pi) / (2 * _FADED))
    found = []
    if offset:
        found.append(Echo(middle_m, offset / fullness, [Band(0.0, 0.0, edge)]))
    floor = 0.45 / step_m
    for level, low, high in (
        (tail, 0.0, 0.8 * centre),
        (noise, centre - floor, centre + floor),
    ):
        for tone in range(_TONES if level else 0):
            position = (tone + rng.uniform(0, 1, (channels, 1))) / _TONES
            value = rng.normal(size=(channels, 1, 2)) @ [1, 1j] / np.sqrt(2 * _TONES)
            found.append(
                Echo(
                    middle_m,
                    level / fullness * value,
                    [Band(low + (high - low) * position, 0.0, edge)],
                )
            )
    return found


def _weights(
    beam: BeamWindow, pixels_m: NDArray[np.float64], centres_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weights of a beam from their definition, [channels, pixels]."""
    if beam.along is None:
        raise ArgumentError("beam", "have the direction `along`")
    towards = pixels_m.reshape(1, -1, 3) - centres_m[:, None]
    along = np.broadcast_to(beam.along, centres_m.shape)
    sine = np.einsum("cpi,ci->cp", towards, along) / np.linalg.norm(towards, axis=-1)
    u = (np.degrees(np.arcsin(sine)) - beam.squint_deg) / beam.width_deg
    weights = np.where(np.abs(u) < 0.5, np.cos(np.pi * u) ** 2 if beam.shape == "hann" else 1.0, 0)
    if beam.normalise:
        weights = weights * len(centres_m) / np.maximum(weights.sum(axis=0), 0.01)
    return weights


def ultrasonic(channels: int = 160, track: NDArray | None = None, **options: Any) -> Known:
    """Return a scene at 1 MHz with 100 kHz of bandwidth, 42.5 m (28 000 wavelengths) away."""
    defaults: dict[str, Any] = {
        "carrier_hz": 1e6, "bandwidth_hz": 1e5, "pixel_m": (4e-3, 4e-3), "shape": (48, 48),
    }  # fmt: skip
    track = along_x(channels, 8.25e-3) if track is None else track
    return scene(track, (0.3, 42.5, 0), **(defaults | options))


def array(*, moving: bool, channels: int = 160, **options: Any) -> Known:
    """Return `ultrasonic` for 8 receivers per transmitter, at rest or moving at up to 17 m/s."""
    rx = along_x(channels, 8.25e-3)
    tx = np.repeat(rx[::8], 8, axis=0) + [0.3, 0.1, -0.2]
    velocity = np.random.default_rng(3).uniform(-10, 10, rx.shape) if moving else None
    return ultrasonic(track=tx, rx_m=rx, rx_velocity_m_s=velocity, **options)


def raw(channels: int = 96, targets: int = 60, oversampling: float = 8.0, **options: Any) -> Known:
    """Return a scene at 30 kHz with 8 kHz of bandwidth, of analytic lines on their carrier."""
    return scene(
        along_x(channels, 0.025), (0.2, 12, 0), carrier_hz=3e4, bandwidth_hz=8e3,
        pixel_m=(0.03, 0.03), on_carrier=True, targets=targets, oversampling=oversampling,
        **options,
    )  # fmt: skip


def at_1_khz(**options: Any) -> Known:
    """Return a scene at 1 kHz with 200 Hz of bandwidth, 1.5 km away."""
    return scene(
        along_x(80, 0.7), (0, 1500, -200), carrier_hz=1e3, bandwidth_hz=200, pixel_m=(6.0, 1.5),
        **options,
    )  # fmt: skip


def radar(**options: Any) -> Known:
    """Return a scene at 10 GHz with 600 MHz of bandwidth, from an aircraft 8 km away."""
    return scene(
        along_x(128, 2.0, sway_m=0.3), (20, 7000, -4000), carrier_hz=1e10, bandwidth_hz=6e8,
        pixel_m=(0.15, 0.1), speed_m_s=LIGHT_M_S, **options,
    )  # fmt: skip


def closed(**options: Any) -> Known:
    """Return a scene at 100 kHz with 20 kHz of bandwidth, inside a circle of 8 m radius."""
    return scene(
        circle(300, 8.0, 3.0), (0.1, 0.05, 0), carrier_hz=1e5, bandwidth_hz=2e4,
        pixel_m=(3e-3, 3e-3), **options,
    )  # fmt: skip


def narrow(**options: Any) -> Known:
    """Return `ultrasonic` with a bandwidth of 0.5 % of the carrier."""
    return ultrasonic(96, bandwidth_hz=5e3, **options)


def widest(**options: Any) -> Known:
    """Return a scene at 30 kHz with a bandwidth of 190 % of the carrier, 12 m away."""
    return scene(
        along_x(160, 0.02), (0.2, 12, 0), carrier_hz=3e4, bandwidth_hz=5.7e4, pixel_m=(0.01, 0.01),
        **options,
    )  # fmt: skip


def rings(**options: Any) -> Known:
    """Return a scene at 20 kHz in air, on the carrier, inside five rings of 0.83 m radius."""
    track = np.concatenate([circle(90, 0.83, 0.5 + 0.04 * number) for number in range(5)])
    return scene(
        track, (0, 0, 0), carrier_hz=2e4, bandwidth_hz=4e3, pixel_m=(5e-3, 5e-3), speed_m_s=349.0,
        on_carrier=True, oversampling=12.0, targets=2, **options,
    )  # fmt: skip


def apart(**options: Any) -> Known:
    """Return a scene at 100 kHz with 2 kHz of bandwidth, and receivers 10 m above transmitters."""
    tx = along_x(200, 0.08)
    defaults: dict[str, Any] = {"bandwidth_hz": 2e3, "pixel_m": (0.2, 0.2)}
    return scene(
        tx, (0.3, 42.0, -15), carrier_hz=1e5, rx_m=tx + [0, 0, 10.0], **(defaults | options)
    )


def uneven(**options: Any) -> Known:
    """Return a scene at 100 kHz with 500 Hz of bandwidth, and velocities that vary by 5 m/s rms."""
    tx = along_x(200, 0.08)
    velocity = [2.0, 0, 0] + np.random.default_rng(5).normal(0, 3, (200, 3))
    return scene(
        tx, (0.3, 42.0, -15), carrier_hz=1e5, bandwidth_hz=500, pixel_m=(0.2, 0.2), rx_m=tx,
        rx_velocity_m_s=velocity, **options,
    )  # fmt: skip


def headings(**options: Any) -> Known:
    """Return a scene at 30 kHz, from three passes at different headings with a Hann beam."""
    turn = np.radians(np.repeat([0, 60, 120], 104))
    along = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    aside = np.stack([np.sin(turn), -np.cos(turn), 0 * turn], axis=1)
    track = np.tile(along_x(104, 0.03)[:, 0], 3)[:, None] * along
    track += np.repeat([0.26, 0.52, 0.78], 104)[:, None] * aside
    return scene(
        track, (3, 0, -2), carrier_hz=3e4, bandwidth_hz=9e3, pixel_m=(0.01, 0.01),
        beam=BeamWindow(40, "hann", along=along), **options,
    )  # fmt: skip


def loud(**options: Any) -> Known:
    """Return a scene at 30 kHz, where a channel 30 dB louder is two wavelengths off the track."""
    track, gains = along_x(300, 0.035), np.ones(300)
    track[130] += [0, 0.1, 0.07]
    gains[130] = 10**1.5
    return scene(
        track, (0, 11.5, 0), carrier_hz=3e4, bandwidth_hz=9e3, pixel_m=(0.08, 0.08), gains=gains,
        **options,
    )  # fmt: skip


def edge(**options: Any) -> Known:
    """Return a scene at 30 kHz, with points at the edge of a Hann beam, where weights are small."""
    return scene(
        along_x(300, 0.02), (3, 9.5, 0), carrier_hz=3e4, bandwidth_hz=9e3, pixel_m=(0.04, 0.02),
        shape=(32, 96), within=(0.88, 0.97),
        beam=BeamWindow(20, "hann", along=np.array([1.0, 0, 0])),
        **options,
    )  # fmt: skip


def steps(centre: float, width: float) -> list[Band]:
    """Return three bands at 0, -15 and -30 dB."""
    return [
        Band(centre + shift * width, 0.28 * width, 0.01 * width, 10 ** (level_db / 20))
        for shift, level_db in ((-0.3, 0), (0, -15), (0.3, -30))
    ]
