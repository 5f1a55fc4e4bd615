"""Curves of equal range against the ranges, and images along them against images formed there."""

import numpy as np
import pytest
from reliefs import GRID, banks, flat_banks

import clsas
from clsas.engine.device.device import open_device
from clsas.engine.signal.spectrum import measure_spectrum, middle_cycles_per_m
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.coherence import Moments, Window
from clsas.interferometry.curves import CurveImages, Curves, spacing_m
from clsas.interferometry.pair import Pair

SEARCH_M = (-1.0, 1.5)
STEPS_M = (0.0125, 0.05)
TURNED = clsas.Grid.oriented([-0.5, 31, 0.1], [0.015, 0.013, 0.001], [0.013, -0.015, 0], (60, 50))


def dunes(x, y):
    return 0.15 * np.sin(2 * np.pi * (y - 32) / 3) + 0.05 * x


def curves_of(lines, grid=GRID, beam=None, search_m=SEARCH_M):
    baseline = Baseline.of(*lines, beam, middle_cycles_per_m(lines[0]))
    return Curves.over(baseline, grid, search_m, STEPS_M)


def mean_range_m(lines, points_m):
    ways_m = (np.linalg.norm(points_m[:, None] - each, axis=2) for each in (lines.tx_m, lines.rx_m))
    return sum(ways_m).mean(axis=1) / 2


@pytest.mark.parametrize("grid", [GRID, TURNED])
def test_curves_keep_the_range_to_the_first_bank(grid):
    lines = flat_banks()
    curves = curves_of(lines, grid)
    some = slice(None, None, 40), slice(None, None, 7)
    start_m = curves.grid.positions_m()[some].reshape(-1, 3)
    for height_m in (-0.9, 0.0, 1.3):
        points_m = curves.points_m(height_m)[some].reshape(-1, 3)
        assert points_m[:, 2] == pytest.approx(curves.level_m + height_m)
        of_first, of_second = (
            mean_range_m(each, points_m) - mean_range_m(each, start_m) for each in lines
        )
        assert np.abs(of_first).max() < 1e-3  # 1/25 of the range resolution
        # The image of the second bank shows this range elsewhere on the plane.
        rows = curves.displaced(height_m)[some].reshape(-1, 1)
        moved_m = start_m + rows * curves.grid.vectors_m[1]
        moved = mean_range_m(lines[1], moved_m) - mean_range_m(lines[1], start_m)
        assert np.abs(of_second - of_first - moved).max() < 5e-6  # 4 mrad


@pytest.mark.parametrize("grid", [GRID, TURNED])
def test_curves_reach_all_places_at_all_heights(grid):
    curves = curves_of(flat_banks(), grid)
    corners_m = grid.spread(2)
    origin_m, row_step_m, column_step_m = curves.grid.vectors_m
    steps_m = np.array([row_step_m, column_step_m])[:, :2]
    for height_m in (curves.lattice.offset_m[0], curves.lattice.offset_m[-1]):
        points_m = curves.points_m(height_m)[..., :2]
        ends = np.array([points_m[0, 0], points_m[-1, -1]]) - origin_m[:2]
        first, last = ends @ np.linalg.inv(steps_m)
        places = (corners_m[:, :2] - origin_m[:2]) @ np.linalg.inv(steps_m)
        assert (places > first).all()
        assert (places < last).all()


def test_curves_begin_on_the_surface_where_the_search_starts():
    hills = GRID.with_height(0.3 + dunes(*np.meshgrid(*GRID.axes_m)))
    curves = curves_of(flat_banks(), hills)
    points_m = curves.points_m(curves.start_m(hills)).reshape(-1, 3)
    x, y, z = points_m[(np.abs(points_m[:, 0]) < 0.7) & (np.abs(points_m[:, 1] - 32) < 1.1)].T
    assert z == pytest.approx(0.3 + dunes(x, y), abs=2e-3)


AHEAD_M = ((0.5, 0.1, 0.0), (0.55, 0.05, 0.25))
TRACKS = {
    "straight": {},
    "sway and roll": {"sway_m": 0.1, "roll_rad": 0.05},
    "receivers ahead": {"sway_m": 0.02, "yaw_rad": 0.05, "arms_m": AHEAD_M},
}


@pytest.mark.parametrize("grid", [GRID, TURNED])
@pytest.mark.parametrize("name", TRACKS)
def test_images_of_a_plane_are_those_at_other_heights(name, grid):
    """Coherence and phase, in small windows; of a straight track the images, too."""
    lines = banks(dunes, snr_db=None, **TRACKS[name])
    device = open_device()
    baseline = Baseline.of(*lines, None, middle_cycles_per_m(lines[0]))
    spectrum = measure_spectrum(lines[0])
    band = 1 / (spectrum.oversampling * lines[0].range_step_m * middle_cycles_per_m(lines[0]))
    steps_m = spacing_m(baseline, grid, band), 0.05
    fine = Curves.over(baseline, grid, SEARCH_M, steps_m)
    images = CurveImages.of(Pair(*lines, -50.0, None, None, device), fine, 2)
    window = Window.of(images.curves.grid, 0.25)
    inside = (slice(*(np.array([0.25, 0.75]) * images.first.shape[0]).astype(int)), slice(4, -4))
    for height_m in (-0.5, 0.5):
        points = clsas.Grid.points(images.curves.points_m(height_m))
        formed = [clsas.backproject(each, points, accuracy_db=-50).pixels for each in lines]
        shown = images.at(height_m)
        one, other = (Moments.of(*pair, window).coherence[inside] for pair in (shown, formed))
        assert np.abs(one).mean() == pytest.approx(np.abs(other).mean(), abs=0.01)
        apart_rad = np.angle(one * other.conj())[np.abs(other) > 0.7]
        assert np.sqrt(np.mean(apart_rad**2)) < (2e-3 if name == "straight" else 0.04)
        if name == "straight":
            product, expected = (a * b.conj() for a, b in (shown, formed))
            error = np.linalg.norm((product - expected)[inside])
            assert error < 0.02 * np.linalg.norm(expected[inside])
