"""Command that writes images, mosaics and heights for other programs: export."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import check_levels, load, read_plan, read_scene
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import INPUT, ORIGIN, File, Output, keep_out
from clsas.cli.view import Folder, size_of
from clsas.cli.wording import command
from clsas.files.hdf5 import read_geometry
from clsas.maps import sicd
from clsas.maps.exporting import SUFFIXES, ExportOptions, check_name


class _Target(File):
    """A file of a known suffix, or a folder for a viewer."""

    written = True

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if nothing can be written there."""
        try:
            check_name("its name", Path(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)
        kind = Output(*SUFFIXES) if Path(value).suffix else Folder()
        return kind.convert(value, param, ctx)


@command()
@click.argument("source", metavar="INPUT", type=File(exists=True))
@click.argument("output", metavar="OUTPUT", type=_Target())
@options.of(ExportOptions, "kind", into="how", called={"kind": ("--as",)})
@options.dynamic_range
@options.of(ExportOptions, "reference", into="how")
@options.colour_map
@options.of(ExportOptions, "north_up", into="how")
@options.of(ExportOptions, "pixel_m", into="how", beside="--north-up")
@click.option(
    "--origin", type=ORIGIN,
    help="Position of the origin, if INPUT has no georeference, as LATITUDE,LONGITUDE[,HEIGHT].",
)  # fmt: skip
@options.of(clsas.Georeference.local, "heading_deg", into="heading", beside="--origin")
@click.option(
    "--crs", help="Or map projection in which x is easting and y northing, such as EPSG:32632."
)
@click.option(
    "--plan", "plan_path", type=INPUT,
    help="Plan of the image, as `clsas plan --json --filters` prints it, for tags of the file.",
)  # fmt: skip
@click.option(
    "--lines", "lines_path", type=INPUT,
    help="Range lines of the image, for tags with their carrier and sound speed. A .nitf requires "
    "them.",
)  # fmt: skip
@click.option(
    "--scene", "scene_path", type=INPUT,
    help="Scene file with the beam that formed the image, for a .nitf.",
)  # fmt: skip
@options.map_marks
@options.as_json
def export(
    source: Path,
    output: Path,
    how: dict[str, Any],
    levels: dict[str, Any],
    origin: tuple[float, ...] | None,
    heading: dict[str, Any],
    crs: str | None,
    plan_path: Path | None,
    lines_path: Path | None,
    scene_path: Path | None,
    marks: dict[str, Any],
    as_json: bool,
) -> None:
    """Write an image or heights as a map, a picture or a web page.

    INPUT is an image or heights in HDF5, or the Zarr store of a finished mosaic, which may be
    larger than memory. The suffix of OUTPUT decides: .tif is a cloud-optimized GeoTIFF, .nc is
    netCDF 4, .nitf is SICD (radar images only), and .png, .pdf and .svg are pictures. A PNG of an
    image with a georeference gets a world file.
    Without a suffix, OUTPUT is a folder that any browser shows, as clsas view writes it. Heights
    become a .tif or .nc of height, deviation and coherence, or a picture.

    \b
    Example:  clsas export mosaic.zarr mosaic.tif --as 8bit
    """
    check_levels(levels)
    place = _georeference(origin, heading, crs)
    if source.is_dir():
        keep_out("OUTPUT", output, "the store", source)
    known: dict[str, Any] = {}
    if plan_path is not None:
        known["plan"] = read_plan(plan_path)
    if lines_path is not None:
        known["lines"] = (
            load(lines_path, clsas.RangeLines)
            if output.suffix.lower() in sicd.SUFFIXES  # the samples show their band
            else read_geometry(lines_path)[0]
        )
    if scene_path is not None:
        known["beam"] = _beam(scene_path)
    start = time.perf_counter()
    with progress_bar("exporting") as progress:
        clsas.export(
            source, output, **how, **levels, **marks, **known, georeference=place,
            progress=progress,
        )  # fmt: skip
    seconds = time.perf_counter() - start
    size_bytes = size_of(output) if output.is_dir() else output.stat().st_size
    report(
        as_json,
        f"{printable(output)}: {size_bytes / 1e6:.3g} MB in {seconds:.2f} s",
        file=output, bytes=size_bytes, seconds=seconds,
    )  # fmt: skip


def _beam(path: Path) -> clsas.BeamWindow:
    """Return the beam of a scene; raise UsageError if it has none."""
    beam = read_scene(path).image.get("beam")
    if beam is None:
        raise click.UsageError(f"--scene {printable(path)} must have a beam, in [image]")
    return beam


def _georeference(
    origin: tuple[float, ...] | None, heading: dict[str, Any], crs: str | None
) -> clsas.Georeference | None:
    """Return the georeference of the options, or None."""
    if crs is not None:
        if origin is not None or heading:
            raise click.UsageError("--crs excludes --origin and --heading-deg")
        return clsas.Georeference.projected(crs)
    if (origin is None) != (not heading):
        raise click.UsageError("--origin and --heading-deg must be given together")
    return None if origin is None else clsas.Georeference.local(*origin, **heading)
