"""Orientation of rasters."""

import itertools

import numpy as np
import pytest

from clsas.maps.georeferencing import Orientation

TURNS = list(itertools.product((1, -1), (1, -1), (False, True)))


@pytest.mark.parametrize(("right", "down", "swapped"), TURNS)
def test_pixels_of_any_order_become_a_map(right, down, swapped):
    """Each pixel keeps its place, and windows of the image the places of their pixels."""
    shape = (5, 7)
    a, b, d, e = (0.5 * right, 0.0, 0.0, 0.3 * down)
    if swapped:
        a, b, d, e = 0.0, 0.5 * right, 0.3 * down, 0.0
    affine = (a, b, 100.0, d, e, 200.0)
    found = Orientation.of(shape, affine)
    p, q, r, s, t, u = found.affine
    assert (q, s) == (0, 0)
    assert p > 0
    assert t < 0
    assert found.is_north_up
    row, column = np.indices(shape) + 0.5
    east, north = a * column + b * row + 100, d * column + e * row + 200
    new_row, new_column = np.indices(found.shape) + 0.5
    np.testing.assert_allclose(found.turned(east), p * new_column + r)
    np.testing.assert_allclose(found.turned(north), t * new_row + u)
    part = slice(1, 4), slice(2, 7)
    np.testing.assert_array_equal(found.turned(east[part]), found.turned(east)[found.window(*part)])


@pytest.mark.parametrize("degrees", range(0, 360, 15))
@pytest.mark.parametrize("mirrored", [False, True])
def test_rasters_are_turned_by_at_most_45_degrees_and_never_mirrored(degrees, mirrored):
    turn = np.radians(degrees + 1e-3)
    a, d = np.cos(turn), np.sin(turn)
    b, e = (-d, a) if mirrored else (d, -a)
    a, b, _, d, e, _ = Orientation.of((3, 4), (a, b, 0.0, d, e, 0.0)).affine
    assert a * e - b * d == pytest.approx(-1)
    assert a >= np.cos(np.radians(45.01))
