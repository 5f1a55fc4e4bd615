import numpy as np
import pytest
from cases import along_x, beside, patch, thesis_lines

from clsas import plan
from clsas.backproject import backproject
from clsas.factorize import factorize
from clsas.grid import Grid
from clsas.quality import relative_error_db

APERTURE = along_x(400, 8.25e-3)


def wide_beam(grid, tx=APERTURE, rx=None, **more):
    return thesis_lines(grid, tx, rx, **more)


def swaying():
    along = np.linspace(0, 2 * np.pi, len(APERTURE))
    return APERTURE + np.stack([0 * along, 2e-3 * np.sin(along), 1e-3 * np.cos(along)], axis=1)


@pytest.mark.parametrize("tolerance_db", [-20, -40, -60])
def test_the_error_is_what_was_asked_for(device, tolerance_db):
    grid = patch(0.3, 42, 150, 130)
    lines = wide_beam(grid)
    exact = backproject(lines, grid, accuracy_db=-80)
    chosen = plan(lines, grid, tolerance_db=tolerance_db)
    assert chosen.predicted_error_db <= tolerance_db
    error_db = relative_error_db(factorize(lines, grid, chosen, device=device), exact)
    assert tolerance_db - 20 <= error_db <= tolerance_db


@pytest.mark.parametrize("track", ["swaying", "bistatic", "reversed", "shuffled"])
def test_any_channels(platform, track):
    grid = patch(0.3, 42, 100, 90)
    tx, rx = APERTURE, None
    if track == "swaying":
        tx = swaying()
    elif track == "bistatic":
        rx = beside(tx, 0.1, 0.02, 0.0)
    elif track == "reversed":
        tx = tx[::-1]
    else:
        tx = np.random.default_rng(1).permutation(tx)
    lines = wide_beam(grid, tx, rx)
    exact = backproject(lines, grid, accuracy_db=-80)
    image = factorize(lines, grid, -45, device=platform)
    assert relative_error_db(image, exact) <= -45


def test_progress_counts_pixels(platform):
    grid = patch(0.3, 42, 70, 33)
    calls = []
    factorize(
        wide_beam(grid), grid, -30, device=platform, progress=lambda *call: calls.append(call)
    )
    done, total = zip(*calls, strict=True)
    assert set(total) == {grid.size} == {done[-1]}
    assert sorted(set(done)) == list(done)


def test_moving_receivers_are_refused():
    grid = patch(0.3, 42, 10, 10)
    lines = wide_beam(grid, velocity=np.ones((len(APERTURE), 3)))
    with pytest.raises(ValueError, match="lines must have no rx_velocity_m_s"):
        factorize(lines, grid, -40)


def test_a_height_map_is_refused():
    grid = patch(0.3, 42, 10, 10)
    lines = wide_beam(grid)
    with pytest.raises(ValueError, match="grid must be a plane"):
        factorize(lines, Grid.points(grid.positions_m()), -40)


@pytest.mark.parametrize("tolerance_db", [-61, 0, np.nan])
def test_a_tolerance_out_of_reach_is_refused(tolerance_db):
    grid = patch(0.3, 42, 10, 10)
    with pytest.raises(ValueError, match=r"tolerance_db must be .*>= -60 and <= -10 dB"):
        factorize(wide_beam(grid), grid, tolerance_db)
