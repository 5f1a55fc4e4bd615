"""Pictures of plans, points and echoes, and parts of images around a position."""

import numpy as np
import pytest
from cases import along_x, lines_over

import clsas
from clsas import plot
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.plot.images import amplitude_at, window_around

pytest.importorskip("matplotlib")

GRID = Grid.plane((-1, 1, 81), (20, 22, 41))
LINES = lines_over(GRID, along_x(32, 0.05), carrier_hz=1e5, step_m=0.01)


def on_points(points_m, level=1.0):
    grid = Grid.points(points_m)
    return Image(np.full(grid.shape, level, np.complex64), grid)


def test_bars_of_a_plan_add_up_to_its_prediction():
    plan = clsas.plan(LINES, GRID, stages=[(2, 2), (2, 2)])
    times, errors = plot.plan(plan, title="A plan").axes
    shown_s = sum(bar.get_width() for bar in times.patches)
    scale = 1.0 if "(s)" in times.get_xlabel() else 1e3
    assert shown_s == pytest.approx(scale * plan.predicted_seconds, rel=2e-3)
    ends_db = np.array([bar.get_x() + bar.get_width() for bar in errors.patches])
    assert 10 * np.log10((10 ** (ends_db / 10)).sum()) == pytest.approx(
        plan.errors.total_db, abs=0.05
    )
    assert list(ends_db) == sorted(ends_db, reverse=True)
    names = [text.get_text() for text in times.get_yticklabels()]
    assert [name.split(":")[0] for name in names[:3]] == ["stage 1", "stage 2", "leaves"]


def test_a_plan_of_an_exact_image_has_one_bar():
    plan = clsas.plan(LINES, Grid.plane((-0.1, 0.1, 3), (20, 21, 4)), tolerance_db=-40)
    assert plan.is_exact
    figure = plot.plan(plan)
    assert len(figure.axes[0].patches) == 1
    assert "Plan: tolerance -40 dB" in figure.get_suptitle()
    with pytest.raises(TypeError, match="plan must be"):
        plot.plan("a plan")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extents_m", "labels"),
    [
        ((4, 3, 1), ("Along-track (m)", "Across-track (m)")),
        ((4, 1, 3), ("Along-track (m)", "Height (m)")),
        ((1, 4, 3), ("Across-track (m)", "Height (m)")),
        ((2, 2, 2), ("Along-track (m)", "Across-track (m)")),
    ],
)
def test_points_are_seen_along_their_shortest_extent(extents_m, labels):
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    axes = plot.points(on_points(corners * np.array(extents_m))).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == labels
    assert axes.get_aspect() == 1.0


def test_strong_points_lie_over_weak_ones():
    rng = np.random.default_rng(5)
    grid = Grid.points(rng.uniform(0, 1, (50, 3)))
    image = Image(rng.uniform(0.01, 1, 50).astype(np.complex64), grid)
    (drawn,) = plot.points(image, dynamic_range_db=20).axes[0].collections
    level = np.asarray(drawn.get_array())
    assert (np.diff(level) >= 0).all()
    assert (drawn.get_clim(), level[-1]) == ((-20, 0), 0)
    order = np.argsort(np.abs(image.pixels))
    np.testing.assert_allclose(drawn.get_offsets()[-1], grid.points_m[order[-1], :2])


def test_of_very_many_points_the_strongest_are_drawn(monkeypatch):
    monkeypatch.setattr("clsas.plot.volumes._MOST_POINTS", 3)
    grid = Grid.points(np.arange(30.0).reshape(10, 3))
    image = Image(np.arange(1, 11).astype(np.complex64), grid)
    (drawn,) = plot.points(image).axes[0].collections
    np.testing.assert_allclose(drawn.get_offsets()[:, 0], grid.points_m[-3:, 0])


def test_planes_are_no_points():
    with pytest.raises(ValueError, match="image must be on points, got one on a plane"):
        plot.points(Image(np.ones(GRID.shape, np.complex64), GRID))


def test_echoes_lie_at_their_times():
    samples = np.zeros((3, 50), np.float32)
    samples[1, 20] = 2.0
    start_s = np.array([0.020, 0.021, 0.020])
    echoes = clsas.Echoes(samples, start_s, 1e4, 1e3, np.zeros(3), np.zeros(3), 1500.0)
    axes = plot.echoes(echoes, reference=0.2).axes[0]
    (drawn,) = axes.get_images()
    np.testing.assert_allclose(drawn.get_extent(), (-0.5, 2.5, 19.95, 25.95))
    level = np.asarray(drawn.get_array())
    assert np.unravel_index(level.argmax(), level.shape) == (30, 1)
    assert level.max() == pytest.approx(20)
    assert axes.get_ylabel() == "Time after transmission (ms)"


def test_percentiles_of_amplitudes_leave_zeros_out():
    values = np.array([[0, 1, 2j], [-3, 0, 4]])
    assert amplitude_at(values, 50) == pytest.approx(2.5)
    assert amplitude_at(values, 100) == pytest.approx(4)
    assert amplitude_at(0 * values, 50) is None


@pytest.mark.parametrize(
    ("near", "extent_m", "rows", "columns"),
    [
        ((0, 21), 0.1, (18, 23), (36, 45)),
        ((0, 21, 0), 0.1, (18, 23), (36, 45)),
        ((-1, 20), 0.1, (0, 3), (0, 5)),
        ((0.011, 21.02), 0.001, (20, 21), (40, 41)),  # between pixels: the nearest one
        ((0, 21), 100, (0, 41), (0, 81)),
        ((0, 21), None, (0, 41), (0, 81)),  # 32 pixels of 5 cm
    ],
)
def test_the_window_around_a_position(near, extent_m, rows, columns):
    assert window_around(GRID, near, extent_m) == (slice(*rows), slice(*columns))


def test_windows_of_grids_that_run_backwards_or_are_slanted():
    backwards = Grid.plane((1, -1, 81), (22, 20, 41))
    rows, columns = window_around(backwards, (0.5, 21.5), 0.1)
    x_m, y_m = backwards.window(rows, columns).axes_m
    np.testing.assert_allclose([x_m[0], x_m[-1], y_m[0], y_m[-1]], [0.6, 0.4, 21.6, 21.4])
    slanted = Grid.oriented([0, 20, 0], [0, 0.03, 0.04], [0.05, 0, 0], (41, 41))
    assert window_around(slanted, (1.0, 20.6, 0.8), 0.1) == (slice(18, 23), slice(18, 23))


@pytest.mark.parametrize(
    ("near", "extent_m", "words"),
    [
        ((2, 21), 0.1, "near must be inside the image, x from -1 to 1 m, got 2 m"),
        ((0, 19.9), 0.1, "y from 20 to 22 m, got 19.9 m"),
        ((0, 21), 0.0, "extent_m must be finite and > 0"),
        ((0,), 0.1, "near must have shape"),
    ],
)
def test_windows_outside_are_refused(near, extent_m, words):
    with pytest.raises(ValueError, match=words):
        window_around(GRID, near, extent_m)
