"""Pictures of corrected tracks."""

from dataclasses import replace
from itertools import combinations
from operator import attrgetter

import numpy as np
import pytest

import clsas
from clsas.engine.data.image import Image
from clsas.navigation.autofocus import Autofocus
from clsas.navigation.micronavigation import Micronavigation

pytest.importorskip("matplotlib")

PINGS = 20


def lines():
    tx_m = np.repeat(np.arange(PINGS)[:, None] * [0.1, 0, 0], 3, axis=0)
    rx_m = tx_m + np.tile([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], (PINGS, 1))
    return clsas.RangeLines(np.ones((3 * PINGS, 4), complex), 10.0, 0.01, tx_m, rx_m, 1e5, 1500.0)


def navigated(coherent=True):
    steps_sd = np.full(PINGS - 1, 1e-5)
    if not coherent:
        steps_sd[3] = np.inf
    at = np.arange(PINGS)
    return Micronavigation(
        lines=lines(),
        track=clsas.Track(np.zeros((PINGS, 3)), at.astype(float)),
        sway_m=0.02 * np.sin(at),
        yaw_rad=0.01 * np.cos(at),
        surge_m=np.zeros(PINGS),
        sway_sd_m=np.full(PINGS, 0.001),
        yaw_sd_rad=np.full(PINGS, 0.2),
        surge_sd_m=np.full(PINGS, 0.1),
        sway_steps_m=np.zeros(PINGS - 1),
        yaw_steps_rad=np.zeros(PINGS - 1),
        sway_steps_sd_m=steps_sd,
        yaw_steps_sd_rad=steps_sd,
        coherence=np.random.default_rng(0).uniform(0.5, 1, (PINGS - 1, 4)),
        range_m=np.array([11.0, 13.0, 15.0, 17.0]),
        overlap=np.full(PINGS - 1, 3),
    )


def focused(focused=True):
    given = lines()
    correction_m = np.zeros((given.channels, 3))
    correction_m[:, 1] = 1e-3 * np.sin(np.arange(given.channels))
    sd_m = np.full(given.channels, 1e-4 if focused else np.inf)
    steps = ("drift", 3.0), ("phase gradient", 2.5), ("phase gradient", 5.0)
    return Autofocus(given, correction_m, sd_m, 2.0, 5.0, steps, focused)


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_corrections_have_their_intervals():
    sway, of_sway, yaw, of_yaw = clsas.plot.corrections(navigated()).axes  # the surge is zero
    assert sway.get_ylabel() == "Sway (mm)"
    assert yaw.get_ylabel() == "Yaw (mrad)"
    assert legend(of_sway) == ["whole track", "its shape"]
    np.testing.assert_allclose(of_sway.lines[0].get_ydata(), 1.96)
    np.testing.assert_allclose(of_yaw.lines[0].get_ydata(), 392)
    assert len(sway.collections) == 2
    assert len(yaw.collections) == 0  # its interval is wider than the panel
    apart = clsas.plot.corrections(navigated(coherent=False)).axes[1]
    assert legend(apart) == ["whole track"]
    focus, of_focus = clsas.plot.corrections(focused()).axes
    assert focus.get_ylabel() == "Along y (mm)"
    np.testing.assert_allclose(of_focus.lines[0].get_ydata(), 0.196)
    assert not clsas.plot.corrections(focused(focused=False)).axes[1].lines


def test_coherence_is_drawn_over_pings_and_range():
    figure = clsas.plot.coherence(navigated())
    beside, levels, _ = figure.axes
    np.testing.assert_allclose(levels.images[0].get_extent(), (-0.5, PINGS - 1.5, 10, 18))
    assert beside.get_ylabel() == "Range (m)"
    assert "median" in legend(beside)
    assert beside.get_xlim()[1] > 1  # a median of 1 is not hidden by the frame
    (steps,) = (each for each in beside.patches if each.get_label() == "median")
    np.testing.assert_allclose(steps.get_data().edges, [10, 12, 14, 16, 18])


@pytest.mark.parametrize(("range_m", "shown"), [((12.0, 17.0), (12, 17)), (None, None)])
def test_a_single_window_is_drawn_over_its_extent(range_m, shown):
    found = navigated()
    reach = found.lines.first_range_m.max(), found.lines.last_range_m.min()
    middle_m = np.mean(range_m or reach)
    single = replace(found, coherence=found.coherence[:, :1], range_m=np.array([middle_m]))
    beside = clsas.plot.coherence(single, range_m=range_m).axes[0]
    np.testing.assert_allclose(beside.get_ylim(), shown or reach)


def test_steps_that_autofocus_left_out_are_marked():
    (axes,) = clsas.plot.sharpness(focused()).axes
    names = [text.get_text() for text in axes.get_xticklabels()]
    assert names == ["before", "drift", "phase gradient", "phase gradient"]
    assert legend(axes) == ["kept", "tried, and left out"]


def test_images_before_and_after_have_one_scale():
    grid = clsas.Grid.plane((0, 1, 5), (0, 1, 4))
    before, after = (Image(level * np.ones((4, 5), complex), grid) for level in (1.0, 10.0))
    figure = clsas.plot.before_and_after(before, after, dynamic_range_db=30)
    titles = [axes.get_title() for axes in figure.axes[:2]]
    assert titles == ["Before: peak −20.0 dB", "After: peak 0.0 dB"]
    assert {axes.images[0].get_clim() for axes in figure.axes[:2]} == {(-30.0, 0.0)}
    figure = clsas.plot.before_and_after(before, after, percentiles=(0, 100))
    assert {axes.images[0].get_clim() for axes in figure.axes[:2]} == {(-20.0, 0.0)}
    with pytest.raises(ValueError, match="after must have the pixels of `before`"):
        clsas.plot.before_and_after(before, Image(np.ones((2, 2), complex), grid.window(
            slice(2), slice(2))))  # fmt: skip
    points = Image(np.ones(4, complex), clsas.Grid.points(np.ones((4, 3))))
    with pytest.raises(ValueError, match="after must be on a plane or height map to be drawn"):
        clsas.plot.before_and_after(before, points)


@pytest.mark.parametrize("y", [(10, 50, 200), (10, 210, 200), (10, 14, 20), (10, 10.4, 2)])
def test_texts_of_images_of_any_shape_do_not_overlap(y):
    grid = clsas.Grid.plane((0, 4, 20), y)
    image = Image(np.ones(grid.shape, complex), grid)
    figure = clsas.plot.before_and_after(image, image)
    figure.canvas.draw()
    before, after, bar = figure.axes
    for text in ("title", "xaxis.label"):
        of = [attrgetter(text)(axes).get_window_extent() for axes in (before, after)]
        assert of[0].x1 < of[1].x0
    below = [axes.xaxis.get_tightbbox() for axes in (before, after)]
    scale = max((bar.xaxis, bar.yaxis), key=lambda axis: len(axis.label.get_text()))
    boxes = [*below, scale.get_tightbbox(), after.get_window_extent()]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    size = [axes.get_window_extent().size for axes in (before, after)]
    np.testing.assert_allclose(*size, rtol=1e-3)


def test_images_of_zeros_are_labelled():
    grid = clsas.Grid.plane((0, 1, 5), (0, 1, 4))
    zero, one = (Image(level * np.ones((4, 5), complex), grid) for level in (0.0, 1.0))
    for pair, words in (
        ((zero, zero), ["Before: image is zero", "After: image is zero"]),
        ((zero, one), ["Before: image is zero", "After: peak 0.0 dB"]),
    ):
        figure = clsas.plot.before_and_after(*pair)
        assert [axes.get_title() for axes in figure.axes[:2]] == words


@pytest.mark.parametrize("draw", ["corrections", "coherence", "sharpness"])
def test_other_types_are_refused(draw):
    with pytest.raises(TypeError, match="found must be of type"):
        getattr(clsas.plot, draw)(1)
