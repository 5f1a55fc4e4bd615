"""Directions of vectors and of tracks."""

import numpy as np

from clsas.engine.data.geometry import course, unit_vectors


def test_a_vector_without_direction_stays_short():
    found = unit_vectors(np.array([[3.0, 0, 4], [0, 0, 0], [0, 1e-12, 0], [0, 0, -1e-8]]))
    np.testing.assert_allclose(found, [[0.6, 0, 0.8], [0, 0, 0], [0, 1e-3, 0], [0, 0, -1]])


def test_the_course_is_that_of_the_longest_extent():
    along = np.array([0.6, 0.8, 0.0])
    positions_m = 5e6 + np.linspace(-20, 20, 41)[:, None] * along + [[0, 0, 0.1]] * 41
    assert abs(course(positions_m) @ along) > 1 - 1e-12
