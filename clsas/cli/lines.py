"""Commands that make and convert range lines: simulate, compress, convert."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import check_levels, load, load_lines, read_scene, warn_of_sampling
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import HDF5, INPUT, Output
from clsas.cli.wording import command
from clsas.files.formats import SUFFIXES, format_named
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


@command()
@click.argument("echoes_file", metavar="ECHOES.H5", type=HDF5)
@options.output("Range lines")
@options.scene
@options.of(clsas.compress, "window", "oversampling", "equalize", into="settings")
@options.picture("the lines")
@options.levels
@options.as_json
def compress(
    echoes_file: Path,
    output: Path,
    scene: Path | None,
    settings: dict[str, Any],
    picture: Path | None,
    levels: dict[str, Any],
    as_json: bool,
) -> None:
    """Compress echoes into range lines.

    Window, oversampling and equalization are taken from the options or, without these, from
    --scene.

    \b
    Example:  clsas compress echoes.h5 -o lines.h5 --window hamming
    """
    check_levels(levels)
    if scene is not None:
        settings = read_scene(scene).compress | settings
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
@options.of(
    clsas.RangeLines.without_background,
    "statistic",
    into="background",
    called={"statistic": ("--without-background",)},
    default="none",
)
@options.of(
    clsas.RangeLines.high_passed,
    "cutoff_hz",
    into="high_pass",
    called={"cutoff_hz": ("--high-pass-hz",)},
)
@options.of(
    clsas.RangeLines.tapered_ends, "length_m", into="taper", called={"length_m": ("--taper-m",)}
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
    of_bank: dict[str, Any],
    without_still_pings: bool,
    background: dict[str, Any],
    high_pass: dict[str, Any],
    taper: dict[str, Any],
    compensate_density: bool,
    as_json: bool,
) -> None:
    """Convert a recording to another format.

    FILE is an HDF5 file of clsas or AirSAS, a CPHD file, or a MATLAB file with a radar's phase
    history or a full matrix capture. The suffix of OUTPUT decides what is written: HDF5 (.h5) or
    CPHD (.cphd). The options keep one receiver bank, or remove faults that `clsas inspect` finds.
    They are applied in the order of this list.

    \b
    Example:  clsas convert lines.h5 lines.cphd
    """
    start = time.perf_counter()
    of_lines = bool(of_bank or without_still_pings or background or high_pass or taper)
    named = format_named(output)
    obj: Any
    if of_lines or compensate_density or (named is not None and named.has_only_lines):
        obj = load_lines(recording, **of_bank)
    else:
        obj = clsas.load(recording)
    if without_still_pings:
        obj = obj.without_still_pings()
    if background:
        obj = obj.without_background(**background)
    if high_pass:
        obj = obj.high_passed(**high_pass)
    if taper:
        obj = obj.tapered_ends(**taper)
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
