"""Messages about mistakes in TOML files, each of which names the table and the key."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from clsas.engine.data import validate

_BARE_KEY = re.compile(r"[\w-]{1,100}", re.ASCII)
# Required kind of value for pydantic's types of errors. Other errors keep pydantic's message.
_MUST_BE = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "list_type": "a list in [...]",
    "model_type": "a table of keys",
    "string_type": "a text in quotes",
}


def explain(error: ValidationError, tables: dict[str, Any], model: type[BaseModel]) -> list[str]:
    """Return one line of text for every key that pydantic refuses.

    Parameters
    ----------
    error : ValidationError
    tables : dict
        The parsed file.
    model : type
        The pydantic model of the whole file.
    """
    lines: dict[tuple, str] = {}
    musts: dict[tuple, dict[str, None]] = {}  # dicts that serve as ordered sets
    mistyped: set[tuple] = set()
    for problem in error.errors(include_url=False):
        kind, path = problem["type"], _path_in(tables, problem["loc"])
        if kind == "missing":
            path = problem["loc"]
            lines[path] = f"missing key {path[-1]!r} in {_table(path[:-1])}"
        elif kind == "extra_forbidden":
            *parents, name = *path[:-1], str(path[-1])
            allowed = list(_model_at(model, parents).model_fields)
            mistyped |= {(*parents, guess) for guess in _close(name, allowed)}
            table = name if _BARE_KEY.fullmatch(name) else validate.shown(name)
            unknown = (
                f"key {validate.shown(name)} in {_table(parents)}"
                if parents
                else f"table [{table}]"
            )
            lines[path] = f"unknown {unknown}{suggestion(name, allowed)}"
        else:  # for a union of types, pydantic reports one error per member
            musts.setdefault(path, {})[_must_be(problem, path)] = None
            expected = " or ".join(musts[path])
            lines[path] = f"{_key(path)} must be {expected}, got {validate.shown(problem['input'])}"
    return [line for path, line in lines.items() if path not in mistyped]


def _must_be(problem: Any, path: tuple) -> str:
    if path == ("targets",):
        return "one or more tables [[targets]]"
    if "actual_length" in problem.get("ctx", {}):
        return f"a list of {problem['ctx'].get('min_length', problem['ctx'].get('max_length'))}"
    return _MUST_BE.get(problem["type"], problem["msg"])


def _path_in(tables: Any, location: Sequence[str | int]) -> tuple[str | int, ...]:
    """Return the part of pydantic's location that the file has, without members of unions."""
    for depth, part in enumerate(location):
        try:
            tables = tables[part]
        except (KeyError, IndexError, TypeError):
            return tuple(location[:depth])
    return tuple(location)


def _table(path: Sequence[str | int]) -> str:
    """Return the name of a table as in the file; repeated tables are counted from 1."""
    name = ".".join(str(part) for part in path if isinstance(part, str))
    return f"[[{name}]] number {path[-1] + 1}" if isinstance(path[-1], int) else f"[{name}]"


def _key(path: Sequence[str | int]) -> str:
    last = max(index for index, part in enumerate(path) if isinstance(part, str))
    name = f"{path[last]}" + "".join(f"[{index}]" for index in path[last + 1 :])
    return f"{_table(path[:last])} {name}" if last else name


def _model_at(model: type[BaseModel], path: Sequence[str | int]) -> type[BaseModel]:
    for part in path:
        if isinstance(part, str):
            model = next(models_in(model.model_fields[part].annotation))
    return model


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in a type such as list[_Target] | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from models_in(argument)


def _close(name: str, allowed: Sequence[str]) -> list[str]:
    without_unit = [other for other in allowed if other.startswith(f"{name}_")]
    return (without_unit or difflib.get_close_matches(name, allowed))[:1]


def suggestion(name: str, allowed: Sequence[str]) -> str:
    """Return the end of a message about an unknown name: the closest or all allowed names."""
    if close := _close(name, allowed):
        return f": did you mean {close[0]!r}?"
    return f"; allowed are {', '.join(allowed)}"
