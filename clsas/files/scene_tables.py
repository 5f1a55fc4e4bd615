"""Tables of scene files: one pydantic model per table, which checks the keys of the table.

Keys that set an argument of the library come from its declaration (`keys_of`). The method `build`
of a table returns an object of the library, and `options` returns arguments of a function. Checks
of the library then apply, and the name of the table is put in front of their messages.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import Count, Other
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import Pulse, Sonar, line_array, stacked
from clsas.engine.data.track import Motion, Pointing, Track
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import Request
from clsas.engine.imaging import factorize
from clsas.engine.signal.compression import compress
from clsas.files.csv_files import read_sound_speed, read_track
from clsas.files.height_files import read_heights
from clsas.files.tables import Pair, Table, Vector, keys_of, located
from clsas.interferometry.checks import PATCH
from clsas.interferometry.heights import heights
from clsas.interferometry.pair_errors import pair_errors
from clsas.navigation.autofocus import autofocus
from clsas.navigation.calibration import calibrate_track
from clsas.navigation.micronavigation import micronavigate
from clsas.simulation.scenes import PointTargets, Seabed
from clsas.simulation.seabeds import pipeline, rocks, wreck
from clsas.simulation.simulator import simulate

PRESETS = ("thesis_wide_beam", "edgetech", "sensotek", "hisas_1030")
SEABEDS: dict[str, Callable[..., Seabed]] = {"wreck": wreck, "pipeline": pipeline, "rocks": rocks}
PLAN_KEYS = ("tolerance_db", "tolerance_wavelengths", "stages")
"""Keys of `[image]` for `clsas.plan`, of which one may be given."""
EXACT_KEYS = ("accuracy_db", "taps", "upsampling")
"""Keys of `[image]` for `clsas.backproject`."""
PROMISE_KEYS = ("certificate", "on_miss")
"""Keys of `[image]` for both, about the measured error."""
STEP_NAMES = (
    "inspect", "calibrate", "navigate", "focus", "pair_errors", "image", "heights", "mosaic"
)  # fmt: skip
"""Names of the steps of `clsas process`, in the order in which they run."""
CORRECTIONS = ("calibrate", "navigate", "focus", "pair_errors")
"""Steps that correct the lines."""

_USUAL = ("inspect", "image")
_OPTIONAL = (*CORRECTIONS, "heights")  # by default they run if their table exists
_REQUIRED = {  # tables without which a step cannot run, each with a key that it must have
    "calibrate": {"calibrate": "`points_m`"},
    "pair_errors": {"pair_errors": "`known_height_m` or `points_m`", "heights": "`search_m`"},
    "heights": {"heights": "`search_m`"},
}
_ORIENTED = ("origin_m", "row_step_m", "column_step_m", "shape")  # keys of a slanted plane
_ALONG_AXES = ("x", "y")
_PROFILES = ({"file"}, {"depth_m", "speed_m_s"}, {"depth_m", "temperature_c", "salinity"})


@keys_of(Pulse)
class PulseTable(Table):
    """`[sonar.pulse]`."""

    code: str | list[int] = "up"

    def build(self) -> Pulse:
        """Return the pulse; raise ValueError if a value is outside its limits."""
        given = self.given()
        code = given.pop("code", self.code)
        if "bandwidth_hz" in given:
            return Pulse(**given, code=code if isinstance(code, str) else tuple(code))
        if isinstance(code, str):
            raise ArgumentError("bandwidth_hz", "be given", hint="only a phase code determines it")
        return Pulse.phase_code(**given, chips=tuple(code))


@keys_of(Sonar)
class SonarTable(Table):
    """`[sonar]`."""

    preset: str | None = None
    pulse: PulseTable | None = None
    receivers: int | None = None
    spacing_m: float | None = None
    bank_heights_m: Annotated[list[float], Field(min_length=1)] | None = None
    rx_m: list[Vector] | None = None
    tx_m: Vector = Field(default=[0.0, 0.0, 0.0])
    sample_rate_hz: float | None = None
    bank_numbers: list[int] | None = None

    def build(self) -> Sonar:
        """Return the sonar; raise ValueError if a value is outside its limits."""
        with located("[sonar]"):
            if self.preset is not None:
                others = sorted(self.model_fields_set - {"preset"})
                if others:
                    raise ArgumentError("preset", "be the only key", f"also {', '.join(others)}")
                validate.one_of("preset", self.preset, PRESETS)
                return getattr(Sonar, self.preset)()
            if self.pulse is None:
                raise ArgumentError("pulse", "be given as [sonar.pulse], or `preset` instead")
            rx_m, banks = self._receivers()
        with located("[sonar.pulse]"):
            pulse = self.pulse.build()
        placing = {"pulse", "receivers", "spacing_m", "rx_m", "bank_heights_m", "bank_numbers"}
        with located("[sonar]"):
            options = {name: each for name, each in self.given().items() if name not in placing}
            return Sonar(pulse, rx_m, **options, bank_numbers=banks)  # type: ignore[arg-type]

    def _receivers(self) -> tuple[NDArray[np.float64], ArrayLike | None]:
        """Return the positions of the receivers, [receivers, 3], and their banks."""
        match self.rx_m, self.receivers, self.spacing_m:
            case list(), None, None:
                if self.bank_heights_m is not None:
                    allowed = "be left out with `rx_m`, which has the heights"
                    hint = "give the banks by `bank_numbers`"
                    raise ArgumentError("bank_heights_m", allowed, hint=hint)
                return np.array(self.rx_m), self.bank_numbers
            case None, int(count), float(spacing):
                if self.bank_numbers is not None:
                    hint = "give the heights of the banks by `bank_heights_m`"
                    raise ArgumentError("bank_numbers", "be left out without `rx_m`", hint=hint)
                row_m = line_array(count, spacing)
                if self.bank_heights_m is None:
                    return row_m, None
                return stacked(row_m, self.bank_heights_m)
        raise ArgumentError("rx_m", "be given, or `receivers` and `spacing_m`, and not both")


class MotionTable(Table):
    """Sinusoidal motion, or random motion of the same power if `random_seed` is given."""

    period_s: float
    phase_deg: float = 0.0
    random_seed: int | None = None

    def _motion(self, name: str, unit: str, scale: float = 1.0) -> Motion:
        amplitude = scale * validate.number(name, getattr(self, name), unit)
        period = validate.positive("period_s", self.period_s, "s")
        phase = validate.number("phase_deg", self.phase_deg, "degrees")
        phases, frequencies = np.radians([phase]), np.array([1 / period])
        if self.random_seed is not None:
            if "phase_deg" in self.model_fields_set:
                raise ArgumentError("phase_deg", "be left out with `random_seed`")
            # Sum of sinusoids of random frequency and phase, with periods from period_s upward.
            random = np.random.default_rng(validate.count("random_seed", self.random_seed, least=0))
            frequencies = random.uniform(0.1, 1.0, 32) / period
            phases = random.uniform(0, 2 * np.pi, 32)
        amplitude /= np.sqrt(len(phases))

        def motion(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
            cycles = np.multiply.outer(time_s, frequencies)
            return amplitude * np.sin(2 * np.pi * cycles + phases).sum(axis=-1)

        return motion


class DisplacementTable(MotionTable):
    """`[track.surge]`, `[track.sway]` or `[track.heave]`."""

    amplitude_m: float

    def build(self) -> Motion:
        """Return the displacement (m) as a function of time (s)."""
        return self._motion("amplitude_m", "m")


class RotationTable(MotionTable):
    """`[track.yaw]`, `[track.pitch]` or `[track.roll]`."""

    amplitude_deg: float

    def build(self) -> Motion:
        """Return the angle (rad) as a function of time (s)."""
        return self._motion("amplitude_deg", "degrees", np.pi / 180)


class TrackTable(Table):
    """`[track]`."""

    file: str | None = None
    start_m: Vector | None = None
    velocity_m_s: Vector | None = None
    pings: int | None = None
    ping_interval_s: float | None = None
    surge: DisplacementTable | None = None
    sway: DisplacementTable | None = None
    heave: DisplacementTable | None = None
    yaw: RotationTable | None = None
    pitch: RotationTable | None = None
    roll: RotationTable | None = None

    def build(self, folder: Path, georeference: Georeference | None = None) -> Track:
        """Return the track; a relative path of a `file` starts from `folder`.

        Parameters
        ----------
        folder : Path
        georeference : Georeference, optional
            Frame of the track.

        Raises
        ------
        ValueError
            If a value is outside its limits or the file cannot be read.
        """
        if self.file is not None:
            others = sorted(self.model_fields_set - {"file"})
            if others:
                got = f"also {', '.join(others)}"
                raise ArgumentError("file", "be the only key", got, where="[track]")
            path = folder / self.file
            try:
                with located("[track] file"):
                    return read_track(path, georeference)
            except OSError as error:
                hint = f"{error.strerror}: {path}"
                raise ArgumentError("file", "be readable", hint=hint, where="[track]") from None
        course = ("start_m", "velocity_m_s", "pings", "ping_interval_s")
        for name in course:
            if getattr(self, name) is None:
                raise ArgumentError(name, "be given, or `file`", where="[track]")
        motions = {}
        for argument in ("surge_m", "sway_m", "heave_m", "yaw_rad", "pitch_rad", "roll_rad"):
            table = argument.split("_")[0]
            if (motion := getattr(self, table)) is not None:
                with located(f"[track.{table}]"):
                    motions[argument] = motion.build()
        with located("[track]"):
            track = Track.straight(*(getattr(self, name) for name in course), **motions)
        return replace(track, georeference=georeference)


class _Target(Table):
    position_m: Vector
    amplitude: float = 1.0


@keys_of(Seabed)
class _Seabed(Table):
    scene: str
    x_m: Pair | None = None
    y_m: Pair | None = None
    position_m: Pair | None = None
    heading_deg: float | None = None
    mast_m: float | None = None
    count: int | None = None
    cell_m: float = 0.1

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


@keys_of(simulate)
class _Simulate(Table):
    where = "[simulate]"
    pointing: _Pointing | None = None

    def options(self) -> dict[str, Any]:
        options = super().options()
        if self.pointing is not None:
            options["pointing"] = self.pointing.build()
        return options


@keys_of(compress, window=str | list[str | float])
class _Compress(Table):
    where = "[compress]"


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
        oriented = self.model_fields_set & set(_ORIENTED)
        along_axes = self.model_fields_set & {*_ALONG_AXES, "z_m"}
        with located("[grid]"):
            if oriented and along_axes:
                raise ArgumentError(
                    min(along_axes),
                    f"be left out with `{min(oriented)}`",
                    hint="give `x`, `y` and `z_m` for a horizontal plane, or `origin_m`, "
                    "`row_step_m`, `column_step_m` and `shape` for any",
                )
            for name in _ORIENTED if oriented else _ALONG_AXES:
                if getattr(self, name) is None:
                    or_else = ", or `origin_m`, `row_step_m`, ... of a slanted plane"
                    raise ArgumentError(name, "be given" + ("" if oriented else or_else))
            if self.x is not None and self.y is not None:
                plane = Grid.plane(self.x.build(), self.y.build(), self.z_m)
            else:
                plane = Grid.oriented(*(getattr(self, name) for name in _ORIENTED))
            if self.height_file is None:
                return plane
            return plane.with_height(read_heights(folder / self.height_file, plane.shape))


class SoundSpeedTable(Table):
    """`[sound_speed]`."""

    file: str | None = None
    depth_m: list[float] | None = None
    speed_m_s: list[float] | None = None
    temperature_c: list[float] | None = None
    salinity: list[float] | float | None = None
    surface_z_m: float = 0.0

    def build(self, folder: Path) -> SoundSpeed:
        """Return the profile; a relative `file` begins at `folder`.

        Raises
        ------
        ValueError
            If keys are missing or exclude each other, or the values are not those of a profile.
        """
        given = self.model_fields_set - {"surface_z_m"}
        if given not in _PROFILES:
            ways = "; or ".join(", ".join(sorted(way)) for way in _PROFILES)
            got = ", ".join(sorted(given)) or "none"
            raise ArgumentError("[sound_speed]", f"have the keys {ways}", got)
        with located("[sound_speed]"):
            surface = {"surface_z_m": self.surface_z_m}
            if self.file is not None:
                return read_sound_speed(folder / self.file, **surface)
            assert self.depth_m is not None
            if self.speed_m_s is not None:
                return SoundSpeed(np.array(self.depth_m), np.array(self.speed_m_s), **surface)
            assert self.temperature_c is not None
            assert self.salinity is not None
            return SoundSpeed.from_temperature(
                self.depth_m, self.temperature_c, self.salinity, **surface
            )


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


@keys_of(BeamWindow)
class _Beam(Table):
    def build(self) -> BeamWindow:
        with located("[image.beam]"):
            return BeamWindow(**self.given())


@keys_of(factorize, *PROMISE_KEYS)
@keys_of(ExactImage, *EXACT_KEYS)
@keys_of(Request, *PLAN_KEYS, stages=list[Annotated[list[int], Field(min_length=2, max_length=2)]])
class _Image(Table):
    where = "[image]"
    beam: _Beam | None = None

    def options(self) -> dict[str, Any]:
        options = super().options()
        with located(self.where):
            given = [name for name in (*PLAN_KEYS, *EXACT_KEYS) if name in options]
            if len(given) > 1 and given[0] in PLAN_KEYS:
                got = f"also {', '.join(given[1:])}"
                raise ArgumentError(given[0], "be the only request", got)
            if set(EXACT_KEYS) <= set(given):
                allowed = "be left out with both `taps` and `upsampling`, which determine it"
                raise ArgumentError("accuracy_db", allowed)
        if self.beam is not None:
            options["beam"] = self.beam.build()
        return options


def _checked_patches(name: str, patches: Sequence[int]) -> tuple[int, int]:
    """Return the number of patches along y and x."""
    given = validate.entries(name, patches, "[along y, along x]")
    if len(given) != 2:
        raise ArgumentError(name, "be a list of 2, along y and x", validate.shown(patches))
    rows, columns = (validate.count(f"every entry of {name}", each) for each in given)
    return rows, columns


class MosaicTable(Table):
    """`[mosaic]`."""

    lines: str | None = None
    store: str | None = None
    patches: Annotated[
        list[int] | None,
        Other(
            _checked_patches,
            help="Number of patches along y and x.",
            default="as large as memory allows",
        ),
    ] = None
    memory_mib: Annotated[
        int | None,
        Count(unit="MiB", help="Memory for patches that are formed together.", default="1024"),
    ] = None

    def build(self, folder: Path) -> dict[str, Any]:
        """Return paths and options of the mosaic. Paths are relative to `folder`."""
        with located("[mosaic]"):
            options = self.given()
            for name in ("lines", "store"):
                if name in options:
                    options[name] = folder / validate.path(name, options[name])
            if "lines" in options and not options["lines"].exists():
                hint = f"{options['lines']} does not exist"
                raise ArgumentError("lines", "be a file or folder", hint=hint)
        return options


@keys_of(calibrate_track)
class _Calibrate(Table):
    where = "[process.calibrate]"


@keys_of(micronavigate)
class _Navigate(Table):
    where = "[process.navigate]"


@keys_of(autofocus)
class _Focus(Table):
    where = "[process.focus]"


@keys_of(pair_errors, "known_height_m", "points_m", "known_sd_m", "unknowns")
class _PairErrors(Table):
    where = "[process.pair_errors]"

    def options(self) -> dict[str, Any]:
        options = super().options()
        with located(self.where):
            names = [name for name in ("known_height_m", "points_m") if name in options]
            if len(names) != 1:
                got = " and ".join(f"`{name}`" for name in names) or "neither"
                raise ArgumentError("known_height_m", "be given, or `points_m`, and only one", got)
        return options


@keys_of(heights)
class HeightsTable(Table):
    """`[process.heights]`."""

    patch_m: Annotated[float | None, PATCH] = None
    store: str | None = None

    def build(self, folder: Path) -> dict[str, Any]:
        """Return the options. A relative `store` starts at `folder`."""
        with located("[process.heights]"):
            options = self.given()
            if self.store is not None:
                validate.suffix("store", Path(self.store), ".zarr")
                options["store"] = folder / self.store
        return options


class ProcessTable(Table):
    """`[process]`."""

    lines: str | None = None
    output: str | None = None
    steps: list[str] | None = None
    bank: Annotated[
        int | None,
        Count(
            0,
            help="Receiver bank that `image` and `mosaic` show. Corrections apply to all banks, "
            "and `heights` uses the first two.",
            default="the first one",
        ),
    ] = None
    calibrate: _Calibrate | None = None
    navigate: _Navigate | None = None
    focus: _Focus | None = None
    pair_errors: _PairErrors | None = None
    heights: HeightsTable | None = None

    def build(self, folder: Path) -> dict[str, Any]:
        """Return paths, steps and the options of every step. Paths are relative to `folder`."""
        with located("[process]"):
            options = self.given()
            for name in ("lines", "output"):
                if name in options:
                    options[name] = folder / validate.path(name, options[name])
        for name in _OPTIONAL:
            if (table := getattr(self, name)) is not None:
                options[name] = table.build(folder) if name == "heights" else table.options()
        if self.steps is None and self.pair_errors is not None and self.heights is None:
            allowed = "be given with `search_m` for [process.pair_errors]"
            raise ArgumentError("[process.heights]", allowed)
        with located("[process]"):
            if self.steps is not None:
                options["steps"] = checked_steps(self.steps, options)
        return options


def checked_steps(steps: Sequence[str] | None, options: dict[str, Any]) -> tuple[str, ...]:
    """Return steps in order; by default the usual ones and those that have options.

    Raises
    ------
    TypeError, ValueError
        If a step is unknown, none is given, or one lacks an option that it requires.
    """
    if steps is None:
        chosen = {*_USUAL, *(name for name in _OPTIONAL if name in options)}
    else:
        chosen = set(validate.named("steps", steps, STEP_NAMES))
    if not chosen:
        raise ArgumentError("steps", f"name at least one of {STEP_NAMES}", "none")
    for name, tables in _REQUIRED.items():
        for table, key in tables.items():
            if name in chosen and table not in options:
                allowed = f"not include {name!r} without {key} in [process.{table}]"
                raise ArgumentError("steps", allowed)
    return tuple(name for name in STEP_NAMES if name in chosen)


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
    mosaic: MosaicTable = MosaicTable()
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
        simulate = self.simulate.options()
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
            compress=self.compress.options(),
            image=self.image.options(),
            mosaic=self.mosaic.build(folder),
            process=self.process.build(folder),
            files={key: folder / file for key, file in paths.items() if file},
        )
