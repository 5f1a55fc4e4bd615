"""Base of the tables in scene files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Table(BaseModel):
    """A table that refuses unknown keys and values of other types."""

    model_config = ConfigDict(extra="forbid", strict=True)

    def given(self) -> dict[str, Any]:
        """Return the keys that the file sets, after checking those that declare limits."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return given | validate.check_declared(type(self), given)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put a file, or a table of it such as "[sonar]", in front of the library's messages."""
    try:
        yield
    except ArgumentError as error:
        raise error.within(where) from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} {error}") from None
