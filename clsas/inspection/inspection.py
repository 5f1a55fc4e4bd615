"""Inspection of a recording before it is imaged: its numbers, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.pings import Transmissions
from clsas.core.wavelengths import wavelength_between_m
from clsas.inspection.phase_sign import check_sign, phase_sign
from clsas.inspection.range_checks import check_ranges
from clsas.inspection.recording_checks import (
    Levels,
    check_background,
    check_band,
    check_ends,
    check_levels,
    check_offset,
)
from clsas.inspection.result import Inspection, PhaseSign
from clsas.inspection.track_checks import check_spacing, check_track
from clsas.opencl.device import Device, open_device
from clsas.signal.compression import compress
from clsas.signal.echoes import Echoes
from clsas.signal.spectrum import Spectrum, measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.sampling import Finding

_FARTHEST_M = 1e3 * validate.FARTHEST_M  # coordinates in mm are reported, not refused
_SLOWEST_M_S = 1.0  # of sound in km/s, a slip that is to be shown


def inspect(
    lines: RangeLines | Echoes,
    grid: Grid | None = None,
    *,
    device: Device | str | int | None = None,
    beam: BeamWindow | None = None,
    element_length_m: float | None = None,
) -> Inspection:
    """Say what a recording looks like and what is wrong with it, before an image is formed.

    Parameters
    ----------
    lines : RangeLines or Echoes
        The recording. Channels of echoes are looked at as they were recorded, the rest after
        compression.
    grid : Grid, optional
        Grid of the image to come: its ranges are compared with those of the lines, and the spacing
        of pings with what it needs.
    device : Device, str or int, optional
        Device that forms the patch that tells the sign of the phase. See
        `clsas.opencl.device.choose`.
    beam : BeamWindow, optional
        Beam of the image to come, for the spacing.
    element_length_m : float, optional
        Length of the elements, metres, for the spacing: at most half of it.

    Returns
    -------
    Inspection
        `print(inspection.describe())` shows it.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind or outside its limits.
    DeviceError
        If there is no such device.

    Notes
    -----
    "Look before you image" in the guide to recordings lists the names of findings, what each means,
    and its limit.

    Pings taken standing still are found first and left out: a halt of hundreds of equal pings
    would hide the rest. Dead and clipped channels are told from what was recorded, ranges from
    the lines as given; band, offset, background, ends, spacing and phase from the moving pings.

    Samples that are NaN or infinite never get here: `RangeLines` and `load` refuse them, and say
    how many there are and where the first one is.
    """
    validate.instance("lines", lines, RangeLines, Echoes)
    if grid is not None:
        validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if element_length_m is not None:
        element_length_m = validate.positive("element_length_m", element_length_m, "m")
    if device is not None:  # whether it is used or not; none is needed to look at the track
        device = open_device(device)
    # Compression would spread clipped samples over a line: levels are those of what was recorded.
    recorded, is_echoes = lines.samples, isinstance(lines, Echoes)
    given = compress(lines) if isinstance(lines, Echoes) else lines
    _check_numbers(given)
    # A halt weighs as much as all of a track: everything but levels and ranges is that of the
    # moving pings.
    pings = Transmissions.of(given)
    moving = _Moving.of(given, pings)
    alike = None if np.ptp(pings.receivers) else int(pings.receivers[0])
    found = check_track(pings, given, moving.wavelength_m)
    found += check_levels(Levels.of(recorded, magnitudes=not is_echoes), alike)
    found += _check_samples(moving)
    found += check_spacing(
        moving.lines, moving.pings, grid, beam=beam, element_length_m=element_length_m,
        wavelength_m=moving.wavelength_m,
    )  # fmt: skip
    found += check_ranges(given, grid)
    # A background is as bright in every ping, and would be taken for the brightest echoes.
    clean = moving.lines
    if any(finding.name == "background" for finding in found):
        clean = clean.without_background("median", receivers=alike)
    sign, reason = phase_sign(clean, grid, moving.wavelength_m, moving.cell_m, device)
    return _inspection(given, pings, moving, (sign, reason), found + check_sign(sign, reason))


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


@dataclass(frozen=True)
class _Moving:
    """Lines of the pings that move, and their occupied band."""

    lines: RangeLines
    pings: Transmissions
    spectrum: Spectrum
    band_hz: tuple[float, float]
    wavelength_m: float
    cell_m: float

    @classmethod
    def of(cls, lines: RangeLines, pings: Transmissions) -> _Moving:
        """Drop pings taken standing still, unless all were, and measure the band."""
        advancing = pings.advancing()
        if pings.usual_step_m and not advancing.all():
            lines = lines.select(pings.channels(advancing))
            pings = Transmissions.of(lines)
        spectrum = measure_spectrum(lines)
        rate_hz = lines.sound_speed_m_s / (2 * lines.range_step_m)
        middle_hz = lines.carrier_hz + spectrum.centre * rate_hz
        oversampling = max(spectrum.oversampling, 1.0)
        half_hz = rate_hz / oversampling / 2
        band_hz = middle_hz - half_hz, middle_hz + half_hz
        return cls(
            lines,
            pings,
            spectrum,
            band_hz,
            wavelength_m=wavelength_between_m(lines, *band_hz),
            cell_m=lines.range_step_m * oversampling,
        )


def _check_samples(moving: _Moving) -> list[Finding]:
    """Return what is wrong with samples, unless all of them are zero."""
    lines = moving.lines
    if not lines.samples.any():
        return []
    found = check_offset(lines) + check_background(lines, moving.pings) + check_ends(lines)
    return found + check_band(lines, moving.spectrum, moving.band_hz)


def _inspection(
    lines: RangeLines,
    pings: Transmissions,
    moving: _Moving,
    told: tuple[PhaseSign | None, str],
    found: list[Finding],
) -> Inspection:
    receivers, depths_m = pings.receivers, lines.phase_centres_m[:, 2]
    if receivers.max() > 1:
        geometry = "array"
    else:
        geometry = "monostatic" if np.array_equal(lines.tx_m, lines.rx_m) else "bistatic"
    speed_m_s = None
    if lines.rx_velocity_m_s is not None:
        speed_m_s = float(np.median(np.linalg.norm(lines.rx_velocity_m_s, axis=1)))
    return Inspection(
        lines=lines,
        geometry=geometry,
        channels=lines.channels,
        pings=pings.count,
        receivers=(int(receivers.min()), int(receivers.max())),
        track_m=float(pings.steps_m.sum()),
        advance_m=pings.usual_step_m,
        depths_m=_span(depths_m),
        speed_m_s=speed_m_s,
        carrier_hz=lines.carrier_hz,
        band_hz=moving.band_hz,
        oversampling=moving.spectrum.oversampling,
        wavelength_m=moving.wavelength_m,
        length=lines.length,
        range_step_m=lines.range_step_m,
        first_range_m=_span(lines.first_range_m),
        last_range_m=_span(lines.last_range_m),
        sign=told[0],
        sign_not_told=told[1],
        findings=tuple(found),
    )


def _span(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values.min()), float(values.max())
