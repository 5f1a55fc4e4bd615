"""Travel times between antennas and many pixels, from tables where these pay."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.water.ray_tables import RayTable
from clsas.engine.water.rays import rays

_TABULATED = 1 << 14  # rays from one height for which a table pays: it takes as long as they do


@dataclass(frozen=True, eq=False)
class RayTimes:
    """Travel times along rays between heights of antennas and heights of pixels.

    Attributes
    ----------
    profile : SoundSpeed
    distances_m, heights_m : (float, float)
        Least and largest horizontal distance, and height of a pixel.
    expected : float
        Number of rays that will be asked for.
    """

    profile: SoundSpeed
    distances_m: tuple[float, float]
    heights_m: tuple[float, float]
    expected: float
    _tables: dict[float, RayTable | None] = field(default_factory=dict, repr=False)

    def between(
        self,
        distance_m: NDArray[np.float64],
        antenna_z_m: NDArray[np.float64] | float,
        z_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the times of rays, seconds, [n]; infinite where there is no direct ray."""
        heights_m, kinds = np.unique(antenna_z_m, return_inverse=True)
        if self.expected < _TABULATED * len(heights_m):
            return rays(self.profile, distance_m, antenna_z_m, z_m).time_s
        if len(heights_m) == 1:
            return self._from_height(float(heights_m[0]), distance_m, z_m)
        time_s = np.empty(len(z_m))
        for kind, height_m in enumerate(heights_m):
            here = kinds.reshape(-1) == kind
            time_s[here] = self._from_height(float(height_m), distance_m[here], z_m[here])
        return time_s

    def _from_height(
        self, antenna_z_m: float, distance_m: NDArray[np.float64], z_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        if antenna_z_m not in self._tables:
            limits = self.distances_m, self.heights_m
            self._tables[antenna_z_m] = RayTable.of(self.profile, antenna_z_m, *limits)
        table = self._tables[antenna_z_m]
        if table is None:  # because of a shadow zone
            return rays(self.profile, distance_m, antenna_z_m, z_m).time_s
        return table.times(distance_m, z_m)
