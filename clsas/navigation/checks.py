"""Checks of lines and arguments before a track is corrected; band and axes of the lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import track_directions
from clsas.engine.data.geometry import unit_vectors
from clsas.engine.data.lines import RangeLines, band_wavelength_m, banks_of, is_about_zero
from clsas.engine.data.pings import Transmissions
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.interpolation import Readout

_MOST_OVERSAMPLING = 64.0  # limits the range resolution of lines that are almost constant
_REMEDY = "`lines.without_still_pings()` drops them"


def mean_wavelength_m(readout: Readout) -> float:
    """Return the wavelength at the centre of the lines' band, which may still have its carrier.

    Raises
    ------
    ValueError
        If neither `carrier_hz` nor the samples determine the wavelength.
    """
    lines, centre = readout.lines, readout.spectrum.centre
    if is_about_zero(lines, centre):
        raise ArgumentError(
            "carrier_hz",
            "be that of the lines, unless their samples still have their carrier",
            f"{lines.carrier_hz:g} Hz, and samples whose band is about 0 Hz",
        )
    return band_wavelength_m(lines, centre)


def range_cell_m(readout: Readout) -> float:
    """Return the range resolution of the lines."""
    oversampling = min(max(readout.spectrum.oversampling, 1.0), _MOST_OVERSAMPLING)
    return readout.lines.range_step_m * oversampling


def displacement_axes(lines: RangeLines, unknowns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the unit vectors of "sway", "heave" and "surge" at every ping, [unknowns, pings, 3].

    They point to port, up, and along the track.
    """
    along = track_directions(lines)[lines.ping_starts]
    sway = unit_vectors(np.cross(np.array([0.0, 0.0, 1.0]), along))
    vectors = {"sway": sway, "heave": np.cross(along, sway), "surge": along}
    return np.stack([vectors[name] for name in unknowns])


def first_bank(lines: RangeLines) -> RangeLines:
    """Return the lines of the first receiver bank, from which the track of all is estimated.

    Channels of different banks share no phase centres, and their echoes differ in phase by the
    height of the seabed. All banks are on one platform, so its displacements apply to them all.

    Raises
    ------
    ValueError
        If a ping has no channels of this bank.
    """
    number = banks_of(lines.bank_numbers)[0]
    bank = lines.bank(number)
    pings, of_bank = len(lines.ping_starts), len(bank.ping_starts)
    if of_bank != pings:
        raise ArgumentError(
            "lines",
            "have channels of every bank in every ping",
            f"some of bank {number} in only {of_bank} of {pings} pings",
            f"correct one bank alone, `lines.bank({number})`",
        )
    return bank


def check_navigation(lines: RangeLines, least_pings: int, purpose: str, *, may_stand: bool) -> None:
    """Refuse lines without a track, and warn of pings out of order.

    Parameters
    ----------
    lines : RangeLines
    least_pings : int
        Fewest pings at different positions.
    purpose : str
        Name of the method, for messages.
    may_stand : bool
        Whether pings may repeat the position of the ping before. If so, a warning says that they
        are corrected as one ping. If not, they are refused.

    Raises
    ------
    ValueError
        If all channels have one position, or there are fewer pings than needed.

    Warns
    -----
    ClsasWarning
        If the track turns back between pings, or pings repeat the position of the ping before.
    """
    pings = Transmissions.of(lines.tx_m, lines.rx_m)
    positions = len(lines.ping_starts)
    if positions < least_pings:
        got = str(positions)
        if pings.count > positions:
            got = (
                f"{pings.count} transmissions from {positions} position"
                f"{'s' * (positions > 1)}: positions are missing, or the platform stood still"
            )
        elif positions == 1:
            got = "one (all channels share one transmitter position)"
        raise ArgumentError("lines", f"have at least {least_pings} pings for {purpose}", got)
    if pings.count > positions:
        repeated = np.flatnonzero(~np.isin(pings.starts[:-1], lines.ping_starts))
        many = f"{len(repeated)} pings repeat" if len(repeated) > 1 else "1 ping repeats"
        fault = f"{many} the position of the ping before (the first is ping {repeated[0]})"
        if not may_stand:
            allowed = f"have pings at different positions for {purpose}"
            raise ArgumentError("lines", allowed, hint=f"{fault}; {_REMEDY}")
        validate.warn(f"{fault}: they are corrected as one ping with it; {_REMEDY}")
    turns = pings.turns
    if turns.size:
        validate.warn(
            f"the track turns back {turns.size} time{'s' * (turns.size > 1)} (first after ping "
            f"{turns[0]}): pings may be out of order. They are used in the order of the lines; "
            "`lines.select(order)` sorts them"
        )


def parabola_peak(before: NDArray, at: NDArray, after: NDArray) -> NDArray:
    """Return where parabolas through three samples peak, in steps from the middle sample.

    It is 0 where the samples have no maximum.
    """
    bend = before - 2 * at + after
    return np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1.0), 0.0)
