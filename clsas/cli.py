"""The `clsas` command: a thin layer over the library, one function per subcommand.

Results go to standard output, progress and warnings to standard error. Exit codes: 0 done, 1 error
(one `Error:` message), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import fields, is_dataclass
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
from clsas.backproject import execute, prepare
from clsas.config import SceneFile, read_scene
from clsas.device import choose
from clsas.quality import Cut, PointResponse
from clsas.validate import positive

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
            return float(start), float(stop), int(count)
        except ValueError:
            self.fail(f"{value!r} must be START:STOP:N, metres and a number of pixels", param, ctx)


class _Place(click.ParamType):
    name = "X,Y"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, float]:
        try:
            x, y = value.split(",")
            return float(x), float(y)
        except ValueError:
            self.fail(f"{value!r} must be X,Y in metres", param, ctx)


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
        # Whichever of the two comes second on the command line finds the first one here.
        other = ctx.params.get("output" if param.name == "png" else "png")
        if other is not None and other.resolve() == path.resolve():
            self.fail("-o and --png must be two files", param, ctx)
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


def _output(kind: str) -> Callable:
    return click.option("-o", "--output", type=_Output(), required=True, help=f"{kind} to write.")


def _png(what: str) -> Callable:
    return click.option("--png", type=_Output(), help=f"Also draw {what}.")


_as_json = click.option("--json", "as_json", is_flag=True, help="Print results as JSON.")
_scene = click.option("--scene", type=_INPUT, help="Scene file for what the options leave out.")
_device = click.option("--device", help="Index or part of the name, as `clsas devices` shows.")


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
@_scene
@click.option("--x", type=_Axis(), help="First and last pixel centre along x (m), and how many.")
@click.option("--y", type=_Axis(), help="The same along y.")
@click.option("--z", type=float, help="Height of the plane (m). [default: 0]")
@_device
@click.option("--accuracy-db", type=float, help="Relative rms error wanted. [default: -60]")
@click.option("--taps", type=int, help="Fix the interpolator's taps: 2, 4, 6 or 8.")
@click.option("--upsampling", type=float, help="Fix how much lines are upsampled.")
@_png("the image in dB")
@click.option(
    "--dynamic-range-db", type=float, default=60.0, show_default=True, help="Of the PNG.",
    callback=lambda ctx, param, value: positive("dynamic_range_db", value, "dB"),
)  # fmt: skip
@click.option("--profile", is_flag=True, help="Also report the time of every kernel.")
@_as_json
def image(
    lines_file: Path,
    output: Path,
    scene: Path | None,
    x: tuple[float, float, int] | None,
    y: tuple[float, float, int] | None,
    z: float | None,
    device: str | None,
    accuracy_db: float | None,
    taps: int | None,
    upsampling: float | None,
    png: Path | None,
    dynamic_range_db: float,
    profile: bool,
    as_json: bool,
) -> None:
    """Form the exact image of range lines.

    The grid is that of --scene, or given by --x, --y and --z.

    \b
    Example:  clsas image lines.h5 --x -2.5:2.5:1024 --y 40:45:1024 -o image.h5 --png image.png
    """
    if (x is None) != (y is None) or (z is not None and x is None):
        raise click.UsageError("--x and --y go together, and --z with them")
    if scene is None and x is None:
        raise click.UsageError("a grid is needed: --scene, or --x and --y")
    if None not in (accuracy_db, taps, upsampling):
        raise click.UsageError(
            "--accuracy-db plays no part where --taps and --upsampling are given"
        )
    described = read_scene(scene) if scene is not None else SceneFile(name="")
    grid = clsas.Grid.plane(x, y, z or 0.0) if x and y else described.need("grid")[0]
    validate.memory("--x and --y" if x else "[grid]", 8 * grid.size)
    options = _options(described.image, accuracy_db=accuracy_db, taps=taps, upsampling=upsampling)
    _warn_of_sampling(described, grid)
    lines = _load(lines_file, clsas.RangeLines)
    with _progress("imaging") as progress:
        start = time.perf_counter()
        preparation = prepare(lines, grid, device=device, **options)
        with preparation.device.profile() if profile else nullcontext({}) as kernels:
            formed = execute(preparation, progress=progress)
        seconds = time.perf_counter() - start
    clsas.save(output, formed)
    if png is not None:
        from clsas import plot

        plot.save_png(plot.image_db(formed, dynamic_range_db=dynamic_range_db), png)
    used, interpolator = preparation.device.info, preparation.interpolator
    table = "".join(
        f"\n  {name}: {times.count} runs of {1e3 * times.minimum_s:.3g} to "
        f"{1e3 * times.maximum_s:.3g} ms, median {1e3 * times.median_s:.3g} ms"
        for name, times in kernels.items()
    )
    _report(
        as_json,
        f"{output}: {' x '.join(map(str, grid.shape))} pixels from {lines.channels} lines in "
        f"{seconds:.2f} s on {used.label} ({interpolator.taps} taps on lines upsampled "
        f"{preparation.resampling.ratio:.3g} times, {interpolator.error_db:.0f} dB){table}",
        file=output, png=png, shape=grid.shape, channels=lines.channels, device=used.label,
        driver=used.driver, taps=interpolator.taps, upsampling=preparation.resampling.ratio,
        interpolation_error_db=interpolator.error_db, seconds=seconds, kernels=kernels,
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
@click.option("--accuracy-db", type=float, default=-50.0, show_default=True, help="Error wanted.")
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Timed runs.")
@_as_json
def bench(
    case: str | None, device: str | None, accuracy_db: float, repeats: int, as_json: bool
) -> None:
    """Time a benchmark case and measure its error; without CASE, all of them run.

    With --json every case is one line.

    \b
    Example:  clsas bench bp-thesis --accuracy-db -80 --json
    """
    from clsas import bench as benchmark

    if case is not None and case not in benchmark.CASES:
        raise click.BadParameter(f"{case!r} is not one of {', '.join(benchmark.CASES)}")
    for name in [case] if case else benchmark.CASES:
        with _progress(name) as progress:
            result = benchmark.run(
                name, device=device, accuracy_db=accuracy_db, repeats=repeats, progress=progress
            )
        if as_json:
            _print_json(result, indent=None)
            continue
        for key, value in result.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            told = ", ".join(f"{part} {_plain(item)}".strip() for part, item in parts)
            click.echo(f"{key:>20}  {told}")


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
