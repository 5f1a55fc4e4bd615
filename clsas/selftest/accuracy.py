"""Self-test: the accuracy of all imagers on a user's device, measured against the oracle."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from clsas.engine.certificate import IdealImage
from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.image import Image
from clsas.engine.device.device import Device, DeviceInfo, open_device
from clsas.engine.exact.wavenumber import wavenumber
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.plan import Plan
from clsas.engine.imaging import backproject, factorize, plan
from clsas.mosaics.mosaic import mosaic
from clsas.selftest import extremes
from clsas.selftest.extremes import Known, along_x

_BUILDS = ((1, False), (4, False), (8, False), (8, True), (16, False))  # width, permuted lookup
_WIDEST = 16

_DIVIDED = Costs(pixel_ns=1e6, point_ns=1e6)
"""Costs that make exact imaging look slow, so that plans divide even small images."""
_FAR_M = (1e7, -1e7, 1e7)
_WAVENUMBER_DB = -60.0  # bound for the wavenumber image, for which no accuracy can be requested
_ONE_PATCH_BYTES = 64 << 20  # memory of a mosaic, too little for several patches at a time


@dataclass(frozen=True)
class Result:
    """Error of one image against the ideal image.

    Attributes
    ----------
    case : str
        Scene and imager.
    asked_db : float or None
        Requested relative rms error, dB; None for an imager without a request.
    measured_db : float or None
        Measured relative rms error; None if no image was formed.
    bound_db : float
        Largest error with which the image passes.
    failure : str
        Type and message of the exception that imaging raised; "" if an image was formed.
    """

    case: str
    asked_db: float | None
    measured_db: float | None
    bound_db: float
    failure: str = ""

    @property
    def passed(self) -> bool:
        """True if the error is within its bound; an error of NaN is not."""
        return self.measured_db is not None and self.measured_db <= self.bound_db


def run(
    device: Device | str | int | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Result, ...]:
    """Return the errors of images of extreme scenes, measured against the oracle.

    The scenes cover 1 kHz to 10 GHz, bands of 0.5 to 190 % of the carrier, one to 1000 channels,
    guard bands down to a tenth of the bandwidth, and coordinates up to 10 000 km. Every imager is
    tested: exact, factorized (in single and in half precision), mosaic and wavenumber, and so are
    the sums by which errors are measured. On a CPU
    every image is also formed with kernels of one lane, as they are built for a GPU, and some
    images with every other vector width that the CPU supports. An image that cannot be formed does
    not pass, and the test continues with the others.

    Parameters
    ----------
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    tuple of Result

    Raises
    ------
    DeviceError
        If there is no such device.
    """
    validate.progress(progress)
    own = open_device(device)
    checks = [(own, "", *check) for check in _CHECKS]
    of_kernels = [check for check in _CHECKS if check[1] != "wavenumber"]
    for width, permute in other_builds(own.info):
        other, name = driven(own, width, permute), f", width {width}"
        if permute:
            name += ", permuted"
        checks += [(other, name, *check) for check in (of_kernels if width == 1 else _OF_VARIANTS)]
    made = functools.cache(lambda name: _SCENES[name]())
    results = []
    for done, (used, variant, scene, imager, asked_db) in enumerate(checks):
        if progress is not None:
            progress(done, len(checks))
        bound_db = _WAVENUMBER_DB if asked_db is None else asked_db
        measured_db, failure = None, ""
        try:
            known = made(scene)
            with validate.muted():  # only the measured error matters
                image = form(imager, known, bound_db, used)
            measured_db = known.error_db(image.pixels)
        except Exception as error:  # a driver may raise anything; the other images still count
            failure = f"{type(error).__name__}: {error}"
        case = f"{scene}, {imager}{variant}"
        results.append(Result(case, asked_db, measured_db, bound_db, failure))
    if progress is not None:
        progress(len(checks), len(checks))
    return tuple(results)


def form(imager: str, known: Known, asked_db: float, device: Device) -> Image:
    """Return the image of a scene that an imager forms, one of those that `run` tests."""
    lines, grid, beam = known.lines, known.grid, known.beam
    if imager == "exact":
        return backproject(
            lines, grid, device=device, accuracy_db=asked_db, beam=beam, certificate=False
        )
    if imager == "mosaic":
        return mosaic(
            lines, grid, tolerance_db=asked_db, beam=beam, patches=(2, 2), device=device,
            certificate=False, memory_bytes=_ONE_PATCH_BYTES,
        ).image()  # fmt: skip
    if imager == "wavenumber":
        return wavenumber(lines, grid, beam=beam)
    if imager == "certificate":
        points_m = grid.at(np.arange(grid.size))
        ideal = IdealImage(lines, beam, device, points_m, np.random.default_rng(0))
        return Image(ideal.at(points_m).reshape(grid.shape), grid)
    if imager == "factorized":
        chosen = divided_plan(known, asked_db, device)
        return factorize(lines, grid, chosen, device=device)
    assert imager == "half precision"
    # Every device can compute in half precision, but plans use it only on those where it is fast.
    able = driven(device, device.info.width, True)
    chosen = divided_plan(known, asked_db, able)
    if not chosen.half_precision:
        raise RuntimeError(f"the plan for {asked_db:g} dB should use half precision, but does not")
    return factorize(lines, grid, chosen, device=device)


def divided_plan(known: Known, asked_db: float, device: Device) -> Plan:
    """Return a plan that divides the image of a scene, however small."""
    return plan(
        known.lines, known.grid, tolerance_db=asked_db, beam=known.beam, device=device,
        costs=_DIVIDED,
    )  # fmt: skip


def other_builds(info: DeviceInfo) -> list[tuple[int, bool]]:
    """Return the builds of kernels that a device does not use by default.

    A build is the number of floats in a vector, and whether lookups are permuted. Only CPUs have
    more than one. Wider vectors than those of the CPU are left out, since compilers may fail on
    them.
    """
    if info.kind != "cpu":
        return []
    most = info.width if info.width > 1 else _WIDEST
    own = (info.width, info.permute)
    return [build for build in _BUILDS if build[0] <= most and build != own]


def driven(device: Device, width: int, permute: bool) -> Device:
    """Return a device whose kernels are built for vectors of `width` floats, permuted or not.

    A width of one float selects the build for GPUs. The device is then driven as a GPU in every
    respect: with work-groups of 64, its own buffers, copies to and from them, and half precision.
    """
    if (width, permute) == (device.info.width, device.info.permute):
        return device
    kind = "gpu" if width == 1 else device.info.kind
    info = dataclasses.replace(
        device.info, kind=kind, width=width, stage_width=width, permute=permute
    )
    return dataclasses.replace(device, info=info, _kernels={})


_HANN = BeamWindow(12, "hann", along=np.array([1.0, 0, 0]))
_SMALL: dict[str, Any] = {"shape": (32, 32)}
_SCENES: dict[str, Callable[[], Known]] = {
    "flat": lambda: extremes.ultrasonic(96, **_SMALL),
    "tilted, guard band 10 %": lambda: extremes.ultrasonic(
        96, oversampling=1.1, tilt_db=10, **_SMALL
    ),
    "noise, guard band 25 %": lambda: extremes.ultrasonic(
        96, oversampling=1.25, tilt_db=10, noise=0.1, **_SMALL
    ),
    "three bands": lambda: extremes.ultrasonic(96, colour=extremes.steps, **_SMALL),
    "on carrier, 5 % offset": lambda: extremes.raw(64, 30, offset=0.05, **_SMALL),
    "10 000 km from the origin": lambda: extremes.ultrasonic(96, origin_m=_FAR_M, **_SMALL),
    "1 kHz": lambda: extremes.at_1_khz(**_SMALL),
    "10 GHz": lambda: extremes.radar(**_SMALL),
    "band of 0.5 %": lambda: extremes.narrow(**_SMALL),
    "band of 190 %": lambda: extremes.widest(**_SMALL),
    "one channel": lambda: extremes.ultrasonic(1, **_SMALL),
    "1000 channels": lambda: extremes.ultrasonic(1000, targets=2, shape=(12, 12)),
    "closed track": lambda: extremes.closed(**_SMALL),
    "rings, on carrier": lambda: extremes.rings(**_SMALL),
    "bistatic": lambda: extremes.array(moving=False, **_SMALL),
    "moving receivers": lambda: extremes.array(moving=True, shape=(48, 48)),
    "2 % and 10 m apart": lambda: extremes.apart(**_SMALL),
    "0.5 % and uneven velocities": lambda: extremes.uneven(**_SMALL),
    "headings under a Hann beam": lambda: extremes.headings(shape=(48, 48)),
    "a loud channel off the track": lambda: extremes.loud(**_SMALL),
    "edge of a Hann beam": lambda: extremes.edge(),
    "Hann beam": lambda: extremes.ultrasonic(
        track=along_x(400, 0.03), beam=_HANN, targets=3, shape=(24, 24)
    ),
}
# With tighter tolerances these scenes would be imaged exactly.
_ROUGHLY = {
    "moving receivers": -30.0,
    "2 % and 10 m apart": -20.0,
    "0.5 % and uneven velocities": -20.0,
    "a loud channel off the track": -30.0,
}
_CHECKS = (
    *((name, "exact", -80.0) for name in _SCENES),
    ("flat", "exact", -40.0),
    *(
        (name, "factorized", -50.0)
        for name in _SCENES
        if name not in _ROUGHLY and name not in ("one channel", "1000 channels", "bistatic")
    ),
    *((name, "factorized", asked_db) for name, asked_db in _ROUGHLY.items()),
    ("flat", "factorized", -70.0),
    ("flat", "half precision", -40.0),
    ("Hann beam", "mosaic", -50.0),
    *((name, "certificate", -95.0) for name in ("flat", "noise, guard band 25 %", "Hann beam")),
    ("Hann beam", "wavenumber", None),
)
# Requests whose kernels compile fast. Kernels for -80 and -50 dB take 1.5 times as long.
_OF_VARIANTS = (("flat", "exact", -60.0), ("flat", "factorized", -35.0))
