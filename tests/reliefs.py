"""Two banks over a seabed of known relief, with noise of a given level."""

from dataclasses import replace
from functools import cache

import numpy as np
from scenes import kept
from scipy.spatial.transform import Rotation

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.imaging import backproject
from clsas.simulation.scenes import Observer, PointTargets, Seabed
from clsas.simulation.simulator import simulate_lines

CARRIER_HZ, BAND_HZ, SOUND_M_S = 100e3, 30e3, 1500.0
ALTITUDE_M = 12.0
GRID = Grid.plane((-0.8, 0.8, 81), (30.8, 33.2, 121))


def track(
    pings=120, aperture_m=10.0, sway_m=0.0, roll_rad=0.0, yaw_rad=0.0, baseline_m=0.25, arms_m=None
):
    """Positions of the transmitter and of the receivers of both banks, [channels, 3] each.

    Roll and yaw turn `arms_m` about the transmitter: where the receivers of both banks are when the
    platform is level and on course. By default, the lower one is where the transmitter is.
    """
    along_m = np.linspace(-aperture_m / 2, aperture_m / 2, pings)
    wave = np.sin(2 * np.pi * along_m / 6)
    tx_m = np.stack([along_m, sway_m * wave, ALTITUDE_M + 0 * along_m], axis=1)
    roll = roll_rad * np.cos(2 * np.pi * along_m / 4)
    yaw = yaw_rad * np.cos(2 * np.pi * along_m / 5)
    turned = Rotation.from_euler("ZYX", np.stack([yaw, 0 * yaw, roll], axis=1))
    lower_m, upper_m = arms_m or ((0, 0, 0), (0, 0, baseline_m))
    return tx_m, tx_m + turned.apply(lower_m), tx_m + turned.apply(upper_m)


@kept
def banks(relief, *, snr_db, seed=1, extent_m=None, density_m2=2500.0, **of_track):
    """Range lines of both banks over speckle on a relief(x, y), with white noise.

    The signal-to-noise ratio is that of the image on `GRID`, averaged over its pixels. The noise
    passes the same filter as the echoes.
    """
    x_m, y_m = extent_m or ((-1.2, 1.2), (30.0, 34.0))
    step_m = 0.02
    x, y = (np.linspace(*each, round((each[1] - each[0]) / step_m) + 1) for each in (x_m, y_m))
    surface = Seabed(x_m, y_m, relief(*np.meshgrid(x, y)), density_m2=density_m2, seed=seed)
    # All channels see what the middle of the track sees.
    points = PointTargets(*surface.visible(Observer(np.array([0.0, 0.0, ALTITUDE_M]))))
    tx_m, *receivers_m = track(**of_track)
    below_m = ALTITUDE_M - surface.heights_m
    near_m = np.hypot(y_m[0], below_m.min()) - 1
    far_m = np.linalg.norm([y_m[1], below_m.max(), np.abs(tx_m[:, 0]).max() + x_m[1]]) + 1
    range_step_m = SOUND_M_S / (4 * BAND_HZ)
    lines = [
        simulate_lines(
            tx_m, rx_m, points, carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ, window="hamming",
            first_range_m=near_m, length=round((far_m - near_m) / range_step_m),
        )
        for rx_m in receivers_m
    ]  # fmt: skip
    if snr_db is None:
        return lines
    random = np.random.default_rng(seed + 100)
    return [_with_noise(each, snr_db, random) for each in lines]


def _with_noise(lines: RangeLines, snr_db, random):
    white = random.standard_normal((*lines.samples.shape, 2)) @ [1, 1j]
    frequency_hz = np.fft.fftfreq(lines.length, 2 * lines.range_step_m / SOUND_M_S)
    inside = np.abs(frequency_hz) <= BAND_HZ / 2
    gain = np.where(inside, 0.54 + 0.46 * np.cos(2 * np.pi * frequency_hz / BAND_HZ), 0)
    noise = replace(lines, samples=np.fft.ifft(np.fft.fft(white) * gain).astype(np.complex64))
    signal_power, noise_power = (
        np.mean(np.abs(backproject(each, GRID, accuracy_db=-40).pixels) ** 2)
        for each in (lines, noise)
    )
    factor = np.sqrt(signal_power / noise_power * 10 ** (-snr_db / 10))
    return replace(lines, samples=(lines.samples + factor * noise.samples).astype(np.complex64))


def truth(relief, grid=GRID):
    """Heights of a relief at the pixels of a grid."""
    return relief(*np.meshgrid(*grid.axes_m))


@cache
def flat_banks():
    """Both banks over a level seabed, with little noise."""
    return banks(lambda x, y: 0 * x, snr_db=17)
