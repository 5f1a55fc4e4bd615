"""Synthetic aperture sonar images in the time domain, exact or fast, on any OpenCL device."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clsas import plot
    from clsas.engine.data.beam import BeamWindow
    from clsas.engine.data.contrast import contrast, entropy
    from clsas.engine.data.findings import Finding
    from clsas.engine.data.georeference import Georeference
    from clsas.engine.data.grid import Grid
    from clsas.engine.data.image import Image
    from clsas.engine.data.image_error import relative_error_db
    from clsas.engine.data.lines import RangeLines
    from clsas.engine.data.sound_speed import SoundSpeed
    from clsas.engine.data.system import Pulse, Sonar
    from clsas.engine.data.track import Pointing, Track, channels
    from clsas.engine.data.validate import ArgumentError, ArgumentTypeError, ClsasWarning
    from clsas.engine.device.device import DeviceError, list_devices
    from clsas.engine.exact.wavenumber import wavenumber
    from clsas.engine.factorized.plan import Plan
    from clsas.engine.imaging import Imager, backproject, factorize, plan
    from clsas.engine.signal.band_parts import sub_bands
    from clsas.engine.signal.compression import compress
    from clsas.engine.signal.echoes import Echoes
    from clsas.engine.signal.full_matrix import from_full_matrix
    from clsas.engine.signal.phase_history import from_phase_history
    from clsas.engine.signal.replica import Replica
    from clsas.files.airsas import read_airsas
    from clsas.files.cphd import read_cphd
    from clsas.files.cphd_writing import write_cphd
    from clsas.files.formats import load, save
    from clsas.files.full_matrix import read_full_matrix
    from clsas.files.hdf5 import FileFormatError
    from clsas.files.phase_histories import read_phase_history
    from clsas.files.sound_speed_files import read_sound_speed
    from clsas.files.xarrays import to_xarray
    from clsas.inspection.inspection import inspect
    from clsas.inspection.result import Inspection, PhaseSign
    from clsas.inspection.sampling import check_sampling
    from clsas.interferometry.heights import heights
    from clsas.interferometry.interferogram import Interferogram, interferogram
    from clsas.interferometry.pair_errors import PairErrors, pair_errors
    from clsas.interferometry.result import Heights
    from clsas.maps.exporting import export
    from clsas.measures.assessment import assess, survey_lines
    from clsas.measures.assessment_result import Assessment, Effect
    from clsas.measures.certificate import Certificate, certify
    from clsas.measures.density import density_compensated, density_weights
    from clsas.measures.limits_result import Limit, Limits
    from clsas.measures.looks import multilook
    from clsas.measures.quality import measure_point
    from clsas.measures.survey_limits import limits
    from clsas.measures.tradeoff import tradeoff
    from clsas.measures.tradeoff_result import Tradeoff
    from clsas.mosaics.height_mosaic import mosaic_heights
    from clsas.mosaics.mosaic import Mosaic, Patch, mosaic
    from clsas.mosaics.store import Store
    from clsas.navigation.autofocus import Autofocus, autofocus
    from clsas.navigation.known_points import Calibration, calibrate_track
    from clsas.navigation.micronavigation import Micronavigation, micronavigate
    from clsas.processing.chain import Processed, process
    from clsas.simulation.scenes import PointTargets, Seabed
    from clsas.simulation.simulator import simulate, simulate_lines

from clsas.engine.data.version import __version__ as __version__

__all__ = [
    "ArgumentError",
    "ArgumentTypeError",
    "Assessment",
    "Autofocus",
    "BeamWindow",
    "Calibration",
    "Certificate",
    "ClsasWarning",
    "DeviceError",
    "Echoes",
    "Effect",
    "FileFormatError",
    "Finding",
    "Georeference",
    "Grid",
    "Heights",
    "Image",
    "Imager",
    "Inspection",
    "Interferogram",
    "Limit",
    "Limits",
    "Micronavigation",
    "Mosaic",
    "PairErrors",
    "Patch",
    "PhaseSign",
    "Plan",
    "PointTargets",
    "Pointing",
    "Processed",
    "Pulse",
    "RangeLines",
    "Replica",
    "Seabed",
    "Sonar",
    "SoundSpeed",
    "Store",
    "Track",
    "Tradeoff",
    "assess",
    "autofocus",
    "backproject",
    "calibrate_track",
    "certify",
    "channels",
    "check_sampling",
    "compress",
    "contrast",
    "density_compensated",
    "density_weights",
    "entropy",
    "export",
    "factorize",
    "from_full_matrix",
    "from_phase_history",
    "heights",
    "inspect",
    "interferogram",
    "limits",
    "list_devices",
    "load",
    "measure_point",
    "micronavigate",
    "mosaic",
    "mosaic_heights",
    "multilook",
    "pair_errors",
    "plan",
    "plot",
    "process",
    "read_airsas",
    "read_cphd",
    "read_full_matrix",
    "read_phase_history",
    "read_sound_speed",
    "relative_error_db",
    "save",
    "simulate",
    "simulate_lines",
    "sub_bands",
    "survey_lines",
    "to_xarray",
    "tradeoff",
    "wavenumber",
    "write_cphd",
]

_MODULES = {
    "engine.data.contrast": "contrast entropy",
    "engine.data.findings": "Finding",
    "engine.data.georeference": "Georeference",
    "engine.data.grid": "Grid",
    "engine.data.image": "Image",
    "engine.data.image_error": "relative_error_db",
    "engine.data.lines": "RangeLines",
    "engine.data.sound_speed": "SoundSpeed",
    "engine.data.validate": "ArgumentError ArgumentTypeError ClsasWarning",
    "engine.exact.wavenumber": "wavenumber",
    "engine.factorized.plan": "Plan",
    "files.airsas": "read_airsas",
    "files.cphd": "read_cphd",
    "files.cphd_writing": "write_cphd",
    "files.formats": "load save",
    "files.full_matrix": "read_full_matrix",
    "files.hdf5": "FileFormatError",
    "files.phase_histories": "read_phase_history",
    "files.sound_speed_files": "read_sound_speed",
    "files.xarrays": "to_xarray",
    "engine.imaging": "Imager backproject factorize plan",
    "inspection.inspection": "inspect",
    "inspection.result": "Inspection PhaseSign",
    "interferometry.heights": "heights",
    "interferometry.interferogram": "Interferogram interferogram",
    "interferometry.pair_errors": "PairErrors pair_errors",
    "interferometry.result": "Heights",
    "maps.exporting": "export",
    "measures.assessment": "assess survey_lines",
    "measures.assessment_result": "Assessment Effect",
    "measures.certificate": "Certificate certify",
    "measures.limits_result": "Limit Limits",
    "measures.looks": "multilook",
    "measures.quality": "measure_point",
    "measures.survey_limits": "limits",
    "measures.tradeoff": "tradeoff",
    "measures.tradeoff_result": "Tradeoff",
    "mosaics.height_mosaic": "mosaic_heights",
    "mosaics.mosaic": "Mosaic Patch mosaic",
    "mosaics.store": "Store",
    "navigation.autofocus": "Autofocus autofocus",
    "navigation.known_points": "Calibration calibrate_track",
    "navigation.micronavigation": "Micronavigation micronavigate",
    "engine.device.device": "DeviceError list_devices",
    "processing.chain": "Processed process",
    "engine.signal.band_parts": "sub_bands",
    "engine.signal.compression": "compress",
    "engine.signal.echoes": "Echoes",
    "engine.signal.full_matrix": "from_full_matrix",
    "engine.signal.phase_history": "from_phase_history",
    "engine.signal.replica": "Replica",
    "simulation.scenes": "PointTargets Seabed",
    "simulation.simulator": "simulate simulate_lines",
    "engine.data.beam": "BeamWindow",
    "measures.density": "density_compensated density_weights",
    "inspection.sampling": "check_sampling",
    "engine.data.system": "Pulse Sonar",
    "engine.data.track": "Pointing Track channels",
}
"""Public names of each module. A module is imported when one of its names is first used."""

_EXTRAS = {
    "files.cphd": "radar",
    "files.cphd_writing": "radar",
    "maps.exporting": "maps",
    "mosaics.mosaic": "mosaic",
    "mosaics.store": "mosaic",
}
"""Extras of modules that need more packages when they are used than when they are imported."""

_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name == "plot":
        return importlib.import_module("clsas.plot")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'clsas' has no attribute {name!r}")
    from clsas.engine.data.extras import needed

    module = _MODULE_OF[name]
    with needed(f"clsas.{name}", _EXTRAS.get(module)):
        value = getattr(importlib.import_module(f"clsas.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
