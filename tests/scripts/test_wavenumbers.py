import pytest
from studies import wavenumbers

import clsas


@pytest.mark.watches("scripts/studies")
def test_wavenumber_images_are_exact_on_a_straight_track_only():
    straight = wavenumbers.Scene(pixels=64)
    swaying = wavenumbers.Scene(sway_m=0.2, altitude_m=15.0, near_m=20.0, pixels=64)
    beam = clsas.BeamWindow(8, "hann", along=[1, 0, 0])
    cells = [wavenumbers.compared(scene, beam, None) for scene in (straight, swaying)]
    errors_db = [float(each[0]) for each in cells]
    assert errors_db[0] < -40 < -10 < errors_db[1]
    assert all(len(each) + 1 == len(wavenumbers.COLUMNS) for each in cells)
