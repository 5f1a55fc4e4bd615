"""Synthetic aperture sonar images in the time domain, exact or fast, on any OpenCL device."""

from clsas.assess import Assessment, Effect, assess, survey_lines
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
    "Assessment",
    "BeamWindow",
    "ClsasWarning",
    "DeviceError",
    "Echoes",
    "Effect",
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
    "assess",
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
    "relative_error_db",
    "save",
    "simulate",
    "simulate_lines",
    "survey_lines",
    "to_xarray",
    "tradeoff",
    "wavenumber",
]
