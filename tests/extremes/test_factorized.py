"""Factorized images at the extremes: far from the origin, far away, on small devices."""

import dataclasses

import numpy as np
import pytest
from cases import along_x
from factorizing import EXACT_IS_SLOW, around, exact, made, over, planned, swaying

from clsas.engine.data.image_error import relative_error_db
from clsas.engine.imaging import backproject, factorize, plan

FAR = np.array([1e7, -1e7, 1e7])


def at_300_m():
    """1 MHz at 300 m: 2.5 million radians of phase."""
    return over(around(0, 300, pixel_m=(0.004, 0.03)), along_x(600, 0.01), carrier_hz=1e6, band=0.1)


def large_image():
    """Roots whose phases turn thousands of times."""
    grid = around(0, 30, pixel_m=(0.02, 0.02), shape=(500, 500))
    return over(grid, along_x(300, 0.02), carrier_hz=1e6, band=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("case", [at_300_m, large_image], ids=lambda case: case.__name__)
def test_rounding_is_part_of_what_is_predicted(case, platform):
    lines, grid = case()
    chosen = plan(lines, grid, tolerance_db=-65, costs=EXACT_IS_SLOW)
    reference = backproject(lines, grid, accuracy_db=-85)
    error_db = relative_error_db(factorize(lines, grid, chosen, device=platform), reference)
    assert error_db <= chosen.predicted_error_db


@pytest.fixture
def small(platform):
    """A platform with memory for some lines and a few roots only."""
    memory_bytes = 64 << 20
    info = dataclasses.replace(
        platform.info, memory_bytes=memory_bytes, max_buffer_bytes=memory_bytes // 4
    )
    return dataclasses.replace(platform, info=info)


@pytest.mark.slow
def test_a_small_device_is_enough(small, buffer_bytes):
    lines, grid = made(swaying)
    chosen = plan(lines, grid, tolerance_db=-40, device=small, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    image = factorize(lines, grid, chosen, device=small)
    assert max(buffer_bytes) <= small.info.max_buffer_bytes
    assert relative_error_db(image, exact(swaying)) <= -40


def test_a_device_too_small_is_named(small):
    info = dataclasses.replace(small.info, memory_bytes=4 << 20, max_buffer_bytes=1 << 20)
    tiny = dataclasses.replace(small, info=info)
    with pytest.raises(ValueError, match=r"MiB"):
        factorize(*made(swaying), planned(swaying, -40), device=tiny)
