"""Warnings about the navigation of a recording, once it was read."""

from __future__ import annotations

import os

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.core.pings import Transmissions


def checked_positions(path: str | os.PathLike, lines: RangeLines) -> RangeLines:
    """Return the lines; warn of positions that are missing, and of pings out of order.

    Lines are returned as the file has them: many things can be looked at without a track.
    """
    pings = Transmissions.of(lines)
    if pings.count < 2:
        return lines
    if not pings.usual_step_m:
        validate.warn(
            f"{os.fspath(path)}: all {pings.count} pings have one position, so that the navigation "
            "seems to be missing; the lines are read as they are, and form no aperture"
        )
    elif (turns := pings.turns).size:
        validate.warn(
            f"{os.fspath(path)}: the track turns back {turns.size} "
            f"time{'s' * (turns.size > 1)} (first after ping {turns[0]}): pings may be out of "
            "order. They are read in the order of the file; lines.select(order) sorts them"
        )
    return lines
