"""Tables of scene files: one pydantic model per table, which checks the keys of the table.

The method `build` converts a table into an object of the library. Checks of the library then apply,
and the name of the table is put in front of their messages.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.track import Pointing
from clsas.engine.data.validate import ArgumentError, Count
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import checked_pairs, tolerance_in_db
from clsas.engine.signal.compression import check_options as check_compression
from clsas.files.georeference_table import GeoreferenceTable
from clsas.files.grid_tables import GridTable
from clsas.files.process_tables import ProcessTable
from clsas.files.sound_speed_table import SoundSpeedTable
from clsas.files.survey_tables import SonarTable, TrackTable
from clsas.files.tables import Table, Vector, located
from clsas.simulation.scenes import PointTargets, Seabed
from clsas.simulation.seabeds import pipeline, rocks, wreck
from clsas.simulation.simulator import check_options as check_simulation

SEABEDS: dict[str, Callable[..., Seabed]] = {"wreck": wreck, "pipeline": pipeline, "rocks": rocks}
PLAN_KEYS = ("tolerance_db", "tolerance_wavelengths", "stages")
"""Keys of `[image]` for `clsas.plan`, of which one may be given."""
EXACT_KEYS = ("accuracy_db", "taps", "upsampling")
"""Keys of `[image]` for `clsas.backproject`."""


class _Target(Table):
    position_m: Vector
    amplitude: float = 1.0


class _Seabed(Table):
    scene: str
    x_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    y_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    position_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    heading_deg: float | None = None
    mast_m: float | None = None
    count: int | None = None
    cell_m: float = 0.1
    density_m2: float = 600.0
    seed: int = 0
    floor_db: float = -50.0

    def build(self) -> Seabed:
        with located("[seabed]"):
            make = SEABEDS[validate.one_of("scene", self.scene, tuple(SEABEDS))]
            options = self.given()
            del options["scene"]
            known = inspect.signature(make).parameters
            for name in options:
                if name not in known:
                    allowed = f"be left out with the scene {validate.shown(self.scene)}"
                    raise ArgumentError(name, allowed)
            return make(**options)


class _Pointing(Table):
    squint_deg: float | list[float] = 0.0
    depression_deg: float = 0.0
    spot_m: Vector | None = None

    def build(self) -> Pointing:
        with located("[simulate.pointing]"):
            if self.spot_m is None:
                squint = np.atleast_1d(self.squint_deg)
                squint = validate.array("squint_deg", squint, np.float64, (None,))
                depression = validate.number("depression_deg", self.depression_deg, "degrees")
                return Pointing.scan(np.radians(squint), depression_rad=np.radians(depression))
            if len(self.model_fields_set) > 1:
                allowed = "be the only key of its table, since it sets the angles"
                raise ArgumentError("spot_m", allowed)
            return Pointing.spot(self.spot_m)


class _Simulate(Table):
    spreading: bool = False
    motion_in_flight: bool = False
    element_pattern: bool = True
    phase_centres: bool = False
    range_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    snr_db: float | None = None
    seed: int = 0
    pointing: _Pointing | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        if self.pointing is not None:
            options["pointing"] = self.pointing.build()
        with located("[simulate]"):
            check_simulation(**options)
        return options


class _Compress(Table):
    window: str | list[str | float] = "none"
    oversampling: float = 2.0
    equalize: bool = False

    def build(self) -> dict[str, Any]:
        options = self.given()
        if isinstance(self.window, list):
            options["window"] = tuple(self.window)
        with located("[compress]"):
            check_compression(**options)
        return options


class _Beam(Table):
    width_deg: float
    shape: str = "rectangular"
    squint_deg: float = 0.0
    taper: float = 0.5
    element_length_m: float | None = None
    normalise: bool = False
    track_pings: int | None = None

    def build(self) -> BeamWindow:
        with located("[image.beam]"):
            return BeamWindow(**self.given())


class _Image(Table):
    tolerance_db: float | None = None
    tolerance_wavelengths: float | None = None
    stages: list[Annotated[list[int], Field(min_length=2, max_length=2)]] | None = None
    accuracy_db: float | None = None
    taps: int | None = None
    upsampling: float | None = None
    beam: _Beam | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        with located("[image]"):
            requests = [name for name in PLAN_KEYS if name in options]
            if len(requests) > 1 or (requests and options.keys() & set(EXACT_KEYS)):
                others = [
                    name
                    for name in (*PLAN_KEYS, *EXACT_KEYS)
                    if name in options and name != requests[0]
                ]
                got = f"also {', '.join(others)}"
                raise ArgumentError(requests[0], "be the only request", got)
            tolerance_in_db(self.tolerance_db, self.tolerance_wavelengths)
            checked_pairs([(beams, divisions) for beams, divisions in self.stages or ()])
            validate.check_declared(ExactImage, options)
        if self.stages is not None:
            options["stages"] = [tuple(stage) for stage in self.stages]
        if self.beam is not None:
            options["beam"] = self.beam.build()
        return options


class _Mosaic(Table):
    lines: str | None = None
    store: str | None = None
    patches: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    memory_mib: Annotated[int | None, Count()] = None

    def build(self, folder: Path) -> dict[str, Any]:
        with located("[mosaic]"):
            options = self.given()
            for name in ("lines", "store"):
                if name in options:
                    options[name] = folder / validate.path(name, options[name])
            if "lines" in options and not options["lines"].exists():
                hint = f"{options['lines']} does not exist"
                raise ArgumentError("lines", "be a file or folder", hint=hint)
            if self.patches is not None:
                rows, columns = (validate.count("every entry of patches", n) for n in self.patches)
                options["patches"] = rows, columns
        return options


class SceneTables(Table):
    """All tables of a scene file."""

    sonar: SonarTable | None = None
    track: TrackTable | None = None
    targets: list[_Target] | None = None
    seabed: _Seabed | None = None
    grid: GridTable | None = None
    sound_speed: SoundSpeedTable | None = None
    georeference: GeoreferenceTable | None = None
    simulate: _Simulate = _Simulate()
    compress: _Compress = _Compress()
    image: _Image = _Image()
    mosaic: _Mosaic = _Mosaic()
    process: ProcessTable = ProcessTable()

    def build(self, folder: Path) -> dict[str, Any]:
        """Return the fields of `clsas.files.scene_files.SceneFile` except the name.

        Parameters
        ----------
        folder : Path
            Folder from which relative paths in the file start.
        """
        parts: list[PointTargets | Seabed] = []
        if self.targets is not None:
            with located("[[targets]]"):
                parts.append(
                    PointTargets(
                        np.reshape([target.position_m for target in self.targets], (-1, 3)),
                        np.array([target.amplitude for target in self.targets], complex),
                    )
                )
        if self.seabed is not None:
            parts.append(self.seabed.build())
        paths = {
            "track.file": self.track and self.track.file,
            "grid.height_file": self.grid and self.grid.height_file,
            "sound_speed.file": self.sound_speed and self.sound_speed.file,
            "mosaic.lines": self.mosaic.lines,
            "process.lines": self.process.lines,
        }
        place = self.georeference.build() if self.georeference else None
        track = self.track.build(folder, place) if self.track else None
        if track is not None:
            place = track.georeference  # its own, if it consists of latitudes and longitudes
        profile = self.sound_speed.build(folder) if self.sound_speed else None
        simulate = self.simulate.build()
        if profile is not None:
            simulate["sound_speed"] = profile
        return dict(
            sonar=self.sonar.build() if self.sonar else None,
            track=track,
            targets=tuple(parts) if len(parts) > 1 else parts[0] if parts else None,
            grid=replace(self.grid.build(folder), georeference=place) if self.grid else None,
            georeference=place,
            sound_speed=profile,
            simulate=simulate,
            compress=self.compress.build(),
            image=self.image.build(),
            mosaic=self.mosaic.build(folder),
            process=self.process.build(folder),
            files={key: folder / file for key, file in paths.items() if file},
        )
