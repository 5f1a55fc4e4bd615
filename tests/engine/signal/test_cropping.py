"""Samples that no pixel needs are left out before lines are upsampled."""

import dataclasses

import numpy as np
import pytest
from cases import along_x, beside, noise
from exactly import execute, prepare

from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.grid import Grid, bounding_box
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines, reached_m
from clsas.selftest.reference import ideal

GRID = Grid.plane((2.0, 3.2, 25), (30.0, 31.0, 21))
TRACK = along_x(60, 0.3)
LENGTH, STEP_M = 1500, 0.02


def lines_of(oversampling, *, rx=TRACK, centre=0.0, **fields):
    samples = noise(len(TRACK), LENGTH, occupied=1 / oversampling, centre=centre)
    return RangeLines(samples, 20.0, STEP_M, TRACK, rx, 60e3, 1500.0, **fields)


SCENES = {
    "thin guard band": lambda: lines_of(1.08),
    "wide guard band": lambda: lines_of(2.0, centre=0.2),
    "moving": lambda: lines_of(1.3, rx=beside(TRACK, 1.0, 0.2, 0), rx_velocity_m_s=[20.0, 5.0, 0]),
    "starts": lambda: dataclasses.replace(
        lines_of(1.3), first_range_m=np.random.default_rng(1).uniform(15, 25, len(TRACK))
    ),
}


@pytest.mark.parametrize("accuracy_db", [-40.0, -60.0, -80.0])
@pytest.mark.parametrize("name", SCENES)
def test_images_are_as_accurate_as_before(name, accuracy_db):
    lines = SCENES[name]()
    prepared = prepare(lines, GRID, accuracy_db=accuracy_db)
    assert prepared.crop.length < LENGTH / 2
    exact = ideal(lines, GRID.positions_m())
    assert relative_error_db(execute(prepared).pixels, exact) < accuracy_db


def test_what_is_left_out_may_be_anything():
    """Echoes 60 dB louder, from elsewhere, would otherwise ring into the image."""
    lines = lines_of(1.25)
    loud = np.array(lines.samples)
    loud[:, -200:] *= 1000
    crop = prepare(lines, GRID).crop
    for each in (lines, dataclasses.replace(lines, samples=loud)):
        np.testing.assert_array_equal(crop.of(each).samples, crop.of(lines).samples)


def test_lines_up_to_their_ends_do_not_fade():
    """The grid lies at the first samples of all lines."""
    lines = lines_of(1.25)
    lines = dataclasses.replace(lines, first_range_m=29.0)
    crop = prepare(lines, Grid.plane((0, 1, 20), (29, 30, 20))).crop
    nearest = np.argmin(np.abs(TRACK[:, 0] - 0.5))
    assert crop.first[nearest] == 0
    cropped = crop.of(lines)
    np.testing.assert_array_equal(cropped.samples[nearest, :9], lines.samples[nearest, :9])
    assert cropped.first_range_m[nearest] == 29.0


def test_a_grid_that_needs_nearly_all_samples_keeps_them():
    lines = lines_of(1.25)
    crop = prepare(lines, Grid.plane((-1, 1, 20), (20.5, 49, 200))).crop
    np.testing.assert_array_equal(crop.of(lines).samples, lines.samples)


@pytest.mark.parametrize("velocity", [None, [40.0, -20.0, 10.0]])
@pytest.mark.parametrize("kind", ["plane", "skewed", "relief", "points"])
def test_no_pixel_lies_beyond_the_ranges_of_the_box(kind, velocity):
    rng = np.random.default_rng(3)
    grid = {
        "plane": Grid.plane((-3, 4, 30), (10, 30, 20), 1.0),
        "skewed": Grid.oriented([1, 5, 0], [0.1, 0.3, 0.2], [0.4, 0.1, 0], (30, 20)),
        "relief": Grid.plane((-3, 4, 30), (10, 30, 20)).with_height(rng.normal(size=(20, 30))),
        "points": Grid.points(rng.uniform(-5, 9, (7, 8, 3))),
    }[kind]
    antennas_m = rng.uniform(-20, 40, (2, 50, 3)) * [1, 1, 0.3]
    lines = RangeLines(np.ones((50, 9), complex), 0.0, 0.01, *antennas_m, 1e5, 1500.0, velocity)
    near_m, far_m = reached_m(lines, *bounding_box(grid))
    fields = (None if velocity is None else lines.rx_velocity_m_s[:, None, None], 1500.0)
    range_m = bistatic_range_m(grid.positions_m(), *antennas_m[:, :, None, None], *fields)
    assert (range_m >= near_m[:, None, None]).all()
    assert (range_m <= far_m[:, None, None]).all()


def test_ranges_of_a_rectangle_are_those_of_its_farthest_corner():
    grid, lines = Grid.oriented([1, 5, 0], [0, 0.3, 0.2], [0.4, 0, 0], (30, 20)), lines_of(1.25)
    _, far_m = reached_m(lines, *bounding_box(grid))
    range_m = bistatic_range_m(grid.positions_m(), *[TRACK[:, None, None]] * 2)
    np.testing.assert_allclose(far_m - range_m.max(axis=(1, 2)), 8 * STEP_M, atol=1e-9)
