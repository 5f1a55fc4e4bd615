"""Commands that measure images, and how fast they are formed: quality, tradeoff, bench."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_beam, read_grid
from clsas.cli.outputs import json_able, print_json, progress_bar, report
from clsas.cli.parameters import INPUT, PLACE, STAGES, Output
from clsas.core import validate
from clsas.files.scene_files import SceneFile
from clsas.products.quality import Cut, PointResponse
from clsas.products.shadows import DARKEST, dark_level_db
from clsas.products.tradeoff import TOLERANCES_DB


@click.command()
@click.argument("image_file", metavar="IMAGE.H5", type=INPUT)
@click.option(
    "--near",
    type=PLACE,
    help="Measure the point near a place on the image's axes, or near x, y, z (m).",
)
@click.option(
    "--search-m", type=float, help="How far from there its peak may be.",
    callback=options.checked(partial(validate.positive, "search_m", unit="m")),
)  # fmt: skip
@click.option(
    "--extent-m", type=float, help="How far from its peak side lobes are looked for.",
    callback=options.checked(partial(validate.positive, "extent_m", unit="m")),
)  # fmt: skip
@click.option("--reference", type=INPUT, help="Image to give the relative error to.")
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
    """Measure an image: contrast, a point's response, the error to another image.

    \b
    Example:  clsas quality image.h5 --near 0,42.5 --picture cuts.png
    """
    if near is None and (search_m, extent_m, picture) != (None, None, None):
        raise click.UsageError("--search-m, --extent-m and --picture go with --near")
    pixels = load(image_file, clsas.Image)
    results: dict[str, Any] = {
        "entropy": clsas.entropy(pixels),
        "contrast": clsas.contrast(pixels),
    }
    text = [f"entropy {results['entropy']:.3f} nats, contrast {results['contrast']:.3f}"]
    if reference is not None:
        wanted = load(reference, clsas.Image)
        error = clsas.relative_error_db(pixels, wanted)
        dark_error = clsas.relative_error_db(pixels, wanted, darkest=DARKEST)
        level = dark_level_db(wanted)
        results["relative_error_db"] = error
        results["dark_error_db"], results["dark_level_db"] = dark_error, level
        text.append(
            f"error relative to {reference}: {error:.1f} dB; its darkest tenth lies at "
            f"{level:.1f} dB and errs by {dark_error:.1f} dB of that level"
        )
    if near is not None:
        response = clsas.measure_point(pixels, near, search_m=search_m, extent_m=extent_m)
        results["point"] = response
        text.append(_describe(response))
        if picture is not None:
            from clsas.products import plot

            plot.save(plot.cuts(response), picture)
    report(as_json, "\n".join(text), **results)


@click.command()
@click.argument("lines_file", metavar="[LINES.H5]", type=INPUT, required=False)
@click.option("--case", help="A built-in case of `clsas bench` instead: ffbp-thesis, ffbp-2k, ...")
@options.grid
@click.option(
    "--tolerance-db",
    type=float,
    multiple=True,
    callback=options.check_tolerance_db,
    help=f"Once for every tolerance. [default: {' '.join(f'{db:g}' for db in TOLERANCES_DB)}]",
)
@click.option(
    "--stages",
    type=STAGES,
    metavar="QRxQI,...",
    multiple=True,
    help="Once for every plan of the thesis's method. [default: 1 to 5 of 2x2, 2 of 2x4]",
)
@click.option("--study", is_flag=True, help="Also sweep the taps of filters and the stages.")
@options.beam
@options.device
@click.option("--repeats", type=click.IntRange(1), default=3, show_default=True, help="Timed runs.")
@click.option("--csv", type=Output(".csv"), help="Also write the table.")
@options.picture("time over error")
@options.as_json
def tradeoff(
    lines_file: Path | None,
    case: str | None,
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
    """Measure speed against accuracy: one image in many ways, timed and compared.

    Range lines of your own on a grid as for `clsas image`, or a built-in case. Resolution and side
    lobes are those of the strongest point.

    \b
    Example:  clsas tradeoff --case ffbp-thesis --csv tradeoff.csv --picture tradeoff.png
    """  # fmt: skip
    if lines_file is None and case is None:
        raise click.UsageError("either LINES.H5 or --case is needed")
    if lines_file is not None and case is not None:
        raise click.UsageError("--case has its own lines: LINES.H5 goes without")
    if case is None:
        described, grid = read_grid(scene, given)
        beam = read_beam(described, given)
        lines = load(lines_file, clsas.RangeLines)
    else:
        if scene is not None or any(given[name] is not None for name in ("x", "y", "z")):
            raise click.UsageError("--case has its own grid: --scene, --x, --y and --z go without")
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
        from clsas.products import plot

        plot.save(plot.tradeoff(measured, title=case or lines_file.name), picture)
    report(
        as_json,
        f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels on "
        f"{measured.device}, median of {repeats} runs; resolutions over those of the exact "
        f"image; its darkest tenth at {measured.dark_level_db:.1f} dB\n{measured.describe()}",
        **json_able(measured),
    )  # fmt: skip


@click.command()
@click.argument("case", required=False)
@options.device
@click.option(
    "--accuracy-db",
    type=float,
    callback=options.check_accuracy_db,
    help="Error wanted in exact cases. [default: -50]",
)
@click.option(
    "--tolerance-db", type=float, callback=options.check_tolerance_db,
    help="And in factorized ones. [default: -50, of the mosaic -40]",
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
    """Time a benchmark case and measure its error; without CASE, all of them run for minutes.

    Cases bp-... are exact imaging; cases ffbp-... are factorized imaging, compared with exact
    imaging; mosaic-wreck is a mosaic, compared with exact imaging with and without the beam's
    limits (its lines are simulated first, once, for minutes). With --json every case is one line.

    \b
    Example:  clsas bench ffbp-2k --tolerance-db -40 --json
    """
    from clsas.trials import bench as benchmark

    measures = dict.fromkeys(benchmark.CASES, benchmark.run)
    measures |= dict.fromkeys(benchmark.FACTORIZED, benchmark.run_factorized)
    measures |= dict.fromkeys(benchmark.MOSAICS, benchmark.run_mosaic)
    if case is not None:
        _one_of(case, measures)
        if (tolerance_db if case in benchmark.CASES else accuracy_db) is not None:
            raise click.UsageError("--accuracy-db goes with bp-..., --tolerance-db with others")
    for name in [case] if case else measures:
        exact, measure = name in benchmark.CASES, measures[name]
        option, value = ("accuracy_db", accuracy_db) if exact else ("tolerance_db", tolerance_db)
        wish = {} if value is None else {option: value}
        with progress_bar(name) as progress:
            result = measure(name, device=device, repeats=repeats, progress=progress, **wish)
        if as_json:
            print_json(result, indent=None)
            continue
        for key, value in result.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            told = ", ".join(f"{part} {_plain(item)}".strip() for part, item in parts)
            click.echo(f"{key:>26}  " + told.replace("\n", "\n" + 28 * " "))


def _case(name: str) -> Any:
    from clsas.trials import bench

    cases = bench.CASES | bench.FACTORIZED
    _one_of(name, cases)
    return cases[name]


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
