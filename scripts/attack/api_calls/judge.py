"""The attack itself: every value for every argument of every valid call, and what comes of it."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import clsas
from api_calls import data, files, imaging, pictures, sonars
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
}
"""What makes the valid calls of each group; their files lie in a folder."""

ATTACKED = (
    clsas.BeamWindow, clsas.Echoes, clsas.Grid, clsas.Image, clsas.PointTargets, clsas.Pointing,
    clsas.Pulse, clsas.RangeLines, clsas.Replica, clsas.Seabed, clsas.Sonar, clsas.Track,
)  # fmt: skip
"""Classes whose properties are read too, where a call returns one of their objects."""


def table(group: str, folder: Path) -> dict[str, Call]:
    """Return the valid calls of a group by their names in `public`."""
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
    """Attack the calls of a group; yield every call before and after it is made.

    Only names that begin with `only` are attacked, only an argument if one is given, and not the
    calls of `skip`. Of the values one in `every` is taken.
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
    """Return the values to attack an argument with, and what each must come to."""
    kind = _kind(call, which)
    parameter = inspect.signature(call.function).parameters.get(which)
    optional = given is None or (parameter is not None and parameter.default is None)
    for value in values_of(kind, given, others, folder):
        if value.label in call.skips.get(which, ()):
            continue
        allowed = value.label in call.accepts.get(which, ()) or (optional and value.label == "None")
        yield value._replace(expected=EITHER) if allowed else value


def arguments_of(call: Call) -> list[str]:
    """Return the names of a call's parameters, those of `**options` aside."""
    parameters = inspect.signature(call.function).parameters.values()
    return [each.name for each in parameters if each.kind is not each.VAR_KEYWORD]


def _kind(call: Call, which: str) -> str:
    """Return the kind of an argument; windows have one name everywhere."""
    by_name = {"window": "window", "device": "device"}.get(which)
    return call.kinds.get(which) or by_name or kind_of(call.arguments[which])


def outcome(call: Call, which: str, value: Value, valid: Result) -> Failure | None:
    """Make a call with one argument replaced; return what is wrong with what comes of it."""
    given = call.arguments[which]
    names = (which, *call.names.get(which, ()), *_parts_of(given))
    if value.expected == EITHER:  # which of several arguments is wrong may be open
        names += tuple(call.arguments)
    arguments = call.arguments | {which: value.value}
    with _quiet():
        try:
            result = call.function(**arguments)
        except Exception as error:
            return judge_error(error, names, value, _kind(call, which) == "path")
        return judge_result(result, valid, value, call.may_be_nan) or _properties(result)


def _parts_of(given: Any) -> tuple[str, ...]:
    """Names of an object's own fields, which a message may name in place of the argument."""
    if type(given).__module__.startswith("clsas"):
        return tuple(getattr(type(given), "__dataclass_fields__", ()))
    return ()


def _properties(result: Any) -> Failure | None:
    """Return what is wrong with the properties of an object that a call returned."""
    if not isinstance(result, ATTACKED):
        return None
    for name, read in properties(result):
        try:
            if Result(read()).nan:
                return Failure("returns NaN", f"in the property {name}")
        except (ValueError, TypeError):
            continue  # documented, such as axes of points
        except Exception as error:
            return Failure("wrong exception", f"property {name}: {type(error).__name__}: {error}")
    return None


class _quiet(warnings.catch_warnings):
    """Without warnings, which an attack is not about."""

    def __enter__(self) -> Any:
        entered = super().__enter__()
        warnings.simplefilter("ignore")
        return entered
