"""Commands that make and convert range lines: simulate, compress, convert."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, load_lines, read_levels, read_scene, warn_of_sampling
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import HDF5, INPUT, Output
from clsas.cli.wording import command
from clsas.engine.data import validate
from clsas.engine.data.lines import STATISTICS
from clsas.engine.signal.compression import check_options
from clsas.files.cphd import SUFFIXES as CPHD
from clsas.files.formats import SUFFIXES
from clsas.measures.density import noise_penalty_db
from clsas.simulation.simulator import check_size


@command()
@click.argument("scene_file", metavar="SCENE.TOML", type=INPUT)
@options.output("Echoes")
@options.picture("track and grid")
@options.as_json
def simulate(scene_file: Path, output: Path, picture: Path | None, as_json: bool) -> None:
    """Simulate the echoes that a scene file describes.

    A warning is printed for every sampling limit that the survey exceeds.

    \b
    Example:  clsas simulate scene.toml -o echoes.h5
    """
    scene = read_scene(scene_file)
    sonar, track, targets = scene.need("sonar", "track", "targets")
    check_size(sonar, track, scene.simulate.get("range_m"))
    warn_of_sampling(scene)
    with progress_bar("simulating") as progress:
        start = time.perf_counter()
        echoes = clsas.simulate(sonar, track, targets, **scene.simulate, progress=progress)
        seconds = time.perf_counter() - start
    clsas.save(output, echoes)
    if picture is not None:
        from clsas import plot

        plot.save(plot.geometry(echoes, scene.grid), picture)
    report(
        as_json,
        f"{printable(output)}: {echoes.channels} channels of {echoes.length} samples in "
        f"{seconds:.2f} s",
        file=output, picture=picture, channels=echoes.channels, length=echoes.length,
        seconds=seconds,
    )  # fmt: skip


def _check_window(window: str) -> None:
    """Raise ValueError unless a window is one that a word describes."""
    try:
        check_options(window=window)
    except ValueError:
        raise ValueError(
            "must be none or a window of SciPy without parameters, such as hamming, hann or "
            f"taylor, got {validate.shown(window)}"
        ) from None


@command()
@click.argument("echoes_file", metavar="ECHOES.H5", type=HDF5)
@options.output("Range lines")
@options.scene
@click.option(
    "--window", help="Window over the band, such as hamming or taylor. [default: none]",
    callback=options.checked(_check_window),
)  # fmt: skip
@click.option(
    "--oversampling", type=float, help="Samples per bandwidth. [default: 2]",
    callback=options.checked(lambda rate: check_options(oversampling=rate)),
)  # fmt: skip
@click.option(
    "--equalize", is_flag=True, default=None,
    help="Remove the ripples of the pulse's spectrum, and the range side lobes that they cause.",
)  # fmt: skip
@options.picture("the lines")
@options.levels
@options.as_json
def compress(
    echoes_file: Path,
    output: Path,
    scene: Path | None,
    window: str | None,
    oversampling: float | None,
    equalize: bool | None,
    picture: Path | None,
    dynamic_range_db: float | None,
    percentiles: tuple[float, float] | None,
    colour_map: str | None,
    as_json: bool,
) -> None:
    """Compress echoes into range lines.

    Window, oversampling and equalization are taken from the options or, without these, from
    --scene.

    \b
    Example:  clsas compress echoes.h5 -o lines.h5 --window hamming
    """
    levels = read_levels(dynamic_range_db, percentiles, colour_map)
    settings = _overridden(
        read_scene(scene).compress if scene else {},
        window=window,
        oversampling=oversampling,
        equalize=equalize,
    )
    echoes = load(echoes_file, clsas.Echoes)
    with progress_bar("compressing") as progress:
        start = time.perf_counter()
        lines = clsas.compress(echoes, **settings, progress=progress)
        seconds = time.perf_counter() - start
    clsas.save(output, lines)
    if picture is not None:
        from clsas import plot

        plot.save(plot.range_lines(lines, **levels), picture)
    report(
        as_json,
        f"{printable(output)}: {lines.channels} lines of {lines.length} samples, "
        f"{1e3 * lines.range_step_m:.4g} mm apart, in {seconds:.2f} s",
        file=output, picture=picture, channels=lines.channels, length=lines.length,
        range_step_m=lines.range_step_m, seconds=seconds,
    )  # fmt: skip


@command()
@click.argument("recording", metavar="FILE", type=INPUT)
@click.argument("output", metavar="OUTPUT", type=Output(*SUFFIXES))
@options.bank
@click.option(
    "--without-still-pings",
    is_flag=True,
    help="Drop pings that were taken while the sonar stood still.",
)
@click.option(
    "--without-background",
    type=click.Choice(STATISTICS),
    help="Subtract this statistic of all pings from every ping.",
)
@click.option(
    "--high-pass-hz",
    type=float,
    help="Keep frequencies of the recorded signal above this one (Hz), and remove those below half "
    "of it.",
    callback=options.checked(partial(validate.positive, "high_pass_hz", unit="Hz")),
)
@click.option(
    "--taper-m",
    type=float,
    help="Fade the lines over this range at either end (m).",
    callback=options.checked(partial(validate.positive, "taper_m", unit="m")),
)
@click.option(
    "--compensate-density",
    is_flag=True,
    help="Weight every channel by the length of track that its phase centre stands for, which "
    "removes the ghosts of repeated phase centres.",
)
@options.as_json
def convert(
    recording: Path,
    output: Path,
    bank: int | None,
    without_still_pings: bool,
    without_background: str | None,
    high_pass_hz: float | None,
    taper_m: float | None,
    compensate_density: bool,
    as_json: bool,
) -> None:
    """Convert a recording to HDF5 or CPHD.

    FILE is an HDF5 file of clsas or AirSAS, a CPHD file, or a MATLAB file with a radar's phase
    history or a full matrix capture. The suffix of OUTPUT decides what is written: HDF5 (.h5) or
    CPHD (.cphd). The options keep one receiver bank, or remove faults that `clsas inspect` finds.
    They are applied in the order of this list.

    \b
    Example:  clsas convert lines.h5 lines.cphd
    """
    start = time.perf_counter()
    steps: list[Callable[[clsas.RangeLines], clsas.RangeLines]] = []
    if without_still_pings:
        steps.append(lambda lines: lines.without_still_pings())
    if without_background is not None:
        steps.append(lambda lines: lines.without_background(without_background))
    if high_pass_hz is not None:
        steps.append(lambda lines: lines.high_passed(high_pass_hz))
    if taper_m is not None:
        steps.append(lambda lines: lines.tapered_ends(taper_m))
    obj: Any
    if steps or compensate_density or bank is not None or output.suffix.lower() in CPHD:
        obj = load_lines(recording, bank)
    else:
        obj = clsas.load(recording)
    for step in steps:
        obj = step(obj)
    noise: dict[str, float] = {}
    if compensate_density:
        weights = clsas.density_weights(obj)
        obj, noise = obj.weighted(weights), {"noise_penalty_db": noise_penalty_db(weights)}
    clsas.save(output, obj)
    seconds = time.perf_counter() - start
    report(
        as_json,
        f"{printable(output)}: {obj!r} in {seconds:.2f} s"
        + "".join(f"\n  the weights raise the noise by {each:.2f} dB" for each in noise.values()),
        file=output, kind=type(obj).__name__, seconds=seconds, **noise,
    )  # fmt: skip


def _overridden(described: dict[str, Any], **given: Any) -> dict[str, Any]:
    """Return the settings of a scene file, with those replaced that options give."""
    return described | {name: value for name, value in given.items() if value is not None}
