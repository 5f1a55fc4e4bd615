"""Commands that measure images and the speed of imaging: quality, tradeoff, bench."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, load_lines, read_beam, read_grid
from clsas.cli.outputs import json_able, print_json, printable, progress_bar, report, say
from clsas.cli.parameters import HDF5, INPUT, POSITION, STAGES, Output
from clsas.cli.wording import command
from clsas.engine.data import validate
from clsas.files.scene_files import SceneFile
from clsas.measures.cuts import Cut
from clsas.measures.quality import PointResponse
from clsas.measures.shadows import DARKEST, dark_level_db
from clsas.measures.tradeoff import TOLERANCES_DB


@command()
@click.argument("image_file", metavar="IMAGE.H5", type=HDF5)
@click.option(
    "--near",
    type=POSITION,
    help="Measure the point near this position on the image's axes, or near x, y, z (m).",
)
@click.option(
    "--search-m", type=float, help="Largest distance of the peak from --near (m).",
    callback=options.checked(partial(validate.positive, "search_m", unit="m")),
)  # fmt: skip
@click.option(
    "--extent-m", type=float, help="Distance from the peak within which side lobes count (m).",
    callback=options.checked(partial(validate.positive, "extent_m", unit="m")),
)  # fmt: skip
@click.option("--reference", type=INPUT, help="Exact image, against which to measure the error.")
@options.picture("cuts through the point")
@options.as_json
def quality(
    image_file: Path,
    near: tuple[float, ...] | None,
    search_m: float | None,
    extent_m: float | None,
    reference: Path | None,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Measure the contrast, a point or the error of an image.

    With --near, resolution and side lobes of a point are measured. With --reference, the error
    relative to an exact image is measured, over all pixels and in the darkest tenth of them.

    \b
    Example:  clsas quality image.h5 --near 0,42.5 --picture cuts.png
    """
    if near is None and (search_m, extent_m, picture) != (None, None, None):
        raise click.UsageError("--search-m, --extent-m and --picture require --near")
    pixels = load(image_file, clsas.Image)
    results: dict[str, Any] = {
        "entropy": clsas.entropy(pixels),
        "contrast": clsas.contrast(pixels),
    }
    text = [f"entropy {results['entropy']:.3f} nats, contrast {results['contrast']:.3f}"]
    if reference is not None:
        exact = load(reference, clsas.Image)
        error = clsas.relative_error_db(pixels, exact)
        dark_error = clsas.relative_error_db(pixels, exact, darkest=DARKEST)
        level = dark_level_db(exact)
        results["relative_error_db"] = error
        results["dark_error_db"], results["dark_level_db"] = dark_error, level
        text.append(
            f"error relative to {printable(reference)}: {error:.1f} dB; its darkest tenth is at "
            f"{level:.1f} dB, with an error of {dark_error:.1f} dB relative to that level"
        )
    if near is not None:
        response = clsas.measure_point(pixels, near, search_m=search_m, extent_m=extent_m)
        results["point"] = response
        text.append(_describe(response))
        if picture is not None:
            from clsas import plot

            plot.save(plot.cuts(response), picture)
    report(as_json, "\n".join(text), **results)


@command()
@click.argument("lines_file", metavar="[LINES.H5]", type=HDF5, required=False)
@click.option(
    "--case", help="Use lines and grid of a case of `clsas bench`: ffbp-thesis, ffbp-2k, ..."
)
@options.bank
@options.grid
@click.option(
    "--tolerance-db",
    type=float,
    multiple=True,
    callback=options.check_tolerance_db,
    help="Tolerance (dB); repeat the option for several. "
    f"[default: {' '.join(f'{db:g}' for db in TOLERANCES_DB)}]",
)
@click.option(
    "--stages",
    type=STAGES,
    metavar="QRxQI,...",
    multiple=True,
    help="Stages of the thesis's method; repeat the option for several. "
    "[default: 1 to 5 of 2x2, 2 of 2x4]",
)
@click.option(
    "--study", is_flag=True, help="Also vary the taps of the filters, and the number of stages."
)
@options.beam
@options.device
@click.option(
    "--repeats", type=click.IntRange(1), default=3, show_default=True,
    help="Number of timed runs of each image.",
)  # fmt: skip
@click.option("--csv", type=Output(".csv"), help="Also write the table.")
@options.picture("time against error")
@options.as_json
def tradeoff(
    lines_file: Path | None,
    case: str | None,
    bank: int | None,
    scene: Path | None,
    tolerance_db: tuple[float, ...],
    stages: tuple[tuple[tuple[int, int], ...], ...],
    study: bool,
    device: str | None,
    repeats: int,
    csv: Path | None,
    picture: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Measure time and error of one image at many tolerances.

    Use your own range lines, with a grid as for `clsas image`, or the lines and the grid of --case.
    Errors are relative to the exact image. Resolution and side lobes are measured at the strongest
    point.

    \b
    Example:  clsas tradeoff --case ffbp-thesis --csv tradeoff.csv --picture tradeoff.png
    """  # fmt: skip
    if lines_file is not None and case is not None:
        raise click.UsageError("--case has its own lines: leave out LINES.H5")
    if lines_file is not None:
        title = lines_file.name
        described, grid = read_grid(scene, given)
        beam = read_beam(described, given)
        lines = load_lines(lines_file, bank, described)
    elif case is None:
        raise click.UsageError("give either LINES.H5 or --case")
    else:
        title = case
        if bank is not None:
            raise click.UsageError("--case has lines of one bank: leave out --bank")
        if scene is not None or any(given[name] is not None for name in ("x", "y", "z")):
            raise click.UsageError("--case has its own grid: leave out --scene, --x, --y and --z")
        built_in = _case(case)
        lines, grid = built_in.lines(), built_in.grid
        beam = read_beam(SceneFile(name="", image={"beam": built_in.beam}), given)
    with progress_bar("imaging") as progress:
        measured = clsas.tradeoff(
            lines, grid,
            tolerances_db=tolerance_db or TOLERANCES_DB,
            stages=stages or None,
            beam=beam, device=device, repeats=repeats, study=study, progress=progress,
        )  # fmt: skip
    if csv is not None:
        measured.save_csv(csv)
    if picture is not None:
        from clsas import plot

        plot.save(plot.tradeoff(measured, title=title), picture)
    report(
        as_json,
        f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels on "
        f"{measured.device}, median of {repeats} runs; resolutions are relative to those of the "
        f"exact image, whose darkest tenth is at {measured.dark_level_db:.1f} dB\n"
        f"{measured.describe()}",
        **json_able(measured),
    )  # fmt: skip


@command()
@click.argument("case", required=False)
@options.device
@click.option(
    "--accuracy-db",
    type=float,
    callback=options.check_accuracy_db,
    help="Accuracy of exact cases (dB). [default: -50]",
)
@click.option(
    "--tolerance-db", type=float, callback=options.check_tolerance_db,
    help="Tolerance of factorized cases (dB). [default: -50; mosaic: -40]",
)  # fmt: skip
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Timed runs.")
@options.as_json
def bench(
    case: str | None,
    device: str | None,
    accuracy_db: float | None,
    tolerance_db: float | None,
    repeats: int,
    as_json: bool,
) -> None:
    """Time benchmark cases, and measure their errors.

    Without CASE, all cases run, which takes minutes. Cases bp-... form an image exactly. Cases
    ffbp-... form a factorized image, and compare it with the exact one. mosaic-wreck forms a
    mosaic, and compares it with exact images with and without a beam; its lines are simulated once,
    which takes minutes. Cases heights... measure heights from two banks, and compare their time
    with that of one image. With --json, the results of each case are one line.

    \b
    Example:  clsas bench ffbp-2k --tolerance-db -40 --json
    """
    from clsas.trials import bench as benchmark
    from clsas.trials import cases

    measures: dict[str, Callable[..., dict[str, Any]]]
    measures = dict.fromkeys(cases.EXACT_CASES, benchmark.run)
    measures |= dict.fromkeys(cases.FACTORIZED_CASES, benchmark.run_factorized)
    measures |= dict.fromkeys(cases.MOSAIC_CASES, benchmark.run_mosaic)
    measures |= dict.fromkeys(cases.HEIGHTS_CASES, benchmark.run_heights)
    if case is not None:
        _one_of(case, measures)
        if (tolerance_db if case in cases.EXACT_CASES else accuracy_db) is not None:
            raise click.UsageError("--accuracy-db is for bp-..., --tolerance-db for other cases")
    for name in [case] if case else measures:
        exact, measure = name in cases.EXACT_CASES, measures[name]
        option, value = ("accuracy_db", accuracy_db) if exact else ("tolerance_db", tolerance_db)
        request = {} if value is None else {option: value}
        with progress_bar(name) as progress:
            result = measure(name, device=device, repeats=repeats, progress=progress, **request)
        if as_json:
            print_json(result, indent=None)
            continue
        for key, value in result.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            text = ", ".join(f"{part} {_plain(item)}".strip() for part, item in parts)
            say(f"{key:>26}  " + text.replace("\n", "\n" + 28 * " "))


def _case(name: str) -> Any:
    from clsas.trials import cases

    known = cases.EXACT_CASES | cases.FACTORIZED_CASES
    _one_of(name, known)
    return known[name]


def _one_of(name: str, cases: Collection[str]) -> None:
    if name not in cases:
        raise click.BadParameter(f"{name!r} is not one of {', '.join(cases)}")


def _describe(response: PointResponse) -> str:
    def cut(cut: Cut) -> str:
        name = {"x": "azimuth", "y": "range"}.get(cut.axis, cut.axis)
        return (
            f"  {name:<13} resolution {1e3 * cut.resolution_m:.2f} mm (-3 dB), PSLR nearest "
            f"{cut.pslr_nearest_db[0]:.1f}, {cut.pslr_nearest_db[1]:.1f} dB, highest "
            f"{cut.pslr_db[0]:.1f}, {cut.pslr_db[1]:.1f} dB, ISLR {cut.islr_db:.1f} dB"
        )

    return "\n".join(
        [
            f"point at x = {response.x_m:.5f} m, y = {response.y_m:.5f} m, "
            f"z = {response.z_m:.5f} m, amplitude {response.amplitude:.6g}",
            cut(response.azimuth),
            cut(response.range),
        ]
    )


def _plain(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
