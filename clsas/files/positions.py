"""Warnings about the navigation of a recording after reading."""

from __future__ import annotations

import os

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.core.pings import Transmissions


def checked_positions(path: str | os.PathLike, lines: RangeLines) -> RangeLines:
    """Return the lines after warning of missing positions and of pings out of order.

    The lines are returned unchanged, since much can be examined without a track.
    """
    pings = Transmissions.of(lines)
    if pings.count < 2:
        return lines
    if not pings.usual_step_m:
        validate.warn(
            f"{os.fspath(path)}: all {pings.count} pings have the same position. The navigation "
            "seems to be missing; without it the lines form no aperture"
        )
    elif (turns := pings.turns).size:
        validate.warn(
            f"{os.fspath(path)}: the track turns back {turns.size} "
            f"time{'s' * (turns.size > 1)} (first after ping {turns[0]}), so pings may be out of "
            "order. They are in the order of the file; lines.select(order) sorts them"
        )
    return lines
