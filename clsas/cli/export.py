"""Command that writes images, mosaics and heights for other programs: export."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_levels, read_plan, read_scene
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import INPUT, ORIGIN, File, Output, keep_out
from clsas.cli.view import Folder, size_of
from clsas.cli.wording import command
from clsas.engine.data import validate
from clsas.files.hdf5 import read_geometry
from clsas.maps import sicd
from clsas.maps.encoding import KINDS
from clsas.maps.export_options import SUFFIXES
from clsas.maps.exporting import check_name


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
@click.option(
    "--as", "kind", type=click.Choice(KINDS),
    help="Pixels of a GeoTIFF of an image: amplitude in dB, complex numbers, or 8-bit levels with "
    "colours. [default: db]",
)  # fmt: skip
@options.dynamic_range
@click.option(
    "--reference", type=float,
    callback=options.checked(partial(validate.positive, "reference")),
    help="Amplitude of 0 dB. [default: 1 for db, otherwise the largest]",
)  # fmt: skip
@options.colour_map
@click.option(
    "--north-up", is_flag=True,
    help="Resample a GeoTIFF so that its rows run east. Without it, its transform is rotated.",
)  # fmt: skip
@click.option(
    "--pixel-m", type=float,
    callback=options.checked(partial(validate.positive, "pixel_m", unit="m")),
    help="With --north-up, size of the pixels (m). [default: the distance of those of INPUT]",
)  # fmt: skip
@click.option(
    "--origin", type=ORIGIN,
    help="Latitude and longitude (degrees) of the origin, and its height (m), if INPUT has no "
    "georeference.",
)  # fmt: skip
@click.option(
    "--heading-deg", type=float,
    help="With --origin, heading of the x axis, clockwise from true north (degrees).",
)  # fmt: skip
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
    kind: str | None,
    dynamic_range_db: float | None,
    reference: float | None,
    colour_map: str | None,
    origin: tuple[float, ...] | None,
    heading_deg: float | None,
    crs: str | None,
    plan_path: Path | None,
    lines_path: Path | None,
    scene_path: Path | None,
    as_json: bool,
    **given: Any,
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
    levels = read_levels(dynamic_range_db, None, colour_map)
    place = _georeference(origin, heading_deg, crs)
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
            source, output, kind=kind, reference=reference, georeference=place, progress=progress,
            **levels, **given, **known,
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
    origin: tuple[float, ...] | None, heading_deg: float | None, crs: str | None
) -> clsas.Georeference | None:
    """Return the georeference of the options, or None."""
    if crs is not None:
        if origin is not None or heading_deg is not None:
            raise click.UsageError("--crs excludes --origin and --heading-deg")
        return clsas.Georeference.projected(crs)
    if (origin is None) != (heading_deg is None):
        raise click.UsageError("--origin and --heading-deg must be given together")
    if origin is None or heading_deg is None:
        return None
    return clsas.Georeference.local(*origin, heading_deg=heading_deg)
