"""North-up rasters by interpolation."""

import numpy as np
import pytest

from clsas.maps.bands import Band
from clsas.maps.resampling import Resampling, north_up

SHAPE = 60, 80


@pytest.mark.parametrize("pixel_m", [0.2, 0.26, 0.7])
@pytest.mark.parametrize("side", [7, 16])
def test_windows_have_no_seams(side, pixel_m):
    values = np.random.default_rng(1).normal(size=SHAPE)
    band = Band("Height", "m", lambda rows, columns: values[rows, columns])
    turn = np.radians(33)
    affine = (
        *(0.25 * np.cos(turn), 0.2 * np.sin(turn), 300.0),
        *(0.25 * np.sin(turn), -0.2 * np.cos(turn), 500.0),
    )
    shape, onto = north_up(SHAPE, affine, pixel_m)
    resampling = Resampling(SHAPE, affine, onto)
    whole = resampling.at(slice(0, shape[0]), slice(0, shape[1]), band, band.read)
    assert np.isfinite(whole).mean() > 0.3
    pieces = np.full(shape, -1.0)
    for top in range(0, shape[0], side):
        for left in range(0, shape[1], side):
            window = (
                slice(top, min(top + side, shape[0])),
                slice(left, min(left + side, shape[1])),
            )
            pieces[window] = resampling.at(*window, band, band.read)
    np.testing.assert_allclose(pieces, whole, atol=1e-6)
