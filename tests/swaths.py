"""Two banks over a wide swath of speckle, with errors that their lines do not account for."""

from dataclasses import replace

import numpy as np
from reliefs import ALTITUDE_M, BAND_HZ, CARRIER_HZ, SOUND_M_S
from scenes import kept

from clsas.engine.data.grid import Grid
from clsas.simulation.scenes import Observer, PointTargets, Seabed
from clsas.simulation.simulator import simulate_lines

GRID = Grid.plane((-0.45, 0.45, 37), (12, 36, 1201))
WINDOW_M = 0.3
BASELINE_M = 0.25
_HALF_M = 0.75  # of the seabed along the track
_BEYOND_M = 0.8  # seabed beyond the grid on either side
_SNR_DB = 15.0  # of the samples


@kept
def banks(
    relief, seed, *, phase_rad=0.0, delay_s=0.0, roll_rad=0.0, track_y_m=0.0, heading=1, pings=126
):
    """Lines of both banks; the errors are those of the second, whose lines state none.

    The roll is about the heading, 1 along x or -1 against it, with the port side up.
    """
    x_m, y_m = (-_HALF_M, _HALF_M), (12 - _BEYOND_M, 36 + _BEYOND_M)
    x, y = (np.linspace(*each, round((each[1] - each[0]) / 0.02) + 1) for each in (x_m, y_m))
    surface = Seabed(x_m, y_m, relief(*np.meshgrid(x, y)), density_m2=1500.0, seed=seed)
    along_m = heading * np.linspace(-2.5, 2.5, pings)
    tx_m = np.stack([along_m, 0 * along_m + track_y_m, 0 * along_m + ALTITUDE_M], axis=1)
    points = PointTargets(*surface.visible(Observer(np.array([0.0, track_y_m, ALTITUDE_M]))))
    ground_m = np.abs(np.array(y_m) - track_y_m)
    near_m = np.hypot(ground_m.min(), ALTITUDE_M - 1) - 1
    far_m = np.hypot(np.hypot(ground_m.max(), ALTITUDE_M + 1), 2.5 + _HALF_M) + 1
    nominal_m = np.array([0.0, 0.0, BASELINE_M])
    turned_m = BASELINE_M * np.array([0.0, -heading * np.sin(roll_rad), np.cos(roll_rad)])
    random = np.random.default_rng([seed, heading + 1])
    found = []
    for arm_m in (np.zeros(3), turned_m):
        clean = simulate_lines(
            tx_m, tx_m + arm_m, points, carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ,
            window="hamming", first_range_m=near_m,
            length=round((far_m - near_m) / (SOUND_M_S / (4 * BAND_HZ))),
        )  # fmt: skip
        found.append(_with_noise(clean, random))
    first, second = found
    frequency_hz = CARRIER_HZ + np.fft.fftfreq(second.length, 1 / (2 * BAND_HZ))
    response = np.exp(1j * (phase_rad - 2 * np.pi * frequency_hz * delay_s))
    samples = np.fft.ifft(np.fft.fft(second.samples) * response)
    return first, replace(second, samples=samples.astype(np.complex64), rx_m=tx_m + nominal_m)


def _with_noise(lines, random):
    """Return lines with noise that has passed the same filter as the echoes."""
    frequency = np.fft.fftfreq(lines.length)  # the samples have twice the band
    gain = np.where(np.abs(frequency) <= 0.25, 0.54 + 0.46 * np.cos(4 * np.pi * frequency), 0)
    white = random.standard_normal((*lines.samples.shape, 2)) @ [1, 1j]
    noise = np.fft.ifft(np.fft.fft(white) * gain)
    power = np.mean(np.abs(lines.samples) ** 2) / np.mean(np.abs(noise) ** 2)
    noisy = lines.samples + noise * np.sqrt(power * 10 ** (-_SNR_DB / 10))
    return replace(lines, samples=noisy.astype(np.complex64))
