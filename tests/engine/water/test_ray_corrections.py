from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, lines_over

from clsas import BeamWindow, Grid, RangeLines, SoundSpeed
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.water.ray_corrections import Corrections, _interpolating
from clsas.engine.water.ray_delays import delays_s
from clsas.engine.water.refraction import homogeneous

THERMOCLINE = SoundSpeed([0, 14, 17, 80], [1505, 1505, 1495, 1495.5])
HZ = 300e3


def relief(extent_m=10.0, count=80, z=-22.0):
    grid = Grid.plane((-5, 5, count), (50, 50 + extent_m, count), z)
    x, y = grid.axes_m
    return grid.with_height(np.sin(0.6 * (y - 50))[:, None] + 0.5 * np.cos(0.5 * x))


def over(grid, tx_m, rx_m=None, velocity=None):
    lines = lines_over(grid, tx_m, rx_m, carrier_hz=HZ, step_m=0.02, velocity=velocity)
    return replace(lines, sound_speed=THERMOCLINE)


def heaving():
    tx_m = along_x(61, 0.16, z=-10.0)
    turn = np.linspace(0, 8, len(tx_m))
    return tx_m + np.stack([0 * turn, 0.2 * np.sin(turn), 0.3 * np.cos(turn)], axis=1)


def array():
    tx_m = np.repeat(along_x(12, 0.6, z=-10.0), 8, axis=0)
    return tx_m, tx_m + np.tile(along_x(8, 0.2) + [0.9, 0, 0.1], (12, 1))


def sheet():
    """A planar array, as of a stationary sonar."""
    x, z = np.meshgrid(np.linspace(-2, 2, 16), np.linspace(-11, -9, 8))
    return np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)


SCENES = {
    "track": lambda: over(relief(), along_x(61, 0.16, z=-10.0)),
    "heave": lambda: over(relief(), heaving()),
    "array": lambda: over(relief(), *array()),
    "moving": lambda: over(relief(), *array(), velocity=[1.8, 0.0, 0.1]),
    "sheet": lambda: over(relief(), sheet()),
}


def phase_errors(lines, grid, water, pixel, channel):
    """Phases of apparent delays less those along exact rays, radians, without corrections."""
    straight = water.change.antennas(lines, slice(None))
    velocity = straight.rx_velocity_m_s
    velocity = None if velocity is None else velocity[channel]
    antennas = straight.tx_m[channel], straight.rx_m[channel], velocity
    range_m = bistatic_range_m(water.grid.at(pixel), *antennas, straight.sound_speed_m_s)

    def error(correction_m):
        total_m = range_m + correction_m
        total_m += water.change.offsets_m(channel, total_m[:, None])[:, 0]
        delay = delays_s(lines, channel, grid.at(pixel))
        return 2 * np.pi * HZ * (2 * total_m / straight.sound_speed_m_s - delay)

    return error


@pytest.mark.parametrize("name", SCENES)
def test_corrections_lead_to_delays_along_exact_rays(name):
    """At pixels and channels between those that are computed."""
    lines, grid = SCENES[name](), relief()
    water = homogeneous(lines, grid, None, None)
    random = np.random.default_rng(2)
    pixel, channel = random.integers(grid.size, size=400), random.integers(lines.channels, size=400)
    error = phase_errors(lines, grid, water, pixel, channel)
    found = water.corrections.at(pixel)
    weights = water.corrections.weights(water.corrections.antennas[channel])
    alone, corrected = error(0.0), error(np.einsum("nk,nk->n", found, weights))
    assert np.std(alone) > 1e-3
    assert np.std(corrected) < 0.03 * np.std(alone)


@pytest.mark.parametrize("beam", [None, BeamWindow(6, "hann", along=[1, 0, 0])])
def test_a_beam_leaves_out_nodes_that_see_nothing(beam):
    """Beyond it there may be no rays. Visible channels have the same corrections."""
    lines, grid = over(relief(), along_x(400, 0.1, z=-10.0)), relief()
    water = homogeneous(lines, grid, beam, None)
    corrections = water.corrections
    pixels = np.arange(0, grid.size, 97)
    near = np.abs(lines.tx_m[:, 0] - grid.at(pixels)[:, :1]) < 2.5
    found = corrections.at(pixels) @ corrections.weights(corrections.antennas).T
    assert np.isfinite(found).all()
    pixel, channel = np.nonzero(near)
    error = phase_errors(lines, grid, water, pixels[pixel], channel)
    assert np.std(error(found[near])) < 2e-3


@pytest.mark.slow
def test_the_error_is_that_of_groups_of_pixels():
    """Twice the distance to the pixel with the correction has twice the error."""
    errors = []
    for count in (80, 160, 320):
        grid = relief(count=count)
        errors.append(homogeneous(over(grid, heaving()), grid, None, None).error)
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_what_hardly_matters_is_not_corrected():
    lines, grid = SCENES["track"](), relief()
    alone = homogeneous(lines, grid, None, None, corrected=False)
    assert alone.corrections is None
    allowed_db = 10 * np.log10(alone.error)
    assert homogeneous(lines, grid, None, allowed_db + 7).corrections is None
    assert homogeneous(lines, grid, None, allowed_db + 5).corrections is not None


@pytest.mark.parametrize("across", [0.0, 0.01, 0.4])
def test_interpolation_is_exact_for_cubics_along_nodes(across):
    """Wherever nodes lie, a constant stays what it is."""
    random = np.random.default_rng(4)
    along = np.sort(random.uniform(-3, 3, (50, 12)), axis=1)
    direction = np.array([0.6, 0.0, 0.0, 0.8, 0.0, 0.0])
    nodes = along[..., None] * direction
    nodes += across * random.uniform(-1, 1, nodes.shape)
    wanted = random.uniform(along[:, 0], along[:, -1])
    weights = _interpolating(nodes, wanted[:, None] * direction)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-12
    if not across:
        cubic = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.2])
        found = np.einsum("nk,nk->n", weights, cubic(along))
        assert np.abs(found - cubic(wanted)).max() < 1e-9


def test_nodes_in_one_place_have_equal_weights():
    nodes = np.zeros((1, 12, 6))
    weights = _interpolating(nodes, np.zeros((1, 6)))
    assert np.allclose(weights, 1 / 12)


def test_lines_of_the_nodes_have_no_samples():
    """They are kept for as long as an imager."""
    lines, grid = SCENES["track"](), relief()
    corrections = homogeneous(lines, grid, None, None).corrections
    assert isinstance(corrections, Corrections)
    assert isinstance(corrections.lines, RangeLines)
    assert corrections.lines.samples.size < lines.samples.size
