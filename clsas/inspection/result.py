"""Results of `clsas.inspect`: a recording in numbers, and what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clsas.core import reprs
from clsas.core.lines import RangeLines
from clsas.core.tables import Report, Table
from clsas.sonar.sampling import Finding

_MOST_RUNS = 12  # of indices that are written out


@dataclass(frozen=True, eq=False)
class PhaseSign:
    """Sharpness of a patch of the lines as they are, and of their conjugates.

    Attributes
    ----------
    as_given, conjugate : float
        Mean squared intensity along the track over the squared mean: 2 for speckle and for blurred
        points, the more the sharper.
    centre_m : tuple of three floats
        Middle of the patch.
    """

    as_given: float
    conjugate: float
    centre_m: tuple[float, float, float]

    @property
    def ratio(self) -> float:
        """Sharpness of the conjugates over that of the lines as they are."""
        return self.conjugate / self.as_given if self.as_given else 1.0


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording in numbers, and what is wrong with it; made by `inspect`.

    Attributes
    ----------
    lines : RangeLines
        The lines inspected; those of echoes after compression.
    geometry : str
        "monostatic", "bistatic" or "array".
    channels, pings : int
        A ping ends where the transmitter moves, or its first receiver's position comes again.
    receivers : tuple of int
        Fewest and most channels of a ping.
    track_m : float
        Distance travelled, from ping to ping.
    advance_m : float
        Median advance of a ping while the platform moves; 0 if it never does.
    depths_m : tuple of float
        Lowest and highest z of the phase centres.
    speed_m_s : float or None
        Median speed of the receivers; None if the lines have no velocities. Lines have no times.
    carrier_hz : float
        Frequency that was mixed out; 0 if lines still have their carrier.
    band_hz : tuple of float
        Lower and upper end of the occupied band, measured.
    oversampling : float
        Sample rate over the width of that band.
    wavelength_m : float
        Wavelength at the mean frequency of the band: at its middle, unless the band reaches below
        0 Hz.
    length : int
        Samples per channel.
    range_step_m : float
        Range between samples.
    first_range_m, last_range_m : tuple of float
        Least and largest range of the first and of the last samples.
    sign : PhaseSign or None
        Sharpest patch imaged both ways; None if none could be imaged.
    sign_not_told : str
        Why the sign of the phase is not told; "" if it is.
    findings : tuple of Finding
        What is wrong, each with its number and what to do.
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
        """Return the finding of a name; raises KeyError if there is none."""
        return {finding.name: finding for finding in self.findings}[name]

    def __contains__(self, name: str) -> bool:
        """Return whether there is a finding of a name."""
        return any(finding.name == name for finding in self.findings)

    @property
    def unambiguous_deg(self) -> float:
        """Angle from broadside, degrees, to which the usual advance keeps grating lobes out.

        For one receiver per ping: sin(angle) = wavelength/(4 advance).
        """
        sine = self.wavelength_m / (4 * self.advance_m) if self.advance_m else math.inf
        return math.degrees(math.asin(min(sine, 1.0)))

    def describe(self) -> str:
        """Return a table of the recording, and the findings."""
        return self._report().text()

    def _report(self) -> Report:
        table = Table(("quantity", "value"), self._rows(), align="left")
        if not self.findings:
            return Report([table, "Nothing found that is wrong."])
        lines = []
        for number, finding in enumerate(self.findings, start=1):
            lines.append(f"{number}. {finding.name}: {finding.message}")
            if finding.where:
                lines.append(f"   Which: {runs(finding.where)}")
            lines.append(f"   Do: {finding.remedy}")
        return Report([table, "Findings:", *lines])

    def _rows(self) -> list[tuple[str, str]]:
        fewest, most = self.receivers
        several = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        array = f", {several} receivers per ping" if most > 1 else ""
        low_hz, high_hz = self.band_hz
        middle_hz = (low_hz + high_hz) / 2
        rows = [
            ("channels", f"{self.channels} in {self.pings} pings"),
            ("geometry", f"{self.geometry}{array}"),
            (
                "track",
                f"{reprs.quantity(_rounded(self.track_m), 'm')} long, "
                f"{reprs.quantity(_rounded(self.advance_m), 'm')} per ping",
            ),
            ("depth (z)", _span(*self.depths_m)),
            (
                "speed",
                "not known: lines have no times"
                if self.speed_m_s is None
                else reprs.quantity(_rounded(self.speed_m_s), "m/s"),
            ),
            (
                "carrier",
                reprs.quantity(self.carrier_hz, "Hz")
                if self.carrier_hz
                else "0, the lines still have it",
            ),
            (
                "band found",
                f"{reprs.quantity(_rounded(high_hz - low_hz), 'Hz')} about "
                f"{reprs.quantity(_rounded(middle_hz), 'Hz')}, wavelength "
                f"{reprs.quantity(_rounded(self.wavelength_m), 'm')}",
            ),
            ("oversampling found", f"{self.oversampling:.3g}"),
            (
                "samples",
                f"{self.length} per line, {reprs.quantity(_rounded(self.range_step_m), 'm')} "
                f"apart: {reprs.quantity(_rounded((self.length - 1) * self.range_step_m), 'm')}",
            ),
            ("first range", _span(*self.first_range_m)),
            ("last range", _span(*self.last_range_m)),
        ]
        if most == 1 and self.advance_m:
            angle = f"no grating lobes within {self.unambiguous_deg:.3g} degrees of broadside"
            rows.append(
                ("spacing", f"{self.advance_m / self.wavelength_m:.3g} wavelengths: {angle}")
            )
        rows.append(("sign of phase", self._sign()))
        return rows

    def _sign(self) -> str:
        if self.sign is None:
            return f"not told: {self.sign_not_told}"
        both = f"sharpness {self.sign.as_given:.3g}, of the conjugate {self.sign.conjugate:.3g}"
        if self.sign_not_told:
            return f"not clear, {both}: {self.sign_not_told}"
        return f"opposite, {both}" if self.sign.ratio > 1 else f"as it should be, {both}"


def runs(indices: Iterable[int]) -> str:
    """Return ascending indices as runs: "0-12, 40"; the first dozen of them."""
    ordered = np.unique(np.fromiter(indices, np.int64))
    breaks = [0, *(np.flatnonzero(np.diff(ordered) > 1) + 1).tolist(), len(ordered)]
    parts = []
    for start, stop in pairwise(breaks):
        first, last = ordered[start], ordered[stop - 1]
        parts.append(f"{first}" if first == last else f"{first}-{last}")
    rest = len(parts) - _MOST_RUNS
    return ", ".join(parts[:_MOST_RUNS]) + (f" and {rest} more runs" if rest > 0 else "")


def _span(low_m: float, high_m: float) -> str:
    """Return "low to high" in metres or millimetres; one value if both look alike."""
    ends = dict.fromkeys((reprs.quantity(low_m, "m"), reprs.quantity(high_m, "m")))
    return " to ".join(ends)


def _rounded(value: float) -> float:
    """Return a measured value to four digits."""
    return float(f"{value:.4g}")
