"""Commands that measure images and the speed of imaging: certify, quality, tradeoff, bench."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, load_lines, read_beam, read_grid, read_scene
from clsas.cli.outputs import json_able, print_json, printable, progress_bar, report, say
from clsas.cli.parameters import HDF5, HDF5_OR_STORE, INPUT, POSITION, STAGES, Output
from clsas.cli.wording import command
from clsas.engine.data.decibels import level_db
from clsas.engine.data.reprs import Table
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import TOLERANCE_DB, Request
from clsas.files.scene_files import SceneFile
from clsas.maps.sources import Source
from clsas.measures.quality import DARKEST, Cut, PointResponse, dark_level_db
from clsas.mosaics.document import requested_db


@command()
@click.argument("image_file", metavar="IMAGE.H5", type=HDF5_OR_STORE)
@click.argument("lines_file", metavar="LINES.H5", type=HDF5)
@options.bank
@options.scene
@options.beam
@options.of(clsas.certify, "pixels", "seed", "scale", into="how")
@options.device
@options.as_json
def certify(
    image_file: Path,
    lines_file: Path,
    of_bank: dict[str, Any],
    scene: Path | None,
    beam: dict[str, Any],
    how: dict[str, Any],
    device: str | None,
    as_json: bool,
) -> None:
    """Measure the error of an image against its range lines.

    A few hundred pixels are formed again, straight from the lines and the
    positions of the antennas, and compared with those of the image. It may come from any imager or
    program, and be the Zarr store of a mosaic that fits into memory. LINES.H5 may also be a
    recording of another kind. The beam is that of the options if any is given, else that with which
    clsas formed the image, or else that of the scene, which may also have the sound speed.

    \b
    Example:  clsas certify image.h5 lines.h5
    """
    described = read_scene(scene) if scene is not None else SceneFile(name="")
    lines = load_lines(lines_file, described, **of_bank)
    tolerance_db = None
    if image_file.is_dir():
        store = clsas.Store.opened(image_file)
        Source.of(store, None).check_finished("image")
        image, inputs = store.image(), store.document.inputs
        tolerance_db, of_store = requested_db(inputs), inputs.get("beam")
        described = replace(described, image={"beam": of_store and clsas.BeamWindow(**of_store)})
    else:
        image = load(image_file, clsas.Image)
        if (formed := image.formed) is not None:
            tolerance_db = formed.tolerance_db
            described = replace(described, image={"beam": formed.beam})
    found = clsas.certify(image, lines, beam=read_beam(described, beam), **how, device=device)
    figures = found.figures
    text = found.describe(tolerance_db)
    if found.worst is not None and found.worst_db is not None:
        places = tuple(found.worst.T)
        figures["worst_m"] = image.grid.at(np.ravel_multi_index(places, image.shape))
        figures["worst_level_db"] = level_db(image.pixels[places], math.sqrt(found.power))
        headings = ("row", "column") if len(image.shape) == 2 else ("pixel",) * len(image.shape)
        numbers = zip(
            found.worst, figures["worst_m"], found.worst_db, figures["worst_level_db"], strict=True
        )
        rows = [
            [*map(str, index), *(f"{each:.4f}" for each in at_m), f"{error:.1f}", f"{level:.1f}"]
            for index, at_m, error, level in numbers
        ]
        table = Table((*headings, "x (m)", "y (m)", "z (m)", "error (dB)", "level (dB)"), rows)
        heading = "the worst of these pixels, relative to the rms amplitude of the image:"
        text += "\n".join(["", heading, *table.lines()])
    report(as_json, text, **figures)


@command()
@click.argument("image_file", metavar="IMAGE.H5", type=HDF5)
@click.option(
    "--near",
    type=POSITION,
    help="Measure the point near this position on the image's axes, or near x, y, z.",
)
@options.of(clsas.measure_point, "search_m", "extent_m", into="within", beside="--near")
@click.option("--reference", type=INPUT, help="Exact image, against which to measure the error.")
@options.picture("cuts through the point")
@options.as_json
def quality(
    image_file: Path,
    near: tuple[float, ...] | None,
    within: dict[str, Any],
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
    if near is None and (within or picture is not None):
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
        response = clsas.measure_point(pixels, near, **within)
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
@options.of(
    clsas.tradeoff, "tolerances_db", "stages", "study", into="ways",
    called={"tolerances_db": ("--tolerance-db",)}, types={"tolerances_db": float, "stages": STAGES},
)  # fmt: skip
@options.beam
@options.device
@options.of(clsas.tradeoff, "repeats", into="ways")
@click.option("--csv", type=Output(".csv"), help="Also write the table.")
@options.picture("time against error")
@options.as_json
def tradeoff(
    lines_file: Path | None,
    case: str | None,
    of_bank: dict[str, Any],
    scene: Path | None,
    axes: dict[str, Any],
    ways: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    csv: Path | None,
    picture: Path | None,
    as_json: bool,
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
        described, grid = read_grid(scene, axes)
        window = read_beam(described, beam)
        lines = load_lines(lines_file, described, **of_bank)
    elif case is None:
        raise click.UsageError("give either LINES.H5 or --case")
    else:
        title = case
        if of_bank:
            raise click.UsageError("--case has lines of one bank: leave out --bank")
        if scene is not None or axes:
            raise click.UsageError("--case has its own grid: leave out --scene, --x, --y and --z")
        built_in = _case(case)
        lines, grid = built_in.lines(), built_in.grid
        window = read_beam(SceneFile(name="", image={"beam": built_in.beam}), beam)
    with progress_bar("imaging") as progress:
        measured = clsas.tradeoff(
            lines, grid, **ways, beam=window, device=device, progress=progress
        )
    if csv is not None:
        measured.save_csv(csv)
    if picture is not None:
        from clsas import plot

        plot.save(plot.tradeoff(measured, title=title), picture)
    report(
        as_json,
        f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels on "
        f"{measured.device}, median of {measured.repeats} runs; resolutions are relative to those "
        f"of the exact image, whose darkest tenth is at {measured.dark_level_db:.1f} dB\n"
        f"{measured.describe()}",
        **json_able(measured),
    )  # fmt: skip


@command()
@click.argument("case", required=False)
@options.device
@options.of(ExactImage, "accuracy_db", into="exactly", default=f"{TOLERANCE_DB:g}, of exact cases")
@options.of(
    Request,
    "tolerance_db",
    into="tolerance",
    default=f"{TOLERANCE_DB:g}, of factorized cases; others: -40",
)
@options.of(clsas.tradeoff, "repeats", into="timed", default="5")
@options.as_json
def bench(
    case: str | None,
    device: str | None,
    exactly: dict[str, Any],
    tolerance: dict[str, Any],
    timed: dict[str, Any],
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
    from clsas.selftest import bench as benchmark
    from clsas.selftest import cases

    measures: dict[str, Callable[..., dict[str, Any]]]
    measures = dict.fromkeys(cases.EXACT_CASES, benchmark.run)
    measures |= dict.fromkeys(cases.FACTORIZED_CASES, benchmark.run_factorized)
    measures |= dict.fromkeys(cases.MOSAIC_CASES, benchmark.run_mosaic)
    measures |= dict.fromkeys(cases.HEIGHTS_CASES, benchmark.run_heights)
    if case is not None:
        _one_of(case, measures)
        other = tolerance if case in cases.EXACT_CASES else exactly
        if other:
            raise click.UsageError("--accuracy-db is for bp-..., --tolerance-db for other cases")
    for name in [case] if case else measures:
        request = {"repeats": 5} | timed | (exactly if name in cases.EXACT_CASES else tolerance)
        with progress_bar(name) as progress:
            result = measures[name](name, device=device, progress=progress, **request)
        if as_json:
            print_json(result, indent=None)
            continue
        for key, value in result.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            text = ", ".join(f"{part} {_plain(item)}".strip() for part, item in parts)
            say(f"{key:>26}  " + text.replace("\n", "\n" + 28 * " "))


def _case(name: str) -> Any:
    from clsas.selftest import cases

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
