import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from clsas import Certificate, plot
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes
from clsas.measures.quality import measure_point

pytest.importorskip("matplotlib")

GRID = Grid.plane(x=(1e6, 1e6 + 1.99, 200), y=(40.0, 41.49, 150))
X, Y = GRID.axes_m
PIXELS = 2 * np.sinc((X - X[80]) / 0.015) * np.sinc((Y - Y[60]) / 0.02)[:, None] + 0j
IMAGE = Image(PIXELS, GRID)
TRACK = np.stack([np.repeat(np.arange(5.0), 2), np.zeros(10), np.zeros(10)], -1)


def lines(samples, first_range_m=40.0):
    ahead = np.array([0.1, 0, 0])
    return RangeLines(samples, first_range_m, 0.1, TRACK, TRACK + ahead, 0, 1500)


def shown(figure):
    """Return the array, extent and colour limits of the picture in a figure."""
    (drawn,) = figure.axes[0].get_images()
    return drawn.get_array(), drawn.get_extent(), drawn.get_clim()


def test_image_is_in_decibels_over_metres():
    figure = plot.image_db(IMAGE, dynamic_range_db=50, title="a point")
    level, extent, limits = shown(figure)
    np.testing.assert_allclose(
        level, np.maximum(20 * np.log10(np.maximum(np.abs(PIXELS) / 2, 1e-9)), -50), atol=1e-3
    )
    np.testing.assert_allclose(extent, [1e6 - 0.005, 1e6 + 1.995, 39.995, 41.495])
    assert limits == (-50, 0)
    axes, bar = figure.axes
    assert axes.get_aspect() == 1
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Along-track (m)", "Across-track (m)")
    assert axes.get_title() == "a point"
    assert bar.get_ylabel() == "Amplitude (dB re max)"


def test_reference_sets_zero_decibels():
    figure = plot.image_db(IMAGE, reference=20)
    assert shown(figure)[0].max() == pytest.approx(-20)
    assert figure.axes[1].get_ylabel() == "Amplitude (dB re 20)"


def test_zero_image_is_black():
    level, _, _ = shown(plot.image_db(Image(0 * PIXELS, GRID)))
    np.testing.assert_allclose(level, -60)


def test_image_may_run_backwards():
    backwards = Grid.plane(x=(1, -1, 5), y=(2, 0, 5))
    pixels = np.zeros((5, 5), complex)
    pixels[0, 0] = 1  # at x = 1, y = 2, the top right
    figure = plot.image_db(Image(pixels, backwards))
    level, extent, _ = shown(figure)
    assert level[0, 0] == 0
    assert extent == [1.25, -1.25, 2.25, -0.25]
    assert figure.axes[0].get_xlim() == (-1.25, 1.25)
    assert figure.axes[0].get_ylim() == (-0.25, 2.25)


def test_large_images_keep_their_points():
    grid = Grid.plane(x=(0, 4000, 4001), y=(0, 10, 11))
    pixels = np.zeros(grid.shape, complex)
    pixels[3, 2345] = 1
    level, extent, _ = shown(plot.image_db(Image(pixels, grid)))
    assert level.shape == (11, 1500)
    row, column = np.unravel_index(level.argmax(), level.shape)
    assert level[row, column] == 0
    across = extent[0] + (column + 0.5) / 1500 * (extent[1] - extent[0])
    assert (row, across) == (3, pytest.approx(2345, abs=3))


def test_oriented_planes_show_distances():
    grid = Grid.oriented([1, 2, 3], [0, 0, 0.5], [0.3, 0.4, 0], (3, 5))
    figure = plot.image_db(Image(np.ones(grid.shape, complex), grid))
    # Rows run along z, columns along neither x nor y.
    np.testing.assert_allclose(shown(figure)[1], [-0.25, 2.25, 2.75, 4.25])
    labels = figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    assert labels == ("Distance along columns (m)", "Height (m)")


DEPTH = Grid.oriented([-0.01, 0, -0.02], [0, 0, -1e-4], [1e-4, 0, 0], (150, 200))


def test_small_planes_in_depth_are_in_millimetres():
    figure = plot.image_db(Image(np.ones(DEPTH.shape, complex), DEPTH))
    np.testing.assert_allclose(shown(figure)[1], [-10.05, 9.95, -19.95, -34.95])
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Along-track (mm)", "Height (mm)")
    assert axes.get_ylim() == pytest.approx((-34.95, -19.95))  # height increases upward


def test_cuts_in_depth_name_their_axes():
    response = measure_point(Image(PIXELS, DEPTH), (-0.002, -0.026))
    figure = plot.cuts(response)
    assert figure.axes[1].get_xlabel() == "Height from the peak (mm)"
    assert "z = -0.0260 m" in figure.axes[0].get_title()


def test_geometry_of_a_plane_in_depth_is_seen_from_its_side():
    rx_m = np.stack([np.linspace(-0.01, 0.01, 10), np.zeros(10), np.zeros(10)], -1)
    data = RangeLines(np.ones((10, 4), complex), 0.0, 1e-4, rx_m, rx_m, 0, 1500)
    figure = plot.geometry(data, DEPTH)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Along-track (mm)", "Height (mm)")
    np.testing.assert_allclose(axes.get_lines()[2].get_ydata().min(), -34.9)


def test_cuts_show_the_figures():
    response = measure_point(IMAGE, (X[80], Y[60]))
    figure = plot.cuts(response)
    for axes, cut in zip(figure.axes, (response.azimuth, response.range), strict=True):
        (line,) = axes.get_lines()
        np.testing.assert_array_equal(line.get_xdata(), 1e3 * cut.offset_m)
        np.testing.assert_array_equal(line.get_ydata(), cut.level_db)
        text = axes.get_legend().get_texts()[0].get_text()
        for words in (f"{1e3 * cut.resolution_m:.4g} mm", f"ISLR {cut.islr_db:.1f} dB (10 + 10"):
            assert words in text
    assert figure.axes[0].get_xlabel() == "Along-track from the peak (mm)"


def test_geometry_shows_places_and_outline():
    figure = plot.geometry(lines(np.ones((10, 4), complex)), GRID)
    receivers, transmitters, outline = figure.axes[0].get_lines()
    assert len(transmitters.get_xdata()) == len(receivers.get_xdata()) == 5
    np.testing.assert_allclose(
        outline.get_xydata(),
        [[X[0], Y[0]], [X[-1], Y[0]], [X[-1], Y[-1]], [X[0], Y[-1]], [X[0], Y[0]]],
    )
    assert figure.axes[0].get_aspect() == 1


def test_geometry_of_echoes_and_points():
    echoes = Echoes(np.ones((10, 4), complex), 0, 1e5, 1e6, TRACK, TRACK, 1500)
    points = np.arange(12.0).reshape(2, 2, 3)
    figure = plot.geometry(echoes, Grid.points(points))
    np.testing.assert_array_equal(
        figure.axes[0].get_lines()[2].get_xydata(), points.reshape(4, 3)[:, :2]
    )


def test_range_lines_lie_at_their_ranges():
    samples = np.zeros((10, 20), complex)
    first = 40 + 0.1 * np.arange(10)
    samples[np.arange(10), 15 - np.arange(10)] = 1  # one range, 41.5 m, in every channel
    level, extent, _ = shown(plot.range_lines(lines(samples, first)))
    assert level.shape == (29, 10)
    np.testing.assert_array_equal(level.argmax(axis=0), 15)
    np.testing.assert_allclose(extent, [-0.5, 9.5, 39.95, 42.85])


def test_pictures_are_written_whole_or_not_at_all(tmp_path, monkeypatch):
    figure = plot.image_db(IMAGE)
    plot.save_png(figure, tmp_path / "image.png", dpi=50)
    content = (tmp_path / "image.png").read_bytes()
    assert content.startswith(b"\x89PNG")

    def interrupted(file, **options):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(figure, "savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        plot.save_png(figure, tmp_path / "image.png")
    assert os.listdir(tmp_path) == ["image.png"]
    assert (tmp_path / "image.png").read_bytes() == content


@pytest.mark.slow
def test_every_figure_is_drawn_without_a_warning(tmp_path, recwarn):
    data = lines(np.ones((10, 4), complex))
    response = measure_point(IMAGE, (X[80], Y[60]))
    line = Image(np.ones((1, 9), complex), Grid.plane(x=(0, 1, 9), y=(0, 0, 1)))
    figures = (
        plot.image_db(IMAGE),
        plot.image_db(line),
        plot.cuts(response),
        plot.geometry(data),
        plot.range_lines(data),
    )
    for figure in figures:
        plot.save_png(figure, tmp_path / "figure.png", dpi=50)
    assert not recwarn.list


@pytest.mark.exhaustive
def test_no_global_state_is_touched():
    code = (
        "import sys, numpy as np; from clsas import plot; from clsas.engine.data.grid import Grid; "
        "from clsas.engine.data.image import Image; assert 'matplotlib' not in sys.modules; "
        "plot.image_db(Image(np.ones((2, 2), complex), Grid.plane((0, 1, 2), (0, 1, 2)))); "
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    assert os.spawnv(os.P_WAIT, sys.executable, [sys.executable, "-c", code]) == 0


def test_bad_input_is_named():
    points = Image(np.ones(3, complex), Grid.points(np.zeros((3, 3))))
    data = lines(np.ones((10, 4), complex))
    with pytest.raises(ValueError, match="must be on a plane or height map"):
        plot.image_db(points)
    with pytest.raises(ValueError, match="dynamic_range_db must be finite and > 0 and <= 2000 dB"):
        plot.image_db(IMAGE, dynamic_range_db=0)
    with pytest.raises(ValueError, match="reference must be finite and > 0"):
        plot.image_db(IMAGE, reference=-1)
    with pytest.raises(TypeError, match="image must be of type Image, got ndarray"):
        plot.image_db(PIXELS)
    with pytest.raises(TypeError, match="lines must be of type RangeLines, got Image"):
        plot.range_lines(IMAGE)
    with pytest.raises(TypeError, match="lines must be of type RangeLines or Echoes, got Image"):
        plot.geometry(IMAGE)
    with pytest.raises(TypeError, match="grid must be of type Grid, got Image"):
        plot.geometry(data, IMAGE)
    with pytest.raises(ValueError, match="floor_db must be finite and < 0 dB"):
        plot.cuts(measure_point(IMAGE, (X[80], Y[60])), floor_db=3)


def test_only_figures_are_saved(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in .png, got '.*a.pdf'"):
        plot.save_png(plot.image_db(IMAGE), tmp_path / "a.pdf")
    with pytest.raises(ValueError, match=r"path must end in .png or .pdf or .svg, got '.*a.jpg'"):
        plot.save(plot.image_db(IMAGE), tmp_path / "a.jpg")
    with pytest.raises(
        ValueError, match="dpi must be finite and >= 10 and <= 10000 pixels per inch"
    ):
        plot.save(plot.image_db(IMAGE), tmp_path / "a.pdf", dpi=0)
    with pytest.raises(TypeError, match="figure must be of type Figure, got int"):
        plot.save_png(5, tmp_path / "a.png")
    with pytest.raises(TypeError, match="response must be of type PointResponse, got Image"):
        plot.cuts(IMAGE)
    assert os.listdir(tmp_path) == []


def test_missing_matplotlib_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'matplotlib>=3\.10'"):
        plot.image_db(IMAGE)


def test_axes_of_a_map_are_easting_and_northing():
    on_map = replace(GRID, georeference=Georeference(crs="EPSG:32632"))
    axes = plot.image_db(Image(PIXELS, on_map), north_arrow=True, scale_bar=True).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Easting (m)", "Northing (m)")
    response = measure_point(Image(PIXELS, on_map), (X[80], Y[60]))
    labels = [axes.get_xlabel() for axes in plot.cuts(response).axes]
    assert labels == ["Easting from the peak (mm)", "Northing from the peak (mm)"]
    north, bar = axes.texts
    assert (north.get_text(), bar.get_text()) == ("N", "0.5 m")
    (line,) = axes.get_lines()
    assert np.ptp(line.get_xdata()) == pytest.approx(0.5)
    tip, tail = np.array(north.get_position()), np.array(north.xy)
    np.testing.assert_allclose((tip - tail)[0], 0, atol=1e-12)
    assert tip[1] > tail[1]


def test_captions_say_how_large_the_error_is():
    certificate = Certificate(64, PIXELS.size, 0.1, 1.0, 1e-5, 1e-12, 0.0)
    formed = Formed("exact", -40, "4 taps", -41.2, None, (), "GPU", "1", "a")
    for how, words in (
        (formed, "predicted error −41.2 dB"),
        (replace(formed, certificate=certificate), "error −50.0 dB (below −49.2 dB with"),
    ):
        axes = plot.image_db(Image(PIXELS, GRID, how), caption=True).axes[0]
        label, *caption = axes.get_xlabel().split("\n")
        assert label == "Along-track (m)"
        assert " ".join(caption).startswith(words)
    for how in (None, replace(formed, predicted_error_db=None)):
        with pytest.raises(ValueError, match="caption must be off for an image whose error"):
            plot.image_db(Image(PIXELS, GRID, how), caption=True)


def test_the_arrow_points_to_the_north_of_a_rotated_scene():
    """The x axis heads south-west, so north is back and to starboard of it."""
    local = Georeference.local(60.39, 5.32, heading_deg=217)
    square = Grid.plane((0, 1, 50), (1, 0, 50), georeference=local)  # rows run backwards
    axes = plot.image_db(Image(np.ones((50, 50), complex), square), north_arrow=True).axes[0]
    (north,) = axes.texts
    along = axes.transAxes.transform([north.get_position(), north.xy])
    along = along[0] - along[1]
    expected = np.radians([217.0])
    np.testing.assert_allclose(
        along / np.hypot(*along), [np.cos(expected[0]), np.sin(expected[0])], atol=1e-9
    )
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Along-track (m)", "Across-track (m)")
    with pytest.raises(ValueError, match="north_arrow must be off for an image without a georef"):
        plot.image_db(IMAGE, north_arrow=True)
