"""Conversion of values to types that JSON has."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def json_able(value: Any) -> Any:
    """Return a value in JSON's types: paths as strings, infinity and NaN as null, arrays as lists.

    Arrays in the fields of a dataclass are left out, because they are data and not results.
    """
    if is_dataclass(value):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        return json_able({k: v for k, v in parts.items() if not isinstance(v, np.ndarray)})
    if isinstance(value, dict):
        return {key: json_able(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return json_able(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_able(item) for item in value]
    if isinstance(value, np.generic):
        return json_able(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
