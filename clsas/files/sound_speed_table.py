"""Table of scene files that describes how the sound speed varies with depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.validate import ArgumentError
from clsas.files.sound_speed_files import read_sound_speed
from clsas.files.tables import Table, located

_WAYS = ({"file"}, {"depth_m", "speed_m_s"}, {"depth_m", "temperature_c", "salinity"})


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
        if given not in _WAYS:
            ways = "; or ".join(", ".join(sorted(way)) for way in _WAYS)
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
