"""What the parts of imaging cost on a device: measured once, stored in the user's cache."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from numpy.typing import ArrayLike

from clsas.core import reading, validate
from clsas.core.atomic import replacing
from clsas.core.cache import cache_folder
from clsas.opencl.device import Device
from clsas.signal.interpolation import COST


@dataclass(frozen=True)
class Costs:
    """Times of the parts of imaging, nanoseconds; the defaults are of 2 AVX-512 cores with PoCL.

    `defaults` returns those for a device.

    Attributes
    ----------
    call_ns : float
        Per image, however it is formed: what is decided first, buffers, launches.
    upsampled_sample_ns, filtered_sample_ns : float
        Per sample of the upsampled lines, by FFT on the host and by filters.
    reference_ns : float
        Per root subimage and channel, on the host.
    batch_ns : float
        Per stage of a batch of roots: launches, tables, transfers.
    subimage_ns : float
        Per subimage in a stage.
    sample_ns, sample_tap_ns : float
        Per aligned sample in a stage, and per tap of either filter.
    given_sample_ns : float
        More in the first stage, whose lines come from main memory.
    leaf_channel_ns : float
        Per subimage and virtual channel of the last stage.
    leaf_ns, leaf_point_ns : float
        Per pixel and virtual channel of the last stage, with 4 taps, on a plane and off it.
    group_ns : float
        Per pixel off a plane: to put it into a group, on the host.
    part_ns : float
        Per tile, or group, and channel of an exact image: references, on the host.
    pixel_ns, point_ns : float
        Per pixel and channel of an exact image, with 4 taps, in tiles and in groups.
    beam_ns : float
        Per pixel and channel of either, where a beam weighs it.
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

    def line_ns(self, samples: ArrayLike, taps: int, *, given: bool) -> ArrayLike:
        """Return the cost of a channel of a subimage in a stage, by the taps of both filters.

        `given` is whether that is the first.
        """
        of_sample = self.sample_ns + self.sample_tap_ns * taps + self.given_sample_ns * given
        return samples * of_sample

    def leaf_line_ns(self, pixels: ArrayLike, taps: int, *, tiled: bool, beam: bool) -> ArrayLike:
        """Return the cost of a virtual channel of a leaf that is backprojected."""
        leaf_ns = self.leaf_ns if tiled else self.leaf_point_ns
        return pixels * (leaf_ns * COST[taps] + self.beam_ns * beam) + self.leaf_channel_ns

    def pair_ns(self, taps: int, *, tiled: bool, beam: bool) -> float:
        """Return the cost of a pixel and channel of an exact image."""
        return (self.pixel_ns if tiled else self.point_ns) * COST[taps] + self.beam_ns * beam


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
    """Return the costs of a device that nothing was measured on.

    Those of 8 lanes are of 2 AVX2 cores with PoCL.
    """
    return _AVX2 if device.info.width == 8 else Costs()


def path() -> Path:
    """Return the file that holds what was measured."""
    return cache_folder() / "costs.json"


def load(device: Device) -> Costs:
    """Return what was measured for a device and its driver, or else `defaults`."""
    return measured(device) or defaults(device)


def measured(device: Device) -> Costs | None:
    """Return what was measured for a device and its driver, if anything was."""
    names = {field.name for field in fields(Costs)}
    try:
        stored = reading.parse_json(reading.read_bytes(path()))[_key(device)]
        return Costs(**{name: float(stored[name]) for name in names})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def save(device: Device, costs: Costs) -> Path:
    """Store what was measured for a device; return where."""
    file = path()
    try:
        stored = dict(reading.parse_json(reading.read_bytes(file)))
    except (OSError, ValueError, TypeError):
        stored = {}  # none yet, or not ours
    stored[_key(device)] = asdict(costs)
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(stored, indent=1))
    return file


def _key(device: Device) -> str:
    info = device.info
    lookup = ", permuting" if info.permute else ""
    return f"{info.label}, {info.driver}, {info.width} lanes{lookup}"
