"""The `clsas` command: a thin layer over the library, one function per subcommand.

Results go to standard output, progress and warnings to standard error. Exit codes: 0 done, 1 error
(one `Error:` message), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import pyopencl
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

import clsas
from clsas import demo as demonstration
from clsas import validate
from clsas.backproject import BEST_ACCURACY_DB, execute, prepare
from clsas.config import DIAL, EXACT, SceneFile, read_scene, simulation_digest
from clsas.device import choose, open_device
from clsas.interpolation import TAPS
from clsas.planner import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB, wavelengths
from clsas.quality import Cut, PointResponse
from clsas.tradeoff import TOLERANCES_DB, summary
from clsas.validate import positive
from clsas.window import SHAPES

_DEFAULT = {"tolerance_db": -50.0}
_SCHEDULER_S = 10  # to answer

# What users cause, and what machines lack.
_ERRORS = (
    ValueError,
    TypeError,
    clsas.DeviceError,
    pyopencl.Error,
    OSError,
    ImportError,
    MemoryError,
)


class _Commands(click.Group):
    """Turns what the library raises and warns of into messages and exit codes."""

    def invoke(self, ctx: click.Context) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("always", clsas.ClsasWarning)
            warnings.simplefilter("ignore", pyopencl.CompilerWarning)
            warnings.showwarning = _show_warning
            try:
                return super().invoke(ctx)
            except BrokenPipeError:
                raise  # click's: whoever reads our output has left
            except KeyboardInterrupt:
                click.echo("Interrupted", err=True)
                ctx.exit(130)
            except _ERRORS as error:
                if ctx.params.get("traceback"):
                    raise
                raise click.ClickException(_message(error)) from error


class _Axis(click.ParamType):
    name = "START:STOP:N"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, float, int]:
        try:
            start, stop, count = value.split(":")
            axis = float(start), float(stop), int(count)
        except ValueError:
            axis = math.nan, math.nan, 0
        if not (np.isfinite(axis).all() and axis[2] > 0):
            self.fail(f"{value!r} must be START:STOP:N, metres and a number of pixels", param, ctx)
        return axis


class _Place(click.ParamType):
    name = "X,Y"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, float]:
        try:
            x, y = value.split(",")
            return float(x), float(y)
        except ValueError:
            self.fail(f"{value!r} must be X,Y in metres", param, ctx)


class _Ratio(click.ParamType):
    name = "NUMBER"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        try:
            return float(Fraction(value))
        except (ValueError, ZeroDivisionError, OverflowError):
            self.fail(f"{value!r} must be a number or a fraction such as 1/30", param, ctx)


class _Stages(click.ParamType):
    name = "stages"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[tuple[int, int], ...]:
        try:
            pairs = [stage.lower().split("x") for stage in value.split(",")]
            stages = tuple((int(beams), int(divisions)) for beams, divisions in pairs)
        except ValueError:
            stages = ((0, 0),)
        if np.min(stages) < 1:
            self.fail(f"{value!r} must be QRxQI for every stage, such as 2x2,2x2", param, ctx)
        return stages


class _Counts(click.ParamType):
    name = "ROWSxCOLUMNS"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        try:
            rows, columns = value.lower().split("x")
            return int(rows), int(columns)
        except ValueError:
            self.fail(f"{value!r} must be ROWSxCOLUMNS, such as 8x8", param, ctx)


class _Output(click.Path):
    """A file to write: what would keep it from being written is said before any work."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        path: Any = super().convert(value, param, ctx)
        if not path.parent.is_dir():
            self.fail(f"there is no folder {str(path.parent)!r}", param, ctx)
        try:
            special = _exists(path) and not path.is_file()
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            self.fail(f"{str(path)!r} cannot be written: {error.strerror}", param, ctx)
        if special:
            self.fail(f"{str(path)!r} is not an ordinary file", param, ctx)
        for other in ctx.command.params:
            # Whichever comes second on the command line finds the first one here.
            taken = ctx.params.get(other.name) if isinstance(other.type, _Output) else None
            if other is not param and taken is not None and taken.resolve() == path.resolve():
                self.fail(f"{other.opts[0]} and {param.opts[0]} must be two files", param, ctx)
        if param.name == "png":
            _need_matplotlib()
        return path


def _exists(path: Path) -> bool:
    """Return whether a path is taken; raises OSError where it cannot be (a long name)."""
    try:
        path.stat()
    except FileNotFoundError:
        return False
    return True


def _need_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise click.ClickException("pictures need matplotlib: pip install 'clsas[plot]'")


_INPUT = click.Path(exists=True, dir_okay=False, path_type=Path)


def _checked(check: Callable[[Any], object]) -> Callable:
    """Return an option's callback that makes a usage error of what a check of its value raises."""

    def callback(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        try:
            for each in value if param.multiple else [value]:
                if each is not None:
                    check(each)
        except (TypeError, ValueError) as error:
            raise click.BadParameter(str(error), ctx, param) from error
        return value

    return callback


def _output(kind: str) -> Callable:
    return click.option("-o", "--output", type=_Output(), required=True, help=f"{kind} to write.")


def _png(what: str) -> Callable:
    return click.option("--png", type=_Output(), help=f"Also draw {what}.")


_as_json = click.option("--json", "as_json", is_flag=True, help="Print results as JSON.")
_dynamic_range = click.option(
    "--dynamic-range-db", type=float, default=60.0, show_default=True, help="Of the PNG.",
    callback=_checked(partial(positive, "dynamic_range_db", unit="dB")),
)  # fmt: skip
_scene = click.option("--scene", type=_INPUT, help="Scene file for what the options leave out.")
_device = click.option("--device", help="Index or part of the name, as `clsas devices` shows.")


def _together(*options: Callable) -> Callable:
    """Return several options as one decorator, in the order in which --help shows them."""

    def decorate(command: Callable) -> Callable:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


_axes = _together(
    click.option("--x", type=_Axis(), help="First and last pixel centre along x (m), how many."),
    click.option("--y", type=_Axis(), help="The same along y."),
    click.option(
        "--z", type=float, callback=_checked(partial(validate.number, "z", unit="m")),
        help="Height of the plane (m). [default: 0]",
    ),
)  # fmt: skip
_grid = _together(_scene, _axes)
_tolerance_db = _checked(
    partial(
        validate.number, "tolerance_db", unit="dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
    )
)
_accuracy_db = _checked(
    partial(validate.number, "accuracy_db", unit="dB", least=BEST_ACCURACY_DB, below=0.0)
)
_dial = _together(
    click.option(
        "--tolerance-db", type=float, callback=_tolerance_db,
        help="Relative rms error allowed against the exact image. [default: -50]",
    ),
    click.option(
        "--tolerance-wavelengths", type=_Ratio(),
        callback=_checked(
            partial(
                validate.number, "tolerance_wavelengths", unit="wavelengths",
                least=wavelengths(BEST_TOLERANCE_DB), most=wavelengths(WORST_TOLERANCE_DB),
            )
        ),
        help="The same as a range error in wavelengths, such as 1/30.",
    ),
    click.option(
        "--stages", type=_Stages(), metavar="QRxQI,...",
        help="The thesis's method: QR and QI of every stage, such as 2x2,2x2.",
    ),
)  # fmt: skip
_beam = _together(
    click.option("--beam-deg", type=float, help="Use a beam of this full width only."),
    click.option(
        "--beam-shape", type=click.Choice(SHAPES), help="Its shape. [default: rectangular]"
    ),
    click.option("--squint-deg", type=float, help="Its middle, ahead of broadside. [default: 0]"),
    click.option(
        "--element-length-m", type=float,
        help="For the shape 'inverse', which divides by the two-way pattern of such elements.",
    ),
)  # fmt: skip


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(clsas.__version__, prog_name="clsas")
@click.option("--traceback", is_flag=True, help="Show Python's traceback of an error.")
def main(traceback: bool) -> None:
    """Synthetic aperture sonar images in the time domain, on any OpenCL device.

    \b
    A first try:     clsas demo
    Step by step:    clsas simulate scene.toml -o echoes.h5
                     clsas compress echoes.h5 -o lines.h5
                     clsas image lines.h5 --scene scene.toml -o image.h5 --png image.png
                     clsas quality image.h5 --near 0,42.5
    """


@main.command()
@_as_json
def devices(as_json: bool) -> None:
    """List OpenCL devices, and say which one is used and why.

    \b
    Example:  CLSAS_DEVICE=0 clsas devices
    """
    used, reason = choose()
    found = clsas.list_devices()
    if as_json:
        _print_json({"devices": found, "used": used.index, "reason": reason})
        return
    for info in found:
        click.echo(
            f"{info.index}  {info.label}\n"
            f"   driver {info.driver}\n"
            f"   {info.kind.upper()}, {info.compute_units} compute units, "
            f"{info.memory_bytes / 2**30:.1f} GiB ({info.max_buffer_bytes / 2**30:.1f} GiB in one "
            f"buffer), {'fp64' if info.fp64 else 'no fp64'}, vectors of {info.width}"
        )
    click.echo(f"Used: {used.index} ({reason})")


@main.command()
@click.argument("scene_file", metavar="SCENE.TOML", type=_INPUT)
@_output("Echoes")
@_png("track and grid")
@_as_json
def simulate(scene_file: Path, output: Path, png: Path | None, as_json: bool) -> None:
    """Simulate the echoes of a scene file.

    \b
    Example:  clsas simulate scene.toml -o echoes.h5
    """
    scene = read_scene(scene_file)
    sonar, track, targets = scene.need("sonar", "track", "targets")
    _warn_of_sampling(scene)
    with _progress("simulating") as progress:
        start = time.perf_counter()
        echoes = clsas.simulate(sonar, track, targets, **scene.simulate, progress=progress)
        seconds = time.perf_counter() - start
    clsas.save(output, echoes)
    if png is not None:
        from clsas import plot

        plot.save_png(plot.geometry(echoes, scene.grid), png)
    _report(
        as_json,
        f"{output}: {echoes.channels} channels of {echoes.length} samples in {seconds:.2f} s",
        file=output, png=png, channels=echoes.channels, length=echoes.length, seconds=seconds,
    )  # fmt: skip


@main.command()
@click.argument("echoes_file", metavar="ECHOES.H5", type=_INPUT)
@_output("Range lines")
@_scene
@click.option("--window", help="Band window: none, hamming, taylor, ... [default: none]")
@click.option("--oversampling", type=float, help="Samples per bandwidth. [default: 2]")
@_png("the lines")
@_as_json
def compress(
    echoes_file: Path,
    output: Path,
    scene: Path | None,
    window: str | None,
    oversampling: float | None,
    png: Path | None,
    as_json: bool,
) -> None:
    """Compress echoes into range lines.

    \b
    Example:  clsas compress echoes.h5 -o lines.h5 --window hamming
    """
    options = _options(
        read_scene(scene).compress if scene else {}, window=window, oversampling=oversampling
    )
    echoes = _load(echoes_file, clsas.Echoes)
    with _progress("compressing") as progress:
        start = time.perf_counter()
        lines = clsas.compress(echoes, **options, progress=progress)
        seconds = time.perf_counter() - start
    clsas.save(output, lines)
    if png is not None:
        from clsas import plot

        plot.save_png(plot.range_lines(lines), png)
    _report(
        as_json,
        f"{output}: {lines.channels} lines of {lines.length} samples, "
        f"{1e3 * lines.range_step_m:.4g} mm apart, in {seconds:.2f} s",
        file=output, png=png, channels=lines.channels, length=lines.length,
        range_step_m=lines.range_step_m, seconds=seconds,
    )  # fmt: skip


@main.command()
@click.argument("lines_file", metavar="LINES.H5", type=_INPUT)
@_output("Image")
@_grid
@_dial
@click.option("--exact", is_flag=True, help="Backproject plainly, as the three options below do.")
@click.option(
    "--accuracy-db",
    type=float,
    callback=_accuracy_db,
    help="Relative rms error wanted. [default: -60]",
)
@click.option(
    "--taps",
    type=int,
    callback=_checked(partial(validate.one_of, "taps", allowed=TAPS)),
    help="Fix the interpolator's taps: 2, 4, 6 or 8.",
)
@click.option(
    "--upsampling", type=float,
    callback=_checked(partial(validate.number, "upsampling", least=1.0, most=64.0)),
    help="Fix how much lines are upsampled.",
)  # fmt: skip
@_beam
@_device
@_png("the image in dB")
@_dynamic_range
@click.option("--profile", is_flag=True, help="Also report the time of every kernel.")
@_as_json
def image(
    lines_file: Path,
    output: Path,
    scene: Path | None,
    exact: bool,
    device: str | None,
    png: Path | None,
    dynamic_range_db: float,
    profile: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Form the image of range lines, fast to a tolerance or exactly.

    The grid is that of --scene, or given by --x, --y and --z. How is told by one of
    --tolerance-db, --tolerance-wavelengths, --stages and --exact, or by [image] of the scene;
    otherwise the error against the exact image is to stay below -50 dB. Where nothing is faster
    within a tolerance, the image is backprojected plainly.

    \b
    Example:  clsas image lines.h5 --x -2.5:2.5:1024 --y 40:45:1024 -o image.h5 --png image.png
    """
    described, grid = _read_grid(scene, given)
    wish = _wish(described, given, exact)
    beam = _read_beam(described, given)
    _warn_of_sampling(described, grid)
    lines = _load(lines_file, clsas.RangeLines)
    opened = open_device(device)
    results: dict[str, Any] = {"method": "exact"}
    chosen, why = None, ""
    if wish.keys() & set(DIAL):
        start = time.perf_counter()
        chosen = clsas.plan(lines, grid, **wish, beam=beam, device=opened)
        results["plan_seconds"] = time.perf_counter() - start
        _warn_of_error(chosen)
        if chosen.is_exact:
            wish = {"accuracy_db": chosen.predicted_error_db}
            why, chosen = f"exact: nothing faster within {chosen.tolerance_db:.4g} dB; ", None
    with (
        _progress("imaging") as progress,
        opened.profile() if profile else nullcontext({}) as kernels,
    ):
        start = time.perf_counter()
        if chosen is not None:
            formed = clsas.factorize(lines, grid, chosen, device=opened, progress=progress)
            how = f"{summary(chosen)}; error predicted {chosen.predicted_error_db:.0f} dB"
            results |= {
                "method": "stages" if chosen.nearest else "factorized",
                "predicted_error_db": chosen.predicted_error_db,
                "predicted_seconds": chosen.predicted_seconds,
            }
        else:
            preparation = prepare(lines, grid, device=opened, beam=beam, **wish)
            formed = execute(preparation, progress=progress)
            interpolator, ratio = preparation.interpolator, preparation.resampling.ratio
            how = (
                f"{why}{interpolator.taps} taps on lines upsampled {ratio:.3g} times, "
                f"{interpolator.error_db:.0f} dB"
            )
            results |= {
                "taps": interpolator.taps,
                "upsampling": ratio,
                "interpolation_error_db": interpolator.error_db,
            }
        seconds = time.perf_counter() - start
    clsas.save(output, formed)
    if png is not None:
        from clsas import plot

        plot.save_png(plot.image_db(formed, dynamic_range_db=dynamic_range_db), png)
    planned = f", planned in {results['plan_seconds']:.2f} s" if "plan_seconds" in results else ""
    table = "".join(
        f"\n  {name}: {times.count} runs of {1e3 * times.minimum_s:.3g} to "
        f"{1e3 * times.maximum_s:.3g} ms, median {1e3 * times.median_s:.3g} ms"
        for name, times in kernels.items()
    )
    _report(
        as_json,
        f"{output}: {' x '.join(map(str, grid.shape))} pixels from {lines.channels} lines in "
        f"{seconds:.2f} s{planned} on {opened.info.label} ({how}){table}",
        file=output, png=png, shape=grid.shape, channels=lines.channels,
        device=opened.info.label, driver=opened.info.driver, **results, seconds=seconds,
        kernels=kernels,
    )  # fmt: skip


@main.command()
@click.argument("lines_file", metavar="LINES.H5", type=_INPUT)
@_grid
@_dial
@_beam
@_device
@_as_json
def plan(
    lines_file: Path, scene: Path | None, device: str | None, as_json: bool, **given: Any
) -> None:
    """Show how an image would be formed, how long it takes and how much it errs.

    Grid, dial and beam as for `clsas image`; where the scene asks for an exact image, a
    tolerance of -50 dB counts. With --json the plan is printed whole, as Plan.to_json has it.

    \b
    Example:  clsas plan lines.h5 --x -2.5:2.5:1024 --y 40:45:1024 --tolerance-db -40
    """
    described, grid = _read_grid(scene, given)
    wish = _wish(described, given)
    beam = _read_beam(described, given)
    lines = _load(lines_file, clsas.RangeLines)
    if not wish.keys() & set(DIAL):
        wish = _DEFAULT
    chosen = clsas.plan(lines, grid, **wish, beam=beam, device=device)
    _warn_of_error(chosen)
    click.echo(chosen.to_json() if as_json else chosen.describe())


@main.command()
@click.argument("lines_file", metavar="[LINES.H5]", type=_INPUT, required=False)
@click.option("--case", help="A built-in case of `clsas bench` instead: ffbp-thesis, ffbp-2k, ...")
@_grid
@click.option(
    "--tolerance-db",
    type=float,
    multiple=True,
    callback=_tolerance_db,
    help=f"Once for every tolerance. [default: {' '.join(f'{db:g}' for db in TOLERANCES_DB)}]",
)
@click.option(
    "--stages",
    type=_Stages(),
    metavar="QRxQI,...",
    multiple=True,
    help="Once for every plan of the thesis's method. [default: 1 to 5 of 2x2, 2 of 2x4]",
)
@click.option("--study", is_flag=True, help="Also sweep the taps of filters and the stages.")
@_beam
@_device
@click.option("--repeats", type=click.IntRange(1), default=3, show_default=True, help="Timed runs.")
@click.option("--csv", type=_Output(), help="Also write the table.")
@_png("time over error")
@_as_json
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
    png: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Measure speed against accuracy: one image in many ways, timed and compared.

    Range lines of your own on a grid as for `clsas image`, or a built-in case. Resolution and side
    lobes are those of the strongest point.

    \b
    Example:  clsas tradeoff --case ffbp-thesis --csv tradeoff.csv --png tradeoff.png
    """  # fmt: skip
    if lines_file is None and case is None:
        raise click.UsageError("either LINES.H5 or --case is needed")
    if lines_file is not None and case is not None:
        raise click.UsageError("--case has its own lines: LINES.H5 goes without")
    if case is None:
        described, grid = _read_grid(scene, given)
        beam = _read_beam(described, given)
        lines = _load(lines_file, clsas.RangeLines)
    else:
        if scene is not None or any(given[name] is not None for name in ("x", "y", "z")):
            raise click.UsageError("--case has its own grid: --scene, --x, --y and --z go without")
        built_in = _case(case)
        lines, grid = built_in.lines(), built_in.grid
        beam = _read_beam(SceneFile(name="", image={"beam": built_in.beam}), given)
    with _progress("imaging") as progress:
        measured = clsas.tradeoff(
            lines, grid,
            tolerances_db=tolerance_db or TOLERANCES_DB,
            stages=stages or None,
            beam=beam, device=device, repeats=repeats, study=study, progress=progress,
        )  # fmt: skip
    if csv is not None:
        measured.save_csv(csv)
    if png is not None:
        measured.save_png(png, title=case or lines_file.name)
    _report(
        as_json,
        f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels on "
        f"{measured.device}, median of {repeats} runs; resolutions over those of the exact "
        f"image\n{measured.describe()}",
        **_json_able(measured),
    )  # fmt: skip


@main.command()
@click.argument("scene", metavar="SCENE.TOML", type=_INPUT)
@click.option(
    "--lines", "lines_path", type=click.Path(exists=True, path_type=Path),
    help="Range lines, or a folder of files of them. [default: simulated from the scene]",
)  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path),
    help="Zarr store to write or go on with. [default: SCENE.zarr]",
)  # fmt: skip
@_axes
@_dial
@click.option("--accuracy-db", type=float, help="Backproject exactly, with this rms error.")
@_beam
@click.option("--patches", type=_Counts(), help="Patches along y and x, such as 8x8.")
@click.option("--memory-mib", type=click.IntRange(1), help="What a patch may take. [default: 1024]")
@click.option("--device", multiple=True, help="Once for every device that is to work.")
@click.option("--workers", type=click.IntRange(1), help="Work in so many processes (Dask).")
@click.option("--scheduler", metavar="ADDRESS", help="Work on a Dask cluster: tcp://host:8786.")
@click.option("--follow", is_flag=True, help="Go on while files are added to the folder --lines.")
@click.option(
    "--idle-s", type=float, default=60.0, show_default=True,
    help="With --follow: until nothing came for so long, or a file `end` did.",
)  # fmt: skip
@_png("an overview in dB")
@_dynamic_range
@_as_json
def mosaic(
    scene: Path,
    lines_path: Path | None,
    output: Path | None,
    patches: tuple[int, int] | None,
    memory_mib: int | None,
    device: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    follow: bool,
    idle_s: float,
    png: Path | None,
    dynamic_range_db: float,
    as_json: bool,
    **given: Any,
) -> None:
    """Form an image of any size patch by patch, into a Zarr store.

    Grid, dial and beam as for `clsas image`. The same command goes on where it was interrupted, by
    Ctrl-C or by anything else. A scene without --lines is simulated first.

    \b
    Example:  clsas mosaic scene.toml --lines lines.h5 -o image.zarr --png image.png
    """
    if workers is not None and scheduler is not None:
        raise click.UsageError("--workers and --scheduler exclude each other")
    if device and (workers or scheduler):
        raise click.UsageError("--device plays no part with --workers and --scheduler")
    described, grid = _read_grid(scene, given, memory=False)
    wish = _wish(described, given)
    if set(wish) - {*DIAL, "accuracy_db"}:
        raise ValueError(f"{scene}: [image] taps and upsampling play no part in a mosaic")
    beam = _read_beam(described, given)
    _warn_of_sampling(described, grid)
    devices = [open_device(name) for name in device] or None
    options = described.mosaic
    output = output or options.get("store") or scene.with_suffix(".zarr")
    lines_path = lines_path or options.get("lines")
    if follow and (lines_path is None or not lines_path.is_dir()):
        raise click.UsageError("--follow goes with --lines, a folder")
    patches = patches or options.get("patches")
    memory_mib = memory_mib or options.get("memory_mib")
    if lines_path is None:
        lines_path = _simulated(described, scene, output, click.echo if not as_json else None)
    start = time.perf_counter()
    with _cluster(workers, scheduler) as client:
        formed = clsas.mosaic(
            lines_path, grid, output, **wish, beam=beam, patches=patches,
            memory_bytes=memory_mib and memory_mib << 20, device=devices,
            client=client, follow_s=idle_s if follow else None,
        )  # fmt: skip
        before, count, pixels = len(formed.finished), 0, 0
        with _patch_progress(output.name, len(formed), before) as tell:
            for patch in formed:
                count, pixels = count + 1, pixels + patch.grid.size
                if not as_json:
                    tell(patch)
    seconds = time.perf_counter() - start
    store = clsas.Store.opened(output)
    records = store.records()
    if png is not None:
        from clsas import plot

        plot.save_png(plot.image_db(store.overview(), dynamic_range_db=dynamic_range_db), png)
    errors = [r.predicted_error_db for r in records.values() if r.predicted_error_db is not None]
    flagged = {place: record.flags for place, record in records.items() if record.flags}
    worst = max(errors, default=None)
    rows, columns = formed.patch_shape
    text = [
        f"{output}: {' x '.join(map(str, formed.shape))} patches of {rows} x {columns} pixels, "
        + (
            f"{count} formed in {seconds:.2f} s ({pixels / seconds / 1e6:.3g} Mpixel/s)"
            if count
            else "none to form"
        )
        + (f", {before} were there" if before else "")
        + ("" if worst is None else f"; error predicted {worst:.1f} dB at most")
    ]
    text += [f"  patch {row},{column}: {'; '.join(f)}" for (row, column), f in flagged.items()]
    _report(
        as_json,
        "\n".join(text),
        file=output, png=png, shape=grid.shape, patches=formed.shape,
        patch_shape=formed.patch_shape, finished=len(records), formed=count, before=before,
        seconds=seconds, pixels_per_s=pixels / seconds, predicted_error_db=worst,
        flags={f"{row},{column}": f for (row, column), f in flagged.items()},
        seconds_of_patches=sum(record.seconds for record in records.values()),
    )  # fmt: skip


@main.command()
@click.argument("image_file", metavar="IMAGE.H5", type=_INPUT)
@click.option("--near", type=_Place(), help="Measure the point near x, y (m).")
@click.option("--search-m", type=float, help="How far from there its peak may be.")
@click.option("--extent-m", type=float, help="How far from its peak side lobes are looked for.")
@click.option("--reference", type=_INPUT, help="Image to give the relative error to.")
@_png("cuts through the point")
@_as_json
def quality(
    image_file: Path,
    near: tuple[float, float] | None,
    search_m: float | None,
    extent_m: float | None,
    reference: Path | None,
    png: Path | None,
    as_json: bool,
) -> None:
    """Measure an image: contrast, a point's response, the error to another image.

    \b
    Example:  clsas quality image.h5 --near 0,42.5 --png cuts.png
    """
    if near is None and (search_m, extent_m, png) != (None, None, None):
        raise click.UsageError("--search-m, --extent-m and --png go with --near")
    pixels = _load(image_file, clsas.Image)
    results: dict[str, Any] = {
        "entropy": clsas.entropy(pixels),
        "contrast": clsas.contrast(pixels),
    }
    text = [f"entropy {results['entropy']:.3f} nats, contrast {results['contrast']:.3f}"]
    if reference is not None:
        error = clsas.relative_error_db(pixels, _load(reference, clsas.Image))
        results["relative_error_db"] = error
        text.append(f"error relative to {reference}: {error:.1f} dB")
    if near is not None:
        response = clsas.measure_point(pixels, near, search_m=search_m, extent_m=extent_m)
        results["point"] = response
        text.append(_describe(response))
        if png is not None:
            from clsas import plot

            plot.save_png(plot.cuts(response), png)
    _report(as_json, "\n".join(text), **results)


@main.command()
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default="clsas-demo",
    show_default=True, help="Folder for the files.",
)  # fmt: skip
@_device
@_as_json
def demo(out: Path, device: str | None, as_json: bool) -> None:
    """Run the thesis's wide-beam case, from simulation to picture and measured figures.

    \b
    Example:  clsas demo --out my-demo
    """
    _need_matplotlib()
    say = (lambda line: None) if as_json else click.echo
    results = demonstration.run(out, device=device, say=say, progress=_progress)
    if as_json:
        _print_json(results)


@main.command()
@click.argument("case", required=False)
@_device
@click.option(
    "--accuracy-db",
    type=float,
    callback=_accuracy_db,
    help="Error wanted in exact cases. [default: -50]",
)
@click.option(
    "--tolerance-db", type=float, callback=_tolerance_db,
    help="And in factorized ones. [default: -50]",
)  # fmt: skip
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Timed runs.")
@_as_json
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
    from clsas import bench as benchmark

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
        with _progress(name) as progress:
            result = measure(name, device=device, repeats=repeats, progress=progress, **wish)
        if as_json:
            _print_json(result, indent=None)
            continue
        for key, value in result.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            told = ", ".join(f"{part} {_plain(item)}".strip() for part, item in parts)
            click.echo(f"{key:>24}  " + told.replace("\n", "\n" + 26 * " "))


@main.command()
@_device
@_as_json
def calibrate(device: str | None, as_json: bool) -> None:
    """Measure what the parts of imaging cost on a device, and store it for planning.

    \b
    Example:  clsas calibrate --device 0
    """
    from clsas import costs
    from clsas.calibrate import calibrate as measure

    opened = open_device(device)
    with _progress("calibrating") as progress:
        found = measure(opened, progress=progress)
    stored = costs.load(opened) == found
    parts = "".join(f"\n{getattr(found, part.name):>12.4g}  {part.name}" for part in fields(found))
    _report(
        as_json,
        f"{opened.info.label}, {'' if stored else 'not '}stored in {costs.path()}{parts}",
        device=opened.info.label, driver=opened.info.driver, file=costs.path(), stored=stored,
        costs=found,
    )  # fmt: skip


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Give a callback that moves a bar, or None where no terminal shows it."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn(what), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _simulated(
    described: SceneFile, scene: Path, output: Path, say: Callable[..., None] | None
) -> Path:
    """Return the file of a scene's range lines beside the store; made where it is not there."""
    digest = simulation_digest(scene.read_bytes(), scene.parent)
    path = output.with_name(f"{output.stem}-{digest}.lines.h5")
    if path.exists():
        if say is not None:
            say(f"{path}: range lines, simulated before", err=True)
        return path
    sonar, track, targets = described.need("sonar", "track", "targets")
    with _progress("simulating") as progress:
        echoes = clsas.simulate(sonar, track, targets, **described.simulate, progress=progress)
    with _progress("compressing") as progress:
        clsas.save(path, clsas.compress(echoes, **described.compress, progress=progress))
    if say is not None:
        say(f"{path}: range lines, simulated from {scene}", err=True)
    return path


@contextmanager
def _cluster(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """Give a client of a Dask cluster, or None where there is none to be used."""
    if workers is None and scheduler is None:
        yield None
        return
    try:
        from distributed import Client, LocalCluster
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise ImportError(
            "--workers and --scheduler need Dask: pip install 'clsas[mosaic]'"
        ) from None
    with ExitStack() as opened:
        if scheduler is not None:
            try:
                client = opened.enter_context(Client(scheduler, timeout=_SCHEDULER_S))
            except (OSError, ValueError) as error:
                raise click.ClickException(
                    f"--scheduler {scheduler} cannot be reached: {error}"
                ) from None
        else:
            # Ctrl-C at a terminal is for this process, which then ends the others.
            heeded = signal.signal(signal.SIGINT, signal.SIG_IGN)
            try:
                cluster = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
            finally:
                signal.signal(signal.SIGINT, heeded)
            opened.enter_context(cluster)
            client = opened.enter_context(Client(cluster))
        try:
            yield client
        except KilledWorker as error:
            raise click.ClickException(
                f"workers died on one patch, over and over: {error}"
            ) from None


@contextmanager
def _patch_progress(name: str, total: int, done: int) -> Iterator[Callable[[clsas.Patch], None]]:
    """Give a function that tells of a patch: a line each and, on a terminal, a moving bar."""
    columns = (
        TextColumn(name), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TaskProgressColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=total, completed=done)

        def tell(patch: clsas.Patch) -> None:
            record = patch.record
            parts = [f"{record.seconds:.2f} s", f"{record.channels} channels"]
            if record.predicted_error_db is not None:
                parts.append(f"error predicted {record.predicted_error_db:.1f} dB")
            line = f"patch {patch.row},{patch.column}: {', '.join((*parts, *record.flags))}"
            console.print(line, markup=False)
            bar.advance(task)

        yield tell


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    click.echo(f"Warning: {message}", err=True)


def _message(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"out of memory: {error}" if str(error) else "out of memory"
    return str(error) or type(error).__name__


def _load(path: Path, kind: type) -> Any:
    obj = clsas.load(path)
    if isinstance(obj, kind):
        return obj
    hint = {
        clsas.Echoes: " (clsas simulate makes them)",
        clsas.RangeLines: " (clsas compress makes them)",
        clsas.Image: " (clsas image makes it)",
    }
    raise ValueError(
        f"{path} must hold {kind.__name__}{hint.get(kind, '')}, got {type(obj).__name__}"
    )


def _case(name: str) -> Any:
    from clsas import bench

    cases = bench.CASES | bench.FACTORIZED
    _one_of(name, cases)
    return cases[name]


def _one_of(name: str, cases: Collection[str]) -> None:
    if name not in cases:
        raise click.BadParameter(f"{name!r} is not one of {', '.join(cases)}")


def _read_grid(
    scene: Path | None, given: dict[str, Any], memory: bool = True
) -> tuple[SceneFile, clsas.Grid]:
    """Return what a scene file describes, or nothing, and the grid that is wanted.

    Its image must fit into the `memory`, if so told.
    """
    x, y, z = (given[name] for name in ("x", "y", "z"))
    if (x is None) != (y is None) or (z is not None and x is None):
        raise click.UsageError("--x and --y go together, and --z with them")
    if scene is None and x is None:
        raise click.UsageError("a grid is needed: --scene, or --x and --y")
    described = read_scene(scene) if scene is not None else SceneFile(name="")
    grid = clsas.Grid.plane(x, y, z or 0.0) if x and y else described.need("grid")[0]
    if memory:
        validate.memory("--x and --y" if x else "[grid]", 8 * grid.size)
    return described, grid


def _wish(described: SceneFile, given: dict[str, Any], exact: bool = False) -> dict[str, Any]:
    """Return how an image is wanted: one of `DIAL`, or else what the exact image takes."""
    dial, exactly = (
        {name: given[name] for name in names if given.get(name) is not None}
        for names in (DIAL, EXACT)
    )
    if len(dial) + exact > 1:
        raise click.UsageError(
            "--tolerance-db, --tolerance-wavelengths, --stages and --exact exclude each other"
        )
    if dial and exactly:
        raise click.UsageError(
            "--accuracy-db, --taps and --upsampling are of the exact image, and play no part with "
            f"--{next(iter(dial)).replace('_', '-')}"
        )
    if len(exactly) == len(EXACT):
        raise click.UsageError(
            "--accuracy-db plays no part where --taps and --upsampling are given"
        )
    if dial:
        return dial
    described_exactly = {key: value for key, value in described.image.items() if key in EXACT}
    if exact or exactly:
        return described_exactly | exactly
    described_dial = {key: value for key, value in described.image.items() if key in DIAL}
    return described_dial or described_exactly or _DEFAULT


def _read_beam(described: SceneFile, given: dict[str, Any]) -> clsas.BeamWindow | None:
    """Return a scene file's beam, changed by what is given, or the beam that is."""
    beam = described.image.get("beam")
    options = {"width_deg": "beam_deg", "shape": "beam_shape", "squint_deg": "squint_deg"}
    options["element_length_m"] = "element_length_m"
    changes = {key: given[name] for key, name in options.items() if given[name] is not None}
    if not changes:
        return beam
    if beam is None and "width_deg" not in changes:
        raise click.UsageError(
            "--beam-shape, --squint-deg and --element-length-m go with --beam-deg"
        )
    try:
        return replace(beam, **changes) if beam is not None else clsas.BeamWindow(**changes)
    except ValueError as error:  # the scene's own was checked when it was read
        raise click.UsageError(str(error)) from error


def _warn_of_error(chosen: clsas.Plan) -> None:
    """Warn where the thesis's method may leave no image."""
    if chosen.nearest and chosen.predicted_error_db > WORST_TOLERANCE_DB:
        click.echo(
            f"Warning: with these stages the error may be as large as "
            f"{chosen.predicted_error_db:.0f} dB, too large for an image to be of use: sum fewer "
            "lines (QR), or divide more (QI)",
            err=True,
        )


def _options(described: dict[str, Any], **given: Any) -> dict[str, Any]:
    """Return a scene file's options, overruled by those given."""
    return described | {name: value for name, value in given.items() if value is not None}


def _warn_of_sampling(scene: SceneFile, grid: clsas.Grid | None = None) -> None:
    grid = scene.grid if grid is None else grid
    if scene.sonar is None or scene.track is None or grid is None:
        return
    for finding in clsas.check_sampling(scene.sonar, scene.track, grid):
        click.echo(f"Warning: {finding.message}", err=True)


def _describe(response: PointResponse) -> str:
    def cut(name: str, cut: Cut) -> str:
        return (
            f"  {name:<8} resolution {1e3 * cut.resolution_m:.2f} mm (-3 dB), PSLR nearest "
            f"{cut.pslr_nearest_db[0]:.1f}, {cut.pslr_nearest_db[1]:.1f} dB, highest "
            f"{cut.pslr_db[0]:.1f}, {cut.pslr_db[1]:.1f} dB, ISLR {cut.islr_db:.1f} dB"
        )

    return "\n".join(
        [
            f"point at x = {response.x_m:.5f} m, y = {response.y_m:.5f} m, "
            f"amplitude {response.amplitude:.6g}",
            cut("azimuth", response.azimuth),
            cut("range", response.range),
        ]
    )


def _report(as_json: bool, text: str, **results: Any) -> None:
    if as_json:
        _print_json(results)
    else:
        click.echo(text)


def _print_json(results: Any, indent: int | None = 2) -> None:
    click.echo(json.dumps(_json_able(results), indent=indent, allow_nan=False))


def _json_able(value: Any) -> Any:
    """Return what JSON can hold: text for a path, null for infinity; curves are left out."""
    if is_dataclass(value):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        return _json_able({k: v for k, v in parts.items() if not isinstance(v, np.ndarray)})
    if isinstance(value, dict):
        return {key: _json_able(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_able(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def _plain(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
