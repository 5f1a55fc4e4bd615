from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, lines_over

from clsas import BeamWindow, Grid, SoundSpeed
from clsas.engine.water.apparent_beam import ApparentBeam
from clsas.engine.water.refraction import homogeneous

GRID = Grid.plane((-2, 2, 33), (58, 63, 41), -25.0)
PROFILE = SoundSpeed([0, 60], [1500, 1440])


def water_of(beam, tx_m, allowed_db=-28):
    lines = lines_over(GRID, tx_m, None, carrier_hz=100e3, step_m=0.02)
    return homogeneous(replace(lines, sound_speed=PROFILE), GRID, beam, allowed_db)


@pytest.mark.parametrize("shape", ["rectangular", "hann", "hamming", "taylor", "tukey", "inverse"])
def test_weights_are_those_at_larger_sines(shape):
    beam = BeamWindow(20, shape, 2.0, element_length_m=0.03)
    water = water_of(beam, along_x(150, 0.2, z=-6.0))
    found = water.beam
    assert found.ratio == pytest.approx(1494 / water.change.sound_speed_m_s, abs=2e-3)
    sine = np.linspace(-0.13, 0.19, 50)
    given, apparent = 1494.0 / 100e3, water.change.sound_speed_m_s / 100e3
    np.testing.assert_allclose(
        found.weights(sine / found.ratio, apparent), beam.weights(sine, given), rtol=1e-12
    )
    ends = np.array(found.limits) * found.ratio
    np.testing.assert_allclose(ends, beam.limits, rtol=1e-12)
    assert not found.weights(1.001 * np.array(found.limits), apparent).any()


def test_a_beam_of_all_directions_stays_one():
    found = water_of(BeamWindow(180), along_x(150, 0.2, z=-6.0)).beam
    assert found.limits[1] == pytest.approx(1 / found.ratio)  # no ray arrives beyond
    lines = lines_over(GRID, along_x(150, 0.2, z=-6.0), None, carrier_hz=100e3, step_m=0.02)
    beam = BeamWindow(20)
    assert homogeneous(lines, GRID, beam, -50).beam is beam


@pytest.mark.parametrize("squint_deg", [87, -87])
def test_a_beam_that_no_ray_reaches_is_empty(squint_deg):
    found = ApparentBeam(2, squint_deg=squint_deg, ratio=0.98)
    sine = np.linspace(-1, 1, 101)
    assert not found.weights(sine, 0.015).any()
    assert found.limits_rad[0] == found.limits_rad[1]


@pytest.mark.parametrize("heave_m", [0.0, 0.2, 0.8])
def test_the_error_is_that_of_independent_rays(heave_m):
    """Rays in a linear gradient are arcs: chord and curvature give the angle at the sonar."""
    beam, track = BeamWindow(10, "hann"), along_x(150, 0.2, z=-6.0)
    track = track + np.outer(np.sin(np.arange(150) / 40), [0, 0, heave_m])
    lines = lines_over(GRID, track, None, carrier_hz=100e3, step_m=0.02)
    lines = replace(lines, sound_speed=PROFILE)
    water, bound = homogeneous(lines, GRID, beam, -30), homogeneous(lines, GRID, None, -30)
    random = np.random.default_rng(5)
    channel, pixel = random.integers(150, size=20000), random.integers(GRID.size, size=20000)
    offset_m = GRID.at(pixel) - track[channel]
    distance_m, fall_m = np.hypot(offset_m[:, 0], offset_m[:, 1]), offset_m[:, 2]
    radius_m = 1500.0 + track[channel, 2]  # centre of all arcs: the height where c = z + 1500 is 0
    # From the distances of both ends to the centre, which lies a metre per m/s below.
    centre_m = (distance_m**2 + (radius_m + fall_m) ** 2 - radius_m**2) / (2 * distance_m)
    level = radius_m / np.hypot(radius_m, centre_m)
    towards = np.column_stack([offset_m[:, :2] / distance_m[:, None] * level[:, None],
                               np.sign(fall_m) * np.sqrt(1 - level**2)])  # fmt: skip
    along = beam.directions(lines)[channel]
    wanted = beam.weights(np.einsum("ni,ni->n", towards, along))
    straight = water.lines(lines.without_samples())
    apparent = GRID.at(pixel) - straight.phase_centres_m[channel]
    apparent /= np.linalg.norm(apparent, axis=1, keepdims=True)
    found = water.beam.weights(np.einsum("ni,ni->n", apparent, water.beam.along[channel]))
    error = np.sum((found - wanted) ** 2) / np.sum(wanted**2)
    assert error < 2 * (water.error - bound.error) < 1e-4
