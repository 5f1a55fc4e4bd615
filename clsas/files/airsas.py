"""Recordings of AirSAS, an in-air sonar on a rail, in HDF5 and CSV files.

The schema is that of the public data set (https://doi.org/10.6084/m9.figshare.26961892). The
samples of a scene are in `scenes/NAME.h5`, and what all scenes share is in `characterization
data/*.csv` beside that folder.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data import reading, validate
from clsas.engine.data.fourier import fourier_series
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import OVERSAMPLING, WINDOW, Window, compress
from clsas.engine.signal.echoes import Echoes
from clsas.files import hdf5
from clsas.files.hdf5 import FileFormatError
from clsas.files.positions import checked_positions

SHARED = "characterization data"
ACQUISITION, SENSORS = "acquistionParams.csv", "sensorCoordinates.csv"  # the data set's spelling
_SERIES_ERROR_DB = -180.0  # of lines interpolated by Fourier series
# Rows of the acquisition parameters, from 0. Each has a name, a number, and further columns.
_RATE, _GROUP_DELAY, _START_HZ, _STOP_HZ, _DURATION, _TAPER = 0, 1, 7, 8, 9, 12


def is_airsas(file: h5py.File) -> bool:
    """Return whether an HDF5 file has the groups of an AirSAS scene."""
    return "na" in file and any(name.startswith("ch") for name in file)


def read_airsas(
    path: str | os.PathLike,
    *,
    channels: Sequence[int] | None = None,
    shared: str | os.PathLike | None = None,
    window: Window = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines from the microphones' samples of an AirSAS scene.

    The constant offset and the group delay of the recorder are removed, the direct transmission is
    blanked, and the samples are compressed with the chirp that the acquisition parameters describe.

    Parameters
    ----------
    path : path-like
        The scene: an HDF5 file with samples `/chN/ts` [pings, time] for every microphone N, and the
        position on the rail (m) and the temperature (degrees Celsius) of every ping in `/na`.
    channels : sequence of int, optional
        Numbers of microphones, from 1; by default all in the file.
    shared : path-like, optional
        Folder of the CSV files; by default `characterization data` beside the scene's folder.
    window, oversampling
        As for `compress`.

    Returns
    -------
    RangeLines
        One line per ping and microphone, in the coordinates of the rail. The speed of sound is
        331.6 + 0.61 T m/s, with T in degrees Celsius. Lines of pings whose speed differs from the
        mean are resampled to the mean speed.

    Raises
    ------
    FileFormatError
        If a file is damaged or incomplete, or its parts disagree.
    TypeError, ValueError
        If an option is outside its limits, or a microphone does not exist.
    OSError
        If a file does not exist or cannot be read.

    Warns
    -----
    ClsasWarning
        If all pings have the same position, or the track turns back, so that pings may be out of
        order.

    Examples
    --------
    >>> import clsas
    >>> lines = clsas.read_airsas("scenes/arrow.h5", channels=[1, 2])  # doctest: +SKIP
    """
    path = validate.path("path", path)
    WINDOW.check("window", window)
    OVERSAMPLING.check("oversampling", oversampling)
    with hdf5.opened(path) as file:
        if not is_airsas(file):
            raise FileFormatError(
                "is an HDF5 file, but not an AirSAS scene: it must contain /na and microphones "
                f"/ch1, /ch2, ..., got {validate.shown(sorted(file))}"
            )
        groups = set(file)
    if shared is None:
        folder = path.absolute().parent.parent / SHARED
    else:
        folder = validate.path("shared", shared)
    rate_hz, group_delay, pulse = _acquisition(folder / ACQUISITION)
    # Positions of the loudspeaker and the microphones at the array's home.
    rows = _rows(folder / SENSORS, 1, 3)
    if len(rows) < 2:
        raise FileFormatError(
            f"{folder / SENSORS} must have rows for a loudspeaker and microphones, got "
            f"{len(rows)} rows"
        )
    sensors_m = np.array(
        [[_number(folder / SENSORS, row, column) for column in (1, 2, 3)] for row in rows]
    )
    there = [number for number in range(1, len(sensors_m)) if f"ch{number}" in groups]
    numbers = _microphones(path, there, channels)
    with hdf5.opened(path) as file:
        budget = validate.Budget()
        rail_m = _numbers(_dataset(file, "na", "position"), budget).ravel()
        pings = len(rail_m)
        recorded = [_dataset(file, f"ch{number}", "ts") for number in numbers]
        for each in recorded:
            if each.shape != (pings, recorded[0].shape[-1]):
                raise FileFormatError(
                    f"must contain {each.name} of shape [pings, time], {pings} by "
                    f"{recorded[0].shape[-1]}, got {each.shape}"
                )
        speed_m_s = _speeds_m_s(_numbers(_dataset(file, "na", "temperature"), budget), pings)
        samples_per_sample = oversampling * pulse.bandwidth_hz / rate_hz
        samples = _together(recorded, budget, lines_bytes=8 * samples_per_sample)

    # Remove the constant offset and the transmission, which microphones record directly. The
    # samples are zero while the pulse is transmitted, and fade in over another pulse length.
    time_s = (np.arange(samples.shape[-1]) - group_delay) / rate_hz
    ramp = np.clip(time_s / pulse.duration_s - 1, 0, 1)
    samples -= samples.mean(axis=-1, keepdims=True, dtype=np.float64).astype(np.float32)
    samples *= np.sin(np.pi / 2 * ramp).astype(np.float32) ** 2

    position_m = np.zeros((pings, 1, 3))
    position_m[..., 0] = rail_m[:, None]
    tx_m, rx_m = (
        np.broadcast_to(position_m + sensors_m[sensors], (pings, len(numbers), 3)).reshape(-1, 3)
        for sensors in ([0], numbers)
    )
    echoes = Echoes(
        samples.reshape(-1, len(time_s)),
        start_time_s=time_s[0],
        sample_rate_hz=rate_hz,
        carrier_hz=pulse.carrier_hz,
        tx_m=tx_m,
        rx_m=rx_m,
        sound_speed_m_s=float(speed_m_s.mean()),
        pulse=pulse,
    )
    lines = compress(echoes, window=window, oversampling=oversampling)
    return checked_positions(path, _at_one_speed(lines, np.repeat(speed_m_s, len(numbers))))


def _acquisition(path: Path) -> tuple[float, float, Pulse]:
    """Return the sample rate, the group delay in samples, and the pulse."""
    rows = _rows(path, 1, 1)
    if len(rows) <= _TAPER:
        raise FileFormatError(f"{path} must have {_TAPER + 1} parameters, got {len(rows)}")
    start_hz, stop_hz, duration_s, taper, rate_hz, group_delay = (
        _number(path, rows[row], 1)
        for row in (_START_HZ, _STOP_HZ, _DURATION, _TAPER, _RATE, _GROUP_DELAY)
    )
    try:
        pulse = Pulse(
            carrier_hz=(start_hz + stop_hz) / 2,
            bandwidth_hz=abs(stop_hz - start_hz),
            duration_s=duration_s,
            code="up" if stop_hz > start_hz else "down",
            taper=taper,
        )
        rate_hz = validate.positive("the sample rate", rate_hz, "Hz")
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from None
    return rate_hz, group_delay, pulse


def _rows(path: Path, first: int, last: int) -> list[list[str]]:
    """Return the rows of a CSV file. The first is skipped if columns first to last lack numbers."""
    try:
        text = reading.read_bytes(path, reading.ROWS_BYTES).decode("utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except (ValueError, csv.Error) as error:
        raise FileFormatError(f"{path} is not a table: {error}") from None
    is_header = rows and any(not _is_number(cell) for cell in rows[0][first : last + 1])
    return rows[1:] if is_header else rows


def _is_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _number(path: Path, row: list[str], column: int) -> float:
    if len(row) <= column or not _is_number(row[column]):
        raise FileFormatError(
            f"{path} must have a number in column {column + 1}, got {validate.shown(row)}"
        )
    return float(row[column])


def _microphones(path: Path, there: list[int], channels: Sequence[int] | None) -> list[int]:
    if not there:
        raise FileFormatError(
            f"{path} must contain microphones of {SENSORS} as /ch1, /ch2, ..., got none"
        )
    if channels is None:
        return there
    given = validate.entries("channels", channels, "whole numbers of microphones")
    numbers = [validate.count("every entry of channels", number) for number in given]
    if not numbers or not set(numbers) <= set(there):
        raise ArgumentError("channels", f"be among {there}", validate.shown(channels))
    return numbers


def _dataset(file: h5py.File, group: str, name: str) -> h5py.Dataset:
    item = hdf5.find_item(file, group)
    item = hdf5.find_item(item, name) if isinstance(item, h5py.Group) else None
    if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "iuf" or not item.size:
        raise FileFormatError(f"must contain numbers in /{group}/{name}")
    return item


def _numbers(dataset: h5py.Dataset, budget: validate.Budget) -> NDArray[np.float64]:
    """Return the values of a dataset; values that are not finite raise FileFormatError."""
    with hdf5.too_large():
        budget.take(f"reading {dataset.name}", 8 * dataset.size)
    values = hdf5.read_values(dataset, budget).astype(np.float64)
    if not np.isfinite(values).all():
        raise FileFormatError(f"must contain finite numbers in {dataset.name}")
    return values


def _together(
    recorded: list[h5py.Dataset], budget: validate.Budget, lines_bytes: float
) -> NDArray[np.float32]:
    """Return the samples of all microphones, [pings, microphones, time].

    Before any are read, the memory is checked: for all samples, for reading the largest dataset,
    and for the lines that are made of them, `lines_bytes` per sample.
    """
    for each in recorded:
        hdf5.check_whole(each)
    names = recorded[0].name
    if len(recorded) > 1:
        names += f" to {recorded[-1].name}"
    with hdf5.too_large():
        budget.take(
            f"reading {names}",
            (4 + lines_bytes) * sum(each.size for each in recorded),
            passing_bytes=max(each.nbytes + hdf5.unpacking_bytes(each) for each in recorded),
        )
    pings, length = recorded[0].shape
    together = np.empty((pings, len(recorded), length), np.float32)
    for number, each in enumerate(recorded):
        together[:, number] = each[()]
        if not np.isfinite(together[:, number]).all():
            raise FileFormatError(f"must contain finite numbers in {each.name}")
    return together


def _speeds_m_s(temperature: NDArray, pings: int) -> NDArray[np.float64]:
    """Return the speed of sound at every ping, from the mean of the thermometers, m/s."""
    if temperature.ndim == 1:
        temperature = temperature[None]
    if temperature.ndim != 2 or temperature.shape[1] != pings:
        raise FileFormatError(
            f"must contain /na/temperature for {pings} pings, got shape {temperature.shape}"
        )
    speed: NDArray[np.float64] = 331.6 + 0.61 * temperature.mean(axis=0)
    if not (speed.min() > 200 and speed.max() < 600):
        raise FileFormatError(
            "must contain /na/temperature in degrees Celsius, got "
            f"{temperature.min():g} to {temperature.max():g}"
        )
    return speed


def _at_one_speed(lines: RangeLines, speed_m_s: NDArray[np.float64]) -> RangeLines:
    """Return lines with one speed of sound, from channels whose speeds of sound differed.

    Ranges r of the lines assume the one speed c, so that samples are at the times 2 r/c. In channel
    i the echo of a point at range r arrives at the time 2 r/c_i. The line is therefore interpolated
    at these times, by a Fourier series, and multiplied by a phasor of phase
    4 pi fc r (1/c_i - 1/c). A point at rho then has its echo at rho in every channel, with the
    phase exp(-j 4 pi fc rho/c).
    """
    validate.memory("lines at one speed of sound", lines.samples.nbytes)
    speed = lines.sound_speed_m_s
    samples = np.array(lines.samples)
    padded = fft.next_fast_len(lines.length + lines.length // 4)
    for channel in np.flatnonzero(speed_m_s != speed):
        range_m = lines.first_range_m[channel] + np.arange(lines.length) * lines.range_step_m
        at = (range_m * speed / speed_m_s[channel] - range_m[0]) / lines.range_step_m
        series = fft.fftshift(fft.fft(samples[channel].astype(np.complex128), padded)) / padded
        line = fourier_series(series, at / padded, _SERIES_ERROR_DB)
        line *= np.exp(-2j * np.pi * (padded // 2) * at / padded)  # the first frequency
        line[(at < 0) | (at > lines.length - 1)] = 0
        cycles = 2 * lines.carrier_hz * range_m * (1 / speed_m_s[channel] - 1 / speed)
        samples[channel] = line * np.exp(2j * np.pi * cycles)
    return replace(lines, samples=samples)
