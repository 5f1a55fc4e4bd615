"""Results of `clsas.inspect`: properties of a recording, and its defects, as a table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clsas.engine.data import reprs
from clsas.engine.data.findings import Finding
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reprs import Report, Table

_MOST_RUNS = 12  # runs of indices that are written out


@dataclass(frozen=True, eq=False)
class PhaseSign:
    """Sharpness of a small image of the lines as given, and of their conjugates.

    Attributes
    ----------
    as_given, conjugate : float
        Mean squared intensity along the track over the squared mean: 2 for speckle and for blurred
        points, more for sharper images.
    centre_m : (float, float, float)
        Centre of the image in metres.

    See Also
    --------
    Inspection.sign : Where `inspect` reports it.
    """

    as_given: float
    conjugate: float
    centre_m: tuple[float, float, float]

    @property
    def ratio(self) -> float:
        """Sharpness with conjugate lines relative to that with the lines as given."""
        return self.conjugate / self.as_given if self.as_given else 1.0


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
            ("looks", self._looks()),
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
        return [*rows, ("sign of phase", self._sign())]

    def _looks(self) -> str:
        if self.lines.look_direction is None:
            return "unknown: the recording does not state the side"
        if self.looks:
            return f"to {self.looks}"
        mean = ", ".join(f"{each:.2f}" for each in self.lines.look_direction.mean(axis=0) + 0.0)
        return f"neither to port nor to starboard: mean direction ({mean})"

    def _sign(self) -> str:
        if self.sign is None:
            return f"undetermined: {self.sign_not_told}"
        both = f"sharpness {self.sign.as_given:.3g}, with conjugate lines {self.sign.conjugate:.3g}"
        if self.sign_not_told:
            return f"unclear, {both}: {self.sign_not_told}"
        return f"opposite, {both}" if self.sign.ratio > 1 else f"correct, {both}"


def runs(indices: Iterable[int]) -> str:
    """Return ascending indices as runs, such as "0-12, 40"; at most the first dozen runs."""
    ordered = np.unique(np.fromiter(indices, np.int64))
    breaks = [0, *(np.flatnonzero(np.diff(ordered) > 1) + 1).tolist(), len(ordered)]
    parts = []
    for start, stop in pairwise(breaks):
        first, last = ordered[start], ordered[stop - 1]
        parts.append(f"{first}" if first == last else f"{first}-{last}")
    rest = len(parts) - _MOST_RUNS
    return ", ".join(parts[:_MOST_RUNS]) + (f" and {rest} more runs" if rest > 0 else "")


def _span(low_m: float, high_m: float) -> str:
    """Return "low to high" in metres or millimetres, or one value if both look alike."""
    ends = dict.fromkeys((reprs.quantity(low_m, "m"), reprs.quantity(high_m, "m")))
    return " to ".join(ends)
