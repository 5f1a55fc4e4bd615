"""Georeferences as tags of lines and grids, without pyproj."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.data.georeference import placed

BERGEN = clsas.Georeference.local(60.39, 5.32, -50.0, heading_deg=217)
UTM = clsas.Georeference(crs="EPSG:32632")


def test_equal_places_are_equal():
    assert clsas.Georeference.local(1, 182, heading_deg=-10) == clsas.Georeference.local(
        1, -178, heading_deg=350
    )
    assert clsas.Georeference(crs=" EPSG:32632 ") == UTM


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: clsas.Georeference(), "latitude_deg must be given unless `crs` is"),
        (lambda: replace(UTM, heading_deg=3.0), "heading_deg must be left out with `crs`"),
        (lambda: clsas.Georeference.local(151.2, -33.9, heading_deg=0), "are probably swapped"),
        (lambda: clsas.Georeference.local(151.2, -133.9, heading_deg=0), "degrees, got 151.2$"),
        (lambda: clsas.Georeference.local(0, 361, heading_deg=0), "longitude_deg must be from"),
        (lambda: clsas.Georeference.local(0, 0, heading_deg=400), "heading_deg must be"),
        (lambda: BERGEN.to_map([1.0, 2.0]), "positions_m must have shape"),
    ],
)  # fmt: skip
def test_other_tags_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_windows_and_heights_keep_the_place():
    grid = clsas.Grid.plane((0, 1, 5), (0, 1, 4), georeference=BERGEN)
    points = clsas.Grid.points(grid.positions_m(), georeference=BERGEN)
    for other in (grid.window(slice(1, 3)), grid.with_height(np.ones((4, 5))), points.window()):
        assert other.georeference == BERGEN
    assert repr(grid).endswith("z 0 m, latitude 60.39 deg, longitude 5.32 deg, height -50 m, "
                               "heading 217 deg)")  # fmt: skip


def test_lines_place_the_grid():
    grid = clsas.Grid.plane((0, 1, 5), (0, 1, 4))
    lines = clsas.RangeLines(
        np.ones((1, 9), complex), 1, 1, np.zeros(3), np.zeros(3), 0, 1500, georeference=BERGEN
    )
    assert placed(lines, grid).georeference == BERGEN
    assert placed(replace(lines, georeference=None), grid) is grid
    on_utm = replace(grid, georeference=UTM)
    assert placed(replace(lines, georeference=None), on_utm) is on_utm
    with pytest.raises(ValueError, match=r"grid must have the georeference of the lines \(lat"):
        placed(lines, on_utm)


@pytest.mark.parametrize("first_is_placed", [True, False])
def test_results_of_two_images_lie_where_either_does(first_is_placed):
    """A georeference that only one image has counts for both, in either order."""
    random = np.random.default_rng(5)
    plain = clsas.Grid.plane((0, 1, 32), (20, 21, 32))
    grids = [replace(plain, georeference=BERGEN), plain]
    a, b = (
        clsas.Image(random.standard_normal((32, 32, 2)) @ [1, 1j], grid)
        for grid in (grids if first_is_placed else grids[::-1])
    )
    assert clsas.multilook([a, b]).grid.georeference == BERGEN
    assert clsas.interferogram(a, b, window_m=0.3).grid.georeference == BERGEN
    track_m = np.outer(np.linspace(-1, 1, 33), [1, 0, 0])
    point = clsas.PointTargets([[0.5, 20.5, 0.0]])
    lines = clsas.simulate_lines(track_m, track_m, point, carrier_hz=30e3, bandwidth_hz=10e3)
    image = clsas.backproject(lines, b.grid, accumulate=a, accuracy_db=-30)
    assert image.grid.georeference == BERGEN
