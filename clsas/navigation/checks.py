"""Checks of the navigation that lines come with, before anything is corrected."""

from __future__ import annotations

import numpy as np

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.core.pings import Transmissions
from clsas.core.wavelengths import band_wavelength_m, is_about_zero
from clsas.signal.readout import Readout

_REMEDY = "lines.without_still_pings() drops them"


def mean_wavelength_m(readout: Readout) -> float:
    """Return the wavelength at the centre of the lines' band, which may hold the carrier still.

    Raises
    ------
    ValueError
        If the lines tell no wavelength.
    """
    lines, centre = readout.lines, readout.spectrum.centre
    if is_about_zero(lines, centre):
        raise ValueError(
            "carrier_hz must be that of the lines, or their samples must hold the carrier still; "
            f"got {lines.carrier_hz:g} Hz, and samples about 0 Hz"
        )
    return band_wavelength_m(lines, centre)


def check_navigation(lines: RangeLines, least_pings: int, purpose: str, *, may_stand: bool) -> None:
    """Refuse lines without a track, and warn of pings out of order.

    Parameters
    ----------
    lines : RangeLines
    least_pings : int
        Fewest pings at different places.
    purpose : str
        Name of the method, for messages.
    may_stand : bool
        True if pings may repeat the place of the one before. They are then corrected as one ping,
        with a warning; else they are refused.

    Raises
    ------
    ValueError
        If all channels lie at one place, or there are fewer pings than needed.

    Warns
    -----
    ClsasWarning
        If the track turns back between pings, or pings repeat the place of the one before.
    """
    pings = Transmissions.of(lines)
    places = len(lines.ping_starts)
    if places < least_pings:
        got = f"got {places}"
        if pings.count > places:
            got = (
                f"got {pings.count} transmissions from {places} place{'s' * (places > 1)}: "
                "positions are missing, or the platform stood still"
            )
        elif places == 1:
            got = "got one (all channels share one transmitter position)"
        raise ValueError(f"lines must hold at least {least_pings} pings for {purpose}, {got}")
    if pings.count > places:
        repeated = np.flatnonzero(~np.isin(pings.starts[:-1], lines.ping_starts))
        many = f"{len(repeated)} pings repeat" if len(repeated) > 1 else "1 ping repeats"
        words = f"{many} the position of the ping before (the first is ping {repeated[0]})"
        if not may_stand:
            raise ValueError(f"lines must hold pings at different places for {purpose}: {words}; "
                             f"{_REMEDY}")  # fmt: skip
        validate.warn(f"{words}: they are corrected as one ping with it; {_REMEDY}")
    turns = pings.turns
    if turns.size:
        validate.warn(
            f"the track turns back {turns.size} time{'s' * (turns.size > 1)} (first after ping "
            f"{turns[0]}): pings may be out of order. They are taken in the order of the lines; "
            "lines.select(order) sorts them"
        )
