"""Costs of each kind of work on a device: measured once, stored in the user's cache."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from clsas.core import reading, validate
from clsas.core.atomic import replacing
from clsas.core.cache import cache_folder
from clsas.factorized.estimates import Work
from clsas.opencl.device import Device


@dataclass(frozen=True)
class Costs:
    """Time of each kind of work, nanoseconds per unit of the field of that name in `Work`.

    The defaults were measured with PoCL on 2 AVX-512 cores (`clsas calibrate`); `defaults` returns
    those for a device.
    """

    call_ns: float = 1.2e7
    upsampled_sample_ns: float = 8.0
    filtered_sample_ns: float = 1.3
    reference_ns: float = 100.0
    batch_ns: float = 1.0e5
    subimage_ns: float = 300.0
    sample_ns: float = 0.02
    sample_tap_ns: float = 0.034
    given_sample_ns: float = 0.25
    leaf_channel_ns: float = 11.0
    leaf_ns: float = 0.55
    leaf_point_ns: float = 0.9
    group_ns: float = 150.0
    part_ns: float = 30.0
    pixel_ns: float = 0.5
    point_ns: float = 0.78
    beam_ns: float = 0.13

    def __post_init__(self) -> None:
        """Check every cost."""
        for field in fields(self):
            validate.number(field.name, getattr(self, field.name), "ns", least=0.0)

    def seconds(self, work: Work) -> Any:
        """Return the time of some work, the sum of amounts times costs: an array if these are."""
        total_ns: Any = 0.0
        for name, amount in vars(work).items():
            if isinstance(amount, np.ndarray) or amount:
                total_ns = total_ns + getattr(self, f"{name}_ns") * amount
        return 1e-9 * total_ns


_AVX2 = Costs(
    call_ns=1.4e7,
    filtered_sample_ns=2.5,
    reference_ns=60.0,
    batch_ns=1.3e5,
    subimage_ns=600.0,
    sample_ns=0.04,
    sample_tap_ns=0.067,
    given_sample_ns=0.2,
    leaf_channel_ns=9.5,
    leaf_ns=0.85,
    leaf_point_ns=1.1,
    pixel_ns=1.07,
    point_ns=1.35,
    beam_ns=0.46,
)


def defaults(device: Device) -> Costs:
    """Return the costs of a device without a measurement of its own.

    For 8 lanes these are the costs of 2 AVX2 cores with PoCL.
    """
    return _AVX2 if device.info.width == 8 else Costs()


def path() -> Path:
    """Return the file that holds the measured costs."""
    return cache_folder() / "costs.json"


def load(device: Device) -> Costs:
    """Return the measured costs of a device and its driver, or else `defaults`."""
    return measured(device) or defaults(device)


def measured(device: Device) -> Costs | None:
    """Return the measured costs of a device and its driver, None without any."""
    names = {field.name for field in fields(Costs)}
    try:
        stored = reading.parse_json(reading.read_bytes(path()))[_key(device)]
        return Costs(**{name: float(stored[name]) for name in names})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def save(device: Device, costs: Costs) -> Path:
    """Store the measured costs of a device; return the file."""
    file = path()
    try:
        stored = dict(reading.parse_json(reading.read_bytes(file)))
    except (OSError, ValueError, TypeError):
        stored = {}  # no file yet, or not one of clsas
    stored[_key(device)] = asdict(costs)
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(stored, indent=1))
    return file


def _key(device: Device) -> str:
    info = device.info
    lookup = ", permuting" if info.permute else ""
    return f"{info.label}, {info.driver}, {info.width} lanes{lookup}"
