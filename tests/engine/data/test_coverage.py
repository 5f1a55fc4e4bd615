import re
import warnings

import numpy as np
import pytest
from cases import along_x, lines_over
from factorizing import EXACT_IS_SLOW, around

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import UnreachedWarning, reaches
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.factorized.costs import Costs
from clsas.engine.imaging import backproject, factorize, plan

NEAR = around(0, 40)
LINES = lines_over(NEAR, along_x(200, 0.02), None, carrier_hz=120e3, step_m=0.02)
FAR = around(0, 90)
ASIDE = around(30, 25)
"""Grid within the range of the lines, 50 degrees ahead."""


def heard(form):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form()
    return [str(each.message) for each in caught if issubclass(each.category, ClsasWarning)]


@pytest.mark.parametrize(
    ("grid", "beam"),
    [
        (FAR, None),
        (around(0, 10), None),
        (Grid.points(FAR.positions_m()[::9, ::9].reshape(-1, 3)), None),
        (FAR.with_height(np.full(FAR.shape, 3.0)), None),
        (ASIDE, BeamWindow(20.0, "hann")),
    ],
    ids=["far", "near", "points", "heights", "beam"],
)
def test_whoever_is_asked_warns_once_of_a_grid_that_no_line_reaches(grid, beam):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnreachedWarning)
        chosen = plan(LINES, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    ways = {
        "plan": lambda: plan(LINES, grid, tolerance_db=-40, beam=beam),
        "factorize": lambda: factorize(LINES, grid, -40, beam=beam),
        "given": lambda: factorize(LINES, grid, chosen),
        "backproject": lambda: backproject(LINES, grid, beam=beam),
    }
    for name, form in ways.items():
        (message,) = heard(form)
        assert "so the image is zero: " in message, name
        assert ("within the beam" in message) == (beam is not None)
        assert re.search(r"the grid lies at [\d.]+ to [\d.]+ m\. Check the \w+", message)


@pytest.mark.parametrize("pixels", [(0, 0), (3, 77), (149, 159)])
def test_nothing_is_said_where_one_pixel_of_many_is_reached(pixels):
    """The pixel lies between the points of the quick test."""
    points_m = np.tile(FAR.positions_m()[:1, :1], (150, 160, 1))
    points_m[pixels] = 0, 40, 0
    assert heard(lambda: plan(LINES, Grid.points(points_m), tolerance_db=-40)) == []


def test_nothing_is_said_of_a_narrow_strip_of_a_large_plane():
    """The beam is one degree wide, the track centimetres long, and pixels metres apart."""
    short = LINES.select(slice(0, 2))
    grid = Grid.plane(x=(-1000.3, 1000, 700), y=(30, 60, 300))
    assert heard(lambda: plan(short, grid, tolerance_db=-40, beam=BeamWindow(1.0))) == []


def test_nothing_is_said_of_lines_of_zeros():
    silent = type(LINES)(
        0 * LINES.samples, LINES.first_range_m, LINES.range_step_m,
        LINES.tx_m, LINES.rx_m, LINES.carrier_hz, LINES.sound_speed_m_s,
    )  # fmt: skip
    assert heard(lambda: plan(silent, FAR, tolerance_db=-40, costs=Costs())) == []


@pytest.mark.slow
@pytest.mark.parametrize("speed", [15.0, 450.0, 1350.0])
def test_lines_of_fast_receivers_reach_the_pixels_in_their_range(speed):
    """Behind a moving receiver, range changes faster than distance."""
    grid = Grid.plane((-80, 0, 81), (0, 20, 21))
    tx, velocity = np.zeros((1, 3)), np.array([[speed, 0, 0]])
    points_m = grid.positions_m().reshape(-1, 3)[1::71]
    for range_m in pairwise_range_m(points_m, tx, tx, velocity, 1500.0)[:, 0]:
        line = RangeLines(np.ones((1, 4), complex), range_m, 1e-3, tx, tx, 1e4, 1500.0, velocity)
        assert reaches(line, grid, None, None)
