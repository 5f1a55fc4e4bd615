"""Results of `clsas.limits`: what a survey can resolve, and which of its limits it keeps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

from clsas.engine.data import reprs
from clsas.engine.data.reprs import Report, Table

_INDENT = "    "

LABELS = {
    "first_echo_s": "first echo",
    "last_echo_s": "last echo",
    "ping_rate_hz": "ping rate",
    "unambiguous_range_m": "unambiguous range",
    "swath_m": "swath",
    "recorded_from_m": "recorded from",
    "recorded_to_m": "recorded to",
    "sample_rate_hz": "sample rate",
    "advance_m": "distance per ping",
    "overlap": "overlap of pings",
    "speed_m_s": "speed",
    "greatest_speed_m_s": "greatest speed",
    "phase_centre_spacing_m": "phase-centre spacing",
    "doppler_bandwidth_hz": "Doppler bandwidth",
    "grating_lobe_m": "grating lobes",
    "grating_lobe_db": "grating-lobe level",
    "ping_lobe_m": "ping lobes",
    "ping_lobe_db": "ping-lobe level",
    "range_resolution_m": "range (c/2B)",
    "range_width_m": "range (-3 dB)",
    "azimuth_resolution_m": "azimuth (L/2)",
    "azimuth_width_m": "azimuth (-3 dB)",
    "aperture_m": "synthetic aperture",
    "range_pixel_m": "pixels in range",
    "azimuth_pixel_m": "pixels in azimuth",
    "array_far_field_m": "far field of the array",
    "aperture_far_field_m": "far field of the aperture",
    "phase_centre_shift_m": "phase-centre path",
    "phase_centre_error_m": "phase-centre error",
    "baseline_m": "baseline of the banks",
    "ambiguity_near_m": "height of ambiguity, near",
    "ambiguity_far_m": "height of ambiguity, far",
}
"""Words for the name of every result, in their order. The last three require several banks."""


@dataclass(frozen=True)
class Limit:
    """A result of `limits`: a number that describes a survey, and the limit that it should keep.

    Attributes
    ----------
    name : str
        Name with the unit, such as "advance_m".
    subject : str
        Heading under which the result is listed, such as "Along the track".
    label : str
        Name in words, such as "distance per ping".
    value : float
        Value in SI units or decibels.
    unit : str
        Unit of value and limit; empty for a ratio.
    limit : float or None
        Limit that the value should keep; None if there is none.
    side : str
        "most" if the value may be at most the limit, "least" if it must be at least the limit,
        empty if there is no limit.
    kept : bool or None
        True if the value keeps its limit; None if there is none.
    equation : str
        Numbers of the equations of Ødegaard (2004), in brackets.
    meaning : str
        What the number means, in one sentence.
    consequence : str
        What happens if the limit is not kept, and what to do; empty if there is no limit.

    See Also
    --------
    limits : Function that returns it, with an example.
    """

    name: str
    subject: str
    label: str
    value: float
    unit: str
    limit: float | None
    side: str
    kept: bool | None
    equation: str
    meaning: str
    consequence: str = ""

    __repr__ = reprs.of_fields


@dataclass(frozen=True)
class Limits:
    """Limits of a survey, as returned by `limits`.

    Attributes
    ----------
    results : tuple of Limit
        All results; ``limits[name]`` is the one with a name.
    missing : dict
        Names of the results that cannot be given, each with the reason.

    See Also
    --------
    limits : Function that returns it, with an example.
    """

    results: tuple[Limit, ...]
    missing: dict[str, str]

    def __repr__(self) -> str:
        """Return a summary: how many results there are, and which limits are exceeded."""
        return reprs.summary(
            self,
            f"{len(self.results)} results",
            f"limits not kept: {', '.join(self.exceeded) or 'none'}",
            f"{len(self.missing)} results missing" if self.missing else None,
        )

    def _repr_html_(self) -> str:
        headings = ("result", "value", "limit", "kept", "equation", "meaning")
        rows = [(*_cells(each), each.meaning) for each in self.results]
        return Report([Table(headings, rows, align="left"), *self._remarks()]).html()

    def __getitem__(self, name: str) -> Limit:
        """Return the result with a name; raise KeyError, with the reason, if there is none."""
        for each in self.results:
            if each.name == name:
                return each
        if name in self.missing:
            raise KeyError(f"{name}: {self.missing[name]}")
        raise KeyError(name)

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Names of the results that do not keep their limits."""
        return tuple(each.name for each in self.results if each.kept is False)

    def describe(self) -> str:
        """Return the results as text: a table, with the meaning of each number below it."""
        table = [_cells(each) for each in self.results]
        headings = ("result", "value", "limit", "kept", "equation")
        widths = [max(map(len, column)) for column in zip(headings, *table, strict=True)]
        lines = [_row(headings, widths)] if table else []
        rows = dict(zip(self.results, table, strict=True))
        for subject, group in groupby(self.results, key=lambda each: each.subject):
            lines += ["", subject]
            for each in group:
                lines += [_row(rows[each], widths), f"{_INDENT}{each.meaning}"]
        return "\n".join([*lines, "", *self._remarks()]).strip()

    def _remarks(self) -> list[str]:
        """Return which limits are not kept, and what is missing, one sentence per line."""
        checked = [each for each in self.results if each.kept is not None]
        broken = [each for each in checked if not each.kept]
        if not checked:
            lines = ["No limit could be checked."]
        elif not broken:
            lines = [f"All limits that could be checked are kept ({len(checked)})."]
        else:
            are = "is" if len(broken) == 1 else "are"
            lines = [f"{len(broken)} of {len(checked)} limits {are} not kept:"]
        for each in broken:
            lines.append(f"  {each.label}: {_excess(each)}. {each.consequence}.")
        reasons: dict[str, list[str]] = {}
        for name, reason in self.missing.items():
            reasons.setdefault(reason, []).append(LABELS[name])
        if reasons:
            lines.append("Not given:")
        lines += [f"  {', '.join(names)}: {reason}" for reason, names in reasons.items()]
        return lines


def _cells(each: Limit) -> tuple[str, ...]:
    """Return what a row of the table shows."""
    limit = "-" if each.limit is None else f"at {each.side} {shown(each.limit, each.unit)}"
    kept = {True: "yes", False: "NO", None: "-"}[each.kept]
    return each.label, shown(each.value, each.unit), limit, kept, each.equation


def _row(cells: tuple[str, ...], widths: list[int]) -> str:
    """Return a row of the table as text, indented by two spaces."""
    padded = (f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True))
    return f"  {'  '.join(padded)}".rstrip()


def _excess(each: Limit) -> str:
    """Return by how much a value misses its limit."""
    assert each.limit is not None
    if each.unit and each.limit > 0 and each.value > 0:
        ratio = each.value / each.limit
        how = f"{abs(ratio - 1):.0%} {'above' if ratio > 1 else 'below'}"
        if ratio >= 2:
            how = f"{ratio:.3g} times"
        return (
            f"{shown(each.value, each.unit)} is {how} the limit of {shown(each.limit, each.unit)}"
        )
    return f"{shown(each.value, each.unit)} is not at {each.side} {shown(each.limit, each.unit)}"


def shown(value: float, unit: str) -> str:
    """Return a value with its unit, to four significant digits."""
    if unit == "dB":
        return f"{value:.1f} dB"
    if unit == "m" and abs(value) >= 10e3:
        return f"{value / 1e3:.4g} km"
    return reprs.measured(value, unit)
