import numpy as np
import pytest

from clsas.aperture.nearest import operations, stage_errors_m

SPACING_M, SIDE_M, NEAREST_M = 8.25e-3, 5.0, 40.0  # THESIS chapter 5


def range_error_m(r, t, a, b):
    """Error of a beam that stands for a sector, at a point [40].

    The point is at r from the middle of a subaperture of half length t, and at an angle b from the
    beam, whose angle with the subaperture is a.
    """
    square = r * r + t * t
    return np.sqrt(square - 2 * r * t * np.cos(a + b)) - np.sqrt(square - 2 * r * t * np.cos(a))


def largest_by_angle(half_length_m, range_m, away_rad):
    """Largest error [40] over beam directions, and over points up to an angle from the beam."""
    angle = np.linspace(0, np.pi, 721)[:, None]
    away = np.linspace(-away_rad, away_rad, 41)
    return np.abs(range_error_m(range_m, half_length_m, angle, away)).max()


def test_operations_of_the_worked_example():
    counts = operations([(2, 2), (2, 2)], 640, (3757, 1990), 1024**2)
    assert counts == [9_617_920, 10_188_800, 167_772_160]
    assert sum(counts) == 187_578_880
    assert operations([], 640, (), 1024**2) == [671_088_640]


def test_operations_of_lines_that_do_not_divide():
    # Sums of 3 of 10 lines are 4; each line of a stage costs gamma in addition.
    assert operations([(3, 2), (2, 1)], 10, (100, 50), 1000, gamma=5) == [
        10 * (4 * 100 + 5),
        4 * (4 * 50 + 5),
        2 * 1000,
    ]


def test_stage_errors_far_away():
    # 2 x 8.25 mm x 2.5 m / (4 x 40 m), in every stage of QR = QI.
    assert stage_errors_m([(2, 2)] * 3, SPACING_M, SIDE_M, NEAREST_M) == pytest.approx(
        [2.578125e-4] * 3, rel=1e-12
    )
    # Thesis 5.2.1: QI = 4, QR = 2 is lambda/11.6, not lambda/30.3.
    (error_m,) = stage_errors_m([(2, 4)], SPACING_M, SIDE_M, NEAREST_M)
    assert 1.5e-3 / error_m == pytest.approx(11.636, abs=1e-3)


def test_stage_errors_near_the_aperture():
    # Subapertures of 2, 4 and 8 m, subimages of 8, 4 and 2 m, and Rmin = 4 m.
    assert stage_errors_m([(2, 2)] * 3, 1.0, 16.0, 4.0) == [1.0, 1.0, 1.0]
    assert stage_errors_m([(2, 2)] * 3, 1.0, 16.0, 3.999) == [
        16 / (4 * 3.999),
        4 / 2,
        2 / 2,
    ]


def test_range_error_against_the_points_themselves():
    # The subaperture ends at (t, 0). Two points are at range r, at angles a and a + b.
    random = np.random.default_rng(1)
    r, t = random.uniform(1, 50, 200), random.uniform(0, 50, 200)
    a, b = random.uniform(0, np.pi, 200), random.uniform(-1, 1, 200)
    end = np.stack([t, 0 * t])
    points = [r * np.stack([np.cos(angle), np.sin(angle)]) for angle in (a, a + b)]
    at_beam, away = (np.linalg.norm(point - end, axis=0) for point in points)
    np.testing.assert_allclose(range_error_m(r, t, a, b), away - at_beam, atol=1e-12)


@pytest.mark.parametrize("length_m", [0.0165, 5.28, 20.0, 39.9])
@pytest.mark.parametrize("side_m", [0.1, 2.5, 20.0])
def test_the_formula_bounds_the_sector(length_m, side_m):
    """[40] <= [45] at every range, over the sector that a subimage's side spans across the beam."""
    (bound_m,) = stage_errors_m([(1, 1)], length_m, side_m, NEAREST_M)
    errors = [
        largest_by_angle(length_m / 2, range_m, side_m / 2 / range_m)
        for range_m in (NEAREST_M, 1.3 * NEAREST_M, 5 * NEAREST_M)
    ]
    assert max(errors) <= bound_m * (1 + 1e-9)
    assert errors[0] >= 0.98 * bound_m


@pytest.mark.parametrize("length_m", [40.1, 100.0, 1000.0])
def test_the_formula_bounds_long_subapertures(length_m):
    (bound_m,) = stage_errors_m([(1, 1)], length_m, 10.0, NEAREST_M)
    largest_m = largest_by_angle(length_m / 2, NEAREST_M, 5 / NEAREST_M)
    assert bound_m == 5
    assert largest_m <= bound_m
    # Tight only where half the subaperture is as long as the range: the branch changes too early.
    assert (largest_m >= 0.98 * bound_m) == (length_m >= 2 * NEAREST_M)


@pytest.mark.parametrize("squint_deg", [0, 7, 15, 22.5, 45, 70])
def test_the_formula_does_not_bound_oblique_squares(squint_deg):
    """A corner is (cos + sin) of the squint farther across the beam; the aperture shrinks by cos.

    At 22.5 degrees that is (1 + sqrt 2)/2, 21 % more than [45] says.
    """
    (bound_m,) = stage_errors_m([(1, 1)], 0.05, 0.1, NEAREST_M)
    squint = np.radians(squint_deg)
    centre = NEAREST_M * np.array([np.sin(squint), np.cos(squint)])
    point = centre + np.array([0.05, -0.05])
    angle, beam = np.arctan2(*point[::-1]), np.arctan2(*centre[::-1])
    error_m = abs(range_error_m(np.linalg.norm(point), 0.025, beam, angle - beam))
    ratio = np.cos(squint) * (np.cos(squint) + np.sin(squint))
    assert error_m / bound_m == pytest.approx(ratio, rel=0.005)
    assert ratio <= (1 + np.sqrt(2)) / 2 + 1e-12
