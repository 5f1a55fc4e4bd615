"""Error terms of planning, and conditions that make plans more careful, and plans without them.

`left_out` replaces the functions and constants that predict some of them, while a plan is made.
`observed` measures how long they take, and which of them may have had an effect.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest import mock

import numpy as np


@dataclass(frozen=True)
class Term:
    """An error term, or a condition that makes plans more careful.

    Attributes
    ----------
    patches : dict of str to object
        What takes the place of functions and constants, by their names within `clsas.engine`.
        Functions map the result and the arguments of what they replace to another result.
    timed : tuple of str
        Functions that find the term; the patched ones if left out.
    code : tuple of str
        Functions and modules that exist only for it.
    inline : int
        Lines elsewhere that exist only for it, counted by hand.
    field : str
        Its field of `ErrorBudget`.
    """

    patches: dict[str, Any]
    timed: tuple[str, ...] = ()
    code: tuple[str, ...] = ()
    inline: int = 0
    field: str = ""

    @property
    def functions(self) -> tuple[str, ...]:
        """Functions that find it."""
        return self.timed or tuple(name for name, new in self.patches.items() if callable(new))

    @property
    def module(self) -> str:
        """Module in which it is predicted."""
        place = next(iter(self.code or self.timed or self.patches))
        while not inspect.ismodule(found(place)):
            place = place.rpartition(".")[0]
        return place

    @property
    def lines(self) -> int:
        """Lines of code that exist only for it, without blank ones."""
        sources = (inspect.getsource(found(name)) for name in self.code)
        return self.inline + sum(bool(line.strip()) for s in sources for line in s.splitlines())


def constant(value: object) -> Callable:
    return lambda result, *arguments: value


def zeros(result: Any, *arguments: object) -> Any:
    return 0 * result


def errors_without(field: str) -> Callable:
    """Return a function that replaces `with_range_filters`."""
    return lambda result, *_: replace(result, errors=replace(result.errors, **{field: 0.0}))


def without(**fields: Any) -> Callable:
    return lambda result, *_: replace(result, **fields)


def without_beam(result: Any, *arguments: Any) -> Any:
    """Return what `errors_of_tree` returns if weights do not change between virtual channels."""
    *before, beam_cycles, device = arguments
    original = inspect.unwrap(found("factorized.errors.errors_of_tree"))
    return original(*before, None, device) if beam_cycles else result


def without_error(result: Any, *_: object) -> Any:
    return replace(result, error=0.0) if result.error else result


TREE, LINES = "factorized.candidates.errors_of_tree", "factorized.candidates.with_range_filters"
SPACING, LEAVES = "factorized.errors.SpacingErrors", "factorized.errors.leaf_error"
TERMS = {
    "exact": Term(
        {"factorized.planner.exact_plan": lambda plan, *_: replace(
            plan, prediction=replace(plan.prediction, errors=type(plan.errors)()))},
        inline=3, field="exact",
    ),
    "range filters": Term(
        {LINES: errors_without("range_filters")}, inline=4, field="range_filters"
    ),
    "range filters: gain on shifted bands": Term(
        {"factorized.errors.uncompensated": zeros},
        code=("factorized.errors.uncompensated",), inline=2,
    ),
    "range filters: bands widened by stretch": Term(
        {"factorized.sampled.Stretch.spectrum": lambda _, stretch, spectrum: spectrum},
        ("factorized.sampled.stretch_of",),
        ("factorized.sampled.Stretch.spectrum", "signal.spectrum.Spectrum.shifted"),
    ),
    "upsampling": Term({LINES: errors_without("upsampling")}, inline=2, field="upsampling"),
    "aperture filters": Term(
        {TREE: lambda result, *_: (replace(result[0], aperture_filters=0.0), result[1])},
        (f"{SPACING}.of_stage",), inline=5, field="aperture_filters",
    ),
    "aperture filters: equal signs on sheets": Term(
        {f"{SPACING}.of_stage": without(biases=[])}, inline=12
    ),
    "spacing": Term(
        {TREE: lambda result, *_: (replace(result[0], spacing=0.0), (0.0,) * len(result[1]))},
        (f"{SPACING}.of_stage",),
        (SPACING, "factorized.errors._Line", "factorized.errors._Samples",
         "factorized.errors._line_of_track", "factorized.errors._line_along",
         "factorized.errors._line_across", "factorized.errors._directions"),
        inline=40, field="spacing",
    ),
    "spacing: weights of the beam": Term({TREE: without_beam}, inline=25),
    "leaves": Term(
        {LEAVES: zeros, "factorized.search.leaf_error": zeros},
        code=(LEAVES,), inline=5, field="leaves",
    ),
    "leaves: nearest pixels": Term({"factorized.errors._MOST_OF_MEAN": math.inf}, inline=7),
    "leaves: weights of the beam": Term(
        {"data.beam.BeamWindow.block_error": zeros,
         "factorized.errors.sine_width": constant(math.inf)},
        inline=5,
    ),
    "roots: off the mean track": Term(
        {"factorized.errors._mean_track_error": constant(0.0)},
        code=("factorized.errors._mean_track_error", "factorized.errors.phase_error",
              "factorized.errors.beam_weights", "factorized.sampled.sampled_channels"),
        inline=6, field="roots",
    ),
    "roots: weights of the beam": Term(
        {"factorized.errors.beam_weights": lambda result, *_: (result[0], result[0])},
        code=("factorized.errors.beam_weights",), inline=4,
    ),
    "roots: rounding": Term({"factorized.errors._FLOAT32": 0.0}, inline=5, field="roots"),
    "beam's edges": Term({"factorized.candidates.EDGES_SHARE": 0.0}, inline=4, field="beam_edges"),
    "phases": Term(
        {"device.kernels.phase_error": zeros},
        code=("device.kernels.phase_error", "device.kernels.phase_terms_within"),
        inline=9, field="phases",
    ),
    "half precision": Term(
        {"factorized.errors._half_rounding": zeros},
        code=("factorized.errors._half_rounding",), inline=12, field="half_precision",
    ),
    "nearest beams": Term(
        {"factorized.planner.nearest_errors": zeros},
        code=("factorized.errors.nearest_errors",), inline=6, field="nearest_beams",
    ),
    "line ends": Term(
        {"signal.ambiguity.ends_error": zeros},
        code=("signal.ambiguity.ends_error", "signal.ambiguity._ends_loudly"),
        inline=20, field="line_ends",
    ),
    "aliasing": Term(
        {"scene.measure_spectrum": lambda s, *_: replace(s, aliasing=0.0) if s.aliasing else s},
        ("signal.spectrum._aliasing",), ("signal.spectrum._aliasing",), inline=16, field="aliasing",
    ),
    "left out: relief, motion, antennas apart": Term(
        {"scene.simplify": without_error}, inline=10, field="left_out"
    ),
    "left out: refraction, and apparent antennas": Term(
        {"scene.homogeneous": without_error}, inline=20, field="left_out"
    ),
    "margin of 1 dB": Term({"factorized.errors.MARGIN_DB": 0.0}, inline=2),
    "margin: few channels": Term({"factorized.errors._FEW_CHANNELS": (0.0, 0.0)}, inline=7),
    "margin: few frequencies": Term({"signal.spectrum._FEW_FREQUENCIES": 0.0}, inline=8),
    "few resolution cells": Term(
        {"signal.ambiguity.scatter": constant(1.0)},
        ("signal.ambiguity.independent_pixels",),
        ("signal.ambiguity.scatter", "signal.ambiguity.independent_pixels"), inline=18,
    ),
    "dark images": Term(
        {"signal.ambiguity.brightness": constant(1.0)},
        code=("signal.ambiguity.brightness", "signal.ambiguity._brightness_of_groups"), inline=30,
    ),
    "coherent frequencies": Term(
        {"signal.spectrum._image_power": lambda _, lines, grid, frequency, power: power},
        code=("signal.spectrum._image_power",), inline=12,
    ),
    "beam: sweeps unevenly": Term(
        {"factorized.planner.sweeps_once": constant(True)},
        code=("factorized.planner.sweeps_once", "factorized.planner._sweeps_once"), inline=2,
    ),
    "beam: unknown directions on sheets": Term(
        {"factorized.planner._directions_unknown": constant(False)},
        code=("factorized.planner._directions_unknown",), inline=4,
    ),
    "beam: turns between channels": Term(
        {"factorized.planner._turns_between_channels": constant(False)},
        code=("factorized.planner._turns_between_channels",), inline=8,
    ),
    "beam: weak coverage, normalised": Term({"factorized.planner._LEAST_COVERED": 0.0}, inline=7),
    "beam: step across few pixels": Term(
        {"factorized.planner._LEAST_PARTIAL": 0.0}, ("factorized.planner.partly_visible_share",),
        ("factorized.planner.partly_visible_share",), inline=4,
    ),
    "beam: covers a tenth": Term(
        {"factorized.planner._LEAST_SHARE_COVERED": 0.0}, ("factorized.planner.coverage",),
        ("factorized.planner.coverage",), inline=4,
    ),
    "doubts": Term(
        {"scene.warn_before_imaging": constant(None)}, code=("signal.doubts",), inline=8
    ),
}  # fmt: skip
REST = "all but range and aperture filters"
ROWS = {name: (name,) for name in TERMS} | {
    REST: tuple(name for name in TERMS if name not in ("range filters", "aperture filters"))
}
"""Rows of the table, and the terms that each leaves out."""


def found(name: str) -> Any:
    """Return a module, class, function or constant within `clsas.engine`."""
    module, _, rest = name.partition(".")
    value: Any = importlib.import_module(f"clsas.engine.{module}")
    for part in rest.split(".") if rest else ():
        is_module = inspect.ismodule(value) and not hasattr(value, part)
        value = (
            importlib.import_module(f"{value.__name__}.{part}")
            if is_module
            else getattr(value, part)
        )
    return value


def replaced(name: str, make: Callable[[Callable], object]) -> Any:
    """Return a context in which something else takes the place of a name."""
    place, _, attribute = name.rpartition(".")
    return mock.patch.object(found(place), attribute, make(found(name)))


@contextmanager
def left_out(names: Sequence[str]) -> Iterator[None]:
    """Leave out some terms."""

    def other(new: Any, original: Any) -> Any:
        if not callable(new):
            return new

        def call(*arguments: Any, **options: Any) -> Any:
            return new(original(*arguments, **options), *arguments)

        return functools.update_wrapper(call, original)

    with ExitStack() as stack:
        for name in names:
            for target, new in TERMS[name].patches.items():
                stack.enter_context(replaced(target, partial(other, new)))
        yield


@contextmanager
def observed(seconds: dict[str, float], effective: set[str] | None = None) -> Iterator[None]:
    """Add up the processor time of the functions that find terms; those not called are absent.

    With `effective`, add the terms without which any of their functions may return something else.
    """
    effective_of: dict[str, dict[str, Callable]] = {}
    for term, each in TERMS.items():
        for name, new in each.patches.items():
            if callable(new):
                effective_of.setdefault(name, {})[term] = new
            elif effective is not None:
                effective.add(term)

    def watching(name: str, original: Callable) -> Callable:
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            result = original(*arguments, **options)
            seconds[name] = seconds.get(name, 0.0) + time.process_time() - start
            if effective is not None:
                for term, new in effective_of.get(name, {}).items():
                    other = new(result, *arguments)
                    if other is not result and not np.array_equal(other, result):
                        effective.add(term)
            return result

        return functools.update_wrapper(call, original)

    names = {name for term in TERMS.values() for name in term.functions} | effective_of.keys()
    with ExitStack() as stack:
        for name in sorted(names):
            stack.enter_context(replaced(name, partial(watching, name)))
        yield
