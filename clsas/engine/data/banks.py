"""Banks of receivers: rows at different heights, each of which forms an image of its own.

Two banks see the seabed from slightly different elevations, so the phase between their images shows
its height. `bank_numbers` has the bank of every receiver or channel, counted from 0; None stands
for a single bank.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate

if TYPE_CHECKING:
    from clsas.engine.data.lines import RangeLines

MOST_BANKS = 1000
"""Largest number of banks, far more than any sonar has: a plain choice."""

REMEDY = "lines.bank(0) has the lines of the first bank"


def checked_numbers(value: ArrayLike, count: int, of: str) -> NDArray[np.int64]:
    """Return bank numbers as a read-only array [count]; `of` says what has one each.

    Raises
    ------
    TypeError, ValueError
        If they are not whole numbers from 0, or not one for each.
    """
    numbers = validate.indices("bank_numbers", value, MOST_BANKS)
    if numbers.shape != (count,):
        raise ValueError(
            f"bank_numbers must be one number for each of {count} {of}, got shape {numbers.shape}"
        )
    numbers = numbers.view()
    numbers.flags.writeable = False
    return numbers


def present(numbers: NDArray[np.int64] | None) -> list[int]:
    """Return the numbers of the banks that occur, ascending."""
    return [0] if numbers is None else [int(each) for each in np.unique(numbers)]


def members(numbers: NDArray[np.int64] | None, number: int) -> slice | NDArray[np.int64]:
    """Return which receivers or channels belong to a bank, as indices.

    Raises
    ------
    TypeError, ValueError
        If `number` is not that of a bank.
    """
    number = validate.count("number", number, least=0)
    known = present(numbers)
    if number not in known:
        names = f"one of the banks {', '.join(map(str, known))}"
        if len(known) == 1:
            names = f"{known[0]}, since there is one bank"
        raise ValueError(f"number must be {names}, got {number}")
    return slice(None) if numbers is None else np.flatnonzero(numbers == number)


def first_two(numbers: NDArray[np.int64] | None) -> tuple[int, int]:
    """Return the banks from which heights are measured: the first two.

    Parameters
    ----------
    numbers : int64 [channels] or None
        Bank of each channel.

    Raises
    ------
    ValueError
        If there is only one bank.

    Warns
    -----
    ClsasWarning
        If there are more than two banks, with the two that are used.
    """
    first, *others = present(numbers)
    if not others:
        raise ValueError("must have at least 2 receiver banks (bank_numbers), got 1")
    second, *unused = others
    if unused:
        validate.warn(
            f"heights are measured from banks {first} and {second}; {_in_words(unused)} not used. "
            "To choose others, give lines.bank(n) of both"
        )
    return first, second


def _in_words(numbers: list[int]) -> str:
    if len(numbers) == 1:
        return f"bank {numbers[0]} is"
    return f"banks {', '.join(map(str, numbers[:-1]))} and {numbers[-1]} are"


def pair(lines: RangeLines) -> tuple[RangeLines, RangeLines]:
    """Return the lines of the two banks from which heights are measured; see `first_two`."""
    first, second = first_two(lines.bank_numbers)
    return lines.bank(first), lines.bank(second)


def with_bank(lines: RangeLines, number: int, bank: RangeLines) -> RangeLines:
    """Return lines in which those of a bank have other samples, ranges and receivers."""
    of_bank = members(lines.bank_numbers, number)

    def put(name: str) -> NDArray:
        values = np.array(getattr(lines, name))
        values[of_bank] = getattr(bank, name)
        return values

    return replace(
        lines, samples=put("samples"), first_range_m=put("first_range_m"), rx_m=put("rx_m")
    )


def together(lines: RangeLines) -> str | None:
    """Return what to expect of one image of several banks, or None if the lines have one bank."""
    if lines.bank_numbers is None or lines.banks == 1:
        return None
    of_bank = [lines.rx_m[lines.bank_numbers == number] for number in present(lines.bank_numbers)]
    heights_m = [float(rx_m[:, 2].mean()) for rx_m in of_bank]
    apart_m = max(heights_m) - min(heights_m)
    return (
        f"lines have {lines.banks} banks, {reprs.quantity(float(f'{apart_m:.3g}'), 'm')} apart in "
        "height. In one image of all, their echoes cancel wherever the seabed is not at the height "
        f"of the grid. {REMEDY}; dataclasses.replace(lines, bank_numbers=None) declares all "
        "channels to be one array"
    )


def warn_of_banks(lines: RangeLines) -> None:
    """Warn before one image is formed of several banks."""
    message = together(lines)
    if message is not None:
        validate.warn(message)
