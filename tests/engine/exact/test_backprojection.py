import dataclasses

import numpy as np
import pytest
from cases import (
    APERTURE,
    CARRIER,
    ORDINARY,
    STEP,
    along_x,
    beside,
    bistatic,
    height_map,
    lines_over,
    made,
    moving,
    noise,
    own_starts,
    patch,
    points,
    rounding_error_db,
    thesis,
    thesis_lines,
    true_error_db,
)
from exactly import execute, prepare, same_interpolator
from hypothesis import given, settings
from hypothesis import strategies as st
from tiers import name_of, thinned

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import list_devices
from clsas.engine.exact.layout import (
    BLOCKS,
    HELD,
    STACK,
    Groups,
    Tiles,
    lookup_options,
    lookup_room,
)
from clsas.engine.imaging import backproject
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

FINE = {"taps": 8, "upsampling": 4}  # an interpolator whose own error is below -100 dB


# Accuracy


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDINARY, ids=lambda case: case.__name__)
def test_rounding_stays_below_80_db(case, device):
    assert rounding_error_db(case, device) <= -80


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interpolator", "case"),
    thinned([(2, 5.0), (4, 4.0), (8, 2.0)], [thesis, height_map]),
    ids=name_of,
)
def test_rounding_does_not_depend_on_the_interpolator(case, device, interpolator):
    taps, upsampling = interpolator
    assert rounding_error_db(case, device, taps=taps, upsampling=upsampling) <= -80


@pytest.mark.slow
def test_the_cases_take_both_ways():
    """A distant plane is divided into tiles, all other grids into groups."""
    assert isinstance(prepare(*made(thesis)).layout, Tiles)
    assert isinstance(prepare(*made(moving)).layout, Tiles)
    assert isinstance(prepare(*made(height_map)).layout, Groups)
    assert isinstance(prepare(*made(points)).layout, Groups)


# Scatter of a mean over a few hundred pixels around its expected value, dB.
SCATTER_DB = 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("accuracy_db", "case"), thinned([-30, -50, -60, -80], [thesis, own_starts]), ids=name_of
)
def test_the_true_error_is_what_was_asked_for(case, platform, accuracy_db):
    image = backproject(*made(case), device=platform, accuracy_db=accuracy_db)
    assert true_error_db(case, image) <= accuracy_db + SCATTER_DB


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDINARY, ids=lambda case: case.__name__)
def test_the_default_accuracy_is_60_db(case):
    assert true_error_db(case, backproject(*made(case))) <= -60 + SCATTER_DB


@pytest.mark.slow
@pytest.mark.parametrize(
    ("taps", "upsampling"), [(2, 1.0), (2, 4.0), (4, 1.5), (4, 3.0), (6, 1.25), (6, 2.0), (8, 1.5)]
)
def test_the_predicted_error_is_the_measured_one(taps, upsampling):
    preparation = prepare(*made(thesis), taps=taps, upsampling=upsampling)
    measured = true_error_db(thesis, execute(preparation))
    assert measured == pytest.approx(preparation.interpolator.error_db, abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("vectors", "parts"), [(1, STACK), (2, 1), (2, 2), (2, STACK)])
@pytest.mark.parametrize("taps", [2, 4, 6, 8])
def test_samples_are_looked_up_wherever_pixels_lie(device, taps, vectors, parts, mirrored):
    """The farthest pixel of a part of a work-item lies just within a window."""
    track = APERTURE[len(APERTURE) // 2 :][:16]
    upsampling, nowhere = 8.0, patch(1.3, 41)
    some = prepare(
        thesis_lines(nowhere, track), nowhere, device=device, taps=taps, upsampling=upsampling
    )
    width = device.info.width if device.info.permute else 16
    block_rows, block_columns = BLOCKS[width]
    away = np.array([STACK // parts * block_rows - 1, block_columns - 1]) / 2
    pitch_m = 0.99 * lookup_room(vectors, taps, width) / some.samples_per_m / np.linalg.norm(away)
    down, across = away / np.linalg.norm(away)
    row_m, column_m = pitch_m * np.array([[across, down, 0], [-down, across, 0]])
    if mirrored:
        row_m, column_m = pitch_m * np.array([[across, -down, 0], [down, across, 0]])
    grid = Grid.oriented([track[8, 0], 42, 0], row_m, column_m, (32, 8))
    lines = thesis_lines(grid, track)
    preparation = prepare(lines, grid, device=device, taps=taps, upsampling=upsampling)
    layout = preparation.layout
    assert isinstance(layout, Tiles)
    options = lookup_options(device, layout, lines, preparation.samples_per_m, taps)
    offered = vectors == 2 if width == HELD else parts == STACK
    if device.info.permute and offered:
        assert (options["PERMUTE"], options["WINDOWS"]) == (vectors, parts)
    wanted = same_interpolator(preparation, grid.positions_m())
    assert relative_error_db(execute(preparation), wanted) <= -80


@pytest.mark.parametrize("channels", [1, 15, 16, 17, 511, 513])
def test_any_number_of_channels(device, channels):
    grid = patch(1.3, 42, 9, 7)
    lines = thesis_lines(grid, APERTURE[:channels])
    preparation = prepare(lines, grid, device=device, **FINE)
    wanted = same_interpolator(preparation, grid.positions_m())
    assert relative_error_db(execute(preparation), wanted) <= -80


@pytest.mark.parametrize(
    ("shape", "kind"),
    thinned([(1, 1), (1, 40), (3, 5), (17, 33), (65, 2)], ["plane", "heights", "points"]),
)
def test_any_shape_of_grid(device, shape, kind):
    grid = patch(1.3, 42, shape[1], shape[0])
    if kind == "heights":
        grid = grid.with_height(np.random.default_rng(1).normal(0, 0.3, shape))
    if kind == "points":
        grid = Grid.points(grid.positions_m())
    lines = thesis_lines(grid, APERTURE[::64])
    preparation = prepare(lines, grid, device=device, **FINE)
    wanted = same_interpolator(preparation, grid.positions_m())
    image = execute(preparation)
    assert image.pixels.shape == shape
    assert relative_error_db(image, wanted) <= -80


@pytest.mark.slow
@settings(max_examples=25)
@given(st.data())
def test_any_geometry(data):
    """Antennas, motion and planes of any direction at 1 MHz, imaged on the default device."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    distance_m = data.draw(st.sampled_from([0.3, 3.0, 30.0, 300.0]))
    tx = rng.normal(0, 0.3, (20, 3)) * distance_m
    rx = tx + rng.normal(0, 0.05, (20, 3)) if data.draw(st.booleans()) else tx
    velocity = rng.uniform(-5, 5, (20, 3)) if data.draw(st.booleans()) else None
    steps = rng.normal(0, 2e-3, (2, 3))
    centre = rng.normal(size=3)
    centre *= distance_m / np.linalg.norm(centre)
    grid = Grid.oriented(centre, *steps, (19, 23))
    lines = thesis_lines(grid, tx, rx, velocity=velocity, own_start=True)
    preparation = prepare(lines, grid, **FINE)
    wanted = same_interpolator(preparation, grid.positions_m())
    assert relative_error_db(execute(preparation), wanted) <= -80


# Physics


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [1, -2j, 3 * np.exp(1.1j)])
def test_a_point_keeps_its_amplitude_and_phase(platform, amplitude):
    rng = np.random.default_rng(2)
    track = APERTURE[::10] + rng.normal(0, 0.05, APERTURE[::10].shape)
    target = [0.31, 41.7, -3.2]
    lines = simulate_lines(
        track, beside(track, 0.1, 0, 0), PointTargets([target], [amplitude]),
        carrier_hz=CARRIER, bandwidth_hz=1e5, rx_velocity_m_s=[2.0, 0, 0],
    )  # fmt: skip
    image = backproject(lines, Grid.points([target]), device=platform, accuracy_db=-60)
    assert abs(image.pixels[0] / (len(track) * amplitude) - 1) <= 1e-3


def test_a_gaussian_pulse_gives_the_closed_form(platform):
    """For lines p(r) exp(-2jk rho) with a Gaussian p the image is known in closed form."""
    track, target = along_x(40, 0.02), np.array([[0.1, 8.0, -1.0]])
    grid = patch(0.08, 7.95, 21, 17, z=-1.0)
    rho = np.linalg.norm(target - track, axis=1)
    r = 7.0 + STEP * np.arange(400)
    k = 2 * np.pi * CARRIER / 1500
    pulse_m = 3 * STEP
    samples = np.exp(-(((r - rho[:, None]) / pulse_m) ** 2) - 2j * k * rho[:, None])
    lines = RangeLines(samples, 7.0, STEP, track, track, CARRIER, 1500.0)
    range_m = np.linalg.norm(grid.positions_m()[..., None, :] - track, axis=-1)
    wanted = np.exp(-(((range_m - rho) / pulse_m) ** 2) + 2j * k * (range_m - rho)).sum(axis=-1)
    image = backproject(lines, grid, device=platform, accuracy_db=-80)
    assert relative_error_db(image, wanted) <= -80


def test_a_point_beyond_a_line_gets_exactly_nothing(device):
    """Half of the grid lies beyond the end of one line, and a part before its beginning."""
    grid = Grid.plane((0, 0, 1), (40, 42, 400))
    track = np.zeros((1, 3))
    lines = RangeLines(np.ones((1, 100), complex), 40.4, STEP, track, track, CARRIER, 1500.0)
    pixels = backproject(lines, grid, device=device, taps=4, upsampling=2).pixels[:, 0]
    place = (grid.axes_m[1] - 40.4) / STEP
    inside = (place >= 0) & (place <= 99)
    beyond = (place < -2) | (place > 99 + 2)  # a filter: 4 taps at twice the rate
    assert beyond.sum() > 250
    assert not pixels[beyond].any()
    assert np.all(np.abs(pixels[inside]) > 0.3)


def test_far_parts_of_a_grid_get_exactly_nothing(device):
    """Points lie from 1 m to 1000 km, and the line extends from 40 m to 43 m."""
    rng = np.random.default_rng(4)
    away = np.concatenate([10 ** rng.uniform(0, 6, 500), rng.uniform(40.5, 42.5, 50)])
    way = rng.normal(size=(550, 3))
    grid = Grid.points(way * (away / np.linalg.norm(way, axis=1))[:, None])
    lines = RangeLines(noise(1, 500), 40.0, STEP, [0, 0, 0], [0, 0, 0], CARRIER, 1500.0)
    preparation = prepare(lines, grid, device=device, **FINE)
    pixels = execute(preparation).pixels
    place = (away - 40) / STEP
    beyond = (place < -3) | (place > 502)
    assert beyond.sum() > 400
    assert not pixels[beyond].any()
    assert relative_error_db(pixels, same_interpolator(preparation, grid.points_m)) <= -80


# Invariants


def test_transmitter_and_receiver_may_be_exchanged(platform):
    lines, grid = made(bistatic)
    exchanged = dataclasses.replace(lines, tx_m=lines.rx_m, rx_m=lines.tx_m)
    one, other = (backproject(each, grid, device=platform, **FINE) for each in (lines, exchanged))
    assert relative_error_db(other, one) <= -100


@pytest.mark.slow
@pytest.mark.parametrize("case", [bistatic, height_map], ids=lambda case: case.__name__)
def test_a_receiver_that_stands_still_may_be_called_moving(case, platform):
    lines, grid = made(case)
    still = dataclasses.replace(lines, rx_velocity_m_s=[0.0, 0, 0])
    image = backproject(still, grid, device=platform, **FINE)
    assert relative_error_db(image, backproject(lines, grid, device=platform, **FINE)) <= -100


def similar_lines(grid):
    """Return lines with one power spectrum, so that all parts get the same interpolator."""
    lines = lines_over(grid, APERTURE, carrier_hz=CARRIER, step_m=STEP)
    turn = np.exp(2j * np.pi * np.random.default_rng(5).random((640, 1)))
    return dataclasses.replace(lines, samples=lines.samples[:1] * turn)


@pytest.mark.parametrize("case", ["plane", "heights"])
@pytest.mark.parametrize(("first", "most_db"), [(70, -120), (7, -105)])
def test_parts_add_up_to_the_whole(platform, case, first, most_db):
    """Images of few channels may have smaller tiles, which are rounded differently."""
    grid = patch(1.3, 42)
    if case == "heights":
        grid = grid.with_height(np.full(grid.shape, 0.25))
    lines = similar_lines(grid)
    image = None
    for part in (slice(0, first), slice(first, 300), slice(300, 640)):
        image = backproject(lines.select(part), grid, device=platform, accumulate=image, **FINE)
    whole = backproject(lines, grid, device=platform, **FINE)
    assert relative_error_db(image, whole) <= most_db


def test_accumulation_leaves_its_argument_alone(platform):
    grid = patch(1.3, 42, 5, 3)
    lines = thesis_lines(grid, APERTURE[::64])
    before = Image(np.full((3, 5), 1 + 2j), patch(1.3, 42, 5, 3))  # an equal grid, not the same
    image = backproject(lines, grid, device=platform, accumulate=before)
    alone = backproject(lines, grid, device=platform)
    np.testing.assert_array_equal(before.pixels, np.full((3, 5), 1 + 2j))
    np.testing.assert_array_equal(image.pixels, before.pixels + alone.pixels)


@pytest.mark.slow
def test_part_of_a_grid_is_part_of_the_image(platform):
    lines, grid = made(bistatic)
    whole = backproject(lines, grid, device=platform, **FINE).pixels[5:30, 3:20]
    part = backproject(lines, grid.window(slice(5, 30), slice(3, 20)), device=platform, **FINE)
    assert relative_error_db(part, whole) <= -80


# Progress


@pytest.mark.parametrize("case", [bistatic, points], ids=lambda case: case.__name__)
def test_progress_is_told_on_the_way(platform, case):
    calls = []
    backproject(*made(case), device=platform, progress=lambda *call: calls.append(call))
    assert len(calls) >= 2


# Nothing to see, and odd input


@pytest.fixture(scope="module")
def good():
    grid = patch(1.3, 42, 4, 4)
    return {"lines": thesis_lines(grid, APERTURE[::64]), "grid": grid}


@pytest.mark.parametrize("kind", ["plane", "points"])
@pytest.mark.parametrize("y", [4.0, 400.0, -4000.0])
def test_a_grid_that_no_line_reaches_warns_and_is_zero(good, platform, y, kind):
    grid = patch(1.3, y, 9, 7)
    if kind == "points":
        grid = Grid.points(grid.positions_m())
    with pytest.warns(ClsasWarning, match=r"span 41\.\d+ to 4\d\.\d+ m, the grid lies at .*\d m"):
        image = backproject(good["lines"], grid, device=platform)
    assert not image.pixels.any()


def test_the_warning_points_at_the_caller(good):
    with pytest.warns(ClsasWarning) as caught:
        backproject(good["lines"], patch(1.3, 400, 2, 2))
    assert caught[0].filename == __file__


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (4, 4)])
def test_a_small_grid_just_short_of_a_line_warns_too(platform, shape):
    """Padding pixels of a tile beyond the grid do not count as reached."""
    grid = Grid.oriented([0, 42, 0], [0, 0.01, 0], [0.01, 0, 0], shape)
    lines = RangeLines(noise(1, 500), 42.08, STEP, [0, 0, 0], [0, 0, 0], CARRIER, 1500.0)
    with pytest.warns(ClsasWarning, match="no pixel"):
        image = backproject(lines, grid, device=platform)
    assert not image.pixels.any()


def test_one_sample_is_a_line(platform):
    """The shortest line: a pulse as wide as a sample."""
    grid = Grid.points([[0, 42, 0], [0, 42 + 4 * STEP, 0]])
    lines = RangeLines([[2 - 1j]], 42.0, STEP, [0, 0, 0], [0, 0, 0], CARRIER, 1500.0)
    pixels = backproject(lines, grid, device=platform, taps=8, upsampling=8).pixels
    phase = np.exp(2j * lines.wavenumber_rad_m * 42.0)
    assert pixels[0] == pytest.approx((2 - 1j) * phase, abs=2e-3)
    assert pixels[1] == 0


@pytest.mark.slow
def test_a_device_may_be_named(good):
    for info in list_devices():
        by_index = backproject(**good, device=info.index)
        by_name = backproject(**good, device=info.label)
        np.testing.assert_array_equal(by_index.pixels, by_name.pixels)
