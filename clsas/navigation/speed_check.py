"""A wrong sound speed, which autofocus takes for a bend of the track.

The range to a response on a straight track has the curvature 1/R. Ranges that are too large by a
share e, of a response seen at (1 + e) R, are curved too strongly by 2 e/R. A track that bends away
from the scene by e x^2/R undoes that, whatever the place of the response along the track. Only
responses at very different ranges tell both apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.navigation.responses import Contributions, Passage

_LEAST_SHARE = 0.95
"""Share of the correction's variance that a parabola explains, from which on a speed is a suspect:
0.997 of sound speeds off by 1 %, and of one smooth random sway in twenty."""
_MOST_ERROR = 0.05  # of the sound speed; water has 1400 to 1600 m/s
_LEAST_BEND = 1 / 50  # wavelengths rms, that an image shows


def check_speed(passage: Passage, found: Contributions, moved_m: NDArray[np.float64]) -> None:
    """Warn of a correction that a wrong sound speed explains.

    Parameters
    ----------
    passage : Passage
    found : Contributions
        To the responses of the focused image.
    moved_m : float64 [unknowns, pings]
        The correction.
    """
    power = passage.by_ping(np.abs(found.values[..., 0]).astype(np.float64) ** 2)
    error = speed_error(passage, found, moved_m, power)
    if error is None:
        return
    given_m_s = passage.lines.sound_speed_m_s
    side = "lower" if error > 0 else "higher"
    validate.warn(
        "the correction found is a parabola along the track, as a wrong sound speed makes it: "
        f"{given_m_s / (1 + error):.5g} m/s, {100 * abs(error):.2g} % {side} than the "
        f"{given_m_s:.5g} m/s of the lines, explains it without any bend of the track. Check the "
        "sound speed, with clsas.calibrate_track for instance"
    )


def speed_error(
    passage: Passage,
    found: Contributions,
    moved_m: NDArray[np.float64],
    power: NDArray[np.float64],
) -> float | None:
    """Return the relative error of the sound speed that explains a correction.

    `power` is what every ping receives of a response, [pings, points]. None if the correction is no
    parabola, too small to matter, or larger than a wrong sound speed makes it.
    """
    total = power.sum(axis=1)
    heard = np.flatnonzero(total > 0)
    if len(heard) < 4:
        return None
    counts = np.bincount(passage.ping)[:, None]
    range_m = passage.by_ping(found.range_m) / counts
    turned = np.stack([passage.by_ping(each) / counts for each in found.gradient])
    each_m = np.einsum("upk,up->pk", turned, moved_m)
    longer_m = np.sum(power * each_m, axis=1)[heard] / total[heard]
    at_m = passage.along_m[heard] - passage.along_m[heard].mean()
    longer_m = longer_m - np.polyval(np.polyfit(at_m, longer_m, 1), at_m)
    fitted = np.polyfit(at_m, longer_m, 2)
    bend_m = np.polyval(fitted, at_m)
    if bend_m.std() < _LEAST_BEND * passage.wavelength_m:
        return None
    if bend_m.var() < _LEAST_SHARE * longer_m.var():
        return None
    error = float(fitted[0] / _curvature(passage.along_m, range_m, power))
    return error if abs(error) <= _MOST_ERROR else None


def _curvature(
    along_m: NDArray[np.float64], range_m: NDArray[np.float64], power: NDArray[np.float64]
) -> float:
    """Return half the curvature of ranges that are too large by themselves; see above.

    A curved track changes that of the ranges: it is measured, response by response.
    """
    bends = []
    for response in np.flatnonzero(power.any(axis=0)).tolist():
        some = power[:, response] > 0
        if some.sum() < 4:
            continue
        weights = np.sqrt(power[some, response])
        at_m = along_m[some] - along_m[some].mean()
        bends.append(np.polyfit(at_m, range_m[some, response], 2, w=weights)[0])
    mean_m = float(np.sum(power * range_m) / np.sum(power))
    return float(np.median(bends)) + 1 / (2 * mean_m)
