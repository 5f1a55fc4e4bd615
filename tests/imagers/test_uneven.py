"""Factorized images of scenes whose bands, motions, channels or coverage are uneven."""

import numpy as np
import pytest
from cases import along_x, bright_where_coverage_ends, lines_over
from factorizing import EXACT_IS_SLOW, around, over
from tiers import also, few, thinned

from clsas import plan
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.imaging import backproject, factorize

pytestmark = pytest.mark.slow

TRACK = along_x(300, 0.04)
GRID = around(0, 43, pixel_m=(0.02, 0.02), z=-15)


def assert_kept(lines, grid, tolerance_db, beam=None, *, factorized=True):
    """The image keeps the tolerance, and its prediction."""
    exact = backproject(lines, grid, accuracy_db=-75, beam=beam)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)
    assert chosen.is_exact != factorized
    error_db = relative_error_db(factorize(lines, grid, chosen), exact)
    assert error_db <= chosen.predicted_error_db <= tolerance_db


@pytest.mark.parametrize(("band", "tolerance_db"), thinned([0.005, 0.02, 0.2], [-20, -40]))
def test_narrow_bands_of_receivers_apart_from_the_transmitter(band, tolerance_db):
    """Ranges of such a receiver grow by another factor than those from the mean track."""
    lines, _ = over(GRID, TRACK, TRACK + [0, 0, 10.0], carrier_hz=100e3, band=band)
    assert_kept(lines, GRID, tolerance_db)


@pytest.mark.parametrize(("band", "tolerance_db"), thinned([0.005, 0.1], [-20, -40]))
def test_receivers_whose_velocity_changes(band, tolerance_db):
    velocity = np.random.default_rng(0).normal(0, 5 / np.sqrt(3), TRACK.shape)
    lines, _ = over(GRID, TRACK, carrier_hz=100e3, band=band, velocity=velocity)
    assert_kept(lines, GRID, tolerance_db)


@pytest.mark.parametrize("tolerance_db", [-40, *also(-20)])
@pytest.mark.parametrize("band", [0.005, *also(0.1)])
def test_a_raster_of_receivers_above_the_transmitters(band, tolerance_db):
    row, column = np.mgrid[0:20, 0:40]
    tx_m = 0.1 * np.stack([column - 19.5, 0 * row, row], axis=-1).reshape(-1, 3)
    lines, _ = over(GRID, tx_m, tx_m + [0, 0, 10.0], carrier_hz=100e3, band=band)
    assert_kept(lines, GRID, tolerance_db)


def headings():
    """Three passes on headings 60 degrees apart, and their directions."""
    x_m, tx_m, along = np.linspace(-1.55, 1.55, 312), [], []
    for number, heading in enumerate(np.radians([0, 60, 120])):
        ahead = np.array([np.cos(heading), np.sin(heading), 0])
        aside = np.array([np.sin(heading), -np.cos(heading), 0])
        tx_m.append(x_m[:, None] * ahead + 0.26 * (number + 1) * aside)
        along.append(np.tile(ahead, (312, 1)))
    return np.concatenate(tx_m), np.concatenate(along)


@pytest.mark.parametrize(
    ("x_m", "beam", "tolerance_db"), thinned([0.0, 3.0], ["none", "hann"], [-30, -50])
)
def test_a_beam_that_sees_parts_of_passes(x_m, beam, tolerance_db):
    """At 3 m the first pass leads over the grid, and its beam sees nothing of it."""
    tx_m, along = headings()
    grid = Grid.oriented([x_m - 1, -1, -2], [0, 0.005, 0], [0.005, 0, 0], (400, 400))
    lines = lines_over(grid, tx_m, carrier_hz=30e3, step_m=0.06, occupied=0.7)
    window = BeamWindow(40.0, "hann", along=along) if beam == "hann" else None
    assert_kept(lines, grid, tolerance_db, window)


@pytest.mark.parametrize(("off_wavelengths", "louder_db"), thinned([0.5, 2.0], [40, 20]))
def test_a_loud_channel_off_the_mean_track(off_wavelengths, louder_db):
    """The error of each channel counts with its power."""
    track = along_x(400, 0.035)
    track[173, 1:] += off_wavelengths * 0.05 * np.array([1.0, 0.7])
    grid = around(0, 11.5, pixel_m=(0.01, 0.01))
    lines, _ = over(grid, track, carrier_hz=30e3, band=0.3)
    samples = lines.samples.copy()
    samples[173] *= 10 ** (louder_db / 20)
    loud = RangeLines(samples, lines.first_range_m, lines.range_step_m, track, track, 30e3, 1500.0)
    assert_kept(loud, grid, -30)


BEAM = BeamWindow(20.0, "hann", along=[1, 0, 0])


@pytest.mark.parametrize(
    ("x_m", "seabed", "tolerance_db"),
    few(
        [
            (x_m, seabed, tolerance_db)
            for x_m, seabed in ((4.0, 0), (4.4, 0), (4.8, 0), (4.4, 300))
            for tolerance_db in (-25, -50)
        ],
        often=[(4.8, 0, -50), (4.4, 300, -25)],
    ),
)
def test_bright_points_where_coverage_ends(x_m, seabed, tolerance_db):
    """Most of what the beam passes cancels, and errors do not."""
    lines, grid = bright_where_coverage_ends(x_m, seabed=seabed)
    exact = backproject(lines, grid, accuracy_db=-62, beam=BEAM)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=BEAM, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    error_db = relative_error_db(factorize(lines, grid, chosen), exact)
    assert error_db <= chosen.predicted_error_db <= tolerance_db


def test_a_dark_image_beyond_single_precision_warns():
    lines, grid = bright_where_coverage_ends(4.8)
    with pytest.warns(ClsasWarning, match=r"2\d dB darker than the echoes at its ranges.*-6\d dB"):
        backproject(lines, grid, accuracy_db=-85, beam=BEAM)


def test_lines_of_one_sample_under_a_beam():
    track = along_x(200, 0.02)
    lines = RangeLines(np.ones((200, 1), complex), 10.0, 0.06, track, track, 30e3, 1500.0)
    grid = Grid.plane((0, 60, 31), (9.9, 10.1, 31))
    with pytest.warns(ClsasWarning, match="lines do not fade"):
        image = backproject(lines, grid, beam=BEAM)
    assert np.isfinite(image.pixels).all()
