"""Benchmarks: how fast and how accurate imaging is on a device."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.image_error import relative_error_db
from clsas.core.lines import RangeLines
from clsas.exact import reference
from clsas.exact.backprojection import form_exactly, prepare
from clsas.exact.run import execute
from clsas.mosaics.mosaic import mosaic
from clsas.mosaics.store import Record
from clsas.opencl.device import Device, open_device
from clsas.planning.factorize import factorize
from clsas.planning.planner import plan
from clsas.products.tradeoff import REFERENCE_DB
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines
from clsas.sonar.beam import BeamWindow, sines
from clsas.trials import wreck

_PIXELS = 300  # random pixels at which errors are measured
_POINTS = 1000
_DUNES_M = 8.0
_SIDE = 64  # pixels at which it is looked what they see
_OFTEN = 3  # in a turn what is fast, which scatters most


@dataclass(frozen=True)
class Case:
    """A straight track over a scene of random points.

    Attributes
    ----------
    channels : int
        Monostatic phase centres.
    spacing_m : float
        Distance between them.
    carrier_hz, bandwidth_hz : float
        Band of the range lines, windowed by nothing and sampled at 1.25 bandwidths.
    x_m, y_m : (first, last)
        Extent of the image.
    pixels : int
        Along either side.
    beam : BeamWindow, optional
        Weights of the channels.
    depth_m, relief_m : float
        Of the plane in which points and pixels lie, below the track; and from the troughs to the
        crests of dunes, 8 m long and wide, on it.
    """

    channels: int
    spacing_m: float
    carrier_hz: float
    bandwidth_hz: float
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    pixels: int
    beam: BeamWindow | None = None
    depth_m: float = 0.0
    relief_m: float = 0.0

    @property
    def grid(self) -> Grid:
        """The image's grid."""
        plane = Grid.plane((*self.x_m, self.pixels), (*self.y_m, self.pixels), -self.depth_m)
        if not self.relief_m:
            return plane
        x_m, y_m = plane.axes_m
        return plane.with_height(self._height_m(x_m, y_m[:, None]))

    def _height_m(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        dunes = np.sin(2 * np.pi * x_m / _DUNES_M) * np.sin(2 * np.pi * y_m / _DUNES_M)
        return self.relief_m / 2 * dunes

    def lines(self, seed: int = 1) -> RangeLines:
        """Return range lines of random points of complex amplitude all over the image."""
        random = np.random.default_rng(seed)
        along = (np.arange(self.channels) - (self.channels - 1) / 2) * self.spacing_m
        tx_m = np.stack([along, np.zeros_like(along), np.zeros_like(along)], axis=1)
        positions = np.zeros((_POINTS, 3))
        positions[:, 0] = random.uniform(*self.x_m, _POINTS)
        positions[:, 1] = random.uniform(*self.y_m, _POINTS)
        positions[:, 2] = self._height_m(*positions[:, :2].T) - self.depth_m
        amplitudes = random.standard_normal(_POINTS) + 1j * random.standard_normal(_POINTS)
        return simulate_lines(
            tx_m,
            tx_m,
            PointTargets(positions, amplitudes),
            carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz,
            oversampling=1.25,
        )


CASES = {
    # THESIS chapter 5; its bandwidth is not given.
    "bp-thesis": Case(640, 8.25e-3, 1e6, 100e3, (-2.5, 2.5), (40.0, 45.0), 1024),
    "bp-2k": Case(2048, 15e-3, 120e3, 30e3, (-20.0, 20.0), (40.0, 80.0), 2048),
}
"""Cases of exact imaging."""

_BEAM = BeamWindow(20.0, "hann")

FACTORIZED = {
    "ffbp-thesis": CASES["bp-thesis"],
    "ffbp-2k": Case(2000, 15e-3, 120e3, 30e3, (-20.48, 20.46), (40.0, 80.0), 2048, _BEAM),
    "ffbp-relief": Case(
        channels=2000,
        spacing_m=15e-3,
        carrier_hz=120e3,
        bandwidth_hz=30e3,
        x_m=(-20.48, 20.46),
        y_m=(40.0, 80.0),
        pixels=2048,
        beam=_BEAM,
        depth_m=20.0,
        relief_m=1.0,
    ),
    # The same pixels and spacing, over a longer track and further out.
    "ffbp-8k": Case(8192, 15e-3, 120e3, 30e3, (-40.96, 40.94), (40.0, 121.9), 4096, _BEAM),
}
"""Cases of factorized imaging."""

MOSAICS = {"mosaic-wreck": (4096, BeamWindow(5.0, "hann"))}
"""Cases of mosaics: pixels along either side of the wreck's scene, and the beam."""


def scaled(size: int) -> Case:
    """Return ffbp-2k with `size` channels and `size` x `size` pixels over the same extents.

    Frequencies grow with the size, so that pixels and channels stay as far apart in wavelengths.
    """
    case = FACTORIZED["ffbp-2k"]
    finer = size / case.pixels
    return replace(
        case,
        channels=size,
        spacing_m=case.spacing_m * case.channels / size,
        carrier_hz=case.carrier_hz * finer,
        bandwidth_hz=case.bandwidth_hz * finer,
        pixels=size,
    )


def run(
    case: str,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = -50.0,
    repeats: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure exact backprojection on a built-in case.

    Parameters
    ----------
    case : str
        One of `CASES`.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    accuracy_db : float
        As for `clsas.backproject`.
    repeats : int
        Timed runs, after one that builds the kernels.
    progress : callable, optional
        Called as progress(runs done, runs).

    Returns
    -------
    dict
        What was measured, ready for JSON. `seconds` are of the whole call of `clsas.backproject`:
        choosing the interpolation, upsampling the lines, references, transfers, kernels and
        reading the image back. `gbp_per_s` is from their median; GBP are 1e9 pixel-channel pairs.
        `kernel_seconds` is the device's time in the backprojection kernel alone (least of the
        runs), `gflop_per_s` its arithmetic and `share_of_peak` that over what a loop of
        independent multiply-adds reaches on the device. `rounding_error_db` compares random
        pixels with a float64 sum by the same interpolation, `true_error_db` with the ideal sum of
        band-limited lines.
    """
    validate.one_of("case", case, tuple(CASES))
    device = open_device(device)
    lines, grid = CASES[case].lines(), CASES[case].grid
    seconds, kernel_seconds = [], []
    for repeat in range(repeats + 1):
        with device.profile() as times:
            start = time.perf_counter()
            preparation = prepare(lines, grid, device=device, accuracy_db=accuracy_db)
            image = execute(preparation)
            seconds.append(time.perf_counter() - start)
        kernel_seconds.append(times["backproject_tiles"].total_s)
        if progress is not None:
            progress(repeat + 1, repeats + 1)
    del seconds[0], kernel_seconds[0]
    pairs = lines.channels * grid.size
    flops = (
        flops_per_pair(preparation.interpolator.taps, preparation.phase_terms)
        * pairs
        / min(kernel_seconds)
    )
    return {
        "case": case,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "pixels": list(grid.shape),
        "accuracy_db": accuracy_db,
        "taps": preparation.interpolator.taps,
        "upsampling": round(preparation.resampling.ratio, 3),
        "seconds": _statistics(seconds)
        | {"included": "all of clsas.backproject, from choosing the interpolation to readback"},
        "gbp_per_s": pairs / statistics.median(seconds) / 1e9,
        "kernel_seconds": min(kernel_seconds),
        "kernel_gbp_per_s": pairs / min(kernel_seconds) / 1e9,
        "gflop_per_s": flops / 1e9,
        "share_of_peak": flops / peak_flops(device),
        "predicted_error_db": preparation.interpolator.error_db,
        "rounding_error_db": reference.sampled_error_db(
            image, partial(reference.same_interpolator, preparation), pixels=_PIXELS
        ),
        "true_error_db": reference.sampled_error_db(
            image, partial(reference.ideal, lines), pixels=_PIXELS
        ),
    }


def run_factorized(
    case: str | Case,
    *,
    device: Device | str | int | None = None,
    tolerance_db: float = -50.0,
    repeats: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure factorized against exact imaging, which take turns.

    Parameters
    ----------
    case : str or Case
        One of `FACTORIZED`, or another case.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    tolerance_db : float
        As for `clsas.plan`.
    repeats : int
        Timed turns, after one that builds the kernels; of one alone the time is with that.
    progress : callable, optional
        Called as progress(turns done, turns).

    Returns
    -------
    dict
        What was measured, ready for JSON. `seconds` are of the whole call of `clsas.factorize` with
        a plan that has formed no image yet, `again_seconds` with one that has, three of each in a
        turn; `exact_seconds` of `clsas.backproject` as accurate as the tolerance, `default_seconds`
        of that with its default accuracy. `speedup`, `speedup_again` and `speedup_over_default` are
        the ratios of their medians, the last two over `seconds`. Planning took `plan_seconds`,
        once. `error_db` is against an exact image of -80 dB.
    """
    if not isinstance(case, Case):
        validate.one_of("case", case, tuple(FACTORIZED))
        title, case = case, FACTORIZED[case]
    else:
        title = f"{case.channels} channels"
    device = open_device(device)
    lines, grid = case.lines(), case.grid
    start = time.perf_counter()
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=case.beam, device=device)
    plan_seconds = time.perf_counter() - start
    fast = partial(factorize, lines, grid, device=device)
    exact = partial(form_exactly, lines, grid, beam=case.beam, device=device)
    error_db = relative_error_db(fast(chosen), exact(accuracy_db=REFERENCE_DB))
    ways = [
        *_OFTEN * [("first", lambda: fast(replace(chosen)))],  # a copy has kept nothing
        *_OFTEN * [("again", lambda: fast(chosen))],
        ("exact", lambda: exact(accuracy_db=tolerance_db)),
        ("default", exact),
    ]
    first, again, exactly, default = _in_turns(ways, repeats, progress).values()
    return {
        "case": title,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "samples": lines.length,
        "pixels": list(grid.shape),
        "tolerance_db": tolerance_db,
        "seconds": first | {"included": "all of clsas.factorize, the plan given"},
        "again_seconds": again | {"included": "the same, by a plan that has formed an image"},
        "plan_seconds": plan_seconds,
        "exact_seconds": exactly | {"included": "all of clsas.backproject, as accurate"},
        "default_seconds": default | {"included": "the same, as accurate as by default"},
        "speedup": exactly["median"] / first["median"],
        "speedup_again": exactly["median"] / again["median"],
        "speedup_over_default": default["median"] / first["median"],
        "error_db": error_db,
        "predicted_error_db": chosen.predicted_error_db,
        "predicted_seconds": chosen.predicted_seconds,
        "predicted_exact_seconds": chosen.exact_seconds,
        "plan": chosen.describe(),
    }


def run_mosaic(
    case: str = "mosaic-wreck",
    *,
    device: Device | str | int | None = None,
    tolerance_db: float = -40.0,
    repeats: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a mosaic against exact imaging with and without the beam's limits; all take turns.

    Parameters
    ----------
    case : str
        One of `MOSAICS`.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    tolerance_db : float
        As for `clsas.mosaic`.
    repeats : int
        As for `run_factorized`.
    progress : callable, optional
        Called as progress(done, total), while the lines are simulated and then turn by turn.

    Returns
    -------
    dict
        What was measured, ready for JSON. `seconds` are of all of `clsas.mosaic`, from lines in
        memory to the image in memory, with all planning, three in a turn; `exact_seconds` and
        `unlimited_seconds` of `clsas.backproject` with the beam and without, as accurate as the
        tolerance, and `default_unlimited_seconds` of the latter with its default accuracy;
        `speedup`, `speedup_unlimited` and `speedup_over_default` are their medians over that of
        the mosaic. `share_seen` is that of all pairs of a pixel and a channel that the beam
        leaves. `error_db` is against an exact image of -80 dB,
        `shadow_contrast_difference_db` is by how much the contrast of the wreck's shadow differs
        from that image's.
    """
    validate.one_of("case", case, tuple(MOSAICS))
    pixels, beam = MOSAICS[case]
    device = open_device(device)
    lines, grid = wreck.lines(progress), wreck.grid(pixels)

    def form() -> tuple[Image, list[Record]]:
        records: list[Record] = []
        wanted = mosaic(lines, grid, tolerance_db=tolerance_db, beam=beam, device=device)
        return wanted.image(lambda patch: records.append(patch.record)), records

    exact = partial(form_exactly, lines, grid, device=device)
    formed, records = form()
    reference_image = exact(beam=beam, accuracy_db=REFERENCE_DB)
    shadow = wreck.Shadow(wreck.scene())
    contrast_db, reference_db = (shadow.contrast_db(each) for each in (formed, reference_image))
    error_db = relative_error_db(formed, reference_image)
    del formed, reference_image
    ways = [
        *_OFTEN * [("seconds", form)],
        ("exact_seconds", partial(exact, beam=beam, accuracy_db=tolerance_db)),
        ("unlimited_seconds", partial(exact, accuracy_db=tolerance_db)),
        ("default_unlimited_seconds", exact),
    ]
    found = _in_turns(ways, repeats, progress)
    seconds = found["seconds"]["median"]
    predicted = [r.predicted_error_db for r in records if r.predicted_error_db is not None]
    return {
        "case": case,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "samples": lines.length,
        "pixels": list(grid.shape),
        "patches": len(records),
        "tolerance_db": tolerance_db,
        **found,
        "share_seen": _share_seen(lines, wreck.grid(_SIDE), beam),
        "plan_seconds": sum(record.plan_seconds for record in records),
        "speedup": found["exact_seconds"]["median"] / seconds,
        "speedup_unlimited": found["unlimited_seconds"]["median"] / seconds,
        "speedup_over_default": found["default_unlimited_seconds"]["median"] / seconds,
        "error_db": error_db,
        "predicted_error_db": max(predicted),
        "shadow_contrast_db": contrast_db,
        "shadow_contrast_difference_db": contrast_db - reference_db,
    }


def _share_seen(lines: RangeLines, grid: Grid, beam: BeamWindow) -> float:
    """Return in which part of all pairs of pixel and channel one sees the other."""
    points_m = grid.positions_m().reshape(-1, 3)
    sine = sines(points_m, lines.phase_centres_m, beam.directions(lines))
    low, high = beam.limits
    return float(((sine > low) & (sine < high)).mean())


def _in_turns(
    ways: Sequence[tuple[str, Callable[[], object]]],
    turns: int,
    progress: Callable[[int, int], None] | None,
) -> dict[str, dict[str, float]]:
    """Return the seconds that some ways take, by name, turn by turn.

    A name may come several times in a turn. Before the turns there is one that builds the kernels,
    unless there is but one.
    """
    taken: dict[str, list[float]] = {name: [] for name, _ in ways}
    warm = int(turns > 1)
    for turn in range(warm + turns):
        for name, way in ways:
            start = time.perf_counter()
            way()
            seconds = time.perf_counter() - start
            if turn >= warm:
                taken[name].append(seconds)
        if progress is not None:
            progress(turn + 1, warm + turns)
    return {name: _statistics(seconds) for name, seconds in taken.items()}


def _statistics(seconds: list[float]) -> dict[str, float]:
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}


def flops_per_pair(taps: int, phase_terms: int) -> int:
    """Return the floating-point operations of cl/backproject_tiles.cl per pixel and channel.

    Counted in its source: 13 for the position, 7 and 4 (phase_terms - 1) for sine and cosine, 8 to
    turn and add, and per pair of taps 4 (taps/2 - 1) + 4 for the weights and 8 to apply them.
    """
    pairs = taps // 2
    return 28 + 4 * (phase_terms - 1) + pairs * (4 * (pairs - 1) + 12)


def peak_flops(device: Device) -> float:
    """Return the rate at which a device does independent multiply-adds, flop/s (cl/peak.cl)."""
    width = device.info.width
    items, steps = 1 << 14, 1 << 12
    kernel = device.kernel("peak", WIDTH=width)
    result = device.buffer(4 * items)
    with device.profile() as times:
        for _ in range(6):
            device.run(kernel, (items,), steps=steps, factor=0.5, result=result)
    return items * steps * 16 * width * 2 / times["peak"].minimum_s
