"""Benchmarks: speed and accuracy of images and heights on a device, for the built-in cases."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.visibility import is_within, sines
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import TOLERANCE_DB
from clsas.engine.forming import SceneImager, form_exactly
from clsas.engine.imaging import Imager, factorize, plan
from clsas.engine.scene import Scene
from clsas.interferometry.checks import HEIGHTS_TOLERANCE_DB
from clsas.interferometry.heights import heights
from clsas.interferometry.refinement import PASSES
from clsas.interferometry.result import Heights
from clsas.measures.tradeoff import REFERENCE_DB
from clsas.mosaics.mosaic import mosaic
from clsas.mosaics.store import Record
from clsas.selftest import cases, reference, wreck
from clsas.selftest.cases import Case, DenseCase

_PIXELS = 300  # random pixels at which errors are measured
_VISIBILITY_PIXELS = 64  # along either side, at which the share of visible channels is evaluated
_FAST_RUNS = 3  # runs per round of the fast methods, whose times scatter most


def run(
    case: str,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = TOLERANCE_DB,
    repeats: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return speed and errors of exact backprojection for a built-in case.

    Parameters
    ----------
    case : str
        One of `clsas.selftest.cases.EXACT_CASES`.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    accuracy_db : float
        Requested accuracy, see `clsas.backproject`.
    repeats : int
        Number of timed runs, which follow one that builds the kernels.
    progress : callable, optional
        Called as progress(runs done, runs).

    Returns
    -------
    dict
        Results as JSON types.

        - `seconds`: time of the whole call of `clsas.backproject`, that is, choosing the
          interpolator, upsampling, references, transfers, kernels and reading the image back.
        - `gbp_per_s`: 1e9 pixel-channel pairs per second, from the median of `seconds`.
        - `kernel_seconds`: least time of a run in the backprojection kernel.
        - `gflop_per_s`: arithmetic rate of the kernel; `share_of_peak`: that rate over the rate of
          independent multiply-adds on the device.
        - `rounding_error_db`: error of random pixels relative to a float64 sum with the same
          interpolator; `true_error_db`: relative to the ideal sum of band-limited lines.
    """
    validate.one_of("case", case, tuple(cases.EXACT_CASES))
    device = open_device(device)
    lines, grid = cases.EXACT_CASES[case].lines(), cases.EXACT_CASES[case].grid
    seconds, kernel_seconds = [], []
    for repeat in range(repeats + 1):
        with device.profile() as times:
            start = time.perf_counter()
            scene = Scene.of(lines, grid, None, accuracy_db)
            imager = SceneImager(scene, ExactImage(accuracy_db), device, keep=False)
            image = imager.form(lines)
            seconds.append(time.perf_counter() - start)
        kernel_seconds.append(times["backproject_tiles"].total_s)
        if progress is not None:
            progress(repeat + 1, repeats + 1)
    del seconds[0], kernel_seconds[0]
    assert imager.decision is not None
    decision, pairs = imager.decision, lines.channels * grid.size
    operations = flops_per_pair(decision.interpolator.taps, decision.phase_terms) * pairs
    flops = operations / min(kernel_seconds)
    return {
        "case": case,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "pixels": list(grid.shape),
        "accuracy_db": accuracy_db,
        "taps": decision.interpolator.taps,
        "upsampling": round(decision.resampling.ratio, 3),
        "seconds": _statistics(seconds)
        | {"included": "all of clsas.backproject, from choosing the interpolation to readback"},
        "gbp_per_s": pairs / statistics.median(seconds) / 1e9,
        "kernel_seconds": min(kernel_seconds),
        "kernel_gbp_per_s": pairs / min(kernel_seconds) / 1e9,
        "gflop_per_s": flops / 1e9,
        "share_of_peak": flops / peak_flops(device),
        "predicted_error_db": decision.interpolator.error_db,
        "rounding_error_db": reference.sampled_error_db(
            image, partial(reference.same_interpolator, lines, decision), pixels=_PIXELS
        ),
        "true_error_db": reference.sampled_error_db(
            image, partial(reference.ideal, lines), pixels=_PIXELS
        ),
    }


def run_factorized(
    case: str | Case | DenseCase,
    *,
    device: Device | str | int | None = None,
    tolerance_db: float = TOLERANCE_DB,
    repeats: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return speed and errors of factorized and exact imaging, measured in turns.

    Parameters
    ----------
    case : str, Case or DenseCase
        One of `clsas.selftest.cases.FACTORIZED_CASES`, or another case.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    tolerance_db : float
        Requested tolerance, see `clsas.plan`.
    repeats : int
        Number of timed rounds, which follow one that builds the kernels. A single round includes
        building them.
    progress : callable, optional
        Called as progress(rounds done, rounds).

    Returns
    -------
    dict
        Results as JSON types.

        - `seconds`: the whole call of `clsas.factorize` with a plan; `again_seconds`: a call of a
          `clsas.Imager` that has formed an image; `moved_seconds`: the same with antennas that have
          moved, and a certificate. Each runs three times in a round.
        - `exact_seconds`: `clsas.backproject` with an accuracy equal to the tolerance;
          `default_seconds`: with its default accuracy.
        - `speedup`: `exact_seconds` over `seconds`; `speedup_again`: `exact_seconds` over
          `again_seconds`; `speedup_over_default`: `default_seconds` over `seconds`;
          `speedup_whole`: `exact_seconds` over `whole_seconds`; all from medians.
        - `plan_seconds`: time of planning; `whole_seconds`: time of planning and imaging, by
          `clsas.factorize` with a tolerance.
        - `error_db`: error relative to an exact image of -80 dB.
    """
    if isinstance(case, str):
        validate.one_of("case", case, tuple(cases.FACTORIZED_CASES))
        title, case = case, cases.FACTORIZED_CASES[case]
    else:
        title = f"{case.channels} channels"
    device = open_device(device)
    lines, grid = case.lines(), case.grid
    planned = partial(plan, lines, grid, tolerance_db=tolerance_db, beam=case.beam, device=device)
    chosen = planned()
    fast = partial(factorize, lines, grid, device=device, certificate=False)
    imager, of_moved = (Imager(lines, grid, chosen, device=device) for _ in range(2))
    tracks = cycle(_raised(lines, share * wavelength_m(lines)) for share in (0.1, 0.2))
    exact = partial(form_exactly, lines, grid, beam=case.beam, device=device)
    error_db = relative_error_db(fast(chosen), exact(accuracy_db=REFERENCE_DB))
    methods: list[tuple[str, Callable[[], object]]] = [
        *_FAST_RUNS * [("plan", planned)],
        *_FAST_RUNS * [("first", lambda: fast(chosen))],
        *_FAST_RUNS * [("again", lambda: imager(lines))],
        *_FAST_RUNS * [("moved", lambda: of_moved(next(tracks)))],
        *_FAST_RUNS * [("whole", lambda: fast(tolerance_db, beam=case.beam))],
        ("exact", lambda: exact(accuracy_db=tolerance_db)),
        ("default", exact),
    ]
    planning, first, again, moved, whole, exactly, default = _in_turns(
        methods, repeats, progress
    ).values()
    return {
        "case": title,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "samples": lines.length,
        "pixels": list(grid.shape),
        "tolerance_db": tolerance_db,
        "seconds": first | {"included": "all of clsas.factorize with a given plan"},
        "again_seconds": again | {"included": "the same, by an Imager that has formed an image"},
        "moved_seconds": moved
        | {"included": "the same, with antennas that have moved, and the measurement of the error"},
        "plan_seconds": planning,
        "whole_seconds": whole | {"included": "planning and imaging"},
        "exact_seconds": exactly
        | {"included": "all of clsas.backproject, with an accuracy equal to the tolerance"},
        "default_seconds": default | {"included": "the same, with the default accuracy"},
        "speedup": exactly["median"] / first["median"],
        "speedup_again": exactly["median"] / again["median"],
        "speedup_whole": exactly["median"] / whole["median"],
        "speedup_over_default": default["median"] / first["median"],
        "error_db": error_db,
        "predicted_error_db": chosen.predicted_error_db,
        "predicted_seconds": chosen.predicted_seconds,
        "predicted_exact_seconds": chosen.exact_seconds,
        "plan": chosen.describe(),
    }


def _raised(lines: RangeLines, height_m: float) -> RangeLines:
    """Return the same samples of antennas that lie higher."""
    up_m = np.array([0.0, 0.0, height_m])
    return replace(lines, tx_m=lines.tx_m + up_m, rx_m=lines.rx_m + up_m)


def run_mosaic(
    case: str = "mosaic-wreck",
    *,
    device: Device | str | int | None = None,
    tolerance_db: float = -40.0,
    repeats: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return speed and errors of a mosaic and of exact imaging, measured in turns.

    Exact images are formed with and without a beam.

    Parameters
    ----------
    case : str
        One of `clsas.selftest.cases.MOSAIC_CASES`.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    tolerance_db : float
        Requested tolerance, see `clsas.mosaic`.
    repeats : int
        As for `run_factorized`.
    progress : callable, optional
        Called as progress(done, total) while the lines are simulated, and after every round.

    Returns
    -------
    dict
        Results as JSON types.

        - `seconds`: time of `clsas.mosaic` including planning, from lines in memory to the image in
          memory; three runs in a round.
        - `exact_seconds`, `unlimited_seconds`: time of `clsas.backproject` with and without the
          beam, with an accuracy equal to the tolerance; `default_unlimited_seconds`: without the
          beam, with the default accuracy.
        - `speedup`, `speedup_unlimited`, `speedup_over_default`: these three times over `seconds`,
          from medians.
        - `share_seen`: share of all pixel-channel pairs within the beam.
        - `error_db`: error relative to an exact image of -80 dB.
        - `shadow_contrast_difference_db`: contrast of the wreck's shadow minus that in the exact
          image.
    """
    validate.one_of("case", case, tuple(cases.MOSAIC_CASES))
    pixels, beam = cases.MOSAIC_CASES[case]
    device = open_device(device)
    lines, grid = wreck.lines(progress), wreck.grid(pixels)

    def form() -> tuple[Image, list[Record]]:
        records: list[Record] = []
        planned = mosaic(
            lines, grid, tolerance_db=tolerance_db, beam=beam, device=device, certificate=False
        )
        return planned.image(lambda patch: records.append(patch.record)), records

    exact = partial(form_exactly, lines, grid, device=device)
    formed, records = form()
    reference_image = exact(beam=beam, accuracy_db=REFERENCE_DB)
    shadow = wreck.Shadow(wreck.scene())
    contrast_db, reference_db = (shadow.contrast_db(each) for each in (formed, reference_image))
    error_db = relative_error_db(formed, reference_image)
    del formed, reference_image
    methods: list[tuple[str, Callable[[], object]]] = [
        *_FAST_RUNS * [("seconds", form)],
        ("exact_seconds", partial(exact, beam=beam, accuracy_db=tolerance_db)),
        ("unlimited_seconds", partial(exact, accuracy_db=tolerance_db)),
        ("default_unlimited_seconds", exact),
    ]
    found = _in_turns(methods, repeats, progress)
    points_m = wreck.grid(_VISIBILITY_PIXELS).positions_m().reshape(-1, 3)
    sine = sines(points_m, lines.phase_centres_m, beam.directions(lines))
    share_seen = float(is_within(sine, beam.limits).mean())
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
        "share_seen": share_seen,
        "plan_seconds": sum(record.plan_seconds for record in records),
        "speedup": found["exact_seconds"]["median"] / seconds,
        "speedup_unlimited": found["unlimited_seconds"]["median"] / seconds,
        "speedup_over_default": found["default_unlimited_seconds"]["median"] / seconds,
        "error_db": error_db,
        "predicted_error_db": max(predicted),
        "shadow_contrast_db": contrast_db,
        "shadow_contrast_difference_db": contrast_db - reference_db,
    }


def run_heights(
    case: str = "heights",
    *,
    device: Device | str | int | None = None,
    tolerance_db: float = HEIGHTS_TOLERANCE_DB,
    repeats: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return speed and errors of heights from two banks, and the time of one image.

    Parameters
    ----------
    case : str
        One of `clsas.selftest.cases.HEIGHTS_CASES`.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    tolerance_db : float
        Requested tolerance of the images, see `clsas.heights`.
    repeats : int
        As for `run_factorized`.
    progress : callable, optional
        Called as progress(rounds done, rounds).

    Returns
    -------
    dict
        Results as JSON types.

        - `seconds`: time of `clsas.heights` including all plans, of which `sweep_seconds` and
          `refinement_seconds` are parts.
        - `image_seconds`: time of a factorized image of one bank on the plane, planned before.
        - `images`: median of `seconds` in such images.
        - `error_m`, `deviation_m`: rms error of the valid heights, and rms of their stated
          deviations.
        - `valid_share`: share of the pixels with a valid height.
    """
    validate.one_of("case", case, tuple(cases.HEIGHTS_CASES))
    dunes = cases.HEIGHTS_CASES[case]
    device = open_device(device)
    grid, banks = dunes.grid, dunes.banks()
    runs: list[tuple[Heights, float, float]] = []

    def measure() -> None:
        steps: list[tuple[int, float]] = []
        start = time.perf_counter()
        found = heights(
            *banks, grid, search_m=dunes.search_m, tolerance_db=tolerance_db, device=device,
            progress=lambda done, total: steps.append((total - done, time.perf_counter())),
        )  # fmt: skip
        swept = next(at for left, at in steps if left <= PASSES)
        runs.append((found, swept - start, time.perf_counter() - swept))

    with Imager(banks[0], grid, tolerance_db=tolerance_db, device=device) as imager:
        image = partial(imager, banks[0], certificate=False)
        methods: list[tuple[str, Callable[[], object]]] = [
            ("seconds", measure),
            *_FAST_RUNS * [("image_seconds", image)],
        ]
        taken = _in_turns(methods, repeats, progress)
    found, *_ = runs[-1]
    _, sweeps, refinements = zip(*runs[-repeats:], strict=True)
    error_m = (found.height_m - dunes.height_m(*np.meshgrid(*grid.axes_m)))[found.mask]
    return {
        "case": case,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": banks[0].channels,
        "pixels": list(grid.shape),
        "tolerance_db": tolerance_db,
        **taken,
        "sweep_seconds": statistics.median(sweeps),
        "refinement_seconds": statistics.median(refinements),
        "images": taken["seconds"]["median"] / taken["image_seconds"]["median"],
        "error_m": float(np.sqrt(np.mean(error_m**2))),
        "deviation_m": float(np.sqrt(np.mean(found.sd_m[found.mask] ** 2))),
        "valid_share": float(found.mask.mean()),
    }


def _in_turns(
    methods: Sequence[tuple[str, Callable[[], object]]],
    rounds: int,
    progress: Callable[[int, int], None] | None,
) -> dict[str, dict[str, float]]:
    """Return statistics of the seconds of every method by name, from rounds of all methods.

    A name may occur several times in a round. Unless there is only one round, another one precedes
    them, which builds the kernels and is not counted.
    """
    taken: dict[str, list[float]] = {name: [] for name, _ in methods}
    warm = int(rounds > 1)
    for number in range(warm + rounds):
        for name, method in methods:
            start = time.perf_counter()
            method()
            seconds = time.perf_counter() - start
            if number >= warm:
                taken[name].append(seconds)
        if progress is not None:
            progress(number + 1, warm + rounds)
    return {name: _statistics(seconds) for name, seconds in taken.items()}


def _statistics(seconds: list[float]) -> dict[str, float]:
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}


def flops_per_pair(taps: int, phase_terms: int) -> int:
    """Return the floating-point operations of cl/backproject_tiles.cl per pixel and channel.

    The source takes 13 operations for the position, 7 + 4 (phase_terms - 1) for sine and cosine,
    and 8 to apply the phase and add. Each pair of taps takes 4 (taps/2 - 1) + 4 operations for the
    weights and 8 to apply them.
    """
    pairs = taps // 2
    return 28 + 4 * (phase_terms - 1) + pairs * (4 * (pairs - 1) + 12)


_CHAINS = (8, 12, 16)
"""Numbers of independent chains: 8 hide a latency of 4 cycles, 12 fit 16 registers, 16 fit 32."""


def peak_flops(device: Device) -> float:
    """Return the rate of independent multiply-adds of a device, flop/s (cl/peak.cl)."""
    width = device.info.width
    items, steps = 1 << 14, 1 << 11
    result = device.buffer(4 * items)
    rates = []
    for chains in _CHAINS:
        kernel = device.kernel("peak", WIDTH=width, CHAINS=chains)
        with device.profile() as times:
            for _ in range(6):
                device.run(kernel, (items,), steps=steps, factor=0.5, result=result)
        rates.append(items * steps * chains * width * 2 / times["peak"].minimum_s)
    return max(rates)
