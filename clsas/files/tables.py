"""Base of the tables in scene files."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model

from clsas.engine.data.declared import (
    Choice,
    Count,
    Declared,
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
    """A table that refuses unknown keys and values of other types."""

    model_config = ConfigDict(extra="forbid", strict=True)

    def given(self) -> dict[str, Any]:
        """Return the keys that the file sets, after checking those that are declared."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return given | check_declared(type(self), given)


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

    def decorate(table: type[_Table]) -> type[_Table]:
        fields = {
            name: (Annotated[types.get(name) or _type_of(what), what], _default_of(source, name))
            for name, what in declared(source).items()
            if name in (names or declared(source))
        }
        made: type[_Table] = create_model(
            table.__name__, __base__=table, __doc__=table.__doc__, __module__=table.__module__,
            **fields,
        )  # type: ignore[call-overload]  # fmt: skip
        return made

    return decorate


def _type_of(what: Declared) -> Any:
    return type(what.allowed[0]) if isinstance(what, Choice) else _TYPES[type(what)]


def _default_of(source: Callable[..., Any], name: str) -> Any:
    """Return the default of a key; ... if it must be given."""
    default = default_of(source, name)
    if default is not inspect.Parameter.empty:
        return default
    return None if getattr(declared(source)[name], "default", "") else ...


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put a file, or a table of it such as "[sonar]", in front of the library's messages."""
    try:
        yield
    except ArgumentError as error:
        raise error.within(where) from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} {error}") from None
