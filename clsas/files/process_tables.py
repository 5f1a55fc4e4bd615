"""Table `[process]` of scene files: steps from a recording to a focused image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError, Choice, Count, Number
from clsas.engine.factorized.planner import TOLERANCE
from clsas.files.tables import Table, Vector, located
from clsas.interferometry.checks import (
    checked_coherence,
    checked_known_sd,
    checked_level,
    checked_points,
    checked_search,
)
from clsas.interferometry.pair_errors_result import UNKNOWNS as OF_PAIRS
from clsas.navigation.autofocus import UNKNOWNS as FOCUSED
from clsas.navigation.checks import checked_unknowns
from clsas.navigation.known_points import UNKNOWNS as CALIBRATED
from clsas.navigation.micronavigation import UNKNOWNS as NAVIGATED

STEPS = (
    "inspect", "calibrate", "navigate", "focus", "pair_errors", "image", "heights", "mosaic"
)  # fmt: skip
"""Steps of `clsas process`, in the order in which they run."""

CORRECTIONS = ("calibrate", "navigate", "focus", "pair_errors")
"""Steps that correct the lines."""

_USUAL = ("inspect", "image")
_OPTIONAL = (*CORRECTIONS, "heights")  # by default they run if their table exists
_REQUIRED = {  # tables without which a step cannot run, each with a key that it must have
    "calibrate": {"calibrate": "`points_m`"},
    "pair_errors": {"pair_errors": "`known_height_m` or `points_m`", "heights": "`search_m`"},
    "heights": {"heights": "`search_m`"},
}
_METRES = Number("m", above=0.0)
_Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Calibrate(Table):
    points_m: list[Vector]
    unknowns: list[str] | None = None
    search_m: Annotated[float | None, _METRES] = None

    def build(self) -> dict[str, Any]:
        with located("[process.calibrate]"):
            options = self.given()
            options["points_m"] = validate.array("points_m", self.points_m, np.float64, (None, 3))
            _check_unknowns(options, CALIBRATED)
        return options


class _Navigate(Table):
    range_m: _Pair | None = None
    window_m: Annotated[float | None, _METRES] = None
    side: Annotated[str, Choice(("port", "starboard"))] = "port"
    seabed_z_m: Annotated[float | None, Number("m")] = None
    element_length_m: Annotated[float | None, _METRES] = None
    sway_sd_m: Annotated[float, _METRES] = 0.1
    yaw_sd_deg: Annotated[float, Number("degrees", above=0.0)] = 1.0
    surge_sd_m: Annotated[float, _METRES] = 0.1
    correlation_pings: Annotated[float | None, Number("pings", above=0.0)] = None
    unknowns: list[str] | None = None
    most_step_m: Annotated[float, _METRES] = 0.1

    def build(self) -> dict[str, Any]:
        with located("[process.navigate]"):
            options = self.given()
            _check_unknowns(options, NAVIGATED)
            if self.range_m is not None:
                near, far = self.range_m
                if not 0 <= near < far:
                    got = validate.shown(self.range_m)
                    raise ArgumentError("range_m", "be [near, far], ascending", got)
                options["range_m"] = near, far
        if "yaw_sd_deg" in options:
            options["yaw_sd_rad"] = math.radians(options.pop("yaw_sd_deg"))
        return options


class _Focus(Table):
    unknowns: list[str] | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        with located("[process.focus]"):
            _check_unknowns(options, FOCUSED)
        return options


class _PairErrors(Table):
    known_height_m: float | None = None
    points_m: list[Vector] | None = None
    known_sd_m: float | None = None
    unknowns: list[str] | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        with located("[process.pair_errors]"):
            names = [name for name in ("known_height_m", "points_m") if name in options]
            if len(names) != 1:
                got = " and ".join(f"`{name}`" for name in names) or "neither"
                raise ArgumentError("known_height_m", "be given, or `points_m`, and only one", got)
            if self.known_height_m is not None:
                checked_level(self.known_height_m)
            if self.points_m is not None:
                options["points_m"] = checked_points(self.points_m)
            if self.known_sd_m is not None:
                checked_known_sd(self.known_sd_m)
            _check_unknowns(options, OF_PAIRS)
        return options


class _Heights(Table):
    search_m: _Pair
    window_m: Annotated[float | None, _METRES] = None
    least_coherence: float | None = None
    tolerance_db: Annotated[float | None, TOLERANCE] = None
    patch_m: Annotated[float | None, _METRES] = None
    store: str | None = None

    def build(self, folder: Path) -> dict[str, Any]:
        with located("[process.heights]"):
            options = self.given()
            options["search_m"] = checked_search(self.search_m)
            if self.store is not None:
                validate.suffix("store", Path(self.store), ".zarr")
                options["store"] = folder / self.store
            if self.least_coherence is not None:
                checked_coherence(self.least_coherence)
        return options


class ProcessTable(Table):
    """`[process]`."""

    lines: str | None = None
    output: str | None = None
    steps: list[str] | None = None
    bank: Annotated[int | None, Count(0)] = None
    calibrate: _Calibrate | None = None
    navigate: _Navigate | None = None
    focus: _Focus | None = None
    pair_errors: _PairErrors | None = None
    heights: _Heights | None = None

    def build(self, folder: Path) -> dict[str, Any]:
        """Return paths, steps and the options of every step. Paths are relative to `folder`."""
        with located("[process]"):
            options = self.given()
            for name in ("lines", "output"):
                if name in options:
                    options[name] = folder / validate.path(name, options[name])
        for name in _OPTIONAL:
            if (table := getattr(self, name)) is not None:
                options[name] = table.build(folder) if name == "heights" else table.build()
        if self.steps is None and self.pair_errors is not None and self.heights is None:
            allowed = "be given with `search_m` for [process.pair_errors]"
            raise ArgumentError("[process.heights]", allowed)
        with located("[process]"):
            if self.steps is not None:
                options["steps"] = checked_steps(self.steps, options)
        return options


def checked_steps(steps: Sequence[str] | None, options: dict[str, Any]) -> tuple[str, ...]:
    """Return steps in order; by default the usual ones and those that have options.

    Raises
    ------
    TypeError, ValueError
        If a step is unknown, none is given, or one lacks an option that it requires.
    """
    if steps is None:
        chosen = {*_USUAL, *(name for name in _OPTIONAL if name in options)}
    else:
        chosen = set(validate.named("steps", steps, STEPS))
    if not chosen:
        raise ArgumentError("steps", f"name at least one of {STEPS}", "none")
    for name, tables in _REQUIRED.items():
        for table, key in tables.items():
            if name in chosen and table not in options:
                allowed = f"not include {name!r} without {key} in [process.{table}]"
                raise ArgumentError("steps", allowed)
    return tuple(name for name in STEPS if name in chosen)


def _check_unknowns(options: dict[str, Any], allowed: tuple[str, ...]) -> None:
    if "unknowns" in options:
        options["unknowns"] = checked_unknowns(options["unknowns"], allowed)
