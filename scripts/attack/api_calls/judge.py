"""The attack itself: every value for every argument of every valid call, and its outcome."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import clsas
from api_calls import data, files, imaging, maps, pictures, sonars
from api_calls.scene import Call, objects, write_files
from api_calls.scene import public as public
from api_calls.values import (
    EITHER,
    Failure,
    Result,
    Value,
    judge_error,
    judge_result,
    kind_of,
    properties,
    values_of,
)

GROUPS: dict[str, Callable[[Path], dict[str, Call]]] = {
    "data": data.data,
    "sonars": sonars.sonars,
    "imaging": imaging.imaging,
    "navigation": imaging.navigation,
    "files": files.files,
    "results": files.results,
    "pictures": pictures.pictures,
    "maps": maps.maps,
}
"""Function that returns the valid calls of each group, given a folder for their files."""

ATTACKED = (
    clsas.BeamWindow, clsas.Echoes, clsas.Georeference, clsas.Grid, clsas.Image,
    clsas.PointTargets, clsas.Pointing, clsas.Pulse, clsas.RangeLines, clsas.Replica, clsas.Seabed,
    clsas.Sonar, clsas.Track,
)  # fmt: skip
"""Classes whose properties are also read if a call returns one of their objects."""


def table(group: str, folder: Path) -> dict[str, Call]:
    """Return the valid calls of a group, by their names in `public`."""
    with _quiet():
        write_files(folder)
        return GROUPS[group](folder)


def attack(
    group: str,
    folder: Path,
    only: str = "",
    argument: str = "",
    skip: Sequence[str] = (),
    every: int = 1,
) -> Iterator[dict[str, Any]]:
    """Attack the calls of a group, and yield every call before and after it is made.

    Only names that begin with `only` are attacked, only `argument` if it is given, and none of the
    calls in `skip`. One value in `every` is tried.
    """
    found = {name: call for name, call in table(group, folder).items() if name.startswith(only)}
    others = objects(folder) if found else {}
    for name, call in found.items():
        with _quiet():
            valid = Result(call.function(**call.arguments))
        for which, given in call.arguments.items():
            if argument not in ("", which):
                continue
            values = list(values_for(call, which, given, others, folder))
            for value in values[len(name + which) % every :: every]:
                said = {"name": name, "argument": which, "label": value.label}
                if " ".join(said.values()) in skip:
                    continue
                yield said | {"done": False}
                failure = outcome(call, which, value, valid)
                yield said | {"done": True, "failure": failure}


def values_for(
    call: Call, which: str, given: Any, others: dict[str, Any], folder: Path
) -> Iterator[Value]:
    """Yield the values with which an argument is attacked, and their expected outcomes."""
    kind = _kind(call, which)
    parameter = inspect.signature(call.function).parameters.get(which)
    optional = given is None or (parameter is not None and parameter.default is None)
    for value in values_of(kind, given, others, folder):
        if value.label in call.skips.get(which, ()):
            continue
        allowed = value.label in call.accepts.get(which, ()) or (optional and value.label == "None")
        yield value._replace(expected=EITHER) if allowed else value


def arguments_of(call: Call) -> list[str]:
    """Return the names of a call's parameters, except `**options`."""
    parameters = inspect.signature(call.function).parameters.values()
    return [each.name for each in parameters if each.kind is not each.VAR_KEYWORD]


def _kind(call: Call, which: str) -> str:
    """Return the kind of an argument; windows and devices are recognised by their name."""
    by_name = {"window": "window", "device": "device"}.get(which)
    return call.kinds.get(which) or by_name or kind_of(call.arguments[which])


def outcome(call: Call, which: str, value: Value, valid: Result) -> Failure | None:
    """Return the failure of a call with one argument replaced, or None if it passes."""
    given = call.arguments[which]
    names = (which, *call.names.get(which, ()), *_parts_of(given))
    if value.expected == EITHER:  # the message may blame another of the arguments
        names += tuple(call.arguments)
    arguments = call.arguments | {which: value.value}
    with _quiet():
        try:
            result = call.function(**arguments)
        except Exception as error:
            return judge_error(error, names, value, _kind(call, which) == "path")
        return judge_result(result, valid, value, call.may_be_nan) or _properties(result)


def _parts_of(given: Any) -> tuple[str, ...]:
    """Return the names of an object's fields, which a message may name instead of the argument."""
    if type(given).__module__.startswith("clsas"):
        return tuple(getattr(type(given), "__dataclass_fields__", ()))
    return ()


def _properties(result: Any) -> Failure | None:
    """Return the failure of a property of an object that a call returned, or None."""
    if not isinstance(result, ATTACKED):
        return None
    for name, read in properties(result):
        try:
            if Result(read()).nan:
                return Failure("returns NaN", f"in the property {name}")
        except (ValueError, TypeError):
            continue  # documented, for example for the axes of points
        except Exception as error:
            return Failure("wrong exception", f"property {name}: {type(error).__name__}: {error}")
    return None


class _quiet(warnings.catch_warnings):
    """Context without warnings, which do not matter here."""

    def __enter__(self) -> Any:
        entered = super().__enter__()
        warnings.simplefilter("ignore")
        return entered
