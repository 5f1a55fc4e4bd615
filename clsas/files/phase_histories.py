"""Phase histories of radar in MATLAB files, as the GOTCHA data set has them."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.core.lines import RangeLines
from clsas.files import matlab
from clsas.files.hdf5 import FileFormatError
from clsas.files.positions import checked_positions
from clsas.signal.compression import Window
from clsas.signal.phase_history import from_phase_history

FIELDS = ("fp", "freq", "x", "y", "z", "r0")


def read_phase_history(
    path: str | os.PathLike, *, window: Window = "none", oversampling: float = 2.0
) -> RangeLines:
    """Read a MATLAB file of motion-compensated radar pulses over frequency.

    The file holds variables, or one structure, with the fields `fp` [frequencies, pulses], `freq`
    (Hz), the antenna's positions `x`, `y`, `z` (m) and `r0` (m), the range that each pulse is
    referenced to: a point at range R gives exp(-j 4 pi freq (R - r0)/c). Autofocus terms (`af`) are
    not applied.

    Parameters
    ----------
    path : path-like
        The file, of MATLAB's version 5 to 7.
    window : str, float or tuple
        Window over the frequencies, as in `from_phase_history`.
    oversampling : float
        Samples per line over frequencies, at least 1.

    Returns
    -------
    RangeLines
        Monostatic lines in the file's coordinates, one period c/(2 step) of range long.

    Raises
    ------
    FileFormatError
        If the file is damaged, lacks a field, or its frequencies are not equally spaced.
    TypeError, ValueError
        If an option is outside its limits.
    OSError
        If the file cannot be read.

    Warns
    -----
    ClsasWarning
        If all pings have one position, or the track turns back, so that pings may be out of order.

    Notes
    -----
    Reference ranges in float32 are rounded to about 1 mm, or 0.4 rad of phase at 10 GHz. Where they
    equal the antenna's distance from the origin to that precision, that distance is used: positions
    are rounded too, but this moves ranges and reference ranges alike and cancels.
    """
    return phase_history_lines(path, matlab.fields_of(path, *FIELDS), window, oversampling)


def phase_history_lines(
    path: str | os.PathLike,
    data: dict[str, Any],
    window: Window = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines of the fields that `read_phase_history` describes."""
    samples = matlab.numbers(path, data, "fp", 2, kinds="c").T
    antenna = [matlab.numbers(path, data, axis, 1) for axis in "xyz"]
    frequency = matlab.numbers(path, data, "freq", 1)
    reference = matlab.numbers(path, data, "r0", 1)
    pulses, count = samples.shape
    if {len(axis) for axis in (*antenna, reference)} != {pulses} or len(frequency) != count:
        raise FileFormatError(
            f"{os.fspath(path)} must hold x, y, z and r0 of every pulse and freq of every "
            f"frequency, got {len(antenna[0])}, {len(antenna[1])}, {len(antenna[2])}, "
            f"{len(reference)} and {len(frequency)} for fp of {count} frequencies, {pulses} pulses"
        )
    antenna_m = np.stack(antenna, axis=-1).astype(np.float64)
    try:
        first_hz, step_hz = _equal_steps(frequency)
        lines = from_phase_history(
            samples,
            first_frequency_hz=first_hz,
            frequency_step_hz=step_hz,
            reference_range_m=_reference_m(reference, antenna_m),
            tx_m=antenna_m,
            rx_m=antenna_m,
            sound_speed_m_s=speed_of_light,
            window=window,
            oversampling=oversampling,
        )
    except (TypeError, ValueError) as error:
        raise type(error)(f"{os.fspath(path)}: {error}") from None
    return checked_positions(path, lines)


def _equal_steps(frequency: NDArray) -> tuple[float, float]:
    """Return first frequency and step of frequencies that are equally spaced but for rounding."""
    exact = np.linspace(float(frequency[0]), float(frequency[-1]), len(frequency))
    step = float(exact[-1] - exact[0]) / max(len(exact) - 1, 1)
    rounding = 2 * _rounding(frequency) + 1e-3 * abs(step)
    if not step > 0 or not np.abs(exact - frequency).max() <= rounding:
        raise FileFormatError("must hold freq in equal, ascending steps")
    return float(exact[0]), step


def _reference_m(reference: NDArray, antenna_m: NDArray[np.float64]) -> NDArray[np.float64]:
    distance = np.linalg.norm(antenna_m, axis=1)
    if np.abs(distance - reference).max() <= 2 * _rounding(reference):
        return distance
    return reference.astype(np.float64)


def _rounding(values: NDArray) -> float:
    """Largest distance between neighbouring numbers of an array's type."""
    if values.dtype.kind != "f":
        return 0.5
    return float(np.spacing(np.abs(values).max()))
