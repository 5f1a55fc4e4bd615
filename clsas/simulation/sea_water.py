"""Properties of sea water that need its equation of state, TEOS-10."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.extras import needed


def teos10_speed_m_s(
    depth_m: NDArray[np.float64],
    temperature_c: NDArray[np.float64],
    salinity: NDArray[np.float64],
    longitude_deg: float,
    latitude_deg: float,
) -> NDArray[np.float64]:
    """Return the sound speed of sea water; `SoundSpeed.from_teos10` describes the arguments."""
    with needed("SoundSpeed.from_teos10"):
        import gsw
    pressure_dbar = gsw.p_from_z(-depth_m, latitude_deg)
    absolute = gsw.SA_from_SP(salinity, pressure_dbar, longitude_deg, latitude_deg)
    return gsw.sound_speed_t_exact(absolute, temperature_c, pressure_dbar)
