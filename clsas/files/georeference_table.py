"""Table of scene files that places the scene on Earth."""

from __future__ import annotations

from clsas.engine.data.georeference import Georeference
from clsas.engine.data.validate import ArgumentError
from clsas.files.tables import Table, located


class GeoreferenceTable(Table):
    """`[georeference]`."""

    crs: str | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None
    heading_deg: float | None = None
    vertical_datum: str | None = None

    def build(self) -> Georeference:
        """Return the georeference.

        Raises
        ------
        ValueError
            If keys are missing or exclude each other, or a value is outside its limits.
        ImportError
            If `crs` is given, which needs pyproj, and it is not installed.
        """
        given = self.given()
        local = [name for name in given if name not in ("crs", "vertical_datum")]
        with located("[georeference]"):
            if self.crs is not None:
                if local:
                    raise ArgumentError(min(local), "be left out with `crs`")
                return Georeference.projected(self.crs, vertical_datum=self.vertical_datum)
            for name in ("latitude_deg", "longitude_deg", "heading_deg"):
                if getattr(self, name) is None:
                    raise ArgumentError(name, "be given, or `crs` of a map projection")
            return Georeference(**{"height_m": 0.0} | given)
