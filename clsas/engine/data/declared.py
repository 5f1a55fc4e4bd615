"""Declarations of options: unit, limits and help of an argument, each stated once.

A field of a dataclass, or a parameter of a function, declares what it takes in its type:

    carrier_hz: Annotated[float, Number("Hz", above=0.0, help="Centre frequency.")]

Its check (`check_declared`), the option of a command that sets it (`clsas.cli.options.of`), the key
of a scene file (`clsas.files.tables.keys_of`) and its row in the documentation follow from that.

Every kind of declaration has a method `check`, which returns a value if it is allowed, and raises
`ArgumentError` otherwise. It also has a `help`: a sentence without unit, limits and default. If the
default is None, `default` says what that stands for.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, InitVar, dataclass
from functools import cache
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError

_TINY, _HUGE = 1e-6, 1e8  # limits beyond which no user comes


@dataclass(frozen=True)
class Number:
    """A number in a unit, within limits."""

    unit: str = ""
    _: KW_ONLY
    above: float | None = None
    below: float | None = None
    least: float | None = None
    most: float | None = None
    help: str = ""
    default: str = ""

    def check(self, name: str, value: float) -> float:
        """Return a value as `validate.number` does."""
        limits = {each: getattr(self, each) for each in ("above", "below", "least", "most")}
        return validate.number(name, value, self.unit, **limits)


@dataclass(frozen=True)
class Count:
    """A whole number within limits."""

    least: int = 1
    _: KW_ONLY
    most: int | None = None
    unit: str = ""
    help: str = ""
    default: str = ""

    def check(self, name: str, value: int) -> int:
        """Return a value as `validate.count` does."""
        return validate.count(name, value, least=self.least, most=self.most)


@dataclass(frozen=True)
class Choice:
    """One of several values."""

    allowed: tuple[Any, ...]
    _: KW_ONLY
    help: str = ""
    default: str = ""

    def check(self, name: str, value: Any) -> Any:
        """Return a value as `validate.one_of` does."""
        return validate.one_of(name, value, self.allowed)


@dataclass(frozen=True)
class Names:
    """One or several of the allowed names, each at most once."""

    allowed: tuple[str, ...]
    _: KW_ONLY
    help: str = ""
    default: str = ""

    def check(self, name: str, value: Any) -> tuple[str, ...]:
        """Return the names as a tuple; a single one may be given alone."""
        names = validate.named(name, value, self.allowed)
        if len(set(names)) < len(names) or not names:
            allowed = f"be one or several of {', '.join(self.allowed)}, each once"
            raise ArgumentError(name, allowed, names or "none")
        return names


@dataclass(frozen=True)
class Flag:
    """True or false."""

    help: str = ""
    _: KW_ONLY
    default: str = ""

    def check(self, name: str, value: object) -> bool:
        """Return a value as `validate.flag` does."""
        return validate.flag(name, value)


@dataclass(frozen=True)
class Span:
    """Two ascending numbers in a unit: the ends of an interval, within limits."""

    unit: str = ""
    _: KW_ONLY
    least: float = -math.inf
    most: float = math.inf
    help: str = ""
    default: str = ""

    def check(self, name: str, value: Any) -> tuple[float, float]:
        """Return the ends as floats."""
        low, high = map(float, validate.array(name, value, np.float64, (2,)))
        if not self.least <= low < high <= self.most:
            allowed = "be two ascending numbers" + (f" in {self.unit}" if self.unit else "")
            allowed += f" from {self.least:g}" if math.isfinite(self.least) else ""
            allowed += f" to {self.most:g}" if math.isfinite(self.most) else ""
            raise ArgumentError(name, allowed, (low, high))
        return low, high


@dataclass(frozen=True)
class Positions:
    """One or more positions x, y, z in a unit."""

    unit: str = "m"
    _: KW_ONLY
    help: str = ""
    default: str = ""

    def check(self, name: str, value: Any) -> NDArray[np.float64]:
        """Return the positions, float64 [positions, 3]."""
        checked_m = validate.array(name, value, np.float64, (None, 3))
        validate.number(name, float(np.abs(checked_m).max()), self.unit, most=validate.FARTHEST_M)
        return checked_m


@dataclass(frozen=True)
class Other:
    """A value of another kind, which a function checks: it gets the name and the value."""

    check: Callable[[str, Any], Any]
    _: KW_ONLY
    unit: str = ""
    help: str = ""
    default: str = ""


@dataclass(frozen=True)
class Several:
    """A sequence of values of one kind."""

    each: Number | Count | Choice | Other
    _: KW_ONLY
    help: str = ""
    default: str = ""

    @property
    def unit(self) -> str:
        """Unit of every value."""
        return getattr(self.each, "unit", "")

    def check(self, name: str, value: Any) -> tuple[Any, ...]:
        """Return the values, each checked."""
        given = validate.entries(name, value, "a sequence")
        return tuple(self.each.check(f"every entry of {name}", entry) for entry in given)


Declared = Number | Count | Choice | Names | Flag | Span | Positions | Other | Several


def declared(source: Callable[..., Any]) -> dict[str, Declared]:
    """Return what a dataclass or a function declares of its fields or parameters, by name."""
    return {name: what for name, (_, what) in _typed(source).items()}


@cache
def _typed(source: Callable[..., Any]) -> dict[str, tuple[Any, Declared]]:
    """Return type and declaration of every field or parameter that has one, by name."""
    found = {}
    source = inspect.unwrap(source)
    for owner in reversed(source.__mro__) if isinstance(source, type) else (source,):
        for name, kind in inspect.get_annotations(owner).items():
            if isinstance(kind, str):  # other types may have names that only type checkers know
                if "Annotated[" not in kind:
                    continue
                kind = eval(kind, vars(sys.modules[owner.__module__]))
            kind = kind.type if isinstance(kind, InitVar) else kind
            for each in getattr(kind, "__metadata__", ()):
                if isinstance(each, Declared):
                    found[name] = kind.__origin__, each
    return found


def default_of(source: Callable[..., Any], name: str) -> Any:
    """Return the default of a field or parameter; `inspect.Parameter.empty` if it has none."""
    return inspect.signature(source).parameters[name].default


def limits_in_words(what: Declared) -> str:
    """Return limits in words, such as "0 to 1"; "" if there are none worth a word."""
    if isinstance(what, Several):
        return limits_in_words(what.each)
    if isinstance(what, Choice | Names):
        return ", ".join(map(str, what.allowed))
    if not isinstance(what, Number | Count | Span):
        return ""
    worth = {}
    for name in ("least", "above", "below", "most"):
        limit = getattr(what, name, None)
        # Limits that only keep numbers finite, and the least count, tell users nothing.
        is_least_count = isinstance(what, Count) and name == "least" and limit == 1
        if limit is None or is_least_count or not (limit == 0 or _TINY < abs(limit) < _HUGE):
            continue
        worth[name] = f"{limit:.0f}" if limit == int(limit) else f"{limit:.3g}"
    if 0 < (getattr(what, "least", None) or 0) <= _TINY:
        worth = {"above": "0"} | worth
    if worth.keys() == {"least", "most"}:
        return f"{worth['least']} to {worth['most']}"
    if worth == {"above": "0"}:
        return ""
    words = {"least": "at least", "above": "above", "below": "below", "most": "at most"}
    return ", ".join(f"{words[name]} {limit}" for name, limit in worth.items())


def check_declared(source: Callable[..., Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of arguments that a class or function declares, checked, in their order."""
    checked = {}
    for name, value in given.items():
        kind, what = _typed(source)[name]
        left_out = value is None and type(None) in get_args(kind)
        checked[name] = None if left_out else what.check(name, value)
    return checked


def check_fields(instance: object) -> None:
    """Check the fields that a frozen dataclass declares, and replace them by what was checked."""
    given = {name: getattr(instance, name) for name in declared(type(instance))}
    for name, value in check_declared(type(instance), given).items():
        object.__setattr__(instance, name, value)
