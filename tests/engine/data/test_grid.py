import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image

HEIGHT = np.random.default_rng(2).normal(size=(3, 5))
GRIDS = {
    "plane": Grid.plane(x=(-1, 1, 5), y=(40, 41, 3), z=-7),
    "oriented": Grid.oriented([1, 2, 3], [0.1, 0.2, -0.3], [0.3, -0.1, 0.2], (3, 5)),
    "height map": Grid.plane(x=(-1, 1, 5), y=(40, 41, 3)).with_height(HEIGHT),
    "points": Grid.points(np.random.default_rng(3).normal(size=(3, 5, 3))),
}
EVERY_GRID = pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())


def test_plane_is_linspace():
    grid = GRIDS["plane"]
    assert grid.shape == (3, 5)
    assert grid.size == 15
    assert grid.is_planar
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(40, 41, 3))
    np.testing.assert_allclose(grid.positions_m(), np.stack([x, y, x * 0 - 7], -1), rtol=1e-15)


def test_plane_may_run_backwards_or_have_one_pixel():
    grid = Grid.plane(x=(1, -1, 3), y=(5, 5, 1))
    x, y = grid.axes_m
    np.testing.assert_array_equal(x, [1, 0, -1])
    np.testing.assert_array_equal(y, [5])


def test_oriented_follows_its_steps():
    grid = GRIDS["oriented"]
    np.testing.assert_allclose(
        grid.positions_m()[2, 4],
        np.array([1, 2, 3]) + 2 * np.array([0.1, 0.2, -0.3]) + 4 * np.array([0.3, -0.1, 0.2]),
        rtol=1e-15,
    )
    assert grid.is_planar


def test_heights_add_to_z():
    grid = GRIDS["height map"]
    np.testing.assert_array_equal(grid.positions_m()[..., 2], HEIGHT)
    assert not grid.is_planar
    raised = GRIDS["plane"].with_height(HEIGHT)
    np.testing.assert_array_equal(raised.positions_m()[..., 2], -7 + HEIGHT)
    np.testing.assert_array_equal(raised.positions_m()[..., :2], grid.positions_m()[..., :2])


@pytest.mark.parametrize("shape", [(7, 3), (2, 3, 4, 3)])
def test_points_are_kept(shape):
    points = np.random.default_rng(0).normal(size=shape)
    grid = Grid.points(points)
    assert grid.shape == shape[:-1]
    assert not grid.is_planar
    np.testing.assert_array_equal(grid.positions_m(), points)
    np.testing.assert_array_equal(grid.positions_m(slice(1, 2)), points[1:2])


def test_axes_exist_only_along_x_and_y():
    x, y = GRIDS["height map"].axes_m
    np.testing.assert_allclose(x, np.linspace(-1, 1, 5))
    np.testing.assert_allclose(y, np.linspace(40, 41, 3))
    assert GRIDS["plane"].has_axes
    swapped = Grid.oriented([0, 0, 0], [1, 0, 0], [0, 1, 0], (2, 2))
    for grid in (GRIDS["oriented"], GRIDS["points"], swapped):
        assert not grid.has_axes
        with pytest.raises(ValueError, match="grid must have columns along x and rows along y"):
            _ = grid.axes_m


SLICES = pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(None), slice(None)),
        (slice(1, 3), slice(2, 5)),
        (slice(-1, None), slice(0, 1)),
        (slice(None, None, 2), slice(4, None, -2)),
    ],
)


@EVERY_GRID
@SLICES
def test_positions_of_a_part_are_those_of_the_whole(grid, rows, columns):
    np.testing.assert_array_equal(
        grid.positions_m(rows, columns), grid.positions_m()[rows, columns]
    )


@EVERY_GRID
@SLICES
def test_window_lies_where_its_pixels_were(grid, rows, columns):
    window = grid.window(rows, columns)
    wanted = grid.positions_m()[rows, columns]
    assert window.shape == wanted.shape[:-1]
    np.testing.assert_allclose(window.positions_m(), wanted, rtol=1e-15, atol=1e-15)
    if grid.is_planar:
        np.testing.assert_array_equal(window.positions_m()[0, 0], wanted[0, 0])


@EVERY_GRID
def test_window_takes_slices_only(grid):
    with pytest.raises(TypeError, match="rows must be of type slice, got int"):
        grid.window(3)
    with pytest.raises(TypeError, match="columns must be of type slice, got list"):
        grid.window(slice(0, 1), [0])


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e8])
def test_steps_are_parallel_by_their_angle(scale):
    shape = (2, 2)
    row, column = scale * np.array([1.0, 0, 0]), scale * np.array([1.0, 1e-9, 0])
    assert Grid.oriented(ZERO, row, column, shape).shape == shape
    for other in (scale * np.array([1.0, 1e-20, 0]), -1e-30 * row, 0.1 * row):
        with pytest.raises(ValueError, match="must not be parallel"):
            Grid.oriented(ZERO, row, other, shape)


@EVERY_GRID
def test_window_must_hold_a_pixel(grid):
    with pytest.raises(ValueError, match=r"must select a pixel|no empty axis"):
        grid.window(slice(3, 3), slice(None))


def test_points_of_one_axis_have_no_columns():
    grid = Grid.points(np.zeros((4, 3)))
    with pytest.raises(ValueError, match="columns must be left out"):
        grid.positions_m(slice(0, 1), slice(0, 1))


@given(
    origin=st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    step=st.floats(1e-3, 1.0),
    row=st.integers(0, 4000),
    column=st.integers(0, 4000),
)
def test_utm_sized_coordinates_lose_nothing(origin, step, row, column):
    # Exact arithmetic in units of 2^-60 m; float64 near 1e7 m has a spacing of 1.9e-9 m.
    grid = Grid.oriented(origin, [0, step, 0], [step, 0, 0], (4001, 4001))
    part = slice(row, row + 1), slice(column, column + 1)
    for got in (grid.positions_m(*part)[0, 0], grid.window(*part).positions_m()[0, 0]):
        for axis, index in enumerate((column, row)):
            exact = int(origin[axis] * 2**60) + index * int(step * 2**60)
            assert abs(int(got[axis] * 2**60) - exact) <= 2e-9 * 2**60


def test_utm_sized_plane_keeps_its_step():
    grid = Grid.plane(x=(9_999_999.0, 10_000_001.0, 1001), y=(1e6, 1e6 + 1, 11))
    x, _ = grid.axes_m
    assert grid.positions_m().dtype == np.float64
    np.testing.assert_allclose(np.diff(x), 0.002, atol=4e-9)
    assert x[-1] == 10_000_001.0


def test_arrays_are_read_only():
    for grid in GRIDS.values():
        for name in ("origin_m", "row_step_m", "column_step_m", "height_m", "points_m"):
            value = getattr(grid, name)
            assert value is None or not value.flags.writeable
        grid.positions_m()[...] = 0  # results may be changed by the caller


ZERO, ONE, TWO = [0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: Grid.plane(x=(0, 1), y=(0, 1, 2)), TypeError, r"x must be \(start m, stop m, co"),
        (lambda: Grid.plane(x=(0, 1, 2), y=3), TypeError, r"y must be \(start m"),
        (lambda: Grid.plane(x=(0, 1, 0), y=(0, 1, 2)), ValueError, "x count must be at least 1"),
        (lambda: Grid.plane(x=(0, 1, 2.5), y=(0, 1, 2)), TypeError, "x count must be a whole"),
        (lambda: Grid.plane(x=(0, np.nan, 2), y=(0, 1, 2)), ValueError, "x stop must be fin"),
        (lambda: Grid.plane(x=(0, 1, 2), y=(3, 3, 2)), ValueError, "y must start and stop at d"),
        (
            lambda: Grid.plane(x=(0, 1, 2), y=(3, 4, 1)),
            ValueError,
            "y must start and stop at one position for 1 pixel, got 3.0 m to 4.0 m",
        ),
        (lambda: Grid.plane((0, 1, 2), (0, 1, 2), z=np.inf), ValueError, "z must be fin"),
        (lambda: Grid.oriented(ZERO, ONE, TWO, (2, 2)), ValueError, "must not be parallel"),
        (lambda: Grid.oriented(ZERO, ZERO, ONE, (2, 2)), ValueError, "row_step_m must not be zero"),
        (lambda: Grid.oriented(ZERO, ONE, ZERO, (2, 2)), ValueError, "column_step_m must not be z"),
        (lambda: Grid.oriented([0, 0], ONE, TWO, (2, 2)), ValueError, r"origin_m.*shape \(3\)"),
        (lambda: Grid.oriented(ZERO, ONE, TWO, (2, 0)), ValueError, "shape must be at least 1"),
        (lambda: Grid.oriented(ZERO, ONE, TWO, (2.0, 2)), TypeError, "shape must be whole numbers"),
        (lambda: Grid.oriented(ZERO, ONE, TWO, 4), TypeError, "shape must be whole numbers"),
        (lambda: Grid.oriented(ZERO, ONE, TWO, (2, 2, 2)), ValueError, r"\(rows, columns\)"),
        (lambda: GRIDS["plane"].with_height(HEIGHT.T), ValueError, r"height_m.*shape \(3, 5\)"),
        (lambda: GRIDS["plane"].with_height(HEIGHT * np.nan), ValueError, "height_m must be fin"),
        (
            lambda: GRIDS["height map"].with_height(HEIGHT),
            ValueError,
            "a plane without heights, got a grid with heights",
        ),
        (
            lambda: GRIDS["points"].with_height(HEIGHT),
            ValueError,
            "a plane without heights, got points",
        ),
        (lambda: Grid.points([1.0, 2, 3]), ValueError, r"points_m must have shape \(any, 3\)"),
        (lambda: Grid.points(np.zeros((0, 3))), ValueError, "no empty axis"),
        (lambda: Grid.points(np.zeros((5, 2))), ValueError, r"shape \(any, 3\)"),
        (lambda: Grid.points(np.full((5, 3), np.nan)), ValueError, "points_m must be finite"),
        (lambda: Grid.points(np.ma.masked_equal([ZERO], 0)), ValueError, "points_m must have no m"),
        (lambda: Grid.points(np.zeros((5, 3), complex)), TypeError, "points_m must be real"),
        (lambda: Grid(ZERO, None, None, (1,), points_m=[ZERO]), ValueError, "must stand alone"),
        (lambda: Grid.points([TWO, [0, 0, -2e9]]), ValueError, "within 1e[+]09 m.*one at 2e[+]09"),
        (lambda: Grid.plane((-1e300, 1e300, 2), (0, 1, 2)), ValueError, "x start must be fin"),
        (lambda: Grid.oriented(ZERO, ONE, [0, 9e307, 0], (2, 4)), ValueError, "one at inf m"),
        (
            lambda: GRIDS["plane"].with_height(HEIGHT + 1e10),
            ValueError,
            "must put all pixels within 1e.09 m",
        ),
    ],
)
def test_bad_input_is_named(make, error, words):
    with pytest.raises(error, match=words):
        make()


@EVERY_GRID
def test_image_has_the_shape_of_its_grid(grid):
    image = Image(np.ones(grid.shape) + 0j, grid)
    assert image.pixels.dtype == np.complex64
    assert not image.pixels.flags.writeable
    with pytest.raises(ValueError, match=r"pixels must have shape \(3, 5\)"):
        Image(np.ones((5, 3), complex), grid)


def test_image_names_bad_input():
    grid = GRIDS["plane"]
    with pytest.raises(TypeError, match="pixels must be complex"):
        Image(np.ones(grid.shape), grid)
    with pytest.raises(ValueError, match="pixels must be finite, got 15"):
        Image(np.full(grid.shape, np.nan + 0j), grid)
    with pytest.raises(TypeError, match="grid must be of type Grid, got tuple"):
        Image(np.ones(grid.shape, complex), (3, 5))


def test_some_pixels_reach_every_edge():
    grid = Grid.plane((0, 4, 100), (10, 12, 3), z=-1.0)
    found = grid.spread(5)
    assert found.shape == (15, 3)
    for axis, ends in enumerate(((0, 4), (10, 12))):
        assert (found[:, axis].min(), found[:, axis].max()) == ends
    assert (found[:, 2] == -1).all()
