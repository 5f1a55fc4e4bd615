"""Inspection of a recording before an image is formed from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import side_of
from clsas.engine.data.findings import Finding
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.device.device import Device, open_device
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.inspection.checks import CHECKS
from clsas.inspection.recording import Recording
from clsas.inspection.result import Inspection

_FARTHEST_M = 1e3 * validate.FARTHEST_M  # coordinates in mm are reported, not refused
_SLOWEST_M_S = 1.0  # accepts a sound speed in km/s, so that the checks can report the slip


def inspect(
    lines: RangeLines | Echoes,
    grid: Grid | None = None,
    *,
    device: Device | str | int | None = None,
    beam: BeamWindow | None = None,
    element_length_m: float | None = None,
) -> Inspection:
    """Return the properties of a recording and its defects, before an image is formed.

    Parameters
    ----------
    lines : RangeLines or Echoes
        The recording. Echoes are compressed first, except to find dead and clipped channels.
    grid : Grid, optional
        Grid of the image to come. With it, ranges are compared with those of the lines, and the
        spacing of pings with what the grid requires.
    device : Device, str or int, optional
        Device that forms small images to find the sign of the phase. See
        `clsas.engine.device.device.choose`.
    beam : BeamWindow, optional
        Beam of the image to come, for the limit of the spacing.
    element_length_m : float, optional
        Length of the elements in metres, for the limit of the spacing: half an element.

    Returns
    -------
    Inspection
        Properties and findings; `describe` returns them as text.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds.
    DeviceError
        If the device does not exist.

    See Also
    --------
    check_sampling : Limits of the spacing of phase centres.
    plot.inspection : Draw an inspection.

    Notes
    -----
    "Look before you image" in the guide to recordings lists all findings with their limits.

    Pings taken standing still are found first, and left out when the band, constants, ends of
    lines, spacing and sign of the phase are checked: a halt of hundreds of equal pings would hide
    everything else. Dead and clipped channels are found in the samples as recorded, and ranges are
    those of all lines.

    Samples that are NaN or infinite never get here: `RangeLines` and `load` refuse them, and report
    how many there are and where the first one is.

    Examples
    --------
    Pings 20 mm apart, three of which were lost:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.delete(np.arange(12), [5, 6, 7]), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.1, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(
    ...     tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3, window="hann"
    ... )
    >>> found = clsas.inspect(lines)
    >>> found
    Inspection(9 channels, 9 pings, monostatic, findings: gaps)
    >>> print(found["gaps"].message)
    the track has 1 gap, after ping 4. The widest is 80 mm; the limit there is 35 mm
    """
    validate.instance("lines", lines, RangeLines, Echoes)
    if grid is not None:
        validate.instance("grid", grid, Grid)
        placed(lines, grid)  # raises if the georeferences differ
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if element_length_m is not None:
        element_length_m = validate.positive("element_length_m", element_length_m, "m")
    if device is not None:  # opened even if no patch is imaged, so that a wrong name is refused
        device = open_device(device)
    given = compress(lines) if isinstance(lines, Echoes) else lines
    _check_numbers(given)
    recording = Recording(lines, given, grid, beam, element_length_m, device)
    return _inspection(recording, [found for check in CHECKS for found in check(recording)])


def _check_numbers(lines: RangeLines) -> None:
    """Raise ValueError for numbers that no recording has, or that float64 cannot subtract."""
    validate.number(
        "sound_speed_m_s", lines.sound_speed_m_s, "m/s", least=_SLOWEST_M_S, most=validate.MOST_M_S
    )
    validate.number("carrier_hz", lines.carrier_hz, "Hz", most=validate.MOST_HZ)
    least_m = lines.sound_speed_m_s / (2 * validate.MOST_HZ)
    validate.number("range_step_m", lines.range_step_m, "m", least=least_m)
    for name in ("first_range_m", "tx_m", "rx_m"):
        farthest_m = float(np.abs(getattr(lines, name)).max())
        validate.number(f"the largest of {name}", farthest_m, "m", most=_FARTHEST_M)
    extent_m = lines.length * lines.range_step_m
    validate.number("the length of lines", extent_m, "m", most=_FARTHEST_M)


def _inspection(recording: Recording, findings: list[Finding]) -> Inspection:
    lines, pings = recording.lines, recording.pings
    if pings.receivers.max() > 1:
        geometry = "array"
    else:
        geometry = "monostatic" if np.array_equal(lines.tx_m, lines.rx_m) else "bistatic"
    speed_m_s = None
    if lines.rx_velocity_m_s is not None:
        speed_m_s = float(np.median(np.linalg.norm(lines.rx_velocity_m_s, axis=1)))
    sign, undetermined = recording.sign
    return Inspection(
        lines=lines,
        geometry=geometry,
        channels=lines.channels,
        pings=pings.count,
        receivers=(int(pings.receivers.min()), int(pings.receivers.max())),
        track_m=float(pings.steps_m.sum()),
        advance_m=pings.usual_step_m,
        depths_m=_span(lines.phase_centres_m[:, 2]),
        speed_m_s=speed_m_s,
        looks="" if lines.look_direction is None else side_of(lines, lines.look_direction),
        carrier_hz=lines.carrier_hz,
        band_hz=recording.band_hz,
        oversampling=recording.spectrum.oversampling,
        wavelength_m=recording.wavelength_m,
        length=lines.length,
        range_step_m=lines.range_step_m,
        first_range_m=_span(lines.first_range_m),
        last_range_m=_span(lines.last_range_m),
        sign=sign,
        sign_not_told=undetermined,
        findings=tuple(findings),
    )


def _span(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values.min()), float(values.max())
