"""Data larger than a device: everything goes in blocks."""

import dataclasses

import numpy as np
import pytest
from cases import APERTURE, CARRIER, STEP, along_x, noise, patch, thesis_lines

from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.imaging import backproject
from clsas.selftest.reference import ideal


@pytest.fixture
def small(platform):
    """A platform with memory for a few thousand pixels only."""

    def limited(memory_bytes):
        info = dataclasses.replace(
            platform.info, memory_bytes=memory_bytes, max_buffer_bytes=memory_bytes // 4
        )
        return dataclasses.replace(platform, info=info)

    return limited


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plane", "points"])
def test_an_image_in_bands_is_the_same_bit_for_bit(platform, small, kind):
    grid = patch(1.3, 42, 50, 45)
    lines = thesis_lines(grid, APERTURE[::16])
    if kind == "points":
        grid = Grid.points(grid.positions_m())
    fixed = {"taps": 6, "upsampling": 3}
    once, often = [], []
    whole = backproject(lines, grid, device=platform, progress=lambda *n: once.append(n), **fixed)
    banded = backproject(
        lines, grid, device=small(65536), progress=lambda *n: often.append(n), **fixed
    )
    assert len(often) >= 3 * len(once)
    np.testing.assert_array_equal(banded.pixels, whole.pixels)


@pytest.mark.slow
def test_one_channel_over_many_points_stays_within_the_device(small, buffer_bytes):
    grid = Grid.points(patch(-1, 42, 400, 400).positions_m())
    track = along_x(1, 1.0)
    lines = RangeLines(noise(1, 1000), 40.0, STEP, track, track, CARRIER, 1500.0)
    backproject(lines, grid, device=small(1 << 20), taps=4, upsampling=3)
    assert max(buffer_bytes) <= 1 << 18


@pytest.mark.slow
def test_long_lines_stay_within_the_device(small, buffer_bytes):
    """Lines of 4000 samples: 512 of them do not fit at once."""
    grid = patch(1.3, 42, 5, 5)
    track = along_x(520, 0.01)
    lines = RangeLines(noise(520, 4000), 36.0, STEP, track, track, CARRIER, 1500.0)
    image = backproject(lines, grid, device=small(1 << 23), taps=6, upsampling=3)
    assert max(buffer_bytes) <= 1 << 21
    assert relative_error_db(image, ideal(lines, grid.positions_m())) <= -80
