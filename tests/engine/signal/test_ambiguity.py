"""Lines whose ends do not fade, in exact and factorized images."""

import dataclasses
import math

import numpy as np
import pytest
from cases import TAPER, along_x, noise
from exactly import execute, prepare

import clsas
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.signal.ambiguity import ends_error
from clsas.engine.signal.spectrum import measure_spectrum


@pytest.fixture(scope="module")
def cut_off():
    """Lines that end amid their noise, from 20 m to 30 m, and the exact images of two grids."""
    samples = noise(200, 1001 + 2 * TAPER)[:, TAPER:-TAPER]
    track = along_x(200, 0.01)
    lines = RangeLines(samples, 20.0, 0.01, track, track, 100e3, 1500.0)
    grids = [Grid.plane((-0.4, 0.4, 100), (a, b, 1000)) for a, b in ((19.5, 30.5), (20.2, 29.8))]
    return lines, [(grid, execute(prepare(lines, grid, accuracy_db=-85))) for grid in grids]


@pytest.mark.parametrize("tolerance_db", [-50, -60, -70])
def test_what_is_made_of_ends_that_do_not_fade_is_predicted(cut_off, tolerance_db):
    lines, ((grid, exact), _) = cut_off
    with pytest.warns(ClsasWarning, match="lines do not fade towards ends that the grid reaches"):
        chosen = clsas.plan(lines, grid, tolerance_db=tolerance_db)
    found_db = relative_error_db(clsas.factorize(lines, grid, chosen), exact)
    assert tolerance_db < chosen.predicted_error_db < -35
    assert found_db <= chosen.predicted_error_db
    assert chosen.tolerance_db == tolerance_db


@pytest.mark.parametrize("tolerance_db", [-40, -60])
@pytest.mark.parametrize("y_m", [(20.005, 20.5), (20.04, 20.5), (29.5, 29.96), (29.5, 29.995)])
def test_a_grid_that_comes_within_five_samples_of_either_end_is_told_too(
    cut_off, y_m, tolerance_db
):
    lines, _ = cut_off
    grid = Grid.plane((-0.4, 0.4, 100), (*y_m, 100))
    with pytest.warns(ClsasWarning, match="lines do not fade towards ends that the grid reaches"):
        clsas.plan(lines, grid, tolerance_db=tolerance_db)


@pytest.mark.parametrize(("which", "tolerance_db"), [(0, -30), (1, -30), (1, -50), (1, -70)])
def test_ends_that_matter_little_or_are_not_reached_keep_the_tolerance(
    cut_off, which, tolerance_db
):
    lines, images = cut_off
    grid, exact = images[which]
    chosen = clsas.plan(lines, grid, tolerance_db=tolerance_db)
    found_db = relative_error_db(clsas.factorize(lines, grid, chosen), exact)
    assert found_db <= chosen.predicted_error_db <= tolerance_db


@pytest.mark.parametrize("accuracy_db", [-50, -60, -70])
def test_exact_images_too_tell_of_ends_that_do_not_fade(cut_off, accuracy_db):
    lines, ((grid, exact), _) = cut_off
    with pytest.warns(ClsasWarning, match=f"do not fade.* instead of `accuracy_db` {accuracy_db}"):
        image = clsas.backproject(lines, grid, accuracy_db=accuracy_db)
    predicted_db = prepare(lines, grid, accuracy_db=accuracy_db).error_db
    assert accuracy_db < predicted_db < -35
    assert relative_error_db(image, exact) <= predicted_db


@pytest.mark.parametrize(("which", "accuracy_db"), [(0, -30), (1, -30), (1, -50), (1, -70)])
def test_exact_images_keep_their_accuracy_where_ends_matter_little(cut_off, which, accuracy_db):
    lines, images = cut_off
    grid, exact = images[which]
    image = clsas.backproject(lines, grid, accuracy_db=accuracy_db)
    assert relative_error_db(image, exact) <= accuracy_db


@pytest.mark.parametrize("share", [0.1, 0.45])
def test_the_rest_makes_up_for_ends_that_take_some_of_what_is_allowed(cut_off, share):
    """Predictions with the ends stay within the tolerance, without a warning."""
    lines, ((grid, exact), _) = cut_off
    tolerance_db = 10 * math.log10(
        ends_error(lines, grid, measure_spectrum(lines), None, None) / share
    )
    chosen = clsas.plan(lines, grid, tolerance_db=tolerance_db)
    assert chosen.predicted_error_db <= tolerance_db
    assert prepare(lines, grid, accuracy_db=tolerance_db).error_db <= tolerance_db
    assert relative_error_db(clsas.factorize(lines, grid, chosen), exact) <= tolerance_db


@pytest.fixture(scope="module")
def four_points():
    """Echoes of four points by two pings of the thesis's sonar, a grid, and its exact image."""
    sonar = clsas.Sonar.thesis_wide_beam()
    track = clsas.Track.straight((-0.264, 0, 0), (2, 0, 0), pings=2, ping_interval_s=0.264)
    points = [(0.0, 42.5, 0), (0.08, 42.505, 0), (-0.07, 42.49, 0), (0.03, 42.512, 0)]
    # The interval keeps the ends of the lines, where echoes still ring, off the grid.
    echoes = clsas.simulate(sonar, track, clsas.PointTargets(points), range_m=(40.0, 45.0))
    grid = Grid.plane((-0.1, 0.1, 128), (42.4, 42.6, 128))
    lines = clsas.compress(echoes, oversampling=4.0)
    return echoes, grid, execute(prepare(lines, grid, accuracy_db=-85))


@pytest.mark.slow
@pytest.mark.parametrize("oversampling", [2.0, 1.4, 1.25, 1.1, 1.06])
def test_thin_guard_bands_keep_what_is_asked(four_points, oversampling):
    echoes, grid, exact = four_points
    lines = clsas.compress(echoes, oversampling=oversampling)
    assert relative_error_db(clsas.backproject(lines, grid, accuracy_db=-80), exact) <= -80
    chosen = clsas.plan(lines, grid, tolerance_db=-50)
    found_db = relative_error_db(clsas.factorize(lines, grid, chosen), exact)
    assert found_db <= chosen.predicted_error_db <= -50


def test_a_band_that_fills_all_that_is_sampled_is_told_with_the_numbers(four_points):
    echoes, grid, exact = four_points
    lines = clsas.compress(echoes, oversampling=1.0)
    message = r"oversampling is 1\.0\d*, but must be above 1.05; the error may be -\d\d dB"
    with pytest.warns(ClsasWarning, match=message):
        image = clsas.backproject(lines, grid, accuracy_db=-80)
    predicted_db = prepare(lines, grid, accuracy_db=-80).error_db
    assert -80 < relative_error_db(image, exact) <= predicted_db < -20
    with pytest.warns(ClsasWarning, match=message):
        assert -50 < clsas.plan(lines, grid, tolerance_db=-50).predicted_error_db < -20


def test_noise_all_over_the_sampled_band_is_no_aliasing(four_points):
    lines = clsas.compress(four_points[0], oversampling=1.5)
    rng = np.random.default_rng(0)
    level = 0.3 * np.sqrt(np.mean(np.abs(lines.samples) ** 2))
    samples = lines.samples + level * (rng.normal(size=(*lines.samples.shape, 2)) @ [1, 1j])
    spectrum = measure_spectrum(dataclasses.replace(lines, samples=samples))
    assert spectrum.aliasing == 0
    assert spectrum.oversampling == pytest.approx(1.5, rel=0.03)
