"""Findings: problems of a survey or a recording, which are reported in a list or as warnings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from clsas.engine.data import validate


@dataclass(frozen=True)
class Finding:
    """Problem that a check found in a survey or a recording.

    Parameters
    ----------
    name : str
        Name of the check that found it, such as "along_track_spacing", "ping_rate" or
        "dead_channels".
    message : str
        Explanation, with numbers and units.
    value, limit : float
        Value found and value allowed, in SI units or decibels.
    remedy : str
        What to do about it.
    where : tuple of int
        Indices of the pings or channels concerned, from 0. The message states whether they are
        pings or channels.

    See Also
    --------
    check_sampling, inspect : Functions that return findings.
    """

    name: str
    message: str
    value: float
    limit: float
    remedy: str = ""
    where: tuple[int, ...] = ()


def warn_of(findings: Iterable[Finding], prefix: str = "") -> None:
    """Issue one ClsasWarning for each finding, with its remedy."""
    for each in findings:
        remedy = f". {each.remedy[0].upper()}{each.remedy[1:]}" if each.remedy else ""
        validate.warn(f"{prefix}{each.message}{remedy}")
