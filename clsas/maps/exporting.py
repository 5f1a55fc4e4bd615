"""Export of images, mosaics and heights to the files that other programs open."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.factorized.plan import Plan
from clsas.files.sidecars import remove_sidecars
from clsas.interferometry.result import Heights
from clsas.maps import geotiff, map_grids, netcdf, sicd, viewer, world_files
from clsas.maps.export_options import HEIGHT_SUFFIXES, SUFFIXES, ExportOptions
from clsas.maps.geotiff import Progress
from clsas.maps.orientation import Orientation
from clsas.maps.sources import Source
from clsas.mosaics.store import Store
from clsas.plot import heights as heights_picture
from clsas.plot.canvas import COLOUR_MAP, DYNAMIC_RANGE_DB
from clsas.plot.canvas import SUFFIXES as PICTURES
from clsas.plot.canvas import save as save_picture


def export(
    source: Image | Store | Heights | str | os.PathLike,
    path: str | os.PathLike,
    *,
    kind: str | None = None,
    dynamic_range_db: float | None = None,
    reference: float | None = None,
    colour_map: str | None = None,
    north_up: bool = False,
    pixel_m: float | None = None,
    georeference: Georeference | None = None,
    plan: Plan | None = None,
    lines: RangeLines | None = None,
    beam: BeamWindow | None = None,
    north_arrow: bool = False,
    scale_bar: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write an image, a mosaic or heights as a file that other programs open.

    The suffix of `path` determines the format:

    - ``.tif``, a cloud-optimized GeoTIFF, for mapping programs. Its overviews are the mean power of
      the pixels that received something. A mosaic is read window by window and may be larger than
      memory.
    - ``.nc``, a netCDF 4 file after the CF conventions, with level (dB re 1, NaN where nothing was
      received), real and imaginary parts.
    - ``.nitf`` or ``.ntf``, a SICD file (1.4.0) of a radar image on a plane, for programs of
      synthetic aperture radar. It has complex pixels and the geometry of the lines.
    - ``.png``, ``.pdf`` or ``.svg``, a picture as `clsas.plot.image_db` draws it. A PNG of an image
      with a georeference gets a world file (``.pgw``) and a file with the coordinate reference
      system (``.png.aux.xml``), unless it is a vertical plane.
    - no suffix, a folder whose ``index.html`` shows the image in any browser, as `clsas view` does.
      A mosaic may be larger than memory.

    Heights become GeoTIFF or netCDF with three numbers per pixel, or a picture as
    `clsas.plot.heights` draws it, without a world file.

    Parameters
    ----------
    source : Image, Store, Heights or path-like
        Image, finished mosaic, heights, or path of a file or store that contains one of them.
    path : path-like
        File to write, or folder. An existing file is replaced in one step. An existing folder is
        replaced only if it contains a viewer; for a moment between two renamings there is neither.
        The name must not begin or end with a dot. Files beside it that describe the one it
        replaces, such as statistics in ``.aux.xml``, are removed.
    kind : {"db", "complex", "8bit"}, optional
        Pixels of a GeoTIFF of an image: the amplitude in dB (float32, NaN where nothing was
        received; the default), complex numbers (complex64), or 8-bit levels with a colour table.
    dynamic_range_db : float, optional
        Level of the first colour below that of the last one, for 8-bit levels, pictures and
        folders; by default 60 dB.
    reference : float, optional
        Amplitude of 0 dB. By default 1 for "db", so that maps of one survey agree, and the largest
        amplitude for 8-bit levels and pictures.
    colour_map : str, optional
        Colours of 8-bit levels, pictures and folders, as for `clsas.plot.image`; by default
        "inferno", and "viridis" for pictures of heights.
    north_up : bool
        True to resample a GeoTIFF so that its columns run east and its rows south. By default
        pixels are kept, and the transform of the file states how they are rotated. Complex pixels
        cannot be resampled: form the image on the grid of `Georeference.north_up`.
    pixel_m : float, optional
        With `north_up`, the size of the new pixels, metres; by default the distance of the image's.
    georeference : Georeference, optional
        Where the image lies on Earth, if it has no georeference of its own.
    plan : Plan, optional
        Plan of the image, if it has none in `Image.formed`. Tolerance, predicted error and plan
        become tags of the file, beside the method, beam and device of `Image.formed`. A mosaic
        knows its own.
    lines : RangeLines, optional
        Range lines of the image. Their carrier and sound speed become tags of the file. SICD
        requires them: track and band follow from them.
    beam : BeamWindow, optional
        Beam with which the image was formed, for SICD. Without it, every line that reaches a pixel
        contributes to it.
    north_arrow, scale_bar : bool
        True to draw an arrow to the north and a scale bar into a picture.
    progress : callable, optional
        Called as progress(done, total) while a GeoTIFF or a folder is written.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, is outside its limits or has no effect on the format; if
        a GeoTIFF has no georeference, its coordinate reference system is unknown, or its grid is
        vertical or consists of points; if complex pixels would have to be resampled; if heights are
        to become SICD or a folder; if a mosaic is damaged, not finished, or changes meanwhile; or
        if the environment variable SOURCE_DATE_EPOCH, which replaces the time in the history of
        netCDF, is no time.
    FileFormatError
        If the file at `source` does not contain an image or heights.
    ImportError
        If a package is missing (extra `maps`; `plot` for pictures and colours).
    OSError
        If a file cannot be read or written, for example on a full disk. Nothing is then written.

    Warns
    -----
    ClsasWarning
        If 8-bit levels leave out the heights of a height map, or if the middle of the grid is more
        than 150 km outside the area of use of its map projection, or where the scale of the map
        differs from 1 by more than 1 %.

    See Also
    --------
    Georeference : Where an image lies on Earth.
    save : Write an image to HDF5, bit for bit.
    to_xarray : The same contents as netCDF, in memory.

    Notes
    -----
    Rows and columns of a GeoTIFF are reversed or exchanged so that the image is never mirrored,
    and its rows run from north to south as far as that is possible without resampling. Pixels in dB
    and complex pixels of a height map have the heights as their second band.

    `Heights` have three bands in float32: height (m), standard deviation (m) and coherence. They
    are NaN outside the mask, and means in overviews leave out such pixels. Deviations in overviews
    are the root of the mean square: those of one pixel of the heights, not of their mean. A mosaic
    of heights has the same bands, and may be larger than memory; a folder shows its image.

    Heights in both cases are those of the seabed on the vertical axis of the map: the height above
    the plane of the grid, plus z of the plane, plus the height of the origin of a local
    georeference. They count from its vertical datum.

    With `north_up`, power is interpolated bilinearly, and so are heights. Pixels that received
    nothing, and heights outside the mask, are left out.

    Examples
    --------
    >>> import clsas
    >>> clsas.export("image.h5", "image.tif")  # doctest: +SKIP
    >>> clsas.export("heights.h5", "heights.tif", north_up=True)  # doctest: +SKIP
    >>> image = clsas.backproject(lines, place.north_up(grid))  # doctest: +SKIP
    >>> clsas.export(image, "complex.tif", kind="complex")  # doctest: +SKIP
    >>> clsas.export(clsas.Store.opened("mosaic.zarr"), "mosaic.tif", kind="8bit")  # doctest: +SKIP
    """
    path = validate.path("path", path)
    check_name("path", path)
    validate.suffix("path", path, *SUFFIXES)
    suffix = path.suffix.lower()
    options = ExportOptions(
        kind=kind,
        dynamic_range_db=dynamic_range_db,
        reference=reference,
        colour_map=colour_map,
        north_up=north_up,
        pixel_m=pixel_m,
        plan=plan,
        lines=lines,
        beam=beam,
        north_arrow=north_arrow,
        scale_bar=scale_bar,
    )
    validate.instance("georeference", georeference, Georeference, type(None))
    validate.progress(progress)
    opened = _opened(source)
    # A folder shows the image of a mosaic of heights.
    of_heights = isinstance(opened, Heights) or (
        isinstance(opened, Store) and bool(suffix) and bool(opened.layers)
    )
    if of_heights and suffix not in HEIGHT_SUFFIXES:
        allowed = f"end in {' or '.join(HEIGHT_SUFFIXES)} for heights"
        raise ArgumentError("path", allowed, validate.shown(str(path)))
    options.check_used(suffix, of_heights=of_heights)
    if suffix and suffix not in PICTURES:
        _write_data(path, _finished(opened, georeference), options, progress)
    elif of_heights or isinstance(opened, Heights):  # a picture
        shown = _placed_heights(opened, georeference)
        save_picture(heights_picture(shown, **options.given), path)
    elif suffix:
        world_files.write_picture(path, _placed(opened, georeference), options.given)
    else:
        viewer.write(
            opened,
            path,
            names=[_name_of(source)],
            dynamic_range_db=options.dynamic_range_db,
            colour_map=options.colour_map,
            georeference=georeference,
            progress=progress,
        )


def check_name(name: str, path: Path) -> None:
    """Raise ValueError for a file name like ".tif" or "image.", whose suffix was meant otherwise.

    Such a name has no suffix, so that a folder would be written.
    """
    last = path.name
    if last != ".." and (last.startswith(".") or last.endswith(".")):
        raise ArgumentError(name, "not begin or end with a dot", validate.shown(last))


def _opened(source: Image | Store | Heights | str | os.PathLike) -> Image | Store | Heights:
    """Return an image, a store or heights, read from a path if one is given."""
    if isinstance(source, Image | Store | Heights):
        return source
    path = validate.path("source", source)
    if path.is_dir():
        return Store.opened(path)
    from clsas.files.formats import load

    found = load(path)
    if not isinstance(found, Image | Heights):
        given = f"{path} with `{type(found).__name__}`"
        raise ArgumentError("source", "contain an image or heights", given)
    return found


def _name_of(source: Image | Store | Heights | str | os.PathLike) -> str:
    """Return the name of an image for the page of a folder: that of its file, if it has one."""
    if isinstance(source, Image | Store | Heights):
        return "image"
    return validate.printable(validate.path("source", source).resolve().name)


def _write_data(
    path: Path, source: Source, options: ExportOptions, progress: Progress | None
) -> None:
    """Write a file of pixels by its suffix, and remove files that describe the one it replaces."""
    suffix = path.suffix.lower()
    if suffix in geotiff.SUFFIXES:
        _check_map(source, options)
    map_grids.warn_of_place(source.grid)
    if suffix in geotiff.SUFFIXES:
        _write_geotiff(path, source, options, progress)
    elif suffix in netcdf.SUFFIXES:
        netcdf.write(path, source, _tags(source, options))
    else:
        sicd.write(path, source, options.lines, options.beam, _tags(source, options), progress)
    remove_sidecars(path)


def _write_geotiff(
    path: Path, source: Source, options: ExportOptions, progress: Progress | None
) -> None:
    """Write a GeoTIFF by the options of an export, or by their defaults."""
    tags = {
        name: value if isinstance(value, str) else f"{value:.12g}"
        for name, value in _tags(source, options).items()
    }
    completed = geotiff.Options(
        kind=options.kind or "db",
        north_up=options.north_up,
        pixel_m=options.pixel_m,
        dynamic_range_db=options.dynamic_range_db or DYNAMIC_RANGE_DB,
        reference=options.reference,
        colour_map=options.colour_map or COLOUR_MAP,
    )
    geotiff.write(path, source, completed, tags, progress)


def _check_map(source: Source, options: ExportOptions) -> None:
    """Raise ValueError for images that a GeoTIFF cannot show."""
    grid = source.grid
    if grid.points_m is not None:
        raise ArgumentError("source", "be on a plane or height map for a GeoTIFF", "points")
    if grid.georeference is None:
        raise ArgumentError(
            "source",
            "have a georeference for a GeoTIFF, since a map needs a place on Earth",
            hint="give `georeference`, or form the image by a scene with a table [georeference]",
        )
    turned = Orientation.of((grid.shape[0], grid.shape[1]), grid.georeference.affine(grid))
    if options.kind == "complex" and geotiff.resamples(
        turned, north_up=options.north_up, pixel_m=options.pixel_m
    ):
        _refuse_phase(grid, options.pixel_m)
    if grid.height_m is not None and options.kind == "8bit":
        validate.warn(
            "8-bit levels leave out the heights of the grid; `kind='db'` has them as second band"
        )


def _refuse_phase(grid: Grid, pixel_m: float | None) -> NoReturn:
    """Raise the error for complex pixels that would be resampled: it says what to do instead."""
    place = grid.georeference
    assert place is not None  # the caller has checked it
    hint = "leave `north_up` out; the transform of the file then states how the image is rotated"
    if grid.is_planar and not any(step_m[2] for step_m in grid.vectors_m[1:]):
        onto = place.north_up(grid, pixel_m)
        names = ("origin_m", "row_step_m", "column_step_m")
        table = [
            f"{name} = {each.tolist()}" for name, each in zip(names, onto.vectors_m, strict=True)
        ]
        hint = (
            "form the image on `georeference.north_up(grid, pixel_m)`, and export it without "
            "`north_up`. In a scene file, this grid is\n  "
        ) + "\n  ".join(["[grid]", *table, f"shape = {list(onto.shape)}"])
    raise ArgumentError(
        "kind", "not be complex with `north_up`, since only power can be resampled", hint=hint
    )


def _tags(source: Source, options: ExportOptions) -> dict[str, Any]:
    """Return what is known of an image's origin, as tags of a file: texts and numbers."""
    lines, plan = options.lines, options.plan
    formed = None if source.image is None else source.image.formed
    place, inputs = source.grid.georeference, source.inputs
    errors = [r.predicted_error_db for r in source.records.values() if r.has_pixels]
    known: dict[str, Any] = {
        "CLSAS_VERSION": __version__,
        "CARRIER_HZ": inputs.get("carrier_hz"),
        "SOUND_SPEED_M_S": inputs.get("sound_speed_m_s"),
        "TOLERANCE_DB": inputs.get("tolerance_db"),
        "ACCURACY_DB": inputs.get("accuracy_db"),
        "PREDICTED_ERROR_DB": max((e for e in errors if e is not None), default=None),
        "PATCHES": len(source.records) or None,
        "WINDOW_M": source.window_m,
    }
    if formed is not None:
        known |= {
            "METHOD": formed.method,
            "TOLERANCE_DB": formed.tolerance_db,
            "PREDICTED_ERROR_DB": formed.predicted_error_db,
            "PLAN": formed.plan or None,
            "BEAM": None if formed.beam is None else repr(formed.beam),
            "LEFT_OUT": ", ".join(formed.left_out) or None,
            "DEVICE": formed.device,
            "LINES_DIGEST": formed.lines_digest,
            "FORMED_BY": f"clsas {formed.version}",
        }
    if lines is not None:
        known |= {"CARRIER_HZ": lines.carrier_hz, "SOUND_SPEED_M_S": lines.sound_speed_m_s}
    if plan is not None:
        known |= {
            "TOLERANCE_DB": plan.tolerance_db,
            "PREDICTED_ERROR_DB": plan.predicted_error_db,
            "PLAN": repr(plan),
        }
    if place is not None:
        known["VERTICAL_DATUM"] = place.vertical_datum
        if not place.is_projected:
            known |= {
                "ORIGIN_LATITUDE_DEG": place.latitude_deg,
                "ORIGIN_LONGITUDE_DEG": place.longitude_deg,
                "ORIGIN_HEIGHT_M": place.height_m,
                "X_AXIS_HEADING_DEG": place.heading_deg,
            }
    return {name: value for name, value in known.items() if value is not None}


def _finished(source: Image | Store | Heights, georeference: Georeference | None) -> Source:
    """Return the source of what is exported; raise ValueError if a store is not finished."""
    found = Source.of(source, georeference)
    found.check_finished()
    return found


def _placed(source: Image | Store, georeference: Georeference | None) -> Image:
    """Return the image that a picture shows, with the georeference of the export."""
    found = _finished(source, georeference)
    shown = source.overview() if isinstance(source, Store) else source
    if shown.georeference == found.grid.georeference:
        return shown
    return replace(shown, grid=replace(shown.grid, georeference=found.grid.georeference))


def _placed_heights(source: Image | Store | Heights, georeference: Georeference | None) -> Heights:
    """Return the heights that a picture shows, with the georeference of the export."""
    if isinstance(source, Store):
        _finished(source, georeference).check_unchanged()
    heights = source.overview_heights() if isinstance(source, Store) else source
    assert isinstance(heights, Heights)
    return replace(heights, image=_placed(heights.image, georeference))
