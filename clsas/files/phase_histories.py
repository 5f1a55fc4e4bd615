"""Phase histories of radar from MATLAB files, in the layout of the GOTCHA data set."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.engine.data import validate
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import Window
from clsas.engine.signal.phase_history import from_phase_history
from clsas.files import matlab
from clsas.files.hdf5 import FileFormatError
from clsas.files.positions import checked_positions
from clsas.files.tables import located

FIELDS = ("fp", "freq", "x", "y", "z", "r0")
_LOWEST_HZ = 1e6  # waves of 300 m: radars that look through ice or ground begin at 1 to 10 MHz


def read_phase_history(
    path: str | os.PathLike, *, window: Window = "none", oversampling: float = 2.0
) -> RangeLines:
    """Return range lines from a MATLAB file of motion-compensated radar pulses over frequency.

    The file contains, as variables or in one structure, the fields `fp` [frequencies, pulses],
    `freq` (Hz), the positions of the antenna `x`, `y`, `z` (m), and `r0` (m), the range to which
    each pulse is referenced: a point at range R gives exp(-j 4 pi freq (R - r0)/c). Autofocus terms
    (`af`) are not applied.

    Parameters
    ----------
    path : path-like
        The file, of MATLAB version 5 to 7.
    window : str, float or tuple
        Window over the frequencies, as for `from_phase_history`.
    oversampling : float
        Number of samples per line over the number of frequencies, at least 1.

    Returns
    -------
    RangeLines
        Monostatic lines in the coordinates of the file. Their length is one period of range,
        c/(2 df) for frequency steps of df.

    Raises
    ------
    FileFormatError
        If the file is damaged, lacks a field, or its frequencies are not equally spaced.
    TypeError, ValueError
        If an option is outside its limits, or frequencies are below 1 MHz in any likely unit.
    OSError
        If the file cannot be read.

    Warns
    -----
    ClsasWarning
        If all pings have the same position, or the track turns back, so that pings may be out of
        order; if frequencies are in MHz or GHz, which are converted; or if positions or units
        cannot be right.

    Notes
    -----
    Reference ranges in float32 are rounded to about 1 mm, or 0.4 rad of phase at 10 GHz. If they
    equal the distance of the antenna from the origin to that precision, this distance is used
    instead. It is rounded too, since the positions are, but ranges and reference ranges then have
    the same error, which cancels.

    See Also
    --------
    from_phase_history : Make range lines from arrays.

    Examples
    --------
    >>> import clsas
    >>> lines = clsas.read_phase_history("pass.mat", window="hann")  # doctest: +SKIP
    """
    return phase_history_lines(path, matlab.fields_of(path, *FIELDS), window, oversampling)


def phase_history_lines(
    path: str | os.PathLike,
    data: dict[str, Any],
    window: Window = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines from the fields that `read_phase_history` describes."""
    samples = matlab.numbers(path, data, "fp", 2, kinds="c").T
    antenna = [matlab.numbers(path, data, axis, 1) for axis in "xyz"]
    frequency = matlab.numbers(path, data, "freq", 1)
    reference = matlab.numbers(path, data, "r0", 1)
    pulses, count = samples.shape
    if {len(axis) for axis in (*antenna, reference)} != {pulses} or len(frequency) != count:
        raise FileFormatError(
            f"{os.fspath(path)} must contain x, y, z and r0 for every pulse and freq for every "
            f"frequency, got {len(antenna[0])}, {len(antenna[1])}, {len(antenna[2])}, "
            f"{len(reference)} and {len(frequency)} for fp [{count} frequencies, {pulses} pulses]"
        )
    antenna_m = np.stack(antenna, axis=-1).astype(np.float64)
    # Frequencies in equal steps, except for rounding.
    exact = np.linspace(float(frequency[0]), float(frequency[-1]), count)
    first, step = float(exact[0]), float(exact[-1] - exact[0]) / max(count - 1, 1)
    rounding = 2 * _rounding(frequency) + 1e-3 * abs(step)
    if not step > 0 or not np.abs(exact - frequency).max() <= rounding:
        raise FileFormatError(f"{os.fspath(path)} must contain freq in equal, ascending steps")
    # Prefer distances from the origin to reference ranges that equal them except for rounding.
    reference_m = np.linalg.norm(antenna_m, axis=1)
    if not np.abs(reference_m - reference).max() <= 2 * _rounding(reference):
        reference_m = reference.astype(np.float64)
    with located(f"{os.fspath(path)}:"):
        first_hz, step_hz = _in_hz(path, first, step, count, reference)
        lines = from_phase_history(
            samples,
            first_frequency_hz=first_hz,
            frequency_step_hz=step_hz,
            reference_range_m=reference_m,
            tx_m=antenna_m,
            rx_m=antenna_m,
            sound_speed_m_s=speed_of_light,
            window=window,
            oversampling=oversampling,
        )
    return checked_positions(path, lines)


def _in_hz(
    path: str | os.PathLike, first: float, step: float, count: int, reference: NDArray
) -> tuple[float, float]:
    """Return a frequency and a step in Hz, if they may be in MHz or GHz.

    No radar images below 1 MHz. The unit is the smallest in which lines of one period, c/(2 step),
    begin in front of the antenna.
    """
    last = first + (count - 1) * step
    if last >= _LOWEST_HZ:
        return first, step
    nearest_m = float(reference.min())
    for unit, name in ((1e6, "MHz"), (1e9, "GHz")):
        if last * unit >= _LOWEST_HZ and speed_of_light / (4 * step * unit) <= nearest_m:
            validate.warn(
                f"{os.fspath(path)}: freq runs from {first:g} to {last:g}, which must be Hz but is "
                f"taken as {name}: no radar images below 1 MHz, and in {name} its lines begin in "
                "front of the antenna. Store freq in Hz"
            )
            return first * unit, step * unit
    hint = "no radar images below 1 MHz. It may be in MHz or GHz"
    raise ArgumentError("freq", "be in Hz", f"{first:g} to {last:g}", hint)


def _rounding(values: NDArray) -> float:
    """Return the spacing of numbers in an array's type, at its largest value."""
    if values.dtype.kind != "f":
        return 0.5
    return float(np.spacing(np.abs(values).max()))
