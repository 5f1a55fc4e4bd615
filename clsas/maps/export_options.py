"""Options of an export, and which of them have an effect on which format."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import DYNAMIC_RANGE, REFERENCE
from clsas.engine.data.declared import Choice, Flag, Number, check_fields
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.plan import Plan
from clsas.maps import geotiff, netcdf, sicd
from clsas.maps.encoding import KINDS
from clsas.plot.canvas import SUFFIXES as PICTURES

SUFFIXES = (*geotiff.SUFFIXES, *netcdf.SUFFIXES, *sicd.SUFFIXES, *PICTURES)
"""Suffixes of the files that `clsas.export` writes."""

HEIGHT_SUFFIXES = (*geotiff.SUFFIXES, *netcdf.SUFFIXES, *PICTURES)
"""Those that it writes for heights."""

_COLOURS = {"dynamic_range_db", "reference", "colour_map"}
_ORIGIN = {"plan", "lines"}


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
            KINDS,
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

    def check_used(self, suffix: str, *, of_heights: bool) -> None:
        """Raise ValueError if an option has no effect on the format of a suffix; "" is a folder."""
        used, what = self._used_by_heights(suffix) if of_heights else self._used(suffix)
        unused = [name for name in self.given if name not in used]
        if unused:
            if unused[0] == "pixel_m" and "north_up" in used:
                what += " without `north_up`"
            raise ArgumentError(unused[0], f"be left out, since it has no effect on {what}")

    def _used(self, suffix: str) -> tuple[set[str], str]:
        """Return the options that have an effect on a format, and what the format is called."""
        if not suffix:
            return {"dynamic_range_db", "colour_map"}, "a folder, as `path` is without a suffix"
        if suffix in PICTURES:
            return _COLOURS | {"north_arrow", "scale_bar"}, suffix
        if suffix in netcdf.SUFFIXES:
            return _ORIGIN, suffix
        if suffix in sicd.SUFFIXES:
            return _ORIGIN | {"beam"}, suffix
        kind = self.kind or "db"
        used = _ORIGIN | {"kind", "north_up"}
        used |= {"8bit": _COLOURS, "complex": set()}.get(kind, {"reference"})
        return self._with_pixel_m(used), f"{suffix} with `kind={kind!r}`"

    def _used_by_heights(self, suffix: str) -> tuple[set[str], str]:
        """Return the same of a format of heights, whose numbers are neither levels nor complex."""
        what = f"{suffix} of heights"
        if suffix in PICTURES:
            return {"colour_map"}, what
        if suffix in netcdf.SUFFIXES:
            return {"lines"}, what
        return self._with_pixel_m({"lines", "north_up"}), what

    def _with_pixel_m(self, used: set[str]) -> set[str]:
        """Return the options of a GeoTIFF, with `pixel_m` if it is resampled."""
        return used | {"pixel_m"} if self.north_up else used
