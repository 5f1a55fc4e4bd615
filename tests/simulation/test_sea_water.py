import numpy as np
import pytest

from clsas import SoundSpeed

gsw = pytest.importorskip("gsw")


@pytest.mark.parametrize("salinity", [30, 35, 38])
def test_teos_10_and_mackenzie_agree_in_the_ocean(salinity):
    depth = np.array([0.0, 50, 500, 3000])
    temperature = np.array([22.0, 15, 8, 3])
    place = {"longitude_deg": -30.0, "latitude_deg": 40.0}
    found = SoundSpeed.from_teos10(depth, temperature, salinity, **place)
    pressure = gsw.p_from_z(-depth, 40.0)
    absolute = gsw.SA_from_SP(salinity, pressure, -30.0, 40.0)
    potential = gsw.CT_from_t(absolute, temperature, pressure)
    # The polynomial for general use is fitted to the exact formula within 0.2 m/s.
    fitted = gsw.sound_speed(absolute, potential, pressure)
    assert np.abs(found.speed_m_s - fitted).max() < 0.2
    other = SoundSpeed.from_temperature(depth, temperature, salinity)
    assert np.abs(found.speed_m_s - other.speed_m_s).max() < 0.4
