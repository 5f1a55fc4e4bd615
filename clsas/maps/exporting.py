"""Export of images, mosaics and heights to the files that other programs open."""

from __future__ import annotations

import os
from collections.abc import Callable, Set
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import DYNAMIC_RANGE, REFERENCE
from clsas.engine.data.declared import Choice, Flag, Number, check_fields
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.factorized.plan import Plan
from clsas.files.sidecars import remove_sidecars
from clsas.interferometry.result import Heights
from clsas.maps import geotiff, netcdf, sicd, viewer, world_files
from clsas.maps.geotiff import Progress
from clsas.maps.sources import Source
from clsas.mosaics.store import Store
from clsas.plot import heights as heights_picture
from clsas.plot.canvas import COLOUR_MAP, DYNAMIC_RANGE_DB
from clsas.plot.canvas import SUFFIXES as PICTURES
from clsas.plot.canvas import save as save_picture

_Opened = Image | Store | Heights


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
    caption: bool = False,
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
    caption : bool
        True to write below a picture how large the error of the image is.
    progress : callable, optional
        Called as progress(done, total) while a GeoTIFF or a folder is written.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, is outside its limits or has no effect on the format; if
        a GeoTIFF has no georeference, its coordinate reference system is unknown, or its grid is
        vertical or consists of points; if complex pixels would have to be resampled; if heights are
        to become SICD or a folder; if a mosaic is damaged, changes meanwhile, or is not finished
        and not to become a folder; or if the environment variable SOURCE_DATE_EPOCH, which replaces
        the time in the history of netCDF, is no time.
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
        caption=caption,
    )
    validate.instance("georeference", georeference, Georeference, type(None))
    validate.progress(progress)
    opened = _opened(source)
    chosen = next((each for each in _FORMATS if suffix in each.suffixes), None)
    # A folder shows the image of a mosaic of heights.
    of_heights = isinstance(opened, Heights) or (
        isinstance(opened, Store) and bool(suffix) and bool(opened.layers)
    )
    if of_heights and (chosen is None or chosen.of_heights is None):
        suffixes = [
            end for each in _FORMATS if each.of_heights is not None for end in each.suffixes
        ]
        allowed = f"end in {' or '.join(suffixes)} for heights"
        raise ArgumentError("path", allowed, validate.shown(str(path)))
    options.check_used(suffix, chosen, of_heights=of_heights)
    if chosen is None:
        assert not isinstance(opened, Heights)  # they have been refused
        name = "image"
        if not isinstance(source, _Opened):
            name = validate.printable(validate.path("source", source).resolve().name)
        viewer.write(
            opened,
            path,
            names=[name],
            dynamic_range_db=options.dynamic_range_db,
            colour_map=options.colour_map,
            georeference=georeference,
            progress=progress,
        )
        return
    found = Source.of(opened, georeference)
    found.check_finished()
    chosen.write(path, opened, found, options, progress)
    if chosen.suffixes != PICTURES:  # which remove them before they write their own
        remove_sidecars(path)


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `clsas.export`, which describes them. None or False is an option not given.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or is outside its limits.
    """

    kind: Annotated[
        str | None,
        Choice(
            geotiff.KINDS,
            help="Pixels of a GeoTIFF of an image: amplitude in dB, complex numbers, or 8-bit "
            "levels with colours.",
            default="db",
        ),
    ] = None
    dynamic_range_db: Annotated[float | None, DYNAMIC_RANGE] = None
    reference: Annotated[float | None, REFERENCE] = None
    colour_map: str | None = None
    north_up: Annotated[
        bool,
        Flag("Resample a GeoTIFF so that its rows run east. Without it, its transform is rotated."),
    ] = False
    pixel_m: Annotated[
        float | None,
        Number(
            "m", above=0.0, help="Size of the pixels.", default="the distance of those of the input"
        ),
    ] = None
    plan: Plan | None = None
    lines: RangeLines | None = None
    beam: BeamWindow | None = None
    north_arrow: Annotated[bool, Flag("Draw an arrow to the north into a picture.")] = False
    scale_bar: Annotated[bool, Flag("Draw a scale bar into a picture.")] = False
    caption: Annotated[bool, Flag("Write the error of the image below a picture.")] = False

    def __post_init__(self) -> None:
        """Check every field, and convert those that are declared."""
        check_fields(self)
        if self.colour_map is not None:
            validate.text("colour_map", self.colour_map)
        validate.instance("plan", self.plan, Plan, type(None))
        validate.instance("lines", self.lines, RangeLines, type(None))
        validate.instance("beam", self.beam, BeamWindow, type(None))

    @property
    def given(self) -> dict[str, Any]:
        """Options that are given, by name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: v for name, v in values.items() if v is not None and v is not False}

    def check_used(self, suffix: str, chosen: _Format | None, *, of_heights: bool) -> None:
        """Raise ValueError if an option has no effect on a format; None is a folder."""
        used: Set[str] = {"dynamic_range_db", "colour_map"}
        if chosen is None:
            what = "a folder, as `path` is without a suffix"
        elif of_heights:  # whose numbers are neither levels nor complex
            used, what = chosen.of_heights or set(), f"{suffix} of heights"
        else:
            used, what = chosen.options, suffix
        if "kind" in used:
            kind = self.kind or "db"
            used, what = used | _OF_KIND[kind], f"{suffix} with `kind={kind!r}`"
        if self.north_up and "north_up" in used:
            used = used | {"pixel_m"}

        unused = [name for name in self.given if name not in used]
        if unused:
            if unused[0] == "pixel_m" and "north_up" in used:
                what += " without `north_up`"
            raise ArgumentError(unused[0], f"be left out, since it has no effect on {what}")


def check_name(name: str, path: Path) -> None:
    """Raise ValueError for a file name like ".tif" or "image.", whose suffix was meant otherwise.

    Such a name has no suffix, so that a folder would be written.
    """
    last = path.name
    if last != ".." and (last.startswith(".") or last.endswith(".")):
        raise ArgumentError(name, "not begin or end with a dot", validate.shown(last))


def _opened(source: Image | Store | Heights | str | os.PathLike) -> Image | Store | Heights:
    """Return an image, a store or heights, read from a path if one is given."""
    if isinstance(source, _Opened):
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


def _write_geotiff(
    path: Path, _: _Opened, source: Source, options: ExportOptions, progress: Progress | None
) -> None:
    tags = _tags(source, options)
    geotiff.write(
        path,
        source,
        kind=options.kind or "db",
        reference=options.reference,
        dynamic_range_db=options.dynamic_range_db or DYNAMIC_RANGE_DB,
        colour_map=options.colour_map or COLOUR_MAP,
        north_up=options.north_up,
        pixel_m=options.pixel_m,
        tags={k: v if isinstance(v, str) else f"{v:.12g}" for k, v in tags.items()},
        progress=progress,
    )


def _write_netcdf(
    path: Path, _: _Opened, source: Source, options: ExportOptions, __: Progress | None
) -> None:
    netcdf.write(path, source, _tags(source, options))


def _write_sicd(
    path: Path, _: _Opened, source: Source, options: ExportOptions, progress: Progress | None
) -> None:
    sicd.write(path, source, options.lines, options.beam, _tags(source, options), progress)


def _write_picture(
    path: Path, opened: _Opened, source: Source, options: ExportOptions, _: Progress | None
) -> None:
    """Write a picture of an image or of heights, with the georeference of the export."""
    place = source.grid.georeference

    def placed(image: Image) -> Image:
        if image.georeference == place:
            return image
        return replace(image, grid=replace(image.grid, georeference=place))

    shown: Image | Heights
    if isinstance(opened, Store):
        shown = opened.overview_heights() if opened.layers else opened.overview()
        source.check_unchanged()
    else:
        shown = opened
    if isinstance(shown, Heights):
        shown = replace(shown, image=placed(shown.image))
        save_picture(heights_picture(shown, **options.given), path)
    else:
        world_files.write_picture(path, placed(shown), options.given)


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
    certificate = source.certificate
    if certificate is not None:
        known |= {
            "MEASURED_ERROR_DB": certificate.error_db,
            "MEASURED_ERROR_UPPER_DB": certificate.upper_db,
            "MEASURED_PIXELS": certificate.pixels,
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


class _Format(NamedTuple):
    """A format of files.

    Attributes
    ----------
    suffixes : tuple of str
    write : callable
        Writes what is exported, which `Source` reads window by window.
    options : set of str
        Options that have an effect on it.
    of_heights : set of str or None
        The same for heights; None if it has no heights.
    """

    suffixes: tuple[str, ...]
    write: Callable[[Path, _Opened, Source, ExportOptions, Progress | None], None]
    options: Set[str]
    of_heights: Set[str] | None


_COLOURS = {"dynamic_range_db", "reference", "colour_map"}
_OF_KIND: dict[str, Set[str]] = {"db": {"reference"}, "complex": set(), "8bit": _COLOURS}
"""Further options of formats with kinds of pixels, by kind."""

_FORMATS = (
    _Format(
        geotiff.SUFFIXES,
        _write_geotiff,
        options={"plan", "lines", "kind", "north_up"},
        of_heights={"lines", "north_up"},
    ),
    _Format(netcdf.SUFFIXES, _write_netcdf, options={"plan", "lines"}, of_heights={"lines"}),
    _Format(sicd.SUFFIXES, _write_sicd, options={"plan", "lines", "beam"}, of_heights=None),
    _Format(
        PICTURES,
        _write_picture,
        options=_COLOURS | {"north_arrow", "scale_bar", "caption"},
        of_heights={"colour_map"},
    ),
)

SUFFIXES = tuple(suffix for each in _FORMATS for suffix in each.suffixes)
"""Suffixes of the files that `clsas.export` writes."""
