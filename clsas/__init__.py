"""Synthetic aperture sonar images in the time domain, exact or fast, on any OpenCL device."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clsas import plot
    from clsas.backproject import backproject
    from clsas.compress import compress
    from clsas.device import DeviceError, list_devices
    from clsas.echoes import Echoes
    from clsas.factorize import factorize
    from clsas.grid import Grid
    from clsas.image import Image
    from clsas.io import FileFormatError, load, save, to_xarray
    from clsas.lines import RangeLines
    from clsas.mosaic import Mosaic, Patch, mosaic
    from clsas.plan import Plan
    from clsas.planner import plan
    from clsas.quality import contrast, entropy, measure_point, relative_error_db
    from clsas.sampling import check_sampling
    from clsas.scene import PointTargets, Seabed
    from clsas.simulate import simulate, simulate_lines
    from clsas.sonar import Pulse, Sonar
    from clsas.store import Store
    from clsas.track import Pointing, Track, channels
    from clsas.tradeoff import Tradeoff, tradeoff
    from clsas.validate import ClsasWarning
    from clsas.wavenumber import wavenumber
    from clsas.window import BeamWindow

__version__ = "0.1.0"

__all__ = [
    "BeamWindow",
    "ClsasWarning",
    "DeviceError",
    "Echoes",
    "FileFormatError",
    "Grid",
    "Image",
    "Mosaic",
    "Patch",
    "Plan",
    "PointTargets",
    "Pointing",
    "Pulse",
    "RangeLines",
    "Seabed",
    "Sonar",
    "Store",
    "Track",
    "Tradeoff",
    "backproject",
    "channels",
    "check_sampling",
    "compress",
    "contrast",
    "entropy",
    "factorize",
    "list_devices",
    "load",
    "measure_point",
    "mosaic",
    "plan",
    "plot",
    "relative_error_db",
    "save",
    "simulate",
    "simulate_lines",
    "to_xarray",
    "tradeoff",
    "wavenumber",
]

_MODULES = {
    "backproject": "backproject",
    "compress": "compress",
    "device": "DeviceError list_devices",
    "echoes": "Echoes",
    "factorize": "factorize",
    "grid": "Grid",
    "image": "Image",
    "io": "FileFormatError load save to_xarray",
    "lines": "RangeLines",
    "mosaic": "Mosaic Patch mosaic",
    "plan": "Plan",
    "planner": "plan",
    "quality": "contrast entropy measure_point relative_error_db",
    "sampling": "check_sampling",
    "scene": "PointTargets Seabed",
    "simulate": "simulate simulate_lines",
    "sonar": "Pulse Sonar",
    "store": "Store",
    "track": "Pointing Track channels",
    "tradeoff": "Tradeoff tradeoff",
    "validate": "ClsasWarning",
    "wavenumber": "wavenumber",
    "window": "BeamWindow",
}
"""Public names of each module. A module is imported when one of its names is first used."""

_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


class _Package(ModuleType):
    """A package whose functions stay visible when modules of their names are imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system binds every imported submodule to the package: clsas.plan, a module,
        # would hide clsas.plan, the function.
        if not (name in _MODULE_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "plot":
        return importlib.import_module("clsas.plot")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'clsas' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"clsas.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
