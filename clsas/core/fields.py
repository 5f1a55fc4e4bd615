"""Types of fields that are stored as JSON: their allowed values, and how they are stored.

Every number that sizes a buffer or an index is bounded, so that a damaged file cannot make a kernel
read beyond its buffers. Pydantic checks the bounds when an object is read from JSON. It is imported
only then, because forming an image does not require it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate

if TYPE_CHECKING:
    from pydantic import ConfigDict, GetCoreSchemaHandler, ValidationError
    from pydantic_core import CoreSchema

CONFIG: ConfigDict = {
    "strict": True,
    "extra": "forbid",
    "arbitrary_types_allowed": True,
    "revalidate_instances": "always",
}
"""Value of `__pydantic_config__` in dataclasses that JSON holds."""


class Constraint:
    """Annotation of the values that a field may have, in the words of pydantic's `Field`.

    Parameters
    ----------
    convert : callable, optional
        Converts a value before it is checked; raises ValueError if it cannot.
    **limits
        Keyword arguments of `Field`, such as `ge=1`.
    """

    def __init__(self, convert: Callable[[Any], Any] | None = None, **limits: Any) -> None:
        self.convert, self.limits = convert, limits

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema of the annotated type with these limits."""
        from pydantic import BeforeValidator, Field

        check = Field(**self.limits) if self.convert is None else BeforeValidator(self.convert)
        return handler.generate_schema(Annotated[kind, check])


Whole = Annotated[int, Constraint(ge=1, lt=2**31)]
Count = Annotated[int, Constraint(ge=0, lt=2**31)]
Number = Annotated[float, Constraint(lt=math.inf)]  # no NaN either, which fails every comparison
Amount = Annotated[float, Constraint(ge=0.0, lt=math.inf)]
Size = tuple[Whole, Whole]


@dataclass(frozen=True)
class StoredAs:
    """Annotation of a class that is stored in JSON as a table of its fields.

    Attributes
    ----------
    table : type
        Type with which pydantic checks the table: a dataclass with the same fields, or a dict.
    """

    table: Any

    def __get_pydantic_core_schema__(self, kind: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema: instances are accepted as they are, tables are converted."""
        from pydantic_core import core_schema

        def build(value: Any, check: Any) -> Any:
            if isinstance(value, kind):
                return value
            table = check(value)
            try:
                return kind(**(table if isinstance(table, dict) else vars(table)))
            except TypeError as error:
                raise ValueError(str(error)) from None

        return core_schema.no_info_wrap_validator_function(
            build,
            handler.generate_schema(self.table),
            serialization=core_schema.plain_serializer_function_ser_schema(_plain),
        )


def _plain(stored: Any) -> dict[str, Any] | None:
    """Return the fields of an instance as numbers, strings and lists."""
    if stored is None:
        return None
    fields = {field.name: getattr(stored, field.name) for field in dataclasses.fields(stored)}
    return {
        name: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        for name, value in fields.items()
    }


def _finite(value: Any) -> NDArray[np.float64]:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError("must be an array of numbers") from None
    if not np.isfinite(array).all():
        raise ValueError("must be an array of finite numbers")
    return array


Array = Annotated[Any, Constraint(_finite)]


def explained(error: ValidationError, values: Any) -> str:
    """Return a message for the first mistake that pydantic found in the values of a JSON text.

    The message names the field, what is allowed, and what was given.
    """
    mistake = error.errors(include_url=False)[0]
    path, here = [], values
    for part in mistake["loc"]:  # some parts are names of union members, not keys
        try:
            here = getattr(here, str(part)) if dataclasses.is_dataclass(here) else here[part]
        except (AttributeError, KeyError, IndexError, TypeError):
            continue
        path.append(part)
    where = ".".join(map(str, path)) or "it"
    if mistake["type"] in ("missing", "missing_argument"):
        return f"{where} lacks {mistake['loc'][-1]!r}"
    if mistake["type"] == "unexpected_keyword_argument":
        return f"{where} is unknown"
    if mistake["type"] == "value_error":
        return f"{where}: {mistake['msg'].removeprefix('Value error, ')}"
    given, allowed = mistake["input"], mistake["msg"].removeprefix("Input should be ")
    if mistake["type"].startswith("union_tag"):
        key = mistake["ctx"]["discriminator"].strip("'")
        where, given = f"{where}.{key}", dict(given).get(key)
        allowed = mistake["ctx"].get("expected_tags", "given")
    elif given != given:
        allowed = "a number"
    return f"{where} must be {allowed}, got {validate.shown(given)}"
