"""Full matrix captures of ultrasonic arrays, from MATLAB files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import Window
from clsas.engine.signal.full_matrix import from_full_matrix
from clsas.files import matlab
from clsas.files.hdf5 import FileFormatError
from clsas.files.positions import checked
from clsas.files.tables import located

FIELDS = ("time_data", "time", "tx", "rx", "array")


def read_full_matrix(
    path: str | os.PathLike,
    *,
    sound_speed_m_s: float | None = None,
    window: Window = "hann",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines from a MATLAB file with a full matrix capture, as used by arim.

    The file contains, as variables or in one structure, the fields `time_data` [time, pairs] (real
    samples on their carrier), `time` (s), `tx` and `rx` (elements of every pair, from 1), and
    `array`, a structure with the positions of the elements `el_xc`, `el_yc`, `el_zc` (m) and
    `centre_freq` (Hz).

    Parameters
    ----------
    path : path-like
        The file, of MATLAB version 5 to 7.
    sound_speed_m_s : float, optional
        Speed of the waves; by default `ph_velocity` of the file.
    window, oversampling
        As for `from_full_matrix`.

    Returns
    -------
    RangeLines
        One line per pair, in the coordinates of the array.

    Raises
    ------
    FileFormatError
        If the file is damaged, lacks a field, or its fields disagree.
    TypeError, ValueError
        If an option is outside its limits, or neither the file nor the option gives a sound speed.
    OSError
        If the file cannot be read.

    See Also
    --------
    from_full_matrix : Make range lines from arrays.

    Examples
    --------
    >>> import clsas
    >>> lines = clsas.read_full_matrix("capture.mat")  # doctest: +SKIP
    """
    return full_matrix_lines(
        path, matlab.fields_of(path, *FIELDS), sound_speed_m_s, window, oversampling
    )


def full_matrix_lines(
    path: str | os.PathLike,
    capture: dict[str, Any],
    sound_speed_m_s: float | None = None,
    window: Window = "hann",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines from the fields that `read_full_matrix` describes."""
    array = capture["array"]
    if not isinstance(array, dict):
        raise FileFormatError(f"{os.fspath(path)} must contain array as a structure")
    if sound_speed_m_s is None:
        if "ph_velocity" not in capture:
            allowed = f"be given, since {os.fspath(path)} has no ph_velocity"
            raise ArgumentError("sound_speed_m_s", allowed)
        sound_speed_m_s = float(matlab.numbers(path, capture, "ph_velocity", 0))
    x_m = matlab.numbers(path, array, "el_xc", 1)
    others = [
        matlab.numbers(path, array, name, 1) if name in array else np.zeros_like(x_m)
        for name in ("el_yc", "el_zc")
    ]
    time_s = matlab.numbers(path, capture, "time", 1).astype(np.float64)
    step_s = np.diff(time_s)
    if len(time_s) < 2 or not step_s.min() > 0 or np.ptp(step_s) > 1e-3 * step_s.mean():
        raise FileFormatError(f"{os.fspath(path)} must contain time in equal, ascending steps")
    if {len(other) for other in others} != {len(x_m)}:
        raise FileFormatError(f"{os.fspath(path)} must contain as many el_yc and el_zc as el_xc")
    tx, rx = (matlab.numbers(path, capture, name, 1) for name in ("tx", "rx"))
    if np.any(tx % 1) or np.any(rx % 1):
        raise FileFormatError(f"{os.fspath(path)} must contain tx and rx as whole numbers")
    samples = matlab.numbers(path, capture, "time_data", 2).T
    if samples.shape != (len(tx), len(time_s)) or len(rx) != len(tx):
        raise FileFormatError(
            f"{os.fspath(path)} must contain time_data of shape [time, pairs], "
            f"{len(time_s)} by {len(tx)}, got {samples.shape[::-1]}"
        )
    carrier_hz = float(matlab.numbers(path, array, "centre_freq", 0))
    with located(f"{os.fspath(path)}:"):
        lines = from_full_matrix(
            samples,
            np.stack([x_m, *others], axis=-1),
            sample_rate_hz=float((len(time_s) - 1) / (time_s[-1] - time_s[0])),
            carrier_hz=carrier_hz,
            sound_speed_m_s=sound_speed_m_s,
            start_time_s=float(time_s[0]),
            pairs=(tx.astype(np.int64) - 1, rx.astype(np.int64) - 1),
            window=window,
            oversampling=oversampling,
        )
    return checked(path, lines)
