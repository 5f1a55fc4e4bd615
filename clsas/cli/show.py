"""Command that draws a file of any kind: show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import check_levels, read_plan
from clsas.cli.options import option_of
from clsas.cli.outputs import printable, report
from clsas.cli.parameters import POSITION, File, Output, keep_out, need_matplotlib
from clsas.cli.wording import command
from clsas.files.formats import SUFFIXES
from clsas.mosaics.levels import COARSEST_SIDE
from clsas.plot.canvas import SUFFIXES as PICTURES
from clsas.plot.images import amplitude_at, window_around

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Shown: TypeAlias = (
    clsas.Image
    | clsas.RangeLines
    | clsas.Echoes
    | clsas.Plan
    | clsas.Store
    | clsas.Interferogram
    | clsas.Heights
)

_ENDINGS = (*SUFFIXES, ".mat", ".json", ".zarr")  # that the picture's name does without
_JSON = b"{"
_MARKS = ("--north-arrow", "--scale-bar", "--caption")


@command()
@click.argument("file", metavar="FILE", type=File(exists=True))
@click.option(
    "-o", "--output", type=Output(*PICTURES),
    help="Picture to write, as PNG, PDF or SVG. [default: FILE with the suffix .png]",
)  # fmt: skip
@options.dynamic_range
@options.of(amplitude_at, "percentile", into="of_amplitudes")
@options.colour_map
@click.option(
    "--near", type=POSITION,
    help="Draw the part around this position on the image's axes, or around x, y, z.",
)  # fmt: skip
@options.of(window_around, "extent_m", into="within", beside="--near")
@options.map_marks
@options.as_json
def show(
    file: Path,
    output: Path | None,
    levels: dict[str, Any],
    of_amplitudes: dict[str, Any],
    near: tuple[float, ...] | None,
    within: dict[str, Any],
    marks: dict[str, Any],
    as_json: bool,
) -> None:
    """Draw an image, heights, lines, a plan or a recording.

    FILE is any file that clsas writes or reads: an image, an interferogram, heights, range lines or
    echoes; a recording of any format; a plan that `clsas plan --json --filters` printed; or the
    Zarr store of a mosaic, which is read patch by patch and may be larger than memory. Its contents
    decide, not its name.

    \b
    Example:  clsas show image.h5 --near 0,42.5 --extent-m 0.2 --db 40
    """
    if within and near is None:
        raise click.UsageError("--extent-m requires --near")
    check_levels(levels)
    need_matplotlib()
    output = output or _beside(file)
    if file.is_dir():
        keep_out("--output", output, "the store", file)
    shown = _read(file)
    given = {option_of(name) for name in (*levels, *of_amplitudes, *within, *marks)}
    _check_options(shown, given | ({"--near"} if near is not None else set()))
    from clsas import plot

    title = printable(file.name).replace("$", r"\$")  # matplotlib would read mathematics
    percentile, extent_m = of_amplitudes.get("percentile"), within.get("extent_m")
    if percentile is not None:
        title += f" (0 dB: percentile {percentile:g})"
    figure, words = _drawn(shown, near, extent_m, percentile, title, levels | marks)
    plot.save(figure, output)
    kind = "mosaic" if isinstance(shown, clsas.Store) else type(shown).__name__
    formed = shown.formed if isinstance(shown, clsas.Image) else None
    text = f"{printable(output)}: {printable(words)}"
    if formed is not None:
        text += f"\n  {printable(formed.describe())}"
    report(
        as_json, text, file=file, picture=output, kind=kind,
        **({} if formed is None else {"formed": formed.describe()}),
    )  # fmt: skip


def _beside(file: Path) -> Path:
    """Return the default picture of a file, which must be one that can be written."""
    context = click.get_current_context()
    (option,) = (each for each in context.command.params if each.name == "output")
    path = file.resolve() if file.name in ("", "..") else file
    if not path.name:
        raise click.UsageError(f"{path} is not a mosaic of clsas")
    name = path.stem if path.suffix.lower() in _ENDINGS else path.name
    return option.type.convert(path.with_name(f"{name}.png"), option, context)


def _read(path: Path) -> Shown:
    """Return what a file holds; raise ValueError if it cannot be drawn."""
    if path.is_dir():
        return clsas.Store.opened(path)
    with path.open("rb") as opened:
        is_json = opened.read(64).lstrip().startswith(_JSON)
    if is_json:
        return read_plan(path)
    if path.suffix.lower() == ".toml":
        raise ValueError(
            f"{path} is a scene, which has nothing to draw yet: clsas simulate {path} -o ECHOES.H5"
        )
    found = clsas.load(path)
    if isinstance(found, clsas.Grid):
        raise ValueError(f"{path} must hold an image, range lines or echoes, got only a grid")
    return found


def _check_options(shown: Shown, given: set[str]) -> None:
    """Raise UsageError for options that have no effect on an object of this kind."""
    if isinstance(shown, clsas.Plan):
        refused, what = given, "a plan"
    elif isinstance(shown, clsas.Interferogram):
        refused, what = given, "an interferogram"
    elif isinstance(shown, clsas.Heights):
        refused, what = given - {"--colour-map"}, "heights"
    elif isinstance(shown, clsas.Store) and shown.layers:
        refused, what = given - {"--colour-map", "--near", "--extent-m"}, "a mosaic of heights"
    elif isinstance(shown, clsas.RangeLines | clsas.Echoes):
        refused, what = given & {"--near", "--extent-m", *_MARKS}, "range lines or echoes"
    elif isinstance(shown, clsas.Image) and shown.grid.points_m is not None:
        is_box = shown.grid.points_m.ndim == 4
        refused = given & {*({"--extent-m"} if is_box else {"--near", "--extent-m"}), *_MARKS}
        what = "an image on points"
    else:
        return
    if refused:
        raise click.UsageError(f"{', '.join(sorted(refused))} cannot be used with {what}")


def _drawn(
    shown: Shown,
    near: tuple[float, ...] | None,
    extent_m: float | None,
    percentile: float | None,
    title: str,
    levels: dict[str, Any],
) -> tuple[Figure, str]:
    """Return the picture of an object, and what it shows in words."""
    from clsas import plot

    if isinstance(shown, clsas.Plan):
        return plot.plan(shown, title=title), repr(shown)
    if isinstance(shown, clsas.Interferogram):
        return plot.interferogram(shown, title=title), repr(shown)
    if isinstance(shown, clsas.Heights):
        chosen = {name: levels[name] for name in levels if name == "colour_map"}
        return plot.heights(shown, **chosen, title=title), repr(shown)
    if isinstance(shown, clsas.Store) and shown.layers:
        found = shown.overview_heights(COARSEST_SIDE, *_window(shown, near, extent_m))
        chosen = {name: levels[name] for name in levels if name == "colour_map"}
        return plot.heights(found, **chosen, title=title), repr(found)
    if isinstance(shown, clsas.Store):
        shown = shown.overview(COARSEST_SIDE, *_window(shown, near, extent_m))
    elif isinstance(shown, clsas.Image) and shown.grid.points_m is None:
        shown = _part(shown, near, extent_m)
    values = shown.pixels if isinstance(shown, clsas.Image) else shown.samples
    reference = None if percentile is None else amplitude_at(values, percentile)
    how = {**levels, "reference": reference, "title": title}
    if isinstance(shown, clsas.RangeLines):
        figure = plot.range_lines(shown, **how)
    elif isinstance(shown, clsas.Echoes):
        figure = plot.echoes(shown, **how)
    elif shown.grid.points_m is None:
        figure = plot.image_db(shown, **how)
    else:
        figure = _of_points(shown, near, how)
    return figure, repr(shown)


def _window(
    store: clsas.Store, near: tuple[float, ...] | None, extent_m: float | None
) -> tuple[slice, ...]:
    """Return the rows and columns around a position; none, which stands for all, without one."""
    return () if near is None else window_around(store.grid, near, extent_m)


def _part(
    image: clsas.Image, near: tuple[float, ...] | None, extent_m: float | None
) -> clsas.Image:
    """Return an image, or the part around a position."""
    if near is None:
        return image
    rows, columns = window_around(image.grid, near, extent_m)
    grid = image.grid.window(rows, columns)
    return replace(image, pixels=image.pixels[rows, columns], grid=grid)


def _of_points(image: clsas.Image, near: tuple[float, ...] | None, how: dict[str, Any]) -> Figure:
    """Draw a volume, with slices through a position or without, or other points from above."""
    from clsas import plot

    if near is not None:
        if len(near) != 3:
            raise click.UsageError("--near must be X,Y,Z for an image on points")
        return plot.volume(image, kind="slices", at=near, **how)
    try:
        return plot.volume(image, **how)
    except ValueError:  # the points form no regular box
        return plot.points(image, **how)
