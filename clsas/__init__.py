"""Synthetic aperture sonar images in the time domain, exact or fast, on any OpenCL device."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

from clsas.engine.data.version import __version__ as __version__

# Public names stand in the stub, where type checkers look for them. The module of a name is
# imported when it is first used.
_MODULE_OF = {
    alias.name: imported.module
    for imported in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body
    if isinstance(imported, ast.ImportFrom)
    for alias in imported.names
}

__all__ = sorted(_MODULE_OF)

_EXTRAS = {
    "radar": ("read_cphd", "write_cphd"),
    "maps": ("export",),
    "mosaic": ("Mosaic", "Patch", "Store", "mosaic"),
}
"""Names whose modules need the packages of an extra when they are used, not when imported."""


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'clsas' has no attribute {name!r}")
    if (module := _MODULE_OF[name]) is None:
        return importlib.import_module(f"clsas.{name}")
    from clsas.engine.data.extras import needed

    extra = next((extra for extra, names in _EXTRAS.items() if name in names), None)
    with needed(f"clsas.{name}", extra):
        value = globals()[name] = getattr(importlib.import_module(f"clsas.{module}"), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
