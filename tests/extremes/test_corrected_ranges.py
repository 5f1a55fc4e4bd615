"""Ranges of groups of pixels that are corrected along rays, on every kind of device."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import along_x, lines_over
from factorizing import EXACT_IS_SLOW

import clsas
from clsas import Grid, SoundSpeed
from clsas.engine.signal.interpolation import Readout
from clsas.engine.water.ray_delays import delays_s
from clsas.engine.water.refraction import homogeneous
from clsas.selftest import oracle

THERMOCLINE = SoundSpeed([0, 14, 17, 60], [1505, 1505, 1495, 1495.5])


@cache
def corrected_scene():
    """Noise over steep relief below a thermocline, and the sum along exact rays."""
    plane = Grid.plane((-0.5, 0.5, 40), (57.5, 60.5, 48), -22)
    x, y = plane.axes_m
    grid = plane.with_height(np.sin(0.6 * y)[:, None] + 0.3 * np.cos(2 * x))
    lines = lines_over(grid, along_x(80, 0.1, z=-10), carrier_hz=100e3, step_m=0.02, occupied=0.6)
    lines = replace(lines, sound_speed=THERMOCLINE)
    channel, points = np.repeat(np.arange(80), grid.size), grid.positions_m().reshape(-1, 3)
    ranges = delays_s(lines, channel, np.tile(points, (80, 1))).reshape(80, -1) * 1500.0 / 2
    read = Readout.of(lines, -85).read(np.arange(80), ranges)
    ideal = np.sum(read * np.exp(4j * np.pi * 100e3 / 1500.0 * ranges), axis=0)
    return lines, grid, ideal.reshape(grid.shape)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exact", "factorized", "normalised"])
def test_corrections_on_every_device(device, method):
    lines, grid, ideal = corrected_scene()
    assert homogeneous(lines, grid, None, -60).corrections is not None
    if method == "exact":
        image = clsas.backproject(lines, grid, accuracy_db=-60, device=device)
        assert oracle.error_db(image.pixels, ideal) < -60
        return
    beam = clsas.BeamWindow(30, "hann", normalise=True) if method == "normalised" else None
    given = {"beam": beam, "device": device}
    plan = clsas.plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW, **given)
    assert not plan.is_exact
    image = clsas.factorize(lines, grid, plan, device=device)
    exact = clsas.backproject(lines, grid, accuracy_db=-60, **given)
    assert clsas.relative_error_db(image, exact) < -50
