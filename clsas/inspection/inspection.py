"""Inspection of a recording before an image is formed from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import side_of
from clsas.engine.data.findings import Finding
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reprs import Report, Table
from clsas.engine.device.device import Device, open_device
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.inspection.checks import CHECKS, Recording, runs
from clsas.inspection.phase_sign import PhaseSign

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
    recorded, lines = lines, compress(lines) if isinstance(lines, Echoes) else lines
    # Refuse numbers that no recording has, or that float64 cannot subtract.
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

    recording = Recording(recorded, lines, grid, beam, element_length_m, device)
    findings = tuple(found for check in CHECKS for found in check(recording))

    pings = recording.pings
    if pings.receivers.max() > 1:
        geometry = "array"
    else:
        geometry = "monostatic" if lines.is_monostatic else "bistatic"
    speed_m_s = None
    if lines.rx_velocity_m_s is not None:
        speed_m_s = float(np.median(np.linalg.norm(lines.rx_velocity_m_s, axis=1)))
    depth_m, first_m, last_m = lines.phase_centres_m[:, 2], lines.first_range_m, lines.last_range_m
    sign, undetermined = recording.sign
    return Inspection(
        lines=lines,
        geometry=geometry,
        channels=lines.channels,
        pings=pings.count,
        receivers=(int(pings.receivers.min()), int(pings.receivers.max())),
        track_m=float(pings.steps_m.sum()),
        advance_m=pings.usual_step_m,
        depths_m=(float(depth_m.min()), float(depth_m.max())),
        speed_m_s=speed_m_s,
        looks="" if lines.look_direction is None else side_of(lines, lines.look_direction),
        carrier_hz=lines.carrier_hz,
        band_hz=recording.band_hz,
        oversampling=recording.spectrum.oversampling,
        wavelength_m=recording.wavelength_m,
        length=lines.length,
        range_step_m=lines.range_step_m,
        first_range_m=(float(first_m.min()), float(first_m.max())),
        last_range_m=(float(last_m.min()), float(last_m.max())),
        sign=sign,
        sign_not_told=undetermined,
        findings=findings,
    )


@dataclass(frozen=True, eq=False)
class Inspection:
    """Properties of a recording and its defects, as returned by `inspect`.

    Attributes
    ----------
    lines : RangeLines
        The lines inspected; echoes are compressed first.
    geometry : str
        "monostatic", "bistatic" or "array".
    channels, pings : int
        Number of channels and pings. A ping ends where the transmitter moves, or where the position
        of its first receiver comes again.
    receivers : (int, int)
        Fewest and most channels of a ping.
    track_m : float
        Distance travelled, in metres: the sum of the steps from ping to ping.
    advance_m : float
        Median advance per ping while the platform moves, in metres; 0 if it never does.
    depths_m : (float, float)
        Lowest and highest z of the phase centres, in metres.
    speed_m_s : float or None
        Median speed of the receivers. None if the lines have no velocities; they have no times
        either.
    looks : str
        Side of the track to which the elements look: "port", "starboard" or "both sides"; "" if it
        is unknown, or they look along the track or straight down.
    carrier_hz : float
        Frequency that was mixed out; 0 if the lines still have their carrier.
    band_hz : (float, float)
        Lower and upper end of the occupied band, as measured.
    oversampling : float
        Sample rate relative to the width of the occupied band.
    wavelength_m : float
        Wavelength at the mean magnitude of the band's frequencies. This is the middle of the band
        unless it reaches below 0 Hz.
    length : int
        Samples per channel.
    range_step_m : float
        Range between samples, in metres.
    first_range_m, last_range_m : (float, float)
        Smallest and largest range of the first samples, and of the last, in metres.
    sign : PhaseSign or None
        Sharpest patch that was imaged with both signs of the phase; None if there is none.
    sign_not_told : str
        Reason why the sign of the phase is undetermined; "" if it is determined.
    findings : tuple of Finding
        Defects, each with its value, limit and remedy.

    See Also
    --------
    inspect : Function that returns it, with an example.

    Notes
    -----
    ``inspection["gaps"]`` is the finding of that name, and ``"gaps" in inspection`` is True if
    there is one.
    """

    lines: RangeLines
    geometry: str
    channels: int
    pings: int
    receivers: tuple[int, int]
    track_m: float
    advance_m: float
    depths_m: tuple[float, float]
    speed_m_s: float | None
    looks: str
    carrier_hz: float
    band_hz: tuple[float, float]
    oversampling: float
    wavelength_m: float
    length: int
    range_step_m: float
    first_range_m: tuple[float, float]
    last_range_m: tuple[float, float]
    sign: PhaseSign | None
    sign_not_told: str
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        """Return the sizes and the names of the findings."""
        return reprs.summary(
            self,
            f"{self.channels} channels",
            f"{self.pings} pings",
            self.geometry,
            f"findings: {', '.join(each.name for each in self.findings) or 'none'}",
        )

    def _repr_html_(self) -> str:
        return self._report().html()

    def __getitem__(self, name: str) -> Finding:
        """Return the finding with a name; raise KeyError if there is none."""
        return {finding.name: finding for finding in self.findings}[name]

    def __contains__(self, name: str) -> bool:
        """Return True if there is a finding with a name."""
        return any(finding.name == name for finding in self.findings)

    @property
    def unambiguous_deg(self) -> float:
        """Angle from broadside, in degrees, within which the usual advance causes no grating lobes.

        With one receiver per ping, sin(angle) = wavelength/(4 advance).
        """
        sine = self.wavelength_m / (4 * self.advance_m) if self.advance_m else math.inf
        return math.degrees(math.asin(min(sine, 1.0)))

    def describe(self) -> str:
        """Return a table of the properties, and the findings with their remedies, as text."""
        return self._report().text()

    def _report(self) -> Report:
        table = Table(("quantity", "value"), self._rows(), align="left")
        if not self.findings:
            return Report([table, "No defects found."])
        lines = []
        for number, finding in enumerate(self.findings, start=1):
            lines.append(f"{number}. {finding.name}: {finding.message}")
            if finding.where:
                lines.append(f"   Where: {runs(finding.where)}")
            lines.append(f"   Remedy: {finding.remedy}")
        return Report([table, "Findings:", *lines])

    def _rows(self) -> list[tuple[str, str]]:
        fewest, most = self.receivers
        several = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        banks = f" in {self.lines.banks} banks" if self.lines.banks > 1 else ""
        array = f", {several} receivers per ping{banks}" if most > 1 else ""
        low_hz, high_hz = self.band_hz
        speed = "unknown: the lines have neither times nor velocities"
        if self.speed_m_s is not None:
            speed = reprs.measured(self.speed_m_s, "m/s")
        carrier = "0: the lines still have their carrier"
        if self.carrier_hz:
            carrier = reprs.quantity(self.carrier_hz, "Hz")
        looks = f"to {self.looks}"
        if self.lines.look_direction is None:
            looks = "unknown: the recording does not state the side"
        elif not self.looks:
            mean = self.lines.look_direction.mean(axis=0) + 0.0
            looks = "neither to port nor to starboard: mean direction "
            looks += f"({', '.join(f'{each:.2f}' for each in mean)})"
        middle = reprs.measured((low_hz + high_hz) / 2, "Hz")
        band = f"{reprs.measured(high_hz - low_hz, 'Hz')} about {middle}"
        length = reprs.measured((self.length - 1) * self.range_step_m, "m")
        advance = f"{reprs.measured(self.advance_m, 'm')} per ping"
        rows = [
            ("channels", f"{self.channels} in {self.pings} pings"),
            ("geometry", f"{self.geometry}{array}"),
            ("track", f"{reprs.measured(self.track_m, 'm')} long, {advance}"),
            ("depth (z)", _span(*self.depths_m)),
            ("speed", speed),
            ("looks", looks),
            ("carrier", carrier),
            ("measured band", f"{band}, wavelength {reprs.measured(self.wavelength_m, 'm')}"),
            ("oversampling", f"{self.oversampling:.3g}"),
            (
                "samples",
                f"{self.length} per line, {reprs.measured(self.range_step_m, 'm')} apart: {length}",
            ),
            ("first range", _span(*self.first_range_m)),
            ("last range", _span(*self.last_range_m)),
        ]
        if most == 1 and self.advance_m:
            angle = f"no grating lobes within {self.unambiguous_deg:.3g} degrees of broadside"
            rows.append(
                ("spacing", f"{self.advance_m / self.wavelength_m:.3g} wavelengths: {angle}")
            )
        sign = f"undetermined: {self.sign_not_told}"
        if self.sign is not None:
            both = f"sharpness {self.sign.as_given:.3g}, with conjugate lines "
            both += f"{self.sign.conjugate:.3g}"
            sign = f"opposite, {both}" if self.sign.ratio > 1 else f"correct, {both}"
            if self.sign_not_told:
                sign = f"unclear, {both}: {self.sign_not_told}"
        return [*rows, ("sign of phase", sign)]


def _span(low_m: float, high_m: float) -> str:
    """Return "low to high" in metres or millimetres, or one value if both look alike."""
    ends = dict.fromkeys((reprs.quantity(low_m, "m"), reprs.quantity(high_m, "m")))
    return " to ".join(ends)
