"""Checks of user input at the point where it enters the library.

A check that fails raises one `ArgumentError`, whose parts are the argument, what is allowed, what
was given and what to do. Names of other arguments and code in messages stand in backticks, so that
the command line can put its own words in their place.
"""

from __future__ import annotations

import contextlib
import math
import operator
import os
import re
import reprlib
import sys
import warnings
from collections.abc import Iterator, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_LONGEST = 100  # characters of a value in a message
_LONGEST_LINE = 1000  # characters of a line of a message
_BARE_BREAK = re.compile(r"\n(?!  )")
# Limits on the parts of a value in a message. Longer parts and deeper lists end in "...".
_REPR = reprlib.Repr()
_REPR.maxlevel = 4
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = _REPR.maxfrozenset = 20
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 2 * _LONGEST
# Files with the memory limit of the process's control group, in versions 2 and 1 of the kernel's
# interface.
_GROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")

MOST_HZ, MOST_M_S = 1e15, 3e8
"""Largest frequency and speed of waves in a recording: those of light."""
FARTHEST_M = 1e9
"""Largest distance from antennas to pixels, and largest coordinate of a simulated point. Up to it
squares of distances stay within float32, and float64 resolves ranges to 1e-7 m."""
_MOST_COUNT = 2**63 - 1
_MOST_CYCLES = 1e10  # of phase, which float64 still resolves to 1e-6 of a cycle

# Size of allocations below which memory is not checked. Asking the system for its free memory takes
# longer than such an allocation.
_SMALL_BYTES = 1 << 20

_T = TypeVar("_T")


class ArgumentError(ValueError):
    """An argument is not what it must be.

    Parameters
    ----------
    argument : str
        Name of the argument.
    allowed : str
        What it must do or be, such as "be finite and > 0 Hz" or "have shape (3,)".
    given : str or object
        What was given: words such as "3 of 4 channels", or a value, of which the message has a
        short text.
    hint : str
        What to do about it.
    where : str
        What contains the argument: a file, a table of it, or both.
    """

    def __init__(
        self, argument: str, allowed: str, given: object = "", hint: str = "", where: str = ""
    ) -> None:
        super().__init__(argument, allowed, given, hint, where)
        self.argument = argument
        self.allowed = allowed
        self.given = given
        self.hint = hint
        self.where = where

    def __str__(self) -> str:
        """Return the message."""
        return self.sentence(self.argument, described(self.given))

    def sentence(self, argument: str, given: str) -> str:
        """Return the message in other words for the argument and what was given."""
        where = f"{self.where} " if self.where else ""
        got = f", got {given}" if given else ""
        hint = f": {self.hint}" if self.hint else ""
        return f"{where}{argument} must {self.allowed}{got}{hint}"

    def within(self, where: str) -> ArgumentError:
        """Return the same error within a file, a table or a part of one."""
        inside = f"{where} {self.where}" if self.where else where
        return type(self)(self.argument, self.allowed, self.given, self.hint, inside)


class ArgumentTypeError(ArgumentError, TypeError):
    """An argument is of another type than it must be; a TypeError, too."""


class ClsasWarning(UserWarning):
    """Warning that a result is valid but probably not the intended one."""


def warn(message: str, category: type[ClsasWarning] = ClsasWarning) -> None:
    """Issue a ClsasWarning that points to the first caller outside clsas."""
    level = 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals["__name__"].split(".")[0] == "clsas":
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)


@contextlib.contextmanager
def muted() -> Iterator[None]:
    """Issue no ClsasWarning in the block."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ClsasWarning)
        yield


def number(
    name: str,
    value: float,
    unit: str = "",
    *,
    above: float | None = None,
    below: float | None = None,
    least: float | None = None,
    most: float | None = None,
) -> float:
    """Return `value` as a finite float within limits.

    Raises
    ------
    TypeError
        If `value` is not a real number.
    ValueError
        If it is not finite, not above `above` or not below `below`, or not from `least` to `most`.
    """
    scalar: Any = value
    if getattr(value, "ndim", None) == 0 and not isinstance(value, str):
        scalar = scalar[()]
    is_real = isinstance(scalar, Real) and not isinstance(scalar, (bool, np.timedelta64))
    if not is_real or np.ma.is_masked(value):
        kind = f"number in {unit}" if unit else "number"
        raise ArgumentTypeError(name, f"be one real {kind}", shown(value))
    try:
        result = float(scalar)
    except OverflowError:  # an int or a fraction beyond float64
        result = math.inf if scalar > 0 else -math.inf
    limits = []
    if above is not None:
        limits.append(f"> {above:g}")
    if below is not None:
        limits.append(f"< {below:g}")
    if least is not None:
        limits.append(f">= {least:g}")
    if most is not None:
        limits.append(f"<= {most:g}")
    inside = (
        np.isfinite(result)
        and (above is None or result > above)
        and (below is None or result < below)
        and (least is None or result >= least)
        and (most is None or result <= most)
    )
    if not inside:
        allowed = " and ".join(["finite", *limits]) + (f" {unit}" if unit else "")
        raise ArgumentError(name, f"be {allowed}", f"{result:g}")
    return result


def positive(name: str, value: float, unit: str = "") -> float:
    """Return `value` as a finite float greater than zero; see `number`."""
    return number(name, value, unit, above=0.0)


def count(name: str, value: int, *, least: int = 1, most: int | None = None) -> int:
    """Return `value` as an int from `least` to `most`; raises TypeError or ValueError.

    The default of `most` is the largest 64-bit integer, which sizes of arrays cannot exceed.
    """
    try:
        if isinstance(value, (bool, np.bool_)) or np.ma.is_masked(value):
            raise TypeError
        result = operator.index(value)  # accepts ints of Python and NumPy, and 0-d arrays of them
    except TypeError:
        raise ArgumentTypeError(name, "be a whole number", shown(value)) from None
    if result < least:
        raise ArgumentError(name, f"be at least {least}", shown(value))
    most = _MOST_COUNT if most is None else most
    if result > most:
        raise ArgumentError(name, f"be at most {most}", shown(value))
    return result


def flag(name: str, value: object) -> bool:
    """Return `value` as a bool; raises TypeError unless it is a bool of Python or NumPy."""
    if not isinstance(value, (bool, np.bool_)):
        raise ArgumentTypeError(name, "be of type bool", type(value).__name__)
    return bool(value)


def one_of(name: str, value: object, allowed: Sequence[_T]) -> _T:
    """Return the member of `allowed` that equals `value`; raises ValueError if there is none.

    NumPy's scalars may equal Python's. A float never equals a whole number or a bool.
    """
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
        value = value.item()
    for each in allowed:
        alike = isinstance(value, type(each)) and isinstance(value, bool) is isinstance(each, bool)
        if alike and value == each:
            return each
    names = ", ".join(map(repr, allowed))
    raise ArgumentError(name, f"be one of {names}", shown(value))


def named(name: str, values: object, allowed: Sequence[str]) -> tuple[str, ...]:
    """Return one or several of the allowed names as a tuple; a single name may be given alone."""
    if isinstance(values, str):
        values = (values,)
    if not isinstance(values, Sequence):
        raise ArgumentTypeError(name, f"be one or several of {tuple(allowed)}", shown(values))
    return tuple(one_of(f"every entry of {name}", each, allowed) for each in values)


def entries(name: str, value: object, meaning: str) -> list[Any]:
    """Return the entries of a sequence or array; raises TypeError for other types and for text."""
    several = isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, (str, bytes))
    if not several or (isinstance(value, np.ndarray) and value.ndim == 0):
        raise ArgumentTypeError(name, f"be {meaning}", shown(value))
    assert isinstance(value, (Sequence, np.ndarray))
    return list(value)


def instance(name: str, value: object, *kinds: type) -> None:
    """Raise TypeError unless `value` is an instance of one of the classes `kinds`."""
    if not isinstance(value, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise ArgumentTypeError(name, f"be of type {names}", type(value).__name__)


def path(name: str, value: object) -> Path:
    """Return `value` as a Path; raises TypeError for other types, ValueError if it is empty."""
    if not isinstance(value, (str, os.PathLike)):
        raise ArgumentTypeError(name, "be a path", shown(value))
    if not os.fspath(value):
        raise ArgumentError(name, "be a path", "an empty one")
    if not isinstance(os.fspath(value), str) or "\0" in os.fspath(value):
        raise ArgumentError(name, "be a path of text without NUL", shown(value))
    return Path(os.fspath(value))


def text(name: str, value: object) -> str:
    """Return `value`; raises TypeError unless it is text, ValueError if UTF-8 cannot encode it."""
    if not isinstance(value, str):
        raise ArgumentTypeError(name, "be text", shown(value))
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ArgumentError(name, "be text of Unicode characters", ascii(value)) from None
    return str(value)


def sides(name: str, value: object) -> tuple[int, int]:
    """Return the rows and columns of a block of pixels, at least 1 each."""
    given = entries(name, value, "(rows, columns)")
    if len(given) != 2:
        raise ArgumentError(name, "be (rows, columns)", shown(value))
    rows, columns = (count(f"every side of {name}", side) for side in given)
    return rows, columns


def selection(name: str, value: object, *, ascending: bool = False) -> slice:
    """Return `value`; raises TypeError or ValueError unless it is a slice of whole numbers."""
    instance(name, value, slice)
    assert isinstance(value, slice)
    try:
        value.indices(0)
    except (TypeError, ValueError) as error:
        kind = ArgumentTypeError if isinstance(error, TypeError) else ArgumentError
        raise kind(name, "be a slice of whole numbers", shown(value)) from None
    if ascending and value.step is not None and value.step < 1:
        raise ArgumentError(name, "be a slice with a step from 1", shown(value))
    return value


def indices(name: str, value: ArrayLike, count: int, *, least: int = 0) -> NDArray[np.int64]:
    """Return `value` as whole numbers of any shape, from `least` to `count` - 1.

    Raises
    ------
    TypeError
        If the values are not whole numbers.
    ValueError
        If a value is outside its limits or masked, or the array is not regular.
    """
    try:
        given = np.asarray(value)
    except ValueError as error:
        raise ArgumentError(name, "be a regular array", hint=str(error)) from None
    if given.dtype.kind not in "iu":
        raise ArgumentTypeError(name, "be whole numbers", shown(value))
    if np.ma.is_masked(value):
        raise ArgumentError(name, "have no masked value", shown(value))
    if given.size and not (least <= given.min() and given.max() < count):
        raise ArgumentError(
            name, f"be from {least} to {count - 1}", f"{given.min()} to {given.max()}"
        )
    return given.astype(np.int64, copy=False)


def suffix(name: str, value: Path, *allowed: str) -> None:
    """Raise ValueError if a file name has the suffix of another format.

    A name without a suffix, such as `image`, is allowed.
    """
    if value.suffix and value.suffix.lower() not in allowed:
        raise ArgumentError(name, f"end in {' or '.join(allowed)}", shown(str(value)))


def function(name: str, given: object) -> None:
    """Raise TypeError unless `given` is callable or None."""
    if not (given is None or callable(given)):
        raise ArgumentTypeError(name, "be a function or None", shown(given))


def progress(given: object) -> None:
    """Raise TypeError unless `given`, a progress argument, is callable or None."""
    function("progress", given)


def described(given: object) -> str:
    """Return what was given as an error's message has it: words as they are, values shortened."""
    if isinstance(given, str):
        return given
    if isinstance(given, tuple) and given and all(isinstance(each, float) for each in given):
        return f"({', '.join(f'{each:g}' for each in given)})"
    return shown(given)


def shown(value: object) -> str:
    """Return a value as text for a message: shortened, and without control characters."""
    try:
        text = _REPR.repr(value)
    except Exception:  # an error in the __repr__ of another library must not hide the message
        text = f"<{type(value).__name__}>"
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
    return printable(text)


def printable(text: str) -> str:
    """Return a message that is safe to print on a terminal: escaped, with shortened lines.

    Line feeds are escaped as well, unless an indented line follows. A name that contains line feeds
    can therefore not imitate a message of its own.
    """
    return "\n".join(
        line if len(line) <= _LONGEST_LINE else f"{line[: _LONGEST_LINE - 3]}..."
        for line in _BARE_BREAK.sub(r"\\n", escaped(text)).split("\n")
    )


def escaped(text: str) -> str:
    """Return a text with its control characters escaped, except line feeds.

    Terminals execute control characters, and file names may contain any of them.
    """
    return "\n".join(
        line
        if line.isprintable()
        else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
        for line in text.split("\n")
    )


class Budget:
    """Memory that one call may take: what is left to this process when the call begins.

    Every allocation is checked before it is made. Allocations that stay are subtracted, so that
    their sum is checked. Nothing is refused if the system does not report its memory.
    """

    def __init__(self) -> None:
        self._left_bytes = _memory_bytes()

    def take(self, name: str, size_bytes: float, *, passing_bytes: float = 0) -> None:
        """Subtract an allocation for `name`; raise ValueError if it exceeds the memory left.

        `passing_bytes` are needed in addition, but only temporarily.
        """
        wanted = size_bytes + passing_bytes
        if not wanted <= self._left_bytes:  # also refuses NaN
            try:
                asked = f"{wanted / 2**30:.3g} GiB"
            except OverflowError:  # an int beyond float64
                asked = "more than 1e300 GiB"
            most = f"{self._left_bytes / 2**30:.3g} GiB, what is left of this machine's memory"
            raise ArgumentError(name, f"ask for at most {most}", asked)
        self._left_bytes -= size_bytes

    def give_back(self, size_bytes: float) -> None:
        """Add memory that was taken before and has been released."""
        self._left_bytes += size_bytes


def memory(name: str, size_bytes: float) -> None:
    """Raise ValueError if the argument `name` requires more memory than this process has left.

    Calls that allocate more than once use a `Budget`.
    """
    if not size_bytes <= _SMALL_BYTES:
        Budget().take(name, size_bytes)


def _memory_bytes() -> float:
    """Return the memory that this process may still take; infinite if the system reports none.

    This is the machine's memory or the limit of the process's control group, minus the memory that
    the process uses. If its address space is limited, it is at most what is left of that.
    """
    limits = [math.inf]
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", ()):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in _GROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # no such file, or the word "max"
            limits.append(int(Path(file).read_text()))
    held_bytes, addressed_bytes = _held_bytes()
    left_bytes = min(limits) - held_bytes
    with contextlib.suppress(ImportError):  # not Unix
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            left_bytes = min(left_bytes, soft - addressed_bytes)
    return max(left_bytes, 0.0)


def _held_bytes() -> tuple[int, int]:
    """Return the private memory of this process, and the size of its address space."""
    try:
        addressed, resident, shared = map(int, Path("/proc/self/statm").read_text().split()[:3])
    except (OSError, ValueError):  # not Linux
        return 0, 0
    page = os.sysconf("SC_PAGE_SIZE")
    return (resident - shared) * page, addressed * page


def phase(carrier_hz: float, sound_speed_m_s: float, farthest_m: float) -> None:
    """Raise ValueError if float64 cannot resolve the phase of the farthest range.

    `carrier_hz` and `farthest_m` may be infinite after an overflow.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        cycles = np.float64(2) * carrier_hz / sound_speed_m_s * farthest_m
    if not cycles <= _MOST_CYCLES:  # also refuses NaN
        raise ArgumentError(
            "carrier_hz",
            f"make at most {_MOST_CYCLES:g} cycles, of which float64 resolves the phase, over "
            f"{farthest_m:g} m at `sound_speed_m_s` = {sound_speed_m_s:g} m/s",
            f"{carrier_hz:g} Hz, with {cycles:.3g} cycles",
        )


def array(
    name: str,
    value: ArrayLike,
    dtype: DTypeLike,
    shape: tuple[int | None, ...] | None,
    *,
    broadcast: bool = False,
) -> NDArray:
    """Return `value` as a finite, C-contiguous, read-only array of `dtype` and `shape`.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : array_like
        The argument. Integers and other floats are converted to `dtype`, complex128 to complex64.
        The caller's array is never modified.
    dtype : dtype
        Required type. Real arrays are refused for complex types, and complex arrays for real types.
    shape : tuple of int or None, or None
        Required shape. None within the tuple allows any length of at least 1. None in place of the
        tuple allows any shape, even an empty one.
    broadcast : bool
        If True, a value of shape `shape[1:]` is repeated along the first axis.

    Raises
    ------
    TypeError
        If the values are not numbers of a kind that can be converted to `dtype`.
    ValueError
        If the shape differs, an axis is empty, a value is NaN, infinite or masked, or the largest
        value overflows or underflows in `dtype`.

    Notes
    -----
    An array that needs no conversion is not copied. The result is a read-only view of it.
    """
    dtype = np.dtype(dtype)
    try:
        given = np.asarray(value)
    except ValueError as error:
        raise ArgumentError(name, "be a regular array", hint=str(error)) from None
    except TypeError as error:  # an object whose own conversion fails
        raise ArgumentTypeError(name, "be an array of numbers", hint=str(error)) from None
    if given.dtype.kind not in ("c" if dtype.kind == "c" else "iuf"):
        wanted = "complex" if dtype.kind == "c" else "real"
        got = given.dtype if given.ndim else type(value).__name__
        hint = ""
        if name == "samples" and given.dtype.kind in "iuf":
            hint = "real samples have no phase; form the analytic signal (`clsas.compress` does)"
        raise ArgumentTypeError(name, f"be {wanted} numbers", str(got), hint)
    if np.ma.is_masked(value):
        masked = np.ma.count_masked(value)
        raise ArgumentError(name, "have no masked value", f"{masked} of {given.size}")
    if shape is None:
        shape = given.shape
    elif broadcast and given.shape == shape[1:]:
        given = np.broadcast_to(given, (shape[0] or 1, *given.shape))
    fits = given.ndim == len(shape) and all(
        have == want or (want is None and have > 0)
        for have, want in zip(given.shape, shape, strict=False)
    )
    if not fits:
        wanted = ", ".join("any" if axis is None else str(axis) for axis in shape)
        raise ArgumentError(name, f"have shape ({wanted}) and no empty axis", str(given.shape))
    if given.dtype.kind in "fc" and np.can_cast(dtype, given.dtype) and dtype != given.dtype:
        _check_narrowing(name, given, dtype)
    copied = given.dtype != dtype or not given.flags.c_contiguous
    if copied and given.size * dtype.itemsize > _SMALL_BYTES:
        memory(name, given.size * dtype.itemsize)
    with np.errstate(over="ignore", under="ignore"):
        result = np.asarray(given, dtype=dtype, order="C")  # keeps 0-d arrays as they are
    with np.errstate(over="ignore", invalid="ignore"):
        finite = np.isfinite(np.add.reduce(result, axis=None))  # or the sum overflowed
    if not finite and not np.isfinite(result).all():
        wrong = ~np.isfinite(result)
        first = [int(index) for index in np.unravel_index(int(wrong.argmax()), wrong.shape)]
        count = f"{int(wrong.sum())} NaN or infinite of {result.size} values"
        raise ArgumentError(name, "be finite", count + (f", the first at {first}" if first else ""))
    result = result.view()
    result.flags.writeable = False
    return result


def real_or_complex(
    name: str,
    value: ArrayLike,
    dtype: DTypeLike = np.complex128,
    shape: tuple[int | None, ...] | None = None,
    *,
    broadcast: bool = False,
) -> NDArray:
    """Return `value` as `array` does, of a complex type or, if it is real, of the real type."""
    try:
        given = np.asarray(value).dtype
    except (TypeError, ValueError):  # `array` refuses the value below
        given = np.dtype(dtype)
    if given.kind not in "iufc":
        raise ArgumentTypeError(name, "be real or complex numbers", str(given))
    kind = np.dtype(dtype) if given.kind == "c" else np.zeros((), dtype).real.dtype
    return array(name, value, kind, shape, broadcast=broadcast)


def _check_narrowing(name: str, given: NDArray, dtype: np.dtype) -> None:
    """Raise ValueError unless the largest value is a normal number of a narrower float type.

    Values that are small relative to the largest one may become 0.
    """
    kind = np.finfo(dtype)
    least, most = float(kind.tiny), float(kind.max)
    parts = (given.real, given.imag) if given.dtype.kind == "c" else (given,)
    ends = [f.reduce(part, axis=None) for part in parts for f in (np.fmin, np.fmax)]
    largest = float(np.max(np.abs(ends)))
    if 0 < largest < least or most < largest < math.inf:
        allowed = f"have a largest value from {least:.2g} to {most:.2g}, the range of {kind.dtype}"
        raise ArgumentError(name, allowed, f"{largest:.3g}", "scale the values")
