"""Tables of scene files that describe the sonar and its track."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from clsas.engine.data import validate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.system import Pulse, Sonar, line_array, stacked
from clsas.engine.data.track import Motion, Track
from clsas.engine.data.validate import ArgumentError
from clsas.files.tables import Table, Vector, located
from clsas.files.track_files import read_track

PRESETS = ("thesis_wide_beam", "edgetech", "sensotek", "hisas_1030")


class PulseTable(Table):
    """`[sonar.pulse]`."""

    carrier_hz: float
    duration_s: float
    bandwidth_hz: float | None = None
    code: str | list[int] = "up"
    taper: float = 0.0

    def build(self) -> Pulse:
        """Return the pulse; raise ValueError if a value is outside its limits."""
        if self.bandwidth_hz is not None:
            code = self.code if isinstance(self.code, str) else tuple(self.code)
            return Pulse(self.carrier_hz, self.bandwidth_hz, self.duration_s, code, self.taper)
        if isinstance(self.code, str):
            raise ArgumentError("bandwidth_hz", "be given", hint="only a phase code determines it")
        return Pulse.phase_code(
            self.carrier_hz, self.duration_s, tuple(self.code), taper=self.taper
        )


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
    sound_speed_m_s: float = 1500.0
    tx_length_m: float | None = None
    rx_length_m: float | None = None
    tx_height_m: float | None = None
    rx_height_m: float | None = None
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
        skipped = {"preset", "pulse", "receivers", "spacing_m", "rx_m"}
        skipped |= {"bank_heights_m", "bank_numbers"}
        with located("[sonar]"):
            options = self.model_dump(exclude=skipped) | {"bank_numbers": banks}
            return Sonar(pulse, rx_m, **options)

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
