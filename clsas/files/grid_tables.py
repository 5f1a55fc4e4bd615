"""Table of scene files that describes the grid: a plane of any orientation, with heights or not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.files.height_files import read_heights
from clsas.files.tables import Table, Vector, located

_ALONG_AXES = ("x", "y")
_ORIENTED = ("origin_m", "row_step_m", "column_step_m", "shape")


class AxisTable(Table):
    """`[grid.x]` or `[grid.y]`."""

    start_m: float
    stop_m: float
    count: int

    def build(self) -> tuple[float, float, int]:
        """Return (start, stop, count), as `Grid.plane` takes it."""
        return self.start_m, self.stop_m, self.count


class GridTable(Table):
    """`[grid]`."""

    x: AxisTable | None = None
    y: AxisTable | None = None
    z_m: float = 0.0
    origin_m: Vector | None = None
    row_step_m: Vector | None = None
    column_step_m: Vector | None = None
    shape: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    height_file: str | None = None

    def build(self, folder: Path) -> Grid:
        """Return the grid; a relative `height_file` begins at `folder`.

        Raises
        ------
        ValueError
            If keys are missing or exclude each other, a value is outside its limits, or the file
            of heights cannot be read or has another shape.
        """
        with located("[grid]"):
            plane = self._plane()
            if self.height_file is None:
                return plane
            return plane.with_height(read_heights(folder / self.height_file, plane.shape))

    def _plane(self) -> Grid:
        """Return the plane, without heights."""
        given = self.model_fields_set
        oriented = given & set(_ORIENTED)
        along_axes = given & {*_ALONG_AXES, "z_m"}
        if oriented and along_axes:
            raise ArgumentError(
                min(along_axes),
                f"be left out with `{min(oriented)}`",
                hint="give `x`, `y` and `z_m` for a horizontal plane, or `origin_m`, `row_step_m`, "
                "`column_step_m` and `shape` for any",
            )
        for name in _ORIENTED if oriented else _ALONG_AXES:
            if getattr(self, name) is None:
                other = "" if oriented else ", or `origin_m`, `row_step_m`, ... of a slanted plane"
                raise ArgumentError(name, f"be given{other}")
        if self.x is not None and self.y is not None:
            return Grid.plane(self.x.build(), self.y.build(), self.z_m)
        assert self.origin_m is not None  # all four have been checked
        assert self.row_step_m is not None
        assert self.column_step_m is not None
        assert self.shape is not None
        rows, columns = self.shape
        return Grid.oriented(self.origin_m, self.row_step_m, self.column_step_m, (rows, columns))
