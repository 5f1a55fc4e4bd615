"""Micronavigation of lines whose true track it does not know, and the bound of its errors.

The array is that of `Sonar.sensotek`, whose first and last 24 receivers overlap from ping to ping.
The receivers in between are left out, since micronavigation does not use them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.fft
import scipy.io
import scipy.signal
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse, Sonar
from clsas.engine.data.track import Track, channels
from clsas.engine.device.device import Device
from clsas.engine.forming import form_exactly
from clsas.engine.signal.compression import compress
from clsas.measures.quality import measure_point
from clsas.navigation.micronavigation import Micronavigation, micronavigate
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate

WAVELENGTH_M = 0.015
SPACING_M = WAVELENGTH_M / 2
"""Distance between phase centres."""
RECEIVERS, OVERLAPPING = 96, 24
COHERENCES = (0.95, 0.7, 0.5)
CELL_M = 0.0207
"""Correlation length in range of speckle with this bandwidth, metres."""

_RANGE_M = 60.0, 66.0  # swath for the comparison with the bound
_ANTENNA_M = WAVELENGTH_M  # length of an element


def overlapping_array(receivers: int, overlapping: int) -> tuple[Sonar, float]:
    """Return a sonar with elements of one wavelength, and its advance per ping, metres.

    It has only the receivers at both ends, which overlap from ping to ping.
    """
    pulse = Pulse(carrier_hz=100e3, bandwidth_hz=37.5e3, duration_s=1e-3)
    at = WAVELENGTH_M * (np.arange(receivers) - (receivers - 1) / 2)
    at = np.concatenate([at[:overlapping], at[-overlapping:]])
    rx_m = np.stack([at, 0 * at, 0 * at], axis=1)
    sonar = Sonar(pulse, rx_m, tx_length_m=_ANTENNA_M, rx_length_m=_ANTENNA_M)
    return sonar, (receivers - overlapping) * SPACING_M


def seabed(
    track: Track, near_m: float, far_m: float, count: int, *, side: int = 1, seed: int = 5
) -> PointTargets:
    """Return speckle: random points over all that a wide beam covers within some ranges."""
    random = np.random.default_rng(seed)
    x = track.positions_m[:, 0]
    along_m = random.uniform(x.min() - far_m, x.max() + far_m, count)
    across_m = side * random.uniform(0.5 * near_m, far_m + 1, count)
    at = np.stack([along_m, across_m, 0 * along_m], axis=1)
    return PointTargets(at, random.standard_normal(count) + 1j * random.standard_normal(count))


def said_to_be_on(lines: RangeLines, sonar: Sonar, track: Track) -> RangeLines:
    """Return lines with the positions of another track."""
    geometry = channels(sonar, track)
    return replace(lines, tx_m=geometry.tx_m, rx_m=geometry.rx_m)


def with_noise(lines: RangeLines, coherence: float, random: np.random.Generator) -> RangeLines:
    """Return lines with noise of the same spectrum, so that pairs have the given coherence."""
    spectrum = np.sqrt(np.mean(np.abs(np.fft.fft(lines.samples, axis=1)) ** 2, axis=0))
    white = random.standard_normal((*lines.samples.shape, 2)) @ [1, 1j]
    noise = np.fft.ifft(np.fft.fft(white, axis=1) * spectrum, axis=1)
    noise *= np.sqrt(np.mean(np.abs(lines.samples) ** 2) / np.mean(np.abs(noise) ** 2))
    noisy = lines.samples + np.sqrt(1 / coherence - 1) * noise
    return replace(lines, samples=noisy.astype(np.complex64))


def detrended(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values without mean and linear trend, which only move the image of a track."""
    at = np.arange(len(values))
    return values - np.polyval(np.polyfit(at, values, 1), at)


def bound(coherence: float, cells: float, pairs: int) -> tuple[float, float]:
    """Return lower bounds of the standard deviations of sway (m) and yaw (rad) per ping.

    See `clsas.micronavigate`. `cells` is the number of independent samples.
    """
    phase = np.sqrt((1 - coherence**2) / (2 * cells * coherence**2))
    sway_m = WAVELENGTH_M / (4 * np.pi) * phase / np.sqrt(pairs)
    return float(sway_m), float(sway_m * np.sqrt(12 / (pairs**2 - 1)) / SPACING_M)


@cache
def straight_lines(pings: int = 21) -> RangeLines:
    """Return lines from a straight track over speckle, at ranges of 60 to 66 m."""
    sonar, advance_m = overlapping_array(RECEIVERS, OVERLAPPING)
    track = Track.straight((0, 0, 0), (advance_m, 0, 0), pings, 1.0)
    near_m, far_m = _RANGE_M
    range_m = near_m - 0.5, far_m + 0.5
    return compress(simulate(sonar, track, seabed(track, *_RANGE_M, 20000), range_m=range_m))


def noisy_runs(count: int = 8, seed: int = 1) -> dict[float, list[Micronavigation]]:
    """Return results for several realisations of noise on `straight_lines`, by coherence."""
    random = np.random.default_rng(seed)
    return {each: _noisy_runs(each, count, random) for each in COHERENCES}


def _noisy_runs(coherence: float, count: int, random: np.random.Generator) -> list[Micronavigation]:
    lines, (near_m, far_m) = straight_lines(), _RANGE_M
    return [
        micronavigate(
            with_noise(lines, coherence, random),
            range_m=_RANGE_M,
            window_m=far_m - near_m,
            element_length_m=_ANTENNA_M,
            unknowns=("sway", "yaw"),
        )
        for _ in range(count)
    ]


def against_bound(
    runs: list[Micronavigation], name: str, coherence: float
) -> tuple[float, float, float]:
    """Return standard deviation and bias of steps over the bound, and the coverage of intervals.

    Parameters
    ----------
    runs : list of Micronavigation
        Results for several realisations of noise.
    name : {"sway", "yaw"}
    coherence : float
        Coherence of pairs.

    Returns
    -------
    deviation, bias : float
        Standard deviation and bias over the bound.
    cover : float
        Share of errors within 1.96 predicted standard deviations.
    """
    unit = "m" if name == "sway" else "rad"
    found = np.array([getattr(run, f"{name}_steps_{unit}") for run in runs])
    predicted = np.array([getattr(run, f"{name}_steps_sd_{unit}") for run in runs])
    least = bound(coherence, np.ptp(_RANGE_M) / CELL_M, OVERLAPPING)[name == "yaw"]
    # Subtracting the mean of few runs reduces their scatter, which the factor restores.
    away = (found - found.mean(axis=0)) * np.sqrt(len(runs) / (len(runs) - 1))
    deviation = float(np.sqrt(np.mean(found.var(axis=0, ddof=1))))
    cover = float(np.mean(np.abs(away) <= 1.96 * predicted))
    return deviation / least, float(found.mean()) / least, cover


def bound_rows() -> Iterator[list[str]]:
    """Yield rows of the errors of steps over the bound, by coherence."""
    for coherence, found in noisy_runs().items():
        for name in ("sway", "yaw"):
            deviation, bias, cover = against_bound(found, name, coherence)
            yield [f"{coherence:g}", name, f"{deviation:.2f}", f"{bias:+.2f}", f"{cover:.3f}"]


BOUND_COLUMNS = ("coherence", "step", "sd over the bound", "bias over the bound", "95 % cover")


@dataclass(frozen=True, eq=False)
class Voyage:
    """A recording of an array whose motion its navigation does not know.

    Attributes
    ----------
    told, true : RangeLines
        Lines with the positions of the navigation, and with those of the true track.
    range_m : (float, float)
        Swath from which the echoes come.
    target_m : (x, y, z)
        Position of a bright point.
    """

    told: RangeLines
    true: RangeLines
    range_m: tuple[float, float]
    target_m: tuple[float, float, float]

    @property
    def aperture_m(self) -> float:
        """Length of the target's synthetic aperture: its range times the beam width, metres."""
        return self.target_m[1] * WAVELENGTH_M / _ANTENNA_M


def voyage(
    pings: int = 100,
    *,
    overlapping: int = OVERLAPPING,
    range_m: tuple[float, float] = (12.0, 20.0),
    points: int = 60000,
    bright: float = 5.0,
    sway_pings: float = 200.0,
    yaw_pings: float = 100.0,
) -> Voyage:
    """Return a voyage over speckle and a bright point, with 0.2 m of sway and 1 degree of yaw.

    `sway_pings` and `yaw_pings` are the periods of these motions. `bright` is the amplitude of the
    bright point over that of single points of the speckle.
    """
    sonar, advance_m = overlapping_array(RECEIVERS, overlapping)
    course = (0, 0, 0), (advance_m, 0, 0), pings, 1.0
    true = Track.straight(
        *course,
        sway_m=lambda t: 0.2 * np.sin(2 * np.pi * t / sway_pings + 0.3),
        yaw_rad=lambda t: np.radians(1.0) * np.sin(2 * np.pi * t / yaw_pings + 1),
    )
    near_m, far_m = range_m
    target_m = float(true.positions_m[:, 0].mean()), near_m + 2, 0.0
    scene = seabed(true, near_m, far_m, points), PointTargets([target_m], [bright])
    lines = compress(simulate(sonar, true, scene, range_m=(near_m - 0.5, far_m + 0.5)))
    told = said_to_be_on(lines, sonar, Track.straight(*course))
    return Voyage(told, said_to_be_on(lines, sonar, true), range_m, target_m)


def navigated(voyage: Voyage, window_m: float | None = None) -> Micronavigation:
    """Return the result of micronavigation for a voyage, with windows of a length in range."""
    return micronavigate(
        voyage.told,
        range_m=voyage.range_m,
        window_m=window_m,
        element_length_m=_ANTENNA_M,
        sway_sd_m=0.2,
        yaw_sd_deg=1.15,
    )


def residual_m(voyage: Voyage, found: RangeLines) -> float:
    """Return the largest rms error across the track within any synthetic aperture, metres.

    Mean and linear trend within an aperture only move the image, and are removed.
    """
    error_m = (found.phase_centres_m - voyage.true.phase_centres_m)[:, 1]
    along_m = voyage.true.phase_centres_m[:, 0]
    worst = 0.0
    length_m = min(voyage.aperture_m, float(np.ptp(along_m)))
    for start_m in np.arange(along_m.min(), along_m.max() - length_m + 1e-9, length_m / 8):
        some = (along_m >= start_m) & (along_m <= start_m + length_m)
        straight = np.polyfit(along_m[some], error_m[some], 1)
        worst = max(worst, float(np.std(error_m[some] - np.polyval(straight, along_m[some]))))
    return worst


def point_against_true(
    voyage: Voyage, found: RangeLines, device: Device | str | None = None
) -> tuple[float, float]:
    """Return peak (dB) and width along the track of the point, over those with the true track."""
    x, y, _ = voyage.target_m
    grid = Grid.plane(x=(x - 0.5, x + 0.5, 401), y=(y - 0.5, y + 0.5, 201))
    made = [
        measure_point(
            form_exactly(each, grid, device=device, accuracy_db=-50), (x, y), search_m=0.2
        )
        for each in (found, voyage.true)
    ]
    peak, width = ([p.amplitude for p in made], [p.azimuth.resolution_m for p in made])
    return float(20 * np.log10(peak[0] / peak[1])), width[0] / width[1]


VOYAGES = (
    # overlapping phase centres, periods of sway and yaw, points of speckle, bright point over them
    (24, 200.0, 100.0, 60_000, 5.0),
    (24, 100.0, 50.0, 60_000, 5.0),
    (24, 200.0, 100.0, 15_000, 30.0),
    (48, 200.0, 100.0, 30_000, 5.0),
)
VOYAGE_COLUMNS = (
    "overlap",
    "periods of sway and yaw, pings",
    "points of speckle",
    "bright point over them",
    "device",
    "coherence",
    "residual as recorded, wavelengths",
    "navigated",
    "peak dB",
    "width",
)


def voyage_rows(devices: Iterable[str]) -> Iterator[list[str]]:
    """Yield rows of residual, peak and width for `VOYAGES`, whose tracks are unknown."""
    for overlapping, sway_pings, yaw_pings, points, bright in VOYAGES:
        made = voyage(
            overlapping=overlapping,
            points=points,
            bright=bright,
            sway_pings=sway_pings,
            yaw_pings=yaw_pings,
        )
        found = navigated(made)
        before, after = (residual_m(made, each) / WAVELENGTH_M for each in (made.told, found.lines))
        for device in devices:
            peak_db, width = point_against_true(made, found.lines, device)
            yield [
                f"{overlapping}",
                f"{sway_pings:g}, {yaw_pings:g}",
                f"{points:_}".replace("_", " "),
                f"{bright:g}",
                device,
                f"{np.median(found.coherence):.2f}",
                f"{before:.1f}",
                f"{after:.3f}",
                f"{peak_db:.2f}",
                f"{width:.3f}",
            ]


def jitter_followed(
    path: str | os.PathLike, rms_s: float
) -> tuple[NDArray[np.float64], Micronavigation]:
    """Return delays added to the transmissions of a full matrix capture, and the result.

    Parameters
    ----------
    path : path-like
        A MATLAB file for `clsas.read_full_matrix`, of a line array over a wall at 40 mm.
    rms_s : float
        Rms value of the delays, s.
    """
    data = scipy.io.loadmat(path, simplify_cells=True)["exp_data"]
    time_s, sound_m_s = np.ravel(data["time"]), float(data["ph_velocity"])
    step_s = time_s[1] - time_s[0]
    at_m = np.ravel(data["array"]["el_xc"])
    count, length = len(at_m), len(time_s)
    first, second = (np.ravel(data[name]).astype(int) - 1 for name in ("tx", "rx"))
    matrix = np.zeros((count, count, length))
    matrix[first, second] = matrix[second, first] = data["time_data"].T
    jitter_s = rms_s * np.random.default_rng(0).standard_normal(count)
    padded = scipy.fft.next_fast_len(length + length // 4)
    frequency_hz = np.fft.rfftfreq(padded, step_s)
    late = np.exp(-2j * np.pi * frequency_hz * jitter_s[:, None, None])
    delayed = np.fft.irfft(np.fft.rfft(matrix, padded, axis=2) * late, padded, axis=2)
    samples = scipy.signal.hilbert(delayed[..., :length], axis=2).reshape(count**2, -1)
    element_m = np.stack([at_m, 0 * at_m, 0 * at_m], axis=1)
    tx_m, rx_m = np.repeat(element_m, count, axis=0), np.tile(element_m, (count, 1))
    lines = RangeLines(
        samples, sound_m_s * time_s[0] / 2, sound_m_s * step_s / 2, tx_m, rx_m, 0.0, sound_m_s
    )
    wall_m = 0.038, 0.042
    found = micronavigate(
        lines, range_m=wall_m, window_m=0.004, most_step_m=4e-4, unknowns=("sway",)
    )
    return jitter_s, found
