"""Mosaics of lines in water whose sound speed varies with depth: each patch has its own water."""

from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, lines_over

import clsas
from clsas import Grid, SoundSpeed
from clsas.selftest.reference import ideal

PROFILE = SoundSpeed([0, 12, 15, 60], [1505, 1504, 1494, 1490])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("request_db", "most_db"), [({"accuracy_db": -60}, -58), ({"tolerance_db": -50}, -50)]
)
def test_patches_have_the_water_of_their_range(request_db, most_db, tmp_path):
    grid = Grid.plane((-4, 4, 64), (30, 60, 240), -25.0)
    track = along_x(240, 0.06, z=-6.0)
    lines = lines_over(grid, track, carrier_hz=100e3, step_m=0.02)
    lines = replace(lines, sound_speed=PROFILE)
    clsas.save(tmp_path / "lines.h5", lines)
    made = clsas.mosaic(tmp_path / "lines.h5", grid, patches=(3, 1), **request_db)
    image = made.image()
    some = np.random.default_rng(0).choice(grid.size, 300, replace=False)
    truth = ideal(lines, grid.at(some))
    assert clsas.relative_error_db(image.pixels.ravel()[some], truth) < most_db
