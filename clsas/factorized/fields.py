"""Types of a plan's fields: the values they may have, and how JSON holds them.

Everything that sizes a buffer or an index has bounds, so that no plan from a file makes a kernel
read what is not there. Pydantic checks them when a plan is made or read.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic import dataclasses as pydantic_dataclasses
from pydantic_core import CoreSchema, core_schema

from clsas.core import validate
from clsas.factorized.estimates import ErrorBudget, Work
from clsas.signal.interpolation import PHASES, UPSAMPLING_TAPS, Interpolator, Resampling, Upsampler
from clsas.sonar.beam import BeamWindow

CONFIG = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)

Whole = Annotated[int, Field(ge=1, lt=2**31)]
Count = Annotated[int, Field(ge=0, lt=2**31)]
Number = Annotated[float, Field(lt=math.inf)]  # no NaN either, which fails every comparison
Amount = Annotated[float, Field(ge=0.0, lt=math.inf)]
Size = tuple[Whole, Whole]


@dataclass(frozen=True)
class StoredAs:
    """Annotation of a class of another room, which JSON holds as a table of its fields.

    Attributes
    ----------
    table : type
        What pydantic checks the table with: a dataclass of the same fields, or a dict.
    """

    table: Any

    def __get_pydantic_core_schema__(self, kind: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema: instances are taken as they are, tables are built."""

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
    """Return the fields of an instance as numbers, texts and lists."""
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


_Array = Annotated[Any, BeforeValidator(_finite)]


@pydantic_dataclasses.dataclass(config=CONFIG)
class _Filter:
    taps: int
    upsampling: Annotated[float, Field(ge=1.0, lt=math.inf)]
    coefficients: _Array
    error_db: Number
    scatter_db: Number

    def __post_init__(self) -> None:
        if self.taps not in (2, 4, 6, 8):
            raise ValueError(f"taps must be 2, 4, 6 or 8, got {self.taps}")
        shape = (self.taps // 2, 2, self.taps // 2)
        if self.coefficients.shape != shape:
            got = self.coefficients.shape
            raise ValueError(f"coefficients must have the shape {shape}, got {got}")


@pydantic_dataclasses.dataclass(config=CONFIG)
class _Upsampler:
    step: Whole
    coefficients: _Array
    error_db: Number

    def __post_init__(self) -> None:
        if self.coefficients.shape not in [(PHASES, taps) for taps in UPSAMPLING_TAPS]:
            raise ValueError(
                f"coefficients must have the shape ({PHASES}, taps), with taps one of "
                f"{UPSAMPLING_TAPS}, got {self.coefficients.shape}"
            )


_Samples = Annotated[int, Field(gt=0, lt=2**30)]


@pydantic_dataclasses.dataclass(config=CONFIG)
class _Resampling:
    lead: Annotated[int, Field(ge=0, lt=2**20)]
    period: _Samples
    upsampled_period: _Samples
    shift: int
    first: Annotated[int, Field(gt=-(2**20), lt=2**20)]
    length: _Samples

    def __post_init__(self) -> None:
        if abs(self.shift) > self.period:
            raise ValueError(f"shift must be within the period {self.period}, got {self.shift}")


RangeFilter = Annotated[Interpolator, StoredAs(_Filter)]
StoredUpsampler = Annotated[Upsampler, StoredAs(_Upsampler)]
StoredResampling = Annotated[Resampling, StoredAs(_Resampling)]
StoredBeam = Annotated[BeamWindow, StoredAs(dict[str, Any])]
StoredWork = Annotated[Work, StoredAs(dict[str, Amount])]
StoredErrors = Annotated[ErrorBudget, StoredAs(dict[str, Amount])]


def explained(error: ValidationError, values: Any) -> str:
    """Return the first mistake that pydantic found in the values of a JSON text.

    It names the field, what is allowed, and what was given.
    """
    mistake = error.errors(include_url=False)[0]
    path, here = [], values
    for part in mistake["loc"]:  # which also names the members of unions
        try:
            here = here[part]
        except (KeyError, IndexError, TypeError):
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
        where, given = f"{where}.method", dict(given).get("method")
        allowed = mistake["ctx"].get("expected_tags", "given")
    elif given != given:
        allowed = "a number"
    return f"{where} must be {allowed}, got {validate.shown(given)}"
