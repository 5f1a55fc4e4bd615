"""Requests for plans: what `clsas.plan` is asked for, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field

from clsas.aperture.filters import ALIGN_TAPS
from clsas.core import validate
from clsas.core.georeference import placed
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.planning.costs import Costs
from clsas.planning.search import MOST_STAGES, Allowed
from clsas.scene import Scene
from clsas.sonar.beam import BeamWindow

BEST_TOLERANCE_DB = -75.0
"""Tightest tolerance that may be requested: the rounding error of a factorized image in float32."""
WORST_TOLERANCE_DB = -10.0
"""Loosest tolerance that may be requested."""

TOLERANCE_DB = -50.0
"""Tolerance of images for which none is requested."""


@dataclass(frozen=True, eq=False)
class Request:
    """Arguments of `clsas.plan`, checked, with those that go together combined.

    Parameters are those of `clsas.plan`, and the same errors are raised.

    Attributes
    ----------
    lines, grid, beam, costs, full_model
        As given.
    tolerance_db : float or None
        The tolerance, also if it was given in wavelengths; None if stages were given.
    stages : sequence of (QR, QI) or None
    memory_bytes : int or None
    allowed : Allowed or None
        Filters and numbers of stages to choose from; None if the search is free.
    """

    lines: RangeLines
    grid: Grid
    tolerance_db: float | None = None
    tolerance_wavelengths: InitVar[float | None] = None
    stages: Sequence[tuple[int, int]] | None = None
    beam: BeamWindow | None = None
    memory_bytes: int | None = None
    costs: Costs | None = None
    taps: InitVar[tuple[int, int] | None] = None
    depth: InitVar[int | None] = None
    full_model: bool = False
    allowed: Allowed | None = field(init=False, default=None)

    def __post_init__(
        self,
        tolerance_wavelengths: float | None,
        taps: tuple[int, int] | None,
        depth: int | None,
    ) -> None:
        """Check every argument, and combine those that go together."""
        validate.instance("lines", self.lines, RangeLines)
        validate.instance("grid", self.grid, Grid)
        placed(self.lines, self.grid)  # raises if the georeferences differ
        if self.beam is not None:
            validate.instance("beam", self.beam, BeamWindow)
        given = [self.tolerance_db, tolerance_wavelengths, self.stages]
        if sum(value is not None for value in given) != 1:
            raise ValueError(
                "exactly one of tolerance_db, tolerance_wavelengths and stages must be given, "
                f"got {given[0]}, {given[1]} and {given[2]}"
            )
        validate.memory("grid", 8 * self.grid.size)
        self._set("tolerance_db", tolerance_in_db(self.tolerance_db, tolerance_wavelengths))
        if self.stages is not None:
            self._set("stages", _stages_within(self.stages, self.lines, self.grid))
        self._set("allowed", _allowed(taps, depth))
        if self.allowed is not None and self.stages is not None:
            raise ValueError("taps and depth go with a tolerance, not with stages")
        if self.costs is not None:
            validate.instance("costs", self.costs, Costs)
        validate.flag("full_model", self.full_model)
        if self.memory_bytes is not None:
            self._set("memory_bytes", validate.count("memory_bytes", self.memory_bytes))

    def scene(self) -> Scene:
        """Return the scene, without effects whose errors lie far below the tolerance."""
        allowed_db = None if self.full_model else self.tolerance_db
        return Scene.of(self.lines, self.grid, self.beam, allowed_db)

    def _set(self, name: str, value: object) -> None:
        """Replace an argument by its checked value."""
        object.__setattr__(self, name, value)


def checked_tolerance_db(tolerance_db: float) -> float:
    """Return a tolerance in dB; raise TypeError or ValueError if it is outside the limits."""
    return validate.number(
        "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
    )


def tolerance_in_db(
    tolerance_db: float | None, tolerance_wavelengths: float | None
) -> float | None:
    """Return the requested tolerance in dB, or None without one, after checking it."""
    if tolerance_db is not None:
        return checked_tolerance_db(tolerance_db)
    if tolerance_wavelengths is None:
        return None
    least, most = (wavelengths(each) for each in (BEST_TOLERANCE_DB, WORST_TOLERANCE_DB))
    return decibels(
        validate.number(
            "tolerance_wavelengths", tolerance_wavelengths, "wavelengths", least=least, most=most
        )
    )


def decibels(wavelengths: float) -> float:
    """Return the relative rms error of range errors spread evenly up to some wavelengths, dB."""
    return 20 * math.log10(4 * math.pi * wavelengths / math.sqrt(3))


def wavelengths(decibels: float) -> float:
    """Return the range error in wavelengths that causes a relative rms error in dB."""
    return 10 ** (decibels / 20) * math.sqrt(3) / (4 * math.pi)


def checked_pairs(stages: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return (QR, QI) of every stage; raise TypeError or ValueError if one is not allowed."""
    meaning = "a sequence of (QR, QI)"
    pairs = [
        validate.entries("stages", stage, meaning)
        for stage in validate.entries("stages", stages, meaning)
    ]
    if any(len(pair) != 2 for pair in pairs):
        raise TypeError(f"stages must be {meaning}, got {validate.shown(stages)}")
    return [
        (validate.count("QR of stages", beams), validate.count("QI of stages", divisions))
        for beams, divisions in pairs
    ]


def _stages_within(
    stages: Sequence[tuple[int, int]], lines: RangeLines, grid: Grid
) -> list[tuple[int, int]]:
    """Return (QR, QI) of every stage; raise ValueError if lines or grid do not allow them."""
    pairs = checked_pairs(stages)
    if not pairs:
        return pairs
    if not grid.is_planar:
        raise ValueError("grid must be a plane for stages")
    most_beams, most_divisions = lines.channels, max(min(grid.shape), 1)
    beams, divisions = (math.prod(numbers) for numbers in zip(*pairs, strict=True))
    if beams > most_beams or divisions > most_divisions:
        raise ValueError(
            f"stages must leave a line and a pixel: they sum {beams} of {lines.channels} lines and "
            f"divide {grid.shape[0]} x {grid.shape[1]} pixels by {divisions} along either side"
        )
    return pairs


def _allowed(taps: tuple[int, int] | None, depth: int | None) -> Allowed | None:
    """Return the requested filters and stages; None if the search is free."""
    if taps is None and depth is None:
        return None
    fields = {}
    if taps is not None:
        meaning = "two, in range and along the aperture"
        given = validate.entries("taps", taps, meaning)
        if len(given) != 2:
            raise TypeError(f"taps must be {meaning}, got {validate.shown(taps)}")
        align, aperture = (
            validate.one_of("taps", validate.count("every entry of taps", each), ALIGN_TAPS)
            for each in given
        )
        fields = {"align_taps": (align,), "aperture_taps": (aperture,)}
    if depth is not None:
        depths = range(1, MOST_STAGES + 1)
        fields["stages"] = (validate.one_of("depth", validate.count("depth", depth), depths),)
    return Allowed(**fields)
