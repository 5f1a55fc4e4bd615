"""Base of the tables in scene files, and parts of messages about tables in files."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, create_model

from clsas.engine.data.declared import (
    Choice,
    Count,
    Flag,
    Names,
    Number,
    Positions,
    Span,
    check_declared,
    declared,
    default_of,
)
from clsas.engine.data.validate import ArgumentError

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]

_TYPES: dict[type, Any] = {
    Number: float, Count: int, Flag: bool, Names: list[str], Span: Pair, Positions: list[Vector]
}  # fmt: skip
"""Type of a key in TOML, by the kind of its declaration."""

_Table = TypeVar("_Table", bound="Table")


class Table(BaseModel):
    """A table that refuses unknown keys and values of other types.

    Attributes
    ----------
    where : str
        Name of the table in the file, such as "[compress]", for messages.
    """

    model_config = ConfigDict(extra="forbid", strict=True)
    where: ClassVar[str] = ""

    def given(self) -> dict[str, Any]:
        """Return the keys that the file sets, after checking those that are declared."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        limited = {name: given[name] for name in declared(type(self)) if name in given}
        return given | check_declared(type(self), limited)

    def options(self) -> dict[str, Any]:
        """Return the keys that the file sets, for a function of the library."""
        with located(self.where):
            return self.given()


def keys_of(
    source: Callable[..., Any], *names: str, **types: Any
) -> Callable[[type[_Table]], type[_Table]]:
    """Return a decorator that gives a table the keys that a class or function declares.

    Parameters
    ----------
    source : callable
        The class or function. Defaults are its own.
    *names : str
        Keys to give, by default all that are declared.
    **types : type
        Types of keys in TOML, where the kind of the declaration does not determine it.
    """
    known = declared(source)
    if unknown := {*names, *types} - known.keys():
        raise LookupError(f"{source.__qualname__} declares no {', '.join(sorted(unknown))}")

    def decorate(table: type[_Table]) -> type[_Table]:
        fields = {}
        for name in names or known:
            what = known[name]
            kind = types.get(name) or (
                type(what.allowed[0]) if isinstance(what, Choice) else _TYPES[type(what)]
            )
            fields[name] = Annotated[kind, what], _value_if_left_out(source, name)
        made: type[_Table] = create_model(
            table.__name__, __base__=table, __doc__=table.__doc__, __module__=table.__module__,
            **fields,
        )  # type: ignore[call-overload]  # fmt: skip
        return made

    return decorate


def _value_if_left_out(source: Callable[..., Any], name: str) -> Any:
    """Return the value of a key that is left out; ... if it must be given."""
    default = default_of(source, name)
    if default is not inspect.Parameter.empty:
        return default
    return None if getattr(declared(source)[name], "default", "") else ...


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in a type such as list[_Target] | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from models_in(argument)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put a file, or a table of it such as "[sonar]", in front of the library's messages."""
    try:
        yield
    except ArgumentError as error:
        raise error.within(where) from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} {error}") from error


def closest(name: str, allowed: Sequence[str]) -> list[str]:
    """Return the allowed name that an unknown one probably stands for, if there is one."""
    without_unit = [other for other in allowed if other.startswith(f"{name}_")]
    return (without_unit or difflib.get_close_matches(name, allowed))[:1]


def suggestion(name: str, allowed: Sequence[str]) -> str:
    """Return the end of a message about an unknown name: the closest or all allowed names."""
    if close := closest(name, allowed):
        return f": did you mean {close[0]!r}?"
    return f"; allowed are {', '.join(allowed)}"
