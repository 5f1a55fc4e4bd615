"""Costs of each kind of work on a device, measured once and stored in the user's cache folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import numpy as np

from clsas.core import reading, validate
from clsas.core.atomic import replacing
from clsas.core.cache import cache_folder, private_folder, trusted_cache
from clsas.core.digests import is_intact, with_digest
from clsas.core.version import __version__
from clsas.opencl.device import Device, DeviceInfo
from clsas.plans.predictions import CostSource, Work

_MOST_NS = 1e15  # arbitrary: eleven days for one unit; times of any image stay finite


@dataclass(frozen=True)
class Costs:
    """Time of each kind of work, in nanoseconds per unit of the field of `Work` with that name.

    The defaults are fitted to times of kernels and host that `scripts/bench predictions` measured
    with PoCL on 2 AVX-512 cores. `defaults` returns those for a device.
    """

    call_ns: float = 1.35e7
    upsampled_sample_ns: float = 18.0
    filtered_sample_ns: float = 1.9
    reference_ns: float = 125.0
    batch_ns: float = 1.0e5
    subimage_ns: float = 300.0
    line_ns: float = 32.0
    sample_ns: float = 0.1
    sample_tap_ns: float = 0.02
    single_sample_ns: float = 1.15
    given_sample_ns: float = 0.05
    leaf_channel_ns: float = 11.0
    leaf_ns: float = 0.53
    leaf_point_ns: float = 1.2
    leaf_gathered_ns: float = 1.25
    group_ns: float = 243.0
    part_ns: float = 16.0
    pixel_ns: float = 0.66
    point_ns: float = 0.85
    beam_ns: float = 0.12

    def __post_init__(self) -> None:
        """Check every cost."""
        for field in fields(self):
            validate.number(field.name, getattr(self, field.name), "ns", least=0.0, most=_MOST_NS)

    def times(self, factors: Mapping[str, float]) -> Costs:
        """Return these costs, with those named multiplied by their factors."""
        return replace(self, **{name: each * getattr(self, name) for name, each in factors.items()})

    def seconds(self, work: Work) -> Any:
        """Return the time of work: sum of amounts times costs, an array if amounts are arrays."""
        total_ns: Any = 0.0
        for name, amount in vars(work).items():
            if isinstance(amount, np.ndarray) or amount:
                total_ns = total_ns + getattr(self, f"{name}_ns") * amount
        return 1e-9 * total_ns


_AVX2 = Costs(
    call_ns=9.2e6,
    upsampled_sample_ns=20.0,
    filtered_sample_ns=1.8,
    reference_ns=122.0,
    batch_ns=8.0e5,
    subimage_ns=1450.0,
    line_ns=24.0,
    sample_ns=0.05,
    sample_tap_ns=0.0235,
    single_sample_ns=0.2,
    given_sample_ns=0.01,
    leaf_channel_ns=5.0,
    leaf_ns=0.69,
    leaf_point_ns=1.53,
    leaf_gathered_ns=0.85,
    group_ns=234.0,
    part_ns=50.0,
    pixel_ns=0.57,
    point_ns=1.7,
    beam_ns=0.4,
)
"""Fitted to processor times of kernels and host for images of the benchmarks at several tolerances,
on 2 cores of Zen 4 with PoCL 3.0. Processor times depend little on other work on the machine."""


@dataclass(frozen=True)
class KnownCosts:
    """Costs of a device, with their origin.

    Attributes
    ----------
    costs : Costs
    source : str
        "given" by the caller; "scaled" from the defaults by a short measurement; or "default".
    measured : str
        Time of the measurement, UTC, in ISO 8601; "" without one.
    """

    costs: Costs
    source: CostSource
    measured: str = ""

    def __post_init__(self) -> None:
        """Check the source and the time."""
        validate.one_of("source", self.source, get_args(CostSource))
        if self.measured and datetime.fromisoformat(self.measured).tzinfo is None:
            raise ValueError(f"measured must have a time zone, got {self.measured}")


def defaults(device: Device | DeviceInfo) -> Costs:
    """Return the costs that are assumed for a device that was not measured.

    For a device of 8 lanes, they are those of 2 AVX2 cores with PoCL.
    """
    info = device.info if isinstance(device, Device) else device
    return _AVX2 if info.width == 8 else Costs()


def path() -> Path:
    """Return the path of the file of measured costs."""
    return cache_folder() / "costs.json"


def load(device: Device | DeviceInfo) -> KnownCosts:
    """Return the stored costs of a device and its driver, or else `defaults`.

    Warns
    -----
    ClsasWarning
        If the file of costs cannot be read or does not contain costs, or other users can write to
        the cache folder.
    """
    info = device.info if isinstance(device, Device) else device
    default = KnownCosts(defaults(info), "default")
    try:
        table = _tables().get(key(info))
        return default if table is None else _known(table)
    except (OSError, ValueError, KeyError, TypeError) as error:
        validate.warn(f"costs stored in {path()} are ignored: {_reason(error)}")
        return default


def save(device: Device, costs: Costs) -> Path:
    """Store the costs of a device that were scaled to it, and return the path of the file.

    The file is replaced as a whole, so that another process reads either the old or the new one.

    Raises
    ------
    OSError
        If the user's cache folder cannot be written, or other users can write to it.
    """
    file = private_folder() / path().name
    try:
        stored = _tables()
    except (OSError, ValueError):
        stored = {}  # whoever reads the file is warned
    measured = datetime.now(UTC).isoformat(timespec="seconds")
    table = {"source": "scaled", "measured": measured, "costs": asdict(costs)}
    stored[key(device.info)] = with_digest(table)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(stored, indent=1))
    return file


def key(info: DeviceInfo) -> str:
    """Return the key of stored costs: device, driver, cores, how kernels are built, and version."""
    lookup = ", permuting" if info.permute else ""
    return (
        f"{info.label}, {info.driver}, {info.compute_units} compute units, {info.width} lanes"
        f"{lookup}, clsas {__version__}"
    )


def _tables() -> dict[str, Any]:
    """Return the stored tables by key; raise OSError or ValueError if the file has none."""
    try:
        stored = reading.parse_json(reading.read_bytes(trusted_cache() / path().name))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    if not isinstance(stored, dict):
        raise ValueError(f"it must hold tables by device, got {validate.shown(stored)}")
    return stored


def _known(table: dict[str, Any]) -> KnownCosts:
    """Return costs from their stored table; raise an error if `save` did not write it."""
    names = [field.name for field in fields(Costs)]
    costs = {name: validate.number(name, table["costs"][name], "ns") for name in names}
    if table["source"] != "scaled" or not table["measured"]:
        raise ValueError("costs must be scaled, at a time")
    if not is_intact(table):
        raise ValueError("costs do not match their digest")
    return KnownCosts(Costs(**costs), "scaled", table["measured"])


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
