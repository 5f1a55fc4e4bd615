from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, optimize

from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.validate import ClsasWarning
from clsas.measures.quality import measure_point

# Closed forms of the point responses, in units of 1 / bandwidth.
PEDESTALS = {"sinc": 1.0, "Hamming": 0.54}


def response(u, pedestal):
    """Fourier transform of the window pedestal + (1 - pedestal) cos(2 pi f) on |f| < 1/2."""
    sides = np.sinc(u - 1) + np.sinc(u + 1)
    return np.sinc(u) + (1 - pedestal) / (2 * pedestal) * sides


def figures(pedestal):
    """Resolution, nearest and highest side lobe and ISLR of ten lobes, from the closed form."""
    u = np.linspace(0, 20, 200_001)
    power = response(u, pedestal) ** 2
    minima = np.flatnonzero((power[1:-1] < power[:-2]) & (power[1:-1] < power[2:])) + 1
    half = optimize.brentq(lambda v: response(v, pedestal) ** 2 - 0.5, 0, 1)
    first, last = u[minima[0]], u[minima[10]]

    def energy(a, b):
        return integrate.quad(lambda v: response(v, pedestal) ** 2, a, b, limit=500)[0]

    return (
        2 * half,
        10 * np.log10(power[minima[0] : minima[1]].max()),
        10 * np.log10(power[minima[0] :].max()),
        10 * np.log10(energy(first, last) / energy(0, first)),
    )


DX, DY = 0.005, 0.01
X, Y = 1e6 + DX * np.arange(220), -40 + DY * np.arange(260)
GRID = Grid.plane((X[0], X[-1], len(X)), (Y[0], Y[-1], len(Y)))
AT = X[107] + 0.317 * DX, Y[121] - 0.441 * DY


def point(
    oversampling=1.5, pedestal=1.0, carriers=(0.0, 0.0), amplitude=3.0, at=AT, x=X, y=Y, dx=DX
):
    """Pixels of a point with carriers exp(j c x), in radians per metre along x and y."""
    along_x = response((x - at[0]) / (dx * oversampling), pedestal)
    along_y = response((y - at[1]) / (DY * oversampling), pedestal)
    phase = np.exp(1j * carriers[0] * (x - at[0])), np.exp(1j * carriers[1] * (y - at[1]))
    return amplitude * (along_y * phase[1])[:, None] * (along_x * phase[0])


def near(at=AT):
    return at[0] + 3 * DX, at[1] - 2 * DY


def test_closed_forms_are_those_of_the_books():
    resolution, nearest, highest, islr = figures(1.0)
    assert resolution == pytest.approx(0.8859, abs=1e-4)
    assert nearest == highest == pytest.approx(-13.26, abs=5e-3)
    assert islr == pytest.approx(-10.1, abs=0.05)
    resolution, _, highest, _ = figures(0.54)
    assert resolution == pytest.approx(1.303, abs=1e-3)
    assert highest == pytest.approx(-42.68, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("carriers", [(0, 0), (0, 8377.6), (-411.0, 1234.5)])
@pytest.mark.parametrize("oversampling", [1.2, 1.5, 3.0])
@pytest.mark.parametrize("window", PEDESTALS)
def test_measures_the_closed_form(window, oversampling, carriers):
    pedestal = PEDESTALS[window]
    image = Image(point(oversampling, pedestal, carriers), GRID)
    got = measure_point(image, near())
    assert got.x_m == pytest.approx(AT[0], abs=DX / 500, rel=0)
    assert got.y_m == pytest.approx(AT[1], abs=DY / 500, rel=0)
    assert got.amplitude == pytest.approx(3.0, rel=2e-4)
    resolution, nearest, highest, islr = figures(pedestal)
    for cut, step in ((got.azimuth, DX), (got.range, DY)):
        assert cut.resolution_m == pytest.approx(resolution * oversampling * step, rel=5e-4)
        assert cut.pslr_nearest_db == pytest.approx((nearest, nearest), abs=0.03)
        assert cut.pslr_db == pytest.approx((highest, highest), abs=0.03)
        assert cut.islr_db == pytest.approx(islr, abs=0.03)
        assert cut.lobes == (10, 10)


@pytest.mark.slow
@pytest.mark.parametrize("window", PEDESTALS)
@pytest.mark.parametrize("carriers", [(0, 0), (300.0, 8377.6)])
@pytest.mark.parametrize("shift", [-0.5, -0.2, 0.0, 0.1, 0.49])
def test_critical_sampling_is_enough(window, carriers, shift):
    # The tails that the image cuts off count here: with pixels at 1/bandwidth nothing is
    # between the band and its alias.
    at = X[107] + shift * DX, Y[121] + shift * DY
    image = Image(point(1.0, PEDESTALS[window], carriers, at=at), GRID)
    got = measure_point(image, at)
    assert got.x_m == pytest.approx(at[0], abs=DX / 100, rel=0)
    assert got.y_m == pytest.approx(at[1], abs=DY / 100, rel=0)
    resolution, _, highest, _ = figures(PEDESTALS[window])
    for cut, step in ((got.azimuth, DX), (got.range, DY)):
        assert cut.resolution_m == pytest.approx(resolution * step, rel=5e-3)
        assert cut.pslr_db == pytest.approx((highest, highest), abs=0.5)


def test_cuts_are_the_response():
    got = measure_point(Image(point(), GRID), near())
    for cut, step in ((got.azimuth, DX), (got.range, DY)):
        inner = np.abs(cut.offset_m) < 10 * step
        wanted = np.abs(response(cut.offset_m[inner] / (1.5 * step), 1.0))
        np.testing.assert_allclose(10 ** (cut.level_db[inner] / 20), wanted, atol=2e-3)
        assert np.all(np.diff(cut.offset_m) > 0)


def test_noise_moves_the_peak_little():
    # 40 dB below the peak, the noise shifts it by about 1/100 of a pixel and no more.
    rng = np.random.default_rng(4)
    noise = 0.03 / np.sqrt(2) * (rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape))
    got = measure_point(Image(point(carriers=(0, 8377.6)) + noise, GRID), near())
    assert abs(got.x_m - AT[0]) < 0.03 * DX
    assert abs(got.y_m - AT[1]) < 0.03 * DY
    assert got.azimuth.pslr_db == pytest.approx((-13.26, -13.26), abs=1.0)


def test_axes_may_run_backwards():
    backwards = Grid.plane((X[-1], X[0], len(X)), (Y[-1], Y[0], len(Y)))
    ghost = point(at=(AT[0] + 40 * 1.5 * DX, AT[1]), amplitude=1.5)
    forth = measure_point(Image(point() + ghost, GRID), near())
    back = measure_point(Image((point() + ghost)[::-1, ::-1], backwards), near())
    assert back.x_m == pytest.approx(forth.x_m, abs=1e-6, rel=0)
    assert back.azimuth.pslr_db == pytest.approx(forth.azimuth.pslr_db, abs=1e-3)
    assert back.range.resolution_m == pytest.approx(forth.range.resolution_m, rel=1e-6)


def on_plane(row_step_m, column_step_m, origin_m=(3.0, -2.0, 5.0)):
    """The image of the point on a plane of some directions, and where on it the point is."""
    grid = Grid.oriented(
        origin_m, DY * np.array(row_step_m), DX * np.array(column_step_m), GRID.shape
    )
    column, row = (AT[0] - X[0]) / DX, (AT[1] - Y[0]) / DY
    at_m = grid.origin_m + row * grid.row_step_m + column * grid.column_step_m
    return Image(point(), grid), at_m


def test_a_plane_in_depth_is_measured():
    image, at_m = on_plane((0, 0, -1), (1, 0, 0))
    flat = measure_point(Image(point(), GRID), near())
    for place in (at_m[[0, 2]], at_m):
        got = measure_point(image, place)
        assert (got.azimuth.axis, got.range.axis) == ("x", "z")
        np.testing.assert_allclose((got.x_m, got.y_m, got.z_m), at_m, atol=1e-3 * DX)
        assert got.azimuth.resolution_m == pytest.approx(flat.azimuth.resolution_m, rel=1e-6)
        assert got.range.resolution_m == pytest.approx(flat.range.resolution_m, rel=1e-6)
    with pytest.raises(ValueError, match="near must be inside the image, z from"):
        measure_point(image, (at_m[0], 50.0))


def test_a_plane_of_any_direction_is_measured():
    c, s = np.cos(0.5), np.sin(0.5)
    image, at_m = on_plane((-s * 0.8, c * 0.8, -0.6), (c, s, 0), origin_m=(1e6, -1e6, 0))
    got = measure_point(image, at_m)
    assert (got.azimuth.axis, got.range.axis) == ("along columns", "along rows")
    np.testing.assert_allclose((got.x_m, got.y_m, got.z_m), at_m, rtol=0, atol=1e-3 * DX)
    flat = measure_point(Image(point(), GRID), near())
    assert got.range.resolution_m == pytest.approx(flat.range.resolution_m, rel=1e-6)
    by_axes = measure_point(image, ((AT[0] - X[0]), (AT[1] - Y[0])))
    assert by_axes.z_m == pytest.approx(got.z_m)


def test_heights_are_part_of_the_position():
    heights_m = np.full(GRID.shape, 2.5)
    got = measure_point(Image(point(), GRID.with_height(heights_m)), near())
    assert got.z_m == 2.5


def test_a_far_ghost_is_the_highest_but_not_the_nearest_lobe():
    ghost = point(at=(AT[0] + 40 * 1.5 * DX, AT[1]), amplitude=1.5)
    image = Image(point() + ghost, GRID)
    cut = measure_point(image, near()).azimuth
    assert cut.pslr_db[1] == pytest.approx(-6.02, abs=0.1)
    assert cut.pslr_db[0] == pytest.approx(-13.26, abs=0.3)
    assert cut.pslr_nearest_db[1] == pytest.approx(-13.26, abs=0.3)
    kept_out = measure_point(image, near(), extent_m=30 * 1.5 * DX).azimuth
    assert kept_out.pslr_db[1] == pytest.approx(-13.26, abs=0.3)
    assert np.abs(kept_out.offset_m).max() <= 30 * 1.5 * DX


def test_counts_the_lobes_that_fit():
    rows, columns = slice(106, 140), slice(98, 118)
    image = Image(point()[rows, columns], GRID.window(rows, columns))
    got = measure_point(image, near())
    # The point is 9.3 pixels of 2/3 resolution from the left edge: nulls at 1, ..., 6.
    assert got.azimuth.lobes == (5, 5)
    assert got.range.lobes == (8, 10)


def test_takes_the_greatest_pixel_within_the_search():
    other = point(3.0, at=(AT[0] + 7 * DX, AT[1]), amplitude=30.0)
    image = Image(point(3.0) + other, GRID)
    assert measure_point(image, AT).x_m == pytest.approx(AT[0] + 7 * DX, abs=0.1 * DX, rel=0)
    with pytest.raises(ValueError, match="only the flank of one outside the search"):
        measure_point(image, AT, search_m=0.03)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"near": (AT[0], 0.0)}, r"near must be inside the image, y from -40 to .* m, got 0 m"),
        ({"near": (0.0, AT[1])}, r"near must be inside the image, x from .* m, got 0 m"),
        ({"near": (np.nan, AT[1])}, "near must be finite"),
        ({"near": AT[0]}, r"near must have shape \(2\)"),
        ({"pixels": np.zeros(GRID.shape, complex)}, r"near must be where the image is not zero"),
        (
            {"pixels": point(at=(X[0], AT[1])), "near": (X[0], AT[1])},
            "beyond the peak near .* got a peak at its border, x =",
        ),
        (
            {"pixels": point(at=(AT[0], Y[-1])), "near": (AT[0], Y[-1])},
            "beyond the peak near .* got a peak at its border, y =",
        ),
        (
            {"pixels": point(at=(X[2], AT[1])), "near": (X[2], AT[1])},
            "must contain a whole side lobe at smaller",
        ),
        ({"extent_m": 0.011}, "must contain a whole side lobe"),
        ({"extent_m": 1e-9}, r"extent_m must be finite and >= 0\.01 m, got 1e-09"),
        ({"extent_m": 0}, r"extent_m must be finite and >= 0\.01 m, got 0"),
        ({"search_m": -1}, "search_m must be finite and > 0"),
        ({"search_m": 1e308}, r"<= 1e\+09 m, got 1e\+308"),
        ({"search_m": 1e10}, r"search_m must be .* <= 1e\+09 m, got 1e\+10"),
        ({"near": (1e308, AT[1])}, r"near must lie within 1e\+09 m of the origin, got \(1e\+308"),
        ({"near": (-1.7e308,) * 3}, r"near must lie within 1e\+09 m of the origin"),
    ],
)
def test_bad_input_is_named(change, words):
    arguments = {"near": near()} | change
    image = Image(arguments.pop("pixels", point()), GRID)
    with pytest.raises(ValueError, match=words):
        measure_point(image, **arguments)


def test_a_side_lobe_taken_for_the_point_is_reported():
    side_lobe = AT[0] + 1.43 * 3 * DX, AT[1]
    with pytest.warns(ClsasWarning, match=r"is 13\.\d dB lower than a side lobe of it"):
        got = measure_point(Image(point(3.0), GRID), side_lobe, search_m=2 * DX)
    assert got.azimuth.pslr_db[0] == pytest.approx(13.26, abs=0.1)


def test_needs_an_image_with_axes():
    with pytest.raises(TypeError, match="image must be of type Image, got ndarray"):
        measure_point(point(), near())
    points = Grid.points(GRID.positions_m())
    with pytest.raises(ValueError, match="must be a plane or height map to have axes"):
        measure_point(Image(point(), points), near())
    line = GRID.window(slice(0, 1))
    with pytest.raises(ValueError, match="3 or more pixels along y, got 1"):
        measure_point(Image(point()[:1], line), (AT[0], Y[0]))


def speckle(*shape):
    rng = np.random.default_rng(5)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def test_relative_error():
    reference = speckle(30, 40)
    assert relative_error_db(reference * (1 + 1e-3j), reference) == pytest.approx(-60, abs=1e-9)
    assert relative_error_db(0 * reference, reference) == pytest.approx(0)
    assert relative_error_db(reference, reference) == -np.inf
    grid = Grid.plane((0, 1, 40), (0, 1, 30))
    single = Image(reference, grid)
    assert relative_error_db(single, reference) == pytest.approx(-150, abs=10)  # complex64
    assert relative_error_db(single, single) == -np.inf


@pytest.mark.parametrize("scale", [1e-320, 1e-200, 1.0, 1e200, 1e307])
def test_relative_error_does_not_depend_on_scale(scale):
    image, reference = np.array([[2.0, 4.0j]]) * scale, np.array([[1.0, 1.0j]]) * scale
    wanted = 10 * np.log10(5)
    assert relative_error_db(image, reference) == pytest.approx(wanted, abs=1e-2)
    assert relative_error_db([1e-200], [1e200]) == pytest.approx(0)
    assert relative_error_db([1e200], [1e-200]) == pytest.approx(8000)


def test_relative_error_is_of_one_place():
    pixels = speckle(30, 40)
    grid = Grid.plane((1e6, 1e6 + 1, 40), (0, 1, 30))
    image = Image(pixels, grid)
    for same in (
        Grid.points(grid.positions_m()),
        grid.with_height(np.zeros(grid.shape)),
        Grid.plane((1e6 - 1, 1e6 + 1, 79), (0, 1, 30)).window(columns=slice(39, None)),
    ):
        assert relative_error_db(image, Image(pixels, same)) == -np.inf
    for other, apart in (
        (Grid.plane((1e6, 1e6 + 1.5, 40), (0, 1, 30)), "0.5"),
        (Grid.plane((1e6, 1e6 + 1, 40), (1, 0, 30)), "1"),
        (grid.with_height(np.full(grid.shape, 2.0)), "2"),
    ):
        with pytest.raises(
            ValueError, match=f"image and ref.* one grid, got .* by up to {apart} m"
        ):
            relative_error_db(image, Image(pixels, other))


def test_relative_error_is_of_one_place_on_earth():
    plane = Grid.plane((0, 1, 40), (0, 1, 30))
    places = [Georeference.local(60, longitude, heading_deg=0) for longitude in (5, 6)]
    grids = [replace(plane, georeference=place) for place in (None, *places)]
    unknown, one, other = (Image(speckle(30, 40), grid) for grid in grids)
    assert relative_error_db(one, unknown) == -np.inf
    with pytest.raises(ValueError, match="image and reference must lie on one grid, got georef"):
        relative_error_db(one, other)


def test_relative_error_names_bad_input():
    with pytest.raises(
        ValueError, match=r"image must have the shape of `reference`, \(3, 2\), got \(2, 3\)"
    ):
        relative_error_db(speckle(2, 3), speckle(3, 2))
    with pytest.raises(ValueError, match="reference must not be zero"):
        relative_error_db(speckle(2, 3), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="image must have no masked value, got 1 of 2"):
        relative_error_db(np.ma.array([1.0, 2.0], mask=[True, False]), [1.0, 2.0])
    with pytest.raises(ValueError, match="image must be finite"):
        relative_error_db(np.full((2, 3), np.nan), speckle(2, 3))
