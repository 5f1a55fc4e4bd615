"""Commands that plan an image of range lines, or form it: image, plan."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import (
    check_levels,
    load_lines,
    read_beam,
    read_grid,
    read_request,
    warn_of_sampling,
)
from clsas.cli.outputs import printable, progress_bar, report, say, warn
from clsas.cli.parameters import HDF5
from clsas.cli.wording import command
from clsas.engine.device.device import KernelTimes, open_device
from clsas.engine.factorized.planner import DEFAULT_REQUEST, WORST_TOLERANCE_DB
from clsas.files.scene_tables import PLAN_KEYS

_BUILD_SHARE = 0.1  # of an image's time; if building kernels takes more, it is reported


@command()
@click.argument("lines_file", metavar="LINES.H5", type=HDF5)
@options.output("Image")
@options.bank
@options.grid
@options.method
@click.option(
    "--exact", is_flag=True, help="Form an exact image. The three options below imply this one."
)
@options.exactly
@options.beam
@options.promise
@options.device
@options.picture("the image in dB")
@options.levels
@click.option("--profile", is_flag=True, help="Also report the time spent in each kernel.")
@options.as_json
@options.refusing_unreached
def image(
    lines_file: Path,
    output: Path,
    of_bank: dict[str, Any],
    scene: Path | None,
    axes: dict[str, Any],
    request: dict[str, Any],
    exact: bool,
    beam: dict[str, Any],
    promise: dict[str, Any],
    device: str | None,
    picture: Path | None,
    levels: dict[str, Any],
    profile: bool,
    as_json: bool,
) -> None:
    """Form an image of range lines, to a tolerance or exactly.

    The grid is that of --scene, or given by --x, --y and --z. Choose the method by one of
    --tolerance-db, --tolerance-wavelengths, --stages and --exact, or by [image] of the scene. The
    default is a tolerance of -50 dB against the exact image. If no faster method meets the
    tolerance, the image is formed exactly. The error of the image is then measured at some pixels,
    as by `clsas certify`. LINES.H5 may also be a recording of another kind.

    \b
    Example:  clsas image lines.h5 --x -2.5:2.5:1024 --y 40:45:1024 -o image.h5 --picture image.png
    """
    check_levels(levels)
    described, grid = read_grid(scene, axes)
    request = read_request(described, request, exact)
    window = read_beam(described, beam)
    # `clsas simulate` has already warned about the scene's own grid.
    if described.targets is None or grid is not described.grid:
        warn_of_sampling(described, grid)
    lines = load_lines(lines_file, described, **of_bank)
    opened = open_device(device)
    imager, chosen, planned_s = None, None, None
    if request.keys() & set(PLAN_KEYS):
        start = time.perf_counter()
        if "tolerance_db" in request:  # which other plans do not promise to meet
            imager = clsas.Imager(lines, grid, **request, beam=window, device=opened)
        else:
            planned = clsas.plan(lines, grid, **request, beam=window, device=opened)
            _warn_of_error(planned)
            imager = clsas.Imager(lines, grid, planned, device=opened)
        chosen = imager.plan  # before another one replaces it, if the image misses its tolerance
        planned_s = time.perf_counter() - start
    promise = described.promise | promise
    profiling: AbstractContextManager[dict[str, KernelTimes]] = nullcontext({})
    if profile:
        profiling = opened.profile()
    with progress_bar("imaging") as progress, profiling as kernels:
        built_before_s, start = opened.build_seconds, time.perf_counter()
        if imager is not None:
            formed = imager(lines, **promise, progress=progress)
        else:
            formed = clsas.backproject(
                lines, grid, **request, beam=window, device=opened, **promise, progress=progress
            )
        seconds = time.perf_counter() - start
        built_s = opened.build_seconds - built_before_s
    clsas.save(output, formed)
    if picture is not None:
        from clsas import plot

        plot.save(plot.image_db(formed, **levels), picture)
    words, error, figures = _results(formed, chosen)
    if planned_s is not None:
        figures["plan_seconds"] = planned_s
    certificate = figures["certificate"]
    duration = _duration(seconds, built_s, planned_s, certificate and certificate["seconds"])
    report(
        as_json,
        f"{printable(output)}: {' x '.join(map(str, grid.shape))} pixels from "
        f"{lines.channels} lines in {duration} on {opened.info.label} ({words}){error}"
        + _table(kernels),
        file=output, picture=picture, shape=grid.shape, channels=lines.channels,
        device=opened.info.label, driver=opened.info.driver, **figures, seconds=seconds,
        build_seconds=built_s, kernels=kernels,
    )  # fmt: skip


def _results(image: clsas.Image, chosen: clsas.Plan | None) -> tuple[str, str, dict[str, Any]]:
    """Return how an image was formed and its measured error, in words, and both in JSON's types."""
    formed = image.formed
    assert formed is not None
    error_db, certificate = formed.predicted_error_db, formed.certificate
    parts = [formed.plan, "all pixels are zero"]
    if error_db is not None:
        parts[-1] = f"predicted error {error_db:.0f} dB"
    if formed.left_out:
        parts.append(f"without {', '.join(formed.left_out)}, far below the error allowed")
    figures = {
        "method": formed.method,
        "how": formed.plan,
        "predicted_error_db": error_db,
        "certificate": None if certificate is None else certificate.figures,
        "misses": formed.misses,
        "is_zero": error_db is None,
        "left_out": formed.left_out,
    }
    if chosen is not None:
        figures["predicted_seconds"] = chosen.predicted_seconds
        if chosen.tolerance_db is None:
            figures["method"] = "stages"
        elif chosen.is_exact:
            parts.insert(0, f"exact: nothing faster within {chosen.tolerance_db:.4g} dB")
    words = "; ".join(parts)
    if certificate is None:
        return words, "", figures
    return words, f"\n  {certificate.describe(formed.tolerance_db)}", figures


def _duration(
    seconds: float, built_s: float, planned_s: float | None, measured_s: float | None
) -> str:
    """Return the time of an image in words, with the parts that later images do not repeat."""
    parts = []
    if built_s > _BUILD_SHARE * seconds:
        parts.append(f"{built_s:.2f} s of that to build kernels, which the driver keeps")
    if measured_s is not None:
        parts.append(f"{measured_s:.2f} s {'' if parts else 'of that '}to measure its error")
    words = f"{seconds:.2f} s" + (f" ({', and '.join(parts)})" if parts else "")
    return words if planned_s is None else f"{words}, planned in {planned_s:.2f} s"


def _table(kernels: dict[str, KernelTimes]) -> str:
    """Return the times of every kernel, each on a line of its own."""
    return "".join(
        f"\n  {name}: {times.count} runs of {1e3 * times.minimum_s:.3g} to "
        f"{1e3 * times.maximum_s:.3g} ms, median {1e3 * times.median_s:.3g} ms"
        for name, times in kernels.items()
    )


@command()
@click.argument("lines_file", metavar="LINES.H5", type=HDF5)
@options.bank
@options.grid
@options.method
@options.beam
@options.device
@options.as_json
@click.option(
    "--filters", is_flag=True,
    help="With --json, include the coefficients of the filters. The plan is then complete.",
)  # fmt: skip
def plan(
    lines_file: Path,
    of_bank: dict[str, Any],
    scene: Path | None,
    axes: dict[str, Any],
    request: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    as_json: bool,
    filters: bool,
) -> None:
    """Show how an image would be formed, its time and its error.

    Specify grid, method and beam as for `clsas image`. If the scene requests an exact image, a
    tolerance of -50 dB is used instead. With --json and --filters, the output is a complete plan,
    which `clsas show` draws and clsas.Plan.from_json reads.

    \b
    Example:  clsas plan lines.h5 --x -2.5:2.5:1024 --y 40:45:1024 --tolerance-db -40
    """
    if filters and not as_json:
        raise click.UsageError("--filters requires --json")
    described, grid = read_grid(scene, axes)
    request = read_request(described, request)
    window = read_beam(described, beam)
    lines = load_lines(lines_file, described, **of_bank)
    if not request.keys() & set(PLAN_KEYS):
        request = DEFAULT_REQUEST
    chosen = clsas.plan(lines, grid, **request, beam=window, device=device)
    _warn_of_error(chosen)
    say(chosen.to_json(filters=filters) if as_json else chosen.describe())


def _warn_of_error(chosen: clsas.Plan) -> None:
    """Warn if the error of the thesis's method may be about as large as the image."""
    if chosen.tolerance_db is None and chosen.predicted_error_db > WORST_TOLERANCE_DB:
        warn(
            "with these stages the error may be as large as "
            f"{chosen.predicted_error_db:.0f} dB, too large for a useful image: sum fewer lines "
            "(QR), or divide more (QI)"
        )
