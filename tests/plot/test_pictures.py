"""Formats, scales, colours, mosaics and volumes in pictures, and labels that do not overlap."""

import base64
import io
import re
import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest
from cases import along_x, lines_over
from tiers import also

import clsas
from clsas import plot
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.measures.tradeoff import Row, Tradeoff
from clsas.plot.canvas import colour_map

matplotlib = pytest.importorskip("matplotlib")

GRID = Grid.plane(x=(-1, 1, 101), y=(40, 42, 81))


def speckle(grid):
    return Image(np.random.default_rng(0).normal(size=(*grid.shape, 2)) @ [1, 1j], grid)


SPECKLE = speckle(GRID)
LINES = lines_over(GRID, along_x(32, 0.05), carrier_hz=1e5, step_m=0.01)


def level_of(figure):
    return figure.axes[0].get_images()[0]


def texts(figure):
    """Return every text that a figure shows, with its box."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    shown = []
    hidden = set()
    for axes in figure.axes:
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            low, high = sorted(limits)
            for tick in axis.get_major_ticks() + axis.get_minor_ticks():
                if not low <= tick.get_loc() <= high:
                    hidden |= {tick.label1, tick.label2}
    for text in figure.findobj(lambda artist: isinstance(artist, Text)):
        if text.get_visible() and text.get_text() and text not in hidden:
            shown.append((text.get_text(), Text.get_window_extent(text, renderer)))
    return shown


def check_labels(figure):
    """Check that no texts overlap."""
    found = texts(figure)
    assert len(found) > 3
    for (one, a), (other, b) in combinations(found, 2):
        wide = min(a.x1, b.x1) - max(a.x0, b.x0)
        high = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert wide <= 0.5 or high <= 0.5, f"{one!r} lies over {other!r}"


GRIDS = {
    "square": GRID,
    "utm": Grid.plane(x=(6e5 - 0.3, 6e5 + 0.3, 61), y=(7e6, 7e6 + 0.6, 61)),
    "strip": Grid.plane(x=(6e5, 6e5 + 60, 301), y=(7e6, 7e6 + 4, 21)),
    "tall": Grid.plane(x=(7e6, 7e6 + 4, 21), y=(6e5, 6e5 + 60, 301)),
    "line": Grid.plane(x=(0, 1, 50), y=(40, 40, 1)),
    "depth": Grid.oriented([0.1, 0, -0.02], [0, 0, -1e-4], [1e-4, 0, 0], (150, 200)),
    "oriented": Grid.oriented([0, 40, 0], [-3, 3, 0], [4, 4, 1], (30, 50)),
}


@pytest.mark.slow
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_labels_of_images_do_not_overlap(grid):
    check_labels(plot.image_db(speckle(grid), title="An image of speckle"))


@pytest.mark.exhaustive
def test_labels_of_resized_figures_do_not_overlap():
    figure = plot.image_db(speckle(GRIDS["utm"]))
    for inches in ((3, 3), (4, 2), (12, 9)):
        figure.set_size_inches(inches)
        check_labels(figure)


def test_labels_of_curves_and_geometry_do_not_overlap():
    x, y = GRID.axes_m
    pixels = np.sinc((x - 0.1) / 0.05) * np.sinc((y - 41) / 0.08)[:, None] + 0j
    check_labels(plot.cuts(clsas.measure_point(Image(pixels, GRID), (0.1, 41))))
    check_labels(plot.geometry(LINES, GRID))
    check_labels(plot.range_lines(LINES, title="Lines"))


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0.1, *also(1.0, 0.0)])
def test_labels_of_a_tradeoff_do_not_overlap(apart):
    rows = [
        Row(f"{label} {k}", method, "", 0.0, 0.1 * 2 ** (apart * k), 0.1, -30 - 8 * apart * k, -25)
        for method, label in (("tolerance", "-50 dB"), ("stages", "2 of 2x2"))
        for k in range(7)
    ]
    rows.append(Row("exact", "exact", "", 0.0, 3.0, 2.0, -90, -90))
    measured = Tradeoff("A device", "1", 640, (1024, 1024), 3, tuple(rows))
    check_labels(plot.tradeoff(measured, title="A case"))


@pytest.mark.slow
def test_the_suffix_decides_the_format(tmp_path):
    figure = plot.image_db(SPECKLE)
    for name, start in (
        ("a.png", b"\x89PNG"),
        ("a", b"\x89PNG"),
        ("a.pdf", b"%PDF"),
        ("a.SVG", b"<?xml"),
    ):
        plot.save(figure, tmp_path / name, dpi=50)
        assert (tmp_path / name).read_bytes().startswith(start)
    assert b"Along-track" in (tmp_path / "a.SVG").read_bytes()
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert b"/Type3" not in pdf  # publishers refuse these fonts


@pytest.mark.exhaustive
def test_the_same_picture_is_the_same_file(tmp_path):
    for suffix in ("png", "pdf", "svg"):
        files = [tmp_path / f"{k}.{suffix}" for k in range(2)]
        for file in files:
            plot.save(plot.image_db(SPECKLE), file, dpi=50)
        assert files[0].read_bytes() == files[1].read_bytes()


def test_colours_span_percentiles():
    pixels = SPECKLE.pixels.copy()
    pixels[:20] = 0  # these do not count
    image = Image(pixels, GRID)
    drawn = level_of(plot.image_db(image, percentiles=(5, 95)))
    level = image.db()[20:]
    np.testing.assert_allclose(drawn.get_clim(), np.percentile(level, (5, 95)), atol=1e-3)
    assert drawn.get_array().min() == drawn.get_clim()[0]
    equal = Image(np.ones(GRID.shape, complex), GRID)
    assert level_of(plot.image_db(equal, percentiles=(1, 99))).get_clim() == (-1, 0)
    nothing = Image(np.zeros(GRID.shape, complex), GRID)
    assert level_of(plot.image_db(nothing, percentiles=(1, 99))).get_clim() == (-60, 0)


@pytest.mark.parametrize("scale", np.linspace(0.1, 3, 30))
def test_the_scale_is_pointed_where_levels_lie_beyond_it(scale):
    def pointed(**options):
        return level_of(plot.image_db(image, **options)).colorbar.extend

    image = Image((scale * SPECKLE.pixels).astype(np.complex64), GRID)
    assert pointed(dynamic_range_db=20) == "min"  # whatever the largest level is rounded to
    if scale == 0.1:
        assert pointed(dynamic_range_db=200) == "neither"
        assert pointed(percentiles=(1, 99)) == "both"
        assert pointed(reference=0.1, dynamic_range_db=200) == "max"


def lightness_and_colour(colours):
    """Return sRGB colours in CIELAB."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    matrix = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = linear @ np.transpose(matrix) / [0.9505, 1, 1.089]
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=-1
    )


def test_the_sonar_colours_are_even():
    def unevenness(name):
        steps = np.diff(
            lightness_and_colour(colour_map(name)(np.linspace(0, 1, 33))[:, :3]), axis=0
        )
        assert (steps[:, 0] > 0).all()
        distance = np.linalg.norm(steps, axis=1)
        return distance.max() / distance.min()

    assert unevenness("sonar") < 1.6 < unevenness("copper")


def test_colour_maps_by_name_or_themselves():
    assert level_of(plot.image_db(SPECKLE, colour_map="sonar")).get_cmap().name == "sonar"
    assert level_of(plot.image_db(SPECKLE, colour_map="gray")).get_cmap().name == "gray"
    own = matplotlib.colors.ListedColormap(["black", "white"], name="own")
    assert level_of(plot.image_db(SPECKLE, colour_map=own)).get_cmap().name == "own"
    with pytest.raises(ValueError, match=r"colour_map must be 'sonar' or one of matplotlib's.*got"):
        plot.image_db(SPECKLE, colour_map="sonnar")
    with pytest.raises(TypeError, match="colour_map must be a name or a `Colormap`, got 3"):
        plot.image_db(SPECKLE, colour_map=3)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (
            {"percentiles": (1, 99), "dynamic_range_db": 40},
            ValueError,
            "percentiles must be left out if",
        ),
        ({"percentiles": 99}, ValueError, "percentiles must have shape"),
        ({"percentiles": (99, 1)}, ValueError, "percentiles must be two ascending numbers"),
        ({"percentiles": (-1, 50)}, ValueError, "percentiles must be .* from 0 to 100"),
        ({"percentiles": (1, 101)}, ValueError, "percentiles must be .* got .1, 101"),
        ({"axes": 3}, TypeError, "axes must be of type Axes, got int"),
    ],
)
def test_bad_arguments_are_named(options, error, words):
    with pytest.raises(error, match=words):
        plot.image(SPECKLE, **options)


def test_an_image_is_drawn_into_axes_of_ones_own():
    figure = matplotlib.figure.Figure()
    left, right = figure.subplots(1, 2)
    assert SPECKLE.plot(left, dynamic_range_db=30, title="left") is left
    SPECKLE.plot(axes=right, colour_bar=False)
    assert len(figure.axes) == 3
    assert left.get_images()[0].get_clim() == (-30, 0)
    assert (left.get_title(), right.get_xlabel()) == ("left", "Along-track (m)")
    np.testing.assert_allclose(right.get_images()[0].get_extent(), [-1.01, 1.01, 39.9875, 42.0125])
    assert right.get_aspect() == 1


def test_an_image_alone_is_drawn_into_a_figure_of_pyplot():
    from matplotlib import pyplot

    axes = SPECKLE.plot()
    try:
        assert axes.figure.number in pyplot.get_fignums()
        check_labels(axes.figure)
    finally:
        pyplot.close(axes.figure)


def test_notebooks_show_a_small_picture():
    from PIL import Image as Picture

    page = SPECKLE._repr_html_()
    assert "x -1 to 1 m, y 40 to 42 m" in page
    assert len(page) < 150_000
    (encoded,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    width, height = Picture.open(io.BytesIO(base64.b64decode(encoded))).size
    assert 250 < width < 600
    assert 250 < height < 600


def test_notebooks_show_every_decibel_in_a_colour_of_its_own():
    """Also levels of few pixels, in an image of which most is at the floor."""
    from PIL import Image as Picture

    grid = Grid.plane(x=(0, 3, 301), y=(40, 42, 201))
    level_db = np.full(grid.shape, -60.0)
    level_db[100:, :] = -(np.arange(301) // 5)  # stripes of 1 dB
    page = Image(10 ** (level_db / 20) + 0j, grid)._repr_html_()
    (encoded,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    pixels = np.asarray(Picture.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"))
    expected = 255 * colour_map("inferno")(np.linspace(0, 1, 256))[:, :3]
    row = pixels[len(pixels) // 4]  # in the upper half, across the stripes
    shown = [int(np.abs(expected - each).sum(axis=1).argmin()) for each in row]
    is_image = np.abs(expected[shown] - row).max(axis=1) <= 4
    found_db = {round(60 * at / 255) for at, ok in zip(shown, is_image, strict=True) if ok}
    assert set(range(1, 61)) <= found_db
    colours = {tuple(each) for each, ok in zip(row, is_image, strict=True) if ok}
    assert len(colours) >= 60
    assert len(page) < 150_000


def test_notebooks_mix_no_colours_where_pixels_share_a_dot():
    """A mixture of black and yellow is on no colour map, and would be shown as grey."""
    from PIL import Image as Picture

    grid = Grid.plane(x=(0, 3, 600), y=(40, 43, 600))
    levels = np.where(np.arange(600) % 2, 1.0, 1e-3)
    page = Image(levels[:, None] * speckle(grid).pixels, grid)._repr_html_()
    (encoded,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    pixels = np.asarray(Picture.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"))
    inner = pixels[100:200, 100:200].reshape(-1, 3)
    expected = 255 * colour_map("inferno")(np.linspace(0, 1, 256))[:, :3]
    assert np.abs(expected - inner[:, None]).max(axis=2).min(axis=1).max() <= 4


def test_notebooks_show_text_without_matplotlib_and_of_points(monkeypatch):
    points = Image(np.ones(4, complex), Grid.points(np.ones((4, 3))))
    assert points._repr_html_() == "<pre>Image(4 complex pixels, x 1 m, y 1 m, z 1 m)</pre>"
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert SPECKLE._repr_html_().startswith("<pre>Image(81 x 101 complex pixels")


def test_missing_matplotlib_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for draw in (SPECKLE.plot, lambda: plot.volume(VOLUME)):
        with pytest.raises(ImportError, match=r"pip install 'matplotlib>=3\.10'"):
            draw()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    pytest.importorskip("zarr")
    path = tmp_path_factory.mktemp("mosaic") / "image.zarr"
    list(clsas.mosaic(LINES, GRID, path, patches=(2, 3)))
    return path


def test_borders_of_patches_on_request(store):
    assert not plot.mosaic(store).axes[0].get_lines()
    figure = plot.mosaic(clsas.Store.opened(store), borders=True, colour_map="gray")
    lines = [np.ravel(line.get_xydata()) for line in figure.axes[0].get_lines()]
    # Patches of 41 x 34 pixels of 2.5 cm and 2 cm; borders lie half a pixel before their first.
    np.testing.assert_allclose([lines[0][0], lines[1][0]], [-1 + 33.5 * 0.02, -1 + 67.5 * 0.02])
    np.testing.assert_allclose(lines[2][1], 40 + 40.5 * 0.025)
    assert len(lines) == 3
    assert level_of(figure).get_cmap().name == "gray"


def test_the_picture_of_a_mosaic_is_its_overview(store):
    figure = plot.mosaic(store, most=50)
    level = clsas.Store.opened(store).overview(50).db()
    np.testing.assert_allclose(level_of(figure).get_array(), np.maximum(level, -60), atol=1e-4)
    with pytest.raises(TypeError, match="borders must be of type bool"):
        plot.mosaic(store, borders="all")
    with pytest.raises(FileNotFoundError):
        plot.mosaic(store / "nothing")


X, Y, Z = np.linspace(-1, 1, 21), np.linspace(40, 43, 31), np.linspace(-2, -1, 11)
BRIGHT = (5, 20, 12)  # z, y, x


def box(order="zyx", turned=""):
    """Return a volume with a bright and a dimmer pixel, its axes in some order and direction."""
    sides = {"x": X, "y": Y, "z": Z}
    sides = {name: side[::-1] if name in turned else side for name, side in sides.items()}
    places = np.meshgrid(*(sides[name] for name in order), indexing="ij")
    grid = Grid.points(np.stack([places[order.index(name)] for name in "xyz"], axis=-1))
    at = np.linalg.norm(grid.points_m - [X[12], Y[20], Z[5]], axis=-1)
    dim = np.linalg.norm(grid.points_m - [X[3], Y[4], Z[9]], axis=-1)
    return Image(np.where(at < 1e-9, 1, np.where(dim < 1e-9, 0.1, 0.01)) + 0j, grid)


VOLUME = box()


@pytest.mark.parametrize(("order", "turned"), [("zyx", ""), ("xyz", "z"), ("yxz", "xy")])
def test_projections_of_a_volume_hold_its_maxima(order, turned):
    figure = plot.volume(box(order, turned), title="A volume")
    above, beside, front, _ = figure.axes
    for axes, places, (row, column), labels in (
        (above, (X, Y), (20, 12), ("", "Across-track (m)")),
        (beside, (Z, Y), (20, 5), ("Height (m)", "")),
        (front, (X, Z), (5, 12), ("Along-track (m)", "Height (m)")),
    ):
        (drawn,) = axes.get_images()
        level = drawn.get_array()
        assert level.shape == tuple(len(side) for side in reversed(places))
        assert level[row, column] == pytest.approx(0, abs=1e-5)
        assert np.sort(level.ravel())[-2] == pytest.approx(-20, abs=1e-4)
        left, right, bottom, _ = drawn.get_extent()
        step = [side[1] - side[0] for side in places]
        np.testing.assert_allclose(left + (column + 0.5) * step[0], places[0][column])
        np.testing.assert_allclose(bottom + (row + 0.5) * step[1], places[1][row])
        assert right - left == pytest.approx(step[0] * len(places[0]))
        assert (axes.get_xlabel(), axes.get_ylabel()) == labels
        assert axes.get_aspect() == 1
    check_labels(figure)


def test_views_of_a_volume_have_one_scale_and_are_aligned():
    figure = plot.volume(VOLUME)
    figure.draw_without_rendering()
    above, beside, front = (axes.get_window_extent() for axes in figure.axes[:3])
    np.testing.assert_allclose([above.x0, above.x1], [front.x0, front.x1], atol=0.5)
    np.testing.assert_allclose([above.y0, above.y1], [beside.y0, beside.y1], atol=0.5)


@pytest.mark.parametrize("options", [{"dynamic_range_db": 90}, {"percentiles": (0, 100)}])
def test_views_of_a_volume_show_levels_below_60_db(options):
    volume = Image(np.where(VOLUME.pixels == 0.01, 1e-4, VOLUME.pixels), VOLUME.grid)
    for axes in plot.volume(volume, **options).axes[:3]:
        (drawn,) = axes.get_images()
        assert drawn.get_array().min() == pytest.approx(-80, abs=1e-3)
        assert drawn.get_clim()[0] <= -80


def test_slices_of_a_volume_go_through_a_point():
    figure = plot.volume(VOLUME, kind="slices", at=(X[3], Y[4], Z[9] + 0.04), colour_map="sonar")
    above, beside, front, _ = figure.axes
    for axes, row, column in ((above, 4, 3), (beside, 4, 9), (front, 9, 3)):
        level = axes.get_images()[0].get_array()
        assert level[row, column] == pytest.approx(-20, abs=1e-4)
        assert level.max() == level[row, column]
        assert len(axes.get_lines()) == 2
    assert above.get_title() == "z = -1.1 m"
    assert level_of(plot.volume(VOLUME, kind="slices")).get_array().max() == pytest.approx(0)
    check_labels(figure)


@pytest.mark.parametrize("flat", [np.s_[3:4], np.s_[:, 7:8], np.s_[:, :, 2:3]])
def test_a_volume_of_one_plane_is_drawn(flat):
    image = Image(VOLUME.pixels[flat], Grid.points(VOLUME.grid.points_m[flat]))
    check_labels(plot.volume(image))


def test_a_volume_is_a_regular_box():
    for image in (
        SPECKLE,
        Image(np.ones(4, complex), Grid.points(np.ones((4, 3)))),
        Image(
            VOLUME.pixels, Grid.points(VOLUME.grid.points_m @ [[1, 0.01, 0], [0, 1, 0], [0, 0, 1]])
        ),
        Image(VOLUME.pixels, Grid.points(VOLUME.grid.points_m**2)),
    ):
        with pytest.raises(ValueError, match=r"image must be on points .* that form a regular box"):
            plot.volume(image)
    with pytest.raises(ValueError, match="kind must be one of 'maximum', 'slices', got 'mean'"):
        plot.volume(VOLUME, kind="mean")
    with pytest.raises(ValueError, match="at must be left out with `kind='maximum'`"):
        plot.volume(VOLUME, at=(0, 41, -1.5))
    with pytest.raises(ValueError, match="at must lie in the volume, y from 40 to 43 m, got 50 m"):
        plot.volume(VOLUME, kind="slices", at=(0, 50, -1.5))


def test_pictures_of_extreme_amplitudes(tmp_path):
    for scale in (1e-37, 1.0, 3e37):
        image = Image((scale * SPECKLE.pixels / 3).astype(np.complex64), GRID)
        np.testing.assert_allclose(image.db(), SPECKLE.db(), atol=1e-3)
        np.testing.assert_allclose(
            level_of(plot.image_db(image)).get_array(),
            level_of(plot.image_db(SPECKLE)).get_array(),
            atol=1e-3,
        )


_LIMITED = """
import resource, signal, sys
import matplotlib.pyplot as plt
import clsas
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
figure, axes = plt.subplots()
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
try:
    clsas.plot.save(figure, sys.argv[1])
except OSError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", *also("pdf", "svg")])
def test_a_file_that_cannot_grow_is_reported(suffix, tmp_path):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"old")
    command = [sys.executable, "-c", _LIMITED, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "File too large" in done.stdout
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
