"""Detection of a wrong sound speed, which autofocus mistakes for a bend of the track.

The range to a response, as a function of the position along a straight track, has the curvature
1/R. Suppose that ranges are too large by a share e, so that a response appears at (1 + e) R. Its
ranges are then curved too strongly, by 2 e/R. A track that bends away from the scene by e x^2/R
compensates this for every response along the track. Only responses at very different ranges would
reveal the difference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.navigation.responses import Contributions, Passage

_LEAST_SHARE = 0.95
"""Share of the variance of a correction that a parabola must explain before a wrong sound speed is
suspected. It is 0.997 for speeds that are off by 1 %, and one smooth random sway in twenty also
reaches 0.95."""
_MOST_ERROR = 0.05  # of the sound speed; water has 1400 to 1600 m/s
_LEAST_BEND = 1 / 50  # rms bend in wavelengths below which an image does not change
_LEAST_PINGS = 4  # pings that determine a parabola


def check_speed(passage: Passage, found: Contributions, moved_m: NDArray[np.float64]) -> None:
    """Warn if a wrong sound speed explains a correction.

    Parameters
    ----------
    passage : Passage
    found : Contributions
        Contributions to the responses of the focused image.
    moved_m : float64 [unknowns, pings]
        The correction.
    """
    error = _speed_error(passage, found, moved_m)
    if error is None:
        return
    given_m_s = passage.lines.sound_speed_m_s
    side = "lower" if error > 0 else "higher"
    validate.warn(
        "the correction found is a parabola along the track, and a wrong sound speed may be the "
        f"cause: {given_m_s / (1 + error):.5g} m/s, {100 * abs(error):.2g} % {side} than the "
        f"{given_m_s:.5g} m/s of the lines, explains it without any bend of the track. Check the "
        "sound speed, for instance with `clsas.calibrate_track`"
    )


def _speed_error(
    passage: Passage, found: Contributions, moved_m: NDArray[np.float64]
) -> float | None:
    """Return the relative error of the sound speed that explains a correction.

    None if the correction is not a parabola, is too small to matter, or is larger than a plausible
    error of the sound speed makes it.
    """
    power = passage.by_ping(np.abs(found.values[..., 0]).astype(np.float64) ** 2)
    total = power.sum(axis=1)
    received = np.flatnonzero(total > 0)
    if len(received) < _LEAST_PINGS:
        return None
    gradient = np.stack([passage.mean_by_ping(each) for each in found.gradient])
    each_m = np.einsum("upk,up->pk", gradient, moved_m)
    longer_m = np.sum(power * each_m, axis=1)[received] / total[received]
    at_m = passage.along_m[received] - passage.along_m[received].mean()
    longer_m = longer_m - np.polyval(np.polyfit(at_m, longer_m, 1), at_m)
    parabola = np.polyfit(at_m, longer_m, 2)
    bend_m = np.polyval(parabola, at_m)
    if bend_m.std() < _LEAST_BEND * passage.wavelength_m:
        return None
    if bend_m.var() < _LEAST_SHARE * longer_m.var():
        return None
    range_m = passage.mean_by_ping(found.range_m)
    error = float(parabola[0] / _curvature(passage.along_m, range_m, power))
    return error if abs(error) <= _MOST_ERROR else None


def _curvature(
    along_m: NDArray[np.float64], range_m: NDArray[np.float64], power: NDArray[np.float64]
) -> float:
    """Return the quadratic coefficient by which ranges change per relative error of the speed.

    A curved track changes the curvature of ranges, so that it is measured, response by response.
    `range_m` and `power` are [pings, points].
    """
    bends = []
    for response in np.flatnonzero(power.any(axis=0)).tolist():
        some = power[:, response] > 0
        if some.sum() < _LEAST_PINGS:
            continue
        weights = np.sqrt(power[some, response])
        at_m = along_m[some] - along_m[some].mean()
        bends.append(np.polyfit(at_m, range_m[some, response], 2, w=weights)[0])
    mean_m = float(np.sum(power * range_m) / np.sum(power))
    return float(np.median(bends)) + 1 / (2 * mean_m)
