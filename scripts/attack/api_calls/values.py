"""Values with which arguments are attacked, and the check of the outcomes.

Every value has an expected outcome. "refused": the value is wrong for this kind of argument, so the
call must raise. "equal": the value is equivalent to the valid one, so the result must be equal.
"either": the call may refuse the value or accept it, but the result must not contain NaN.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import re
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import clsas

REFUSED, EQUAL, EITHER = "refused", "equal", "either"
LOOSE = 3e-3  # relative difference, more than rounding to float16 causes
DEEPEST = 6  # levels of fields in a result that are compared


class Value(NamedTuple):
    """A value, its label in reports, and its expected outcome."""

    label: str
    value: Any
    expected: str
    tolerance: float = 0.0  # relative, for results that must be equal


class Foreign:
    """An object of a class that no function of clsas accepts."""

    def __repr__(self) -> str:
        """Return a name that is the same in every run."""
        return "<Foreign>"


def _function(*_: Any) -> None:
    """Accept any arguments."""


GARBAGE: dict[str, Any] = {
    "object": Foreign(),
    "class": int,
    "ellipsis": ...,
    "dict": {"a": 1},
    "set": {1, 2},
    "bytes": b"bytes",
    "str": "no such",
    "empty str": "",
    "complex": 1 + 2j,
    "function": _function,
    "module": math,
}
NUMBERS: dict[str, Any] = {
    "None": None,
    "nan": math.nan,
    "inf": math.inf,
    "-inf": -math.inf,
    "True": True,
    "np.True_": np.True_,
    "empty list": [],
    "empty array": np.zeros(0),
    "object 0-d": np.array(Foreign(), dtype=object),
    "list of None": [None],
    "list of str": ["a", "b"],
    "masked": np.ma.masked,
}


def values_of(kind: str, valid: Any, others: Mapping[str, Any], folder: Path) -> Iterator[Value]:
    """Yield the values for an argument of a given kind; `others` are objects of clsas."""
    garbage = [Value(label, value, REFUSED) for label, value in GARBAGE.items()]
    garbage += [
        Value(name, value, REFUSED)
        for name, value in others.items()
        if type(value) is not type(valid)
    ]
    yield from _KINDS[kind](valid, garbage, folder)


def _without(values: list[Value], *labels: str) -> list[Value]:
    return [each for each in values if each.label not in labels]


def _number(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    for label, value in {
        "list": [valid],
        "array": np.array([valid]),
        "pair": (valid, valid),
    }.items():
        yield Value(label, value, REFUSED)
    yield Value("object 0-d of it", np.array(valid, dtype=object), EITHER)
    yield Value("float64", np.float64(valid), EQUAL)
    yield Value("float32", np.float32(valid), EQUAL, LOOSE)
    yield Value("longdouble", np.longdouble(valid), EQUAL)
    yield Value("0-d array", np.array(float(valid)), EQUAL)
    yield Value("Fraction", Fraction(valid), EQUAL)
    if float(valid) == int(valid):
        yield Value("int", int(valid), EQUAL)
        yield Value("int64", np.int64(valid), EQUAL)
    if abs(valid) < 6e4:
        yield Value("float16", np.float16(valid), EITHER)
    for factor in (0, -1, 1e-3, 1e3, 1e12, 1e-12):
        yield Value(f"times {factor:g}", factor * float(valid), EITHER)
    for value in (1e300, -1e300, 1e-300, 5e-324, 10**400, -(10**400), 1, -1):
        yield Value(
            f"{value:.0e}" if abs(value) < 10**308 else f"{'-' * (value < 0)}10**400", value, EITHER
        )


def _count(valid: int, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    for label, value in {"list": [valid], "array": np.array([valid]), "half": valid + 0.5}.items():
        yield Value(label, value, REFUSED)
    yield Value("float", float(valid), EITHER)
    yield Value("Fraction", Fraction(valid), EITHER)
    for kind in (np.int64, np.int32, np.int8, np.uint8, np.uint64):
        if np.iinfo(kind).min <= valid <= np.iinfo(kind).max:
            yield Value(kind.__name__, kind(valid), EQUAL)
    yield Value("0-d array", np.array(valid), EQUAL)
    for value in (0, -1, -valid, 2**31, -(2**31), 2**63, 2**64, 10**30, 10**400):
        yield Value(f"{value:.3g}" if abs(value) < 1e300 else "10**400", value, EITHER)


def _bool(valid: bool, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    for label, value in NUMBERS.items():
        if not label.endswith(("True", "True_")):
            yield Value(label, value, REFUSED)
    for value in (0, 1, 2, 0.0, 1.0):
        yield Value(repr(value), value, REFUSED)
    yield Value("np.bool_", np.bool_(valid), EQUAL)
    yield Value("other", not valid, EITHER)


def _choice(valid: str, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    yield Value("list", [valid], EITHER)
    yield Value("number", 5, REFUSED)
    yield Value("upper case", valid.upper(), EITHER)
    yield Value("np.str_", np.str_(valid), EQUAL)
    yield Value("NUL", f"{valid}\0", REFUSED)


def _window(valid: str, garbage: list[Value], folder: Path) -> Iterator[Value]:
    """Yield values for windows of SciPy, which are names, numbers or tuples of both."""
    for value in _choice(valid, garbage, folder):
        yield value._replace(expected=EITHER) if value.label == "number" else value


def _text(valid: str, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from _without(garbage, "str", "empty str")
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    yield Value("number", 5, REFUSED)
    yield Value("np.str_", np.str_(valid), EQUAL)
    for text in ("", "no such", "$x^{2", "a{2}", "\x1b[2J", "\ud800"):
        yield Value(ascii(text), text, EITHER)


def _path(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from _without(garbage, "str")
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    yield Value("number", 5, REFUSED)
    yield Value("str", str(valid), EQUAL)
    yield Value("Path", Path(valid), EQUAL)
    yield Value("np.str_", np.str_(valid), EITHER)
    yield Value("NUL", f"{valid}\0", REFUSED)
    yield Value("missing folder", folder / "no" / "such" / Path(valid).name, EITHER)
    yield Value("missing", folder / f"no such{Path(valid).suffix}", EITHER)
    yield Value("folder", folder / "folder", EITHER)
    yield Value("empty file", folder / "empty", EITHER)
    yield Value("text file", folder / "text.txt", EITHER)
    yield Value("long", folder / ("x" * 5000), REFUSED)
    yield Value("below a file", folder / "text.txt" / "x", EITHER)


def _array(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    given = np.asarray(valid)
    yield from _without(garbage, "complex") if given.dtype.kind == "c" else garbage
    for label in ("None", "object 0-d", "list of None", "list of str", "masked", "empty list"):
        yield Value(label, NUMBERS[label], REFUSED)
    yield Value("empty array", given[:0], REFUSED)
    if given.dtype.kind in "fc":
        for name, bad in {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}.items():
            changed = np.array(given)
            changed.flat[changed.size // 2] = bad
            yield Value(f"one {name}", changed, REFUSED)
            yield Value(name, bad, REFUSED)
    masked = np.ma.array(given, mask=np.zeros(given.shape, bool))
    masked.mask.flat[0] = True
    yield Value("one masked", masked, REFUSED)
    yield Value("objects", np.full(given.shape, Foreign(), dtype=object), REFUSED)
    yield Value("object dtype", given.astype(object), EITHER)
    yield Value("strings", given.astype(str), REFUSED)
    yield Value("dates", np.zeros(given.shape, "M8[s]"), REFUSED)
    yield Value("ragged", [[1.0, 2.0], [3.0]], REFUSED)
    yield Value("structured", np.zeros(given.shape, [("a", "f8")]), REFUSED)
    yield Value("list", given.tolist(), EQUAL)
    yield Value("big endian", given.astype(given.dtype.newbyteorder(">")), EQUAL)
    yield Value("read only", _read_only(given), EQUAL)
    if given.ndim:
        strided = np.repeat(given, 2, axis=0)[::2]
        yield Value("strided", strided, EQUAL)
        yield Value("Fortran", np.asfortranarray(given), EQUAL)
        yield Value("one axis more", given[None], EITHER)
        yield Value("one axis less", given[0], EITHER)
        yield Value("one less", given[:-1], EITHER)
        yield Value("one more", np.concatenate([given, given[-1:]]), EITHER)
        yield Value("last axis longer", np.concatenate([given, given[..., :1]], axis=-1), EITHER)
        yield Value("transposed", given.T, EITHER)
    yield Value("bools", given.astype(bool), EITHER)
    yield Value("number", 5.0, EITHER)
    yield Value("0-d array", np.array(5.0), EITHER)
    if given.dtype.kind == "c":
        yield Value("complex128", given.astype(np.complex128), EQUAL)
        yield Value("complex64", given.astype(np.complex64), EQUAL, LOOSE)
    elif given.dtype.kind == "f":
        yield Value("float32", given.astype(np.float32), EITHER)
        yield Value("float16", given.astype(np.float16), EITHER)
        yield Value("complex array", given + 1j, REFUSED)
    for factor in (0, -1, 1e-3, 1e3, 1e12, 1e300):
        with np.errstate(all="ignore"):
            yield Value(f"times {factor:g}", np.multiply(given, factor), EITHER)


def _read_only(given: np.ndarray) -> np.ndarray:
    result = given.copy()
    result.flags.writeable = False
    return result


def _parts(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    """Yield values for tuples of numbers, counts or names, such as (start, stop, count)."""
    yield from garbage
    for label in ("None", "nan", "True", "empty list", "empty array", "masked"):
        yield Value(label, NUMBERS[label], REFUSED)
    yield Value("list", list(valid), EQUAL)
    yield Value("tuple", tuple(valid), EQUAL)
    yield Value("number", 5.5, REFUSED)
    yield Value("one less", tuple(valid)[:-1], EITHER)
    yield Value("one more", (*valid, *tuple(valid)[-1:]), EITHER)
    yield Value("nested", [valid], EITHER)
    yield Value("reversed", tuple(valid)[::-1], EITHER)
    yield Value("generator", iter(tuple(valid)), EITHER)
    if all(isinstance(each, numbers.Number) for each in valid):
        yield Value("array", np.array(valid), EITHER)
        if all(isinstance(each, int) for each in valid):
            yield Value("int array", np.array(valid), EQUAL)
            yield Value("int32s", tuple(map(np.int32, valid)), EQUAL)
    for place, part in enumerate(valid):
        if not isinstance(part, (numbers.Number, str)):
            continue
        kind = "choice" if isinstance(part, str) else kind_of(part)
        for each in _KINDS[kind](part, garbage[:6], folder):
            changed = (*valid[:place], each.value, *valid[place + 1 :])
            # In an array, NumPy converts bools to numbers and fractions to objects.
            lenient = each.label in ("True", "np.True_", "Fraction")
            expected = EITHER if lenient else each.expected
            yield Value(f"[{place}] {each.label}", changed, expected, each.tolerance)


def _instance(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    yield Value("number", 5.0, REFUSED)
    yield Value("class of it", type(valid), REFUSED)
    for label in ("None", "nan", "empty list", "empty array", "True"):
        yield Value(label, NUMBERS[label], REFUSED)
    yield Value("list of it", [valid], EITHER)


def _slice(valid: slice, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from garbage
    for label, value in NUMBERS.items():
        yield Value(label, value, REFUSED)
    for value in (slice("a"), slice(0.5), slice(None, None, 0), slice(0, 1, 1.5), slice(Foreign())):
        yield Value(str(value), value, REFUSED)
    for value in (
        5,
        slice(None),
        slice(5, 5),
        slice(None, None, -1),
        slice(10**30),
        slice(-1, None),
    ):
        yield Value(str(value), value, EITHER)
    ends = [None if end is None else np.int64(end) for end in (valid.start, valid.stop, valid.step)]
    yield Value("numpy ends", slice(*ends), EQUAL)


def _callable(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from _without(garbage, "function", "class")
    yield Value("number", 5, REFUSED)
    yield Value("nan", math.nan, REFUSED)
    yield Value("list of it", [valid], REFUSED)


def _device(valid: Any, garbage: list[Value], folder: Path) -> Iterator[Value]:
    yield from _without(garbage, "empty str")
    yield Value("empty str", "", EITHER)
    for value in (99, -1, 1.5, True, math.nan, 10**30, [[]]):
        yield Value(str(value), value, REFUSED)
    yield Value("int64", np.int64(0), EQUAL)
    yield Value("None", None, EITHER)


_KINDS: dict[str, Callable[[Any, list[Value], Path], Iterator[Value]]] = {
    "number": _number,
    "count": _count,
    "bool": _bool,
    "choice": _choice,
    "text": _text,
    "window": _window,
    "path": _path,
    "array": _array,
    "parts": _parts,
    "instance": _instance,
    "slice": _slice,
    "callable": _callable,
    "device": _device,
}


def kind_of(valid: Any) -> str:
    """Return the kind of argument that a valid value implies."""
    if isinstance(valid, bool):
        return "bool"
    if isinstance(valid, int):
        return "count"
    if isinstance(valid, float):
        return "number"
    if isinstance(valid, str):
        return "choice"
    if isinstance(valid, Path):
        return "path"
    if isinstance(valid, np.ndarray):
        return "array"
    if isinstance(valid, (tuple, list)) and not hasattr(valid, "_fields"):
        return "parts"
    if isinstance(valid, slice):
        return "slice"
    return "callable" if callable(valid) and not hasattr(valid, "kept") else "instance"


# Judgement


class Failure(NamedTuple):
    """A kind of failure, and its details."""

    kind: str
    detail: str


def judge_error(
    error: BaseException, names: tuple[str, ...], value: Value, paths: bool
) -> Failure | None:
    """Return the failure of a call that raised, or None if the exception is as expected."""
    text = str(error)
    allowed = (ValueError, TypeError, clsas.DeviceError)
    if paths and isinstance(error, OSError) and not isinstance(error, clsas.FileFormatError):
        given = str(value.value)
        named = given[:200] in f"{error.filename}{text}"  # or a missing folder in it
        named |= bool(error.filename) and given.startswith(str(error.filename))
        return None if named or _names(text, names) else Failure("names no path", _said(error))
    if not isinstance(error, allowed) or isinstance(error, (np.linalg.LinAlgError, UnicodeError)):
        return Failure("wrong exception", _said(error))
    if isinstance(error, clsas.FileFormatError) and paths:
        named = Path(value.value).name[:80] in text
        return None if named or _names(text, names) else Failure("names no path", _said(error))
    if not _names(text, names) and not (paths and Path(str(value.value)).name[:80] in text):
        return Failure("names no argument", _said(error))
    if value.expected == EQUAL:
        return Failure("refuses an equal value", _said(error))
    return None


def _names(text: str, names: tuple[str, ...]) -> bool:
    return any(
        re.search(rf"(?<![a-z_]){re.escape(form)}(?![a-z])", text, re.IGNORECASE)
        for name in names
        for form in (name, name.replace("_", " "))
    )


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error)[:160]}"


def judge_result(
    result: Any, valid: Result, value: Value, may_be_nan: bool = False
) -> Failure | None:
    """Return the failure of a call that returned, or None if the result is as expected."""
    if value.expected == REFUSED:
        return Failure("accepts a wrong value", _short(result))
    found = Result(result)
    wrong = sorted(found.nan - valid.nan)
    if wrong and not may_be_nan:
        return Failure("returns NaN", f"in {wrong[0] or 'the result'}")
    if value.expected == EQUAL:
        return found.difference(valid, value.tolerance)
    return None


def _short(result: Any) -> str:
    try:
        return f"returned {repr(result)[:80]}"
    except Exception as error:
        return f"returned {type(result).__name__}, whose repr raised {_said(error)}"


class Result:
    """All numbers in the result of a call, by their place in it."""

    def __init__(self, value: Any) -> None:
        self.numbers = dict(_walk(value))

    @cached_property
    def nan(self) -> set[str]:
        """Places with NaN."""
        return {
            place
            for place, number in self.numbers.items()
            if number.dtype.kind in "fc" and np.isnan(number).any()
        }

    def difference(self, other: Result, tolerance: float) -> Failure | None:
        """Return the first difference of two results, or None if they are equal."""
        for place, want in other.numbers.items():
            have = self.numbers.get(place)
            if have is None or have.shape != want.shape:
                return Failure("differs from the valid call", f"in {place}: another shape")
            if have.dtype != want.dtype:
                kinds = f"{have.dtype}, not {want.dtype}"
                return Failure("differs from the valid call", f"in {place}: {kinds}")
            same = np.array_equal(have, want, equal_nan=want.dtype.kind in "fc")
            if not same and not _close(have, want, tolerance):
                return Failure("differs from the valid call", f"in {place or 'the result'}")
        return None


def _close(have: np.ndarray, want: np.ndarray, tolerance: float) -> bool:
    if want.dtype.kind not in "fc":
        return tolerance > 0
    scale = float(np.nanmax(np.abs(want), initial=0.0))
    return bool(np.nanmax(np.abs(have - want), initial=0.0) <= (30 * tolerance + 1e-6) * scale)


SECONDS = re.compile(
    r"second|kept|measured|created|time$|costs|work|written|elapsed|_run|digest|version"
    r"|formed\.certificate"  # of as many pixels as a share of the image's time pays for
)
"""Fields that differ from run to run, or do not belong to the result."""


def _walk(value: Any, place: str = "", deep: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """Yield all numbers in an object, with their place in it."""
    if deep > DEEPEST or SECONDS.search(place):
        return
    if isinstance(value, (bool, int, float, complex, np.generic)):
        with np.errstate(all="ignore"):
            array = np.asarray(value)
        if array.dtype.kind in "biufc":
            yield place, array
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "biufc":
            yield place, value
    elif isinstance(value, Mapping):
        for key, each in list(value.items())[:50]:
            yield from _walk(each, f"{place}[{key!r}]", deep + 1)
    elif hasattr(value, "_fields"):
        for name in value._fields:
            yield from _walk(getattr(value, name), f"{place}.{name}", deep + 1)
    elif isinstance(value, (list, tuple)):
        for index, each in enumerate(value[:50]):
            yield from _walk(each, f"{place}[{index}]", deep + 1)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if not field.name.startswith("_"):
                yield from _walk(getattr(value, field.name), f"{place}.{field.name}", deep + 1)
    elif type(value).__module__.startswith("xarray"):
        yield from (
            (f"{place}.{name}", np.asarray(each))
            for name, each in value.coords.items()
            if np.asarray(each).dtype.kind in "biufc"
        )


def properties(value: Any) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the names of an object's public properties with functions that read them."""
    if not type(value).__module__.startswith("clsas"):
        return
    yield "repr", lambda: repr(value)
    for name in dir(type(value)):
        if not name.startswith("_") and isinstance(
            getattr(type(value), name), (property, cached_property)
        ):
            yield name, lambda name=name: getattr(value, name)
