"""Warnings about a recording after reading."""

from __future__ import annotations

import os

from clsas.engine.data import validate
from clsas.engine.data.findings import warn_of
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.pings import Transmissions
from clsas.engine.signal.doubts import doubts


def checked(path: str | os.PathLike, lines: RangeLines) -> RangeLines:
    """Return the lines after warning of what cannot be right about them.

    The lines are returned unchanged, since much can be examined without a track.
    """
    warn_of(doubts(lines), f"{os.fspath(path)}: ")
    return lines


def checked_positions(path: str | os.PathLike, lines: RangeLines) -> RangeLines:
    """Return the lines of a recorder after warning of missing positions and of pings out of order.

    Its pings are in the order of time, unlike those of lines in memory.
    """
    pings = Transmissions.of(lines.tx_m, lines.rx_m)
    if pings.count < 2:
        return lines
    if not pings.usual_step_m:
        validate.warn(
            f"{os.fspath(path)}: all {pings.count} pings have the same position. The navigation "
            "seems to be missing; without it the lines form no aperture"
        )
        return lines
    checked(path, lines)
    if (turns := pings.turns).size:
        validate.warn(
            f"{os.fspath(path)}: the track turns back {turns.size} "
            f"time{'s' * (turns.size > 1)} (first after ping {turns[0]}), so pings may be out of "
            "order. They are in the order of the file; `lines.select(order)` sorts them"
        )
    return lines
