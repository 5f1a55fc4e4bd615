"""Tables of corrected tracks, as CSV for other programs."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from clsas.navigation.autofocus import Autofocus
from clsas.navigation.micronavigation import Micronavigation


def csv_of_track(found: Micronavigation | Autofocus) -> str:
    """Return the corrected track, with the corrections and their standard deviations, as CSV."""
    at_m = found.lines.ping_centres_m
    columns: dict[str, Any] = {"ping": np.arange(len(at_m))}
    columns |= {f"{name}_m": at_m[:, axis] for axis, name in enumerate("xyz")}
    if isinstance(found, Micronavigation):
        columns["heading_rad"] = found.track.yaw_rad
        for name in (
            "sway_m",
            "sway_sd_m",
            "shape_sd_m",
            "yaw_rad",
            "yaw_sd_rad",
            "surge_m",
            "surge_sd_m",
        ):
            columns[name] = getattr(found, name)
    else:
        starts = found.lines.ping_starts
        for axis, name in enumerate("xyz"):
            columns[f"correction_{name}_m"] = found.correction_m[starts, axis]
        columns["correction_sd_m"] = found.correction_sd_m[starts]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(
        [f"{value:.9g}" for value in row] for row in zip(*columns.values(), strict=True)
    )
    return text.getvalue()
