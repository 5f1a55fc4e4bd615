import dataclasses
import itertools

import numpy as np
import pytest
from cases import along_x, beside, noise
from factorizing import (
    BAND,
    BEAMS,
    CARRIER,
    EXACT_IS_SLOW,
    HANN,
    SPEED,
    TRACK,
    arc,
    around,
    bistatic_array,
    changed,
    exact,
    hills,
    made,
    moving_array,
    near,
    over,
    peak_device_bytes,
    planned,
    straight,
    swaying,
    swaying_while_moving,
    with_gap,
)
from tiers import also, name_of, thinned

from clsas import plan
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.errors import HALF_ROUNDING
from clsas.engine.factorized.plan import Plan
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import backproject, factorize
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

STEP = 0.8 * SPEED / (2 * BAND * CARRIER)


def low_frequency():
    grid = around(0, 100, pixel_m=(0.0375, 0.047))
    return over(grid, along_x(600, 0.05), carrier_hz=20e3, band=0.5)


def high_frequency():
    grid = around(0, 40, pixel_m=(0.00375, 0.0075))
    return over(grid, along_x(500, 8e-3), carrier_hz=1e6, band=0.1)


def far():
    grid = around(0, 300, pixel_m=(0.06, 0.1))
    return over(grid, along_x(400, 0.04), band=0.05)


def jittery():
    off_m = np.random.default_rng(1).normal(0, 0.01, TRACK.shape) * [0, 1, 0.5]
    return over(around(0, 40), TRACK + off_m)


def backwards():
    return over(around(0, 40), TRACK[::-1])


def shuffled():
    return over(around(0, 40), np.random.default_rng(1).permutation(TRACK))


def own_starts():
    return over(around(0, 40), own_start=True)


def circle():
    turn = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    track = np.stack([8 * np.cos(turn), 8 * np.sin(turn), 0 * turn + 3], axis=1)
    return over(around(0, 0, pixel_m=(0.004, 0.004)), track, carrier_hz=60e3)


def squinted():
    return over(around(25, 40))


def deep():
    return over(around(0, 37, z=-15.0))


def oriented():
    """A steep plane whose rows and columns are not perpendicular."""
    steps = [0.003, 0.012, 0.006], [0.012, 0.006, -0.001]
    return over(Grid.oriented([-1, 39, -8], *steps, (140, 150)))


def one_sided_band():
    return over(around(0, 40), centre=0.3, occupied=0.5)


def coarse_pixels():
    """A quick look: pixels 20 times as large as the range resolution."""
    return over(around(0, 300, pixel_m=(0.3, 0.3)), along_x(400, 0.025), band=0.5)


def rough():
    """A height map of white noise."""
    grid = around(0, 40)
    return over(grid.with_height(np.random.default_rng(0).normal(0, 0.05, grid.shape)))


def cliff():
    grid = around(0, 40, z=-10)
    row, column = np.indices(grid.shape)
    return over(grid.with_height(1.5 * (row + 0.5 * column > 110)))


def hills_while_moving():
    """The hills, imaged by an array of receivers that move during flight."""
    return made(moving_array)[0], made(hills)[1]


def scattered():
    """Random points in two clusters, one denser than the other, with a gap between them."""
    rng = np.random.default_rng(5)
    points_m = np.concatenate([rng.normal(0, 0.4, (6000, 3)), rng.uniform(-1, 1, (6000, 3))])
    points_m[:, 2] *= 0.1
    points_m[6000:, 0] += 3
    return over(Grid.points(points_m + [0, 40, -5]))


def volume():
    """Random points in a box, some of them twice."""
    points_m = np.random.default_rng(6).uniform(-0.4, 0.4, (5000, 3)) + [0, 40, 0]
    return over(Grid.points(np.concatenate([points_m, points_m[:500]])))


def section():
    """An upright plane of points along the track, [rows, columns, 3]."""
    x, z = np.meshgrid(np.linspace(-1, 1, 120), np.linspace(-20, -18.5, 100))
    return over(Grid.points(np.stack([x, 0 * x + 30, z], axis=-1)))


def profile():
    """Points in a row."""
    along = np.linspace(0, 1, 4000)[:, None]
    return over(Grid.points([-1, 39, 0] + along * [2, 3, -1]))


OFF_A_PLANE = (hills, rough, cliff, hills_while_moving, scattered, volume, section, profile)
STRAIGHT = (straight, low_frequency, high_frequency, far, near, squinted, deep, oriented)
TRACKS = (
    swaying,
    jittery,
    backwards,
    shuffled,
    own_starts,
    bistatic_array,
    moving_array,
    swaying_while_moving,
)
CASES = (*STRAIGHT, *TRACKS, arc, circle, one_sided_band, *OFF_A_PLANE)


def check(case, tolerance_db, device, beam=None):
    """Check that the error is within the tolerance and at most 6 dB below its predicted bound."""
    chosen = planned(case, tolerance_db, beam)
    assert not chosen.is_exact
    image = factorize(*made(case), chosen, device=device)
    error_db = relative_error_db(image, exact(case, beam))
    assert error_db <= chosen.predicted_error_db <= tolerance_db
    assert chosen.predicted_error_db <= error_db + 6


# Tolerances


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-20, -40, -60, -75])
def test_the_error_is_what_was_asked_for(device, tolerance_db):
    check(swaying, tolerance_db, device)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "tolerance_db"),
    thinned(CASES, [-50, -10, -65], whole=(near, swaying, hills)),
    ids=name_of,
)
def test_whatever_the_track_and_the_grid(case, tolerance_db):
    check(case, tolerance_db, None)


def test_receivers_that_move_during_flight_off_a_plane():
    check(hills_while_moving, -65, None)


@pytest.mark.parametrize(
    "case", [straight, low_frequency, near, swaying, moving_array], ids=name_of
)
def test_the_tightest_tolerance(case):
    check(case, -75, None)


@pytest.mark.slow
@pytest.mark.parametrize("case", [bistatic_array, moving_array, arc, hills, scattered], ids=name_of)
def test_on_every_platform(case, platform):
    check(case, -50, platform)


@pytest.mark.slow
@pytest.mark.parametrize(("band", "tolerance_db"), thinned([0.05, 0.3], [-30, -50]))
def test_a_point_where_subimages_of_all_sizes_meet(band, tolerance_db):
    """Phases turn fastest at the corners of subimages, where errors of filters are largest."""
    grid = around(0, 40, shape=(512, 512))
    request = {"tolerance_db": tolerance_db, "costs": EXACT_IS_SLOW}
    radio = {"carrier_hz": CARRIER, "bandwidth_hz": band * CARRIER}

    def lines_of(row, column):
        place_m = grid.origin_m + row * grid.row_step_m + column * grid.column_step_m
        return simulate_lines(TRACK, TRACK, PointTargets(place_m[None], [1.0]), **radio)

    rows, columns = plan(lines_of(255.5, 255.5), grid, **request).sides[0]
    lines = lines_of(256 // rows * rows - 0.5, 256 // columns * columns - 0.5)
    chosen = plan(lines, grid, **request)
    assert chosen.sides[0] == (rows, columns)
    formed = factorize(lines, grid, chosen)
    assert relative_error_db(formed, form_exactly(lines, grid, accuracy_db=-80)) <= tolerance_db


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-20, -40])
def test_pixels_much_coarser_than_the_resolution(device, tolerance_db):
    check(coarse_pixels, tolerance_db, device)


def wide_image():
    """An image much wider than the aperture, so that few channels cover each pixel."""
    grid = around(0, 40, pixel_m=(0.015, 0.06), shape=(100, 240))
    return over(grid, along_x(200, 0.014))


def few_arrays():
    """168 channels all around the image, in groups of four."""
    angle = np.repeat(np.linspace(0, 2 * np.pi, 42, endpoint=False), 4)[:, None]
    radius = 20 * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    along = np.concatenate([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    tx = radius + [0, 40, 0]
    return over(around(0, 40), tx, tx + along * np.tile(0.1 * np.arange(4), 42)[:, None])


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-30, -50])
def test_a_beam_that_hides_most_of_the_image(tolerance_db):
    lines, grid = made(wide_image)
    beam = BeamWindow(9, "hann")
    image = factorize(lines, grid, planned(wide_image, tolerance_db, beam))
    assert relative_error_db(image, exact(wide_image, beam)) <= tolerance_db


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-20, -35, -50])
def test_arrays_whose_channels_come_in_regular_steps(tolerance_db):
    lines, grid = made(few_arrays)
    chosen = planned(few_arrays, tolerance_db)
    assert relative_error_db(factorize(lines, grid, chosen), exact(few_arrays)) <= tolerance_db


KINKED = (
    BeamWindow(8, "tukey", squint_deg=2.0, taper=0.2),
    *(BeamWindow(12, shape) for shape in ("tukey", "hamming", "taylor")),
)


@pytest.mark.slow
@pytest.mark.parametrize(("beam", "tolerance_db"), thinned(BEAMS, [-20, -50, -65]))
def test_with_a_beam(beam, tolerance_db):
    check(near, tolerance_db, None, beam)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beam", "tolerance_db"),
    thinned(KINKED, [-20, -50, -65]),
)
def test_windows_with_kinks_and_steps_keep_the_tolerance(beam, tolerance_db):
    """The image may be exact: virtual channels and blocks of pixels follow such windows poorly."""
    lines, grid = made(near)
    chosen = planned(near, tolerance_db, beam)
    exact = backproject(lines, Grid.points(grid.positions_m()), accuracy_db=-85, beam=beam)
    assert relative_error_db(factorize(lines, grid, chosen).pixels, exact.pixels) <= tolerance_db


def few_channels(y, channels, spacing_m, *, pixel_m, off_m=0.0, **more):
    """A small image with few channels in the beam, at random offsets of `off_m` from the track."""
    off = np.random.default_rng(1).normal(0, off_m, (channels, 3)) * [0.3, 1, 0.5]
    grid = around(0, y, shape=(96, 96), pixel_m=pixel_m)
    return over(grid, along_x(channels, spacing_m) + off, **more)


def jittery_and_few(off_m):
    return few_channels(110, 315, 0.457, pixel_m=(0.006, 0.004), off_m=off_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    "costs",
    [EXACT_IS_SLOW, pytest.param(None, marks=pytest.mark.exhaustive)],
    ids=["forced", "as they are"],
)
@pytest.mark.parametrize(
    ("case", "beam", "tolerance_db"),
    [
        (
            lambda: few_channels(50, 240, 0.3, pixel_m=(0.005, 0.005)),
            BeamWindow(12, "hamming"),
            -50,
        ),
        (lambda: few_channels(117, 260, 0.36, pixel_m=(0.004, 0.006)), BeamWindow(6.8), -60),
        (lambda: few_channels(40, 150, 0.22, pixel_m=(0.02, 0.01)), BeamWindow(3.6, "hann"), -20),
        (lambda: jittery_and_few(0.03), BeamWindow(2.4), -20),
        (lambda: jittery_and_few(0.03), BeamWindow(2.4), -40),
        (lambda: jittery_and_few(0.01), BeamWindow(2.4, "hann"), -40),
        (
            lambda: few_channels(8.7, 438, 0.0078, pixel_m=(0.004, 0.008), carrier_hz=300e3),
            BeamWindow(3.4, "tukey", taper=0.2),
            -25,
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:the beam of 2.4 degrees resolves")  # 37 of these pixels
def test_edges_of_a_beam_with_few_channels(case, beam, tolerance_db, costs):
    """Edges and kinks of the beam lie between the last channel inside it and the next."""
    lines, grid = case()
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=costs)
    exact = backproject(lines, grid, accuracy_db=-80, beam=beam)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= tolerance_db


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-25, *also(-40)])
def test_a_track_that_turns_back_within_a_few_channels(tolerance_db):
    """Channels at the turn are farther from the mean track than all others."""
    there, back = along_x(227, 0.1011), along_x(228, 0.1006)[::-1] + [0, -2.41, 0]
    grid = around(-10.86, 41.35, pixel_m=(0.0059, 0.0034), shape=(158, 74), z=-12.46)
    lines, grid = over(grid, np.concatenate([there, back]), band=0.05)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    exact = backproject(lines, grid, accuracy_db=-80)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= tolerance_db


@pytest.mark.slow
def test_a_beam_on_every_platform(platform):
    check(near, -40, platform, HANN)


NORMALISED = dataclasses.replace(HANN, normalise=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "tolerance_db"), thinned([near, arc, bistatic_array, hills], [-30, -50]), ids=name_of
)
def test_a_normalised_image(case, tolerance_db):
    check(case, tolerance_db, None, NORMALISED)


@pytest.mark.slow
@pytest.mark.parametrize("case", [near, hills], ids=name_of)
def test_a_normalised_image_on_every_platform(case, platform):
    check(case, -40, platform, NORMALISED)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "tolerance_db"), thinned([hills, scattered, section], [-25, -55]), ids=name_of
)
def test_off_a_plane_with_a_beam(case, tolerance_db):
    check(case, tolerance_db, None, HANN)


def spiked(shape, pixel_m, depth_m, spike_m, tracks):
    grid = around(0, 0 if depth_m else 40, shape=shape, pixel_m=pixel_m, z=-depth_m)
    height_m = np.zeros(shape)
    height_m[shape[0] // 3, shape[1] // 3] = spike_m
    return over(grid.with_height(height_m), *tracks)


def off_track():
    turn = np.linspace(0, 3 * np.pi, len(TRACK))
    return (TRACK + 0.1 * np.stack([0 * turn, np.sin(turn), 0.5 * np.cos(turn)], axis=1),)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wild",
    [
        lambda: spiked((200, 100), (0.03, 0.03), 0.5, -2.0, (along_x(300, 0.01),)),
        lambda: spiked((300, 3), (0.08, 0.01), 0.5, -3.0, (along_x(300, 0.01),)),
        lambda: spiked((150, 160), (0.015, 0.015), 0, 4.0, off_track()),
        lambda: spiked((150, 160), (0.015, 0.015), 0, 4.0, (TRACK, beside(TRACK, 0.2, 0, 0))),
    ],
    ids=["below the track", "a strip below it", "off the track", "apart"],
)
@pytest.mark.parametrize("tolerance_db", [-50, *also(-30)])
def test_spikes_keep_the_tolerance(wild, tolerance_db):
    """The prediction includes a box whose relief exceeds its distance, or that of all others."""
    lines, grid = wild()
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    reference = backproject(lines, grid, accuracy_db=-85)
    assert relative_error_db(factorize(lines, grid, chosen), reference) <= tolerance_db


@pytest.mark.slow
def test_a_height_map_is_its_points(platform):
    lines, grid = made(hills)
    points = Grid.points(np.random.default_rng(0).permutation(grid.positions_m().reshape(-1, 3)))
    order = np.lexsort(points.points_m.T)
    of_map, of_points = (
        factorize(lines, each, plan(lines, each, tolerance_db=-60, costs=EXACT_IS_SLOW),
                  device=platform).pixels.ravel()
        for each in (grid, points)
    )  # fmt: skip
    same = np.lexsort(grid.positions_m().reshape(-1, 3).T)
    assert relative_error_db(of_points[order], of_map[same]) <= -57


@pytest.mark.slow
def test_a_flat_height_map_is_a_plane(platform):
    lines, grid = made(straight)
    flat = grid.with_height(np.zeros(grid.shape))
    chosen = plan(lines, flat, tolerance_db=-60, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    image = factorize(lines, flat, chosen, device=platform)
    assert relative_error_db(image.pixels, exact(straight).pixels) <= -60


@pytest.mark.slow
def test_a_beam_with_edges_gets_a_bounded_number_of_virtual_channels():
    """A rectangular window is not band-limited, so that denser virtual channels help little."""
    chosen = planned(near, -30, BeamWindow(12))
    assert all(stage.channels <= 4 * made(near)[0].channels for stage in chosen.stages)
    image = factorize(*made(near), chosen)
    assert relative_error_db(image, exact(near, BeamWindow(12))) <= -30


@pytest.mark.slow
@pytest.mark.parametrize("stages", [[(4, 2)], [(4, 2), (4, 2)], [(2, 1)], [(2, 3), (3, 2)]])
def test_given_stages_err_less_than_predicted(platform, stages):
    lines, grid = made(high_frequency)
    chosen = plan(lines, grid, stages=stages)
    error_db = relative_error_db(
        factorize(lines, grid, chosen, device=platform), exact(high_frequency)
    )
    assert error_db <= chosen.predicted_error_db


def test_no_stages_are_plain_backprojection(platform):
    lines, grid = made(straight)
    chosen = plan(lines, grid, stages=[])
    assert chosen.is_exact
    image = factorize(lines, grid, chosen, device=platform)
    assert relative_error_db(image, exact(straight)) <= -60


def test_exact_plans_keep_their_beam(platform):
    lines, grid = made(straight)
    beam = BeamWindow(10.0, "hann")
    chosen = plan(lines, grid, stages=[], beam=beam)
    image = factorize(lines, grid, chosen, device=platform)
    reference = backproject(lines, grid, beam=beam, accuracy_db=-70, device=platform)
    assert relative_error_db(image, reference) <= -60


# Physics


@pytest.mark.slow
def test_a_point_on_a_hill_keeps_its_amplitude_and_phase(platform):
    """All lines add up in phase only if the height map is right."""
    row, column = np.indices((65, 65))
    grid = around(0.3, 40.6, shape=(65, 65), z=-13.0)
    grid = grid.with_height(0.2 * np.sin(row / 9) * np.cos(column / 7))
    target = grid.positions_m()[32, 32]
    lines = simulate_lines(
        TRACK, beside(TRACK, 0.05, 0, 0), PointTargets([target], [-2j]),
        carrier_hz=CARRIER, bandwidth_hz=BAND * CARRIER,
    )  # fmt: skip
    chosen = plan(lines, grid, tolerance_db=-55, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    pixels = factorize(lines, grid, chosen, device=platform).pixels
    assert abs(pixels[32, 32] / (len(TRACK) * -2j) - 1) <= 3e-3
    assert np.unravel_index(np.abs(pixels).argmax(), pixels.shape) == (32, 32)


@pytest.mark.slow
def test_pixels_outside_the_beam_of_every_channel_are_zero(platform):
    grid = around(14, 40, shape=(20, 400), pixel_m=(0.015, 0.06))
    lines, _ = over(grid)
    beam = BeamWindow(10, "hann")
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    reference = backproject(lines, grid, accuracy_db=-85, beam=beam)
    image = factorize(lines, grid, chosen, device=platform)
    x = grid.axes_m[0]
    last_m = TRACK[-1, 0] + 41 * np.tan(np.radians(6))
    assert (x > last_m).sum() > 50
    assert not image.pixels[:, x > last_m].any()
    assert relative_error_db(image, reference) <= -40


# Few channels, few pixels, unusual positions


SHAPES = [(1, 160), (160, 1), (2, 90), (90, 2), (17, 33), (67, 131), (300, 20)]


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_any_shape_of_grid(shape):
    grid = around(0, 40, shape=shape)
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, chosen)
    assert image.pixels.shape == shape
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -50


@pytest.mark.slow
def test_a_line_of_pixels_needs_no_second_step(platform):
    """`Grid.plane` gives a single column a step of zero."""
    grid = Grid.plane((0.3, 0.3, 1), (39, 41, 60))
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, chosen, device=platform)
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -50


@pytest.mark.slow
@pytest.mark.parametrize(("channels", "spacing_m"), thinned([1, 2, 3, 5, 17], [0.005, 0.2]))
def test_any_number_of_channels(channels, spacing_m):
    grid = around(0, 40, shape=(70, 60))
    lines, _ = over(grid, along_x(channels, spacing_m))
    chosen = plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, chosen)
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -50


def test_one_pixel():
    grid = around(0, 40, shape=(1, 1))
    lines, _ = over(grid)
    image = factorize(lines, grid, -50)
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -50


@pytest.mark.slow
@pytest.mark.parametrize("places", [1, 2, 5])
@pytest.mark.filterwarnings("ignore:.*have exactly the position of another one")
def test_channels_that_share_places(places):
    grid = around(0, 40, shape=(70, 60))
    lines, _ = over(grid, np.repeat(along_x(places, 1.5), 60 // places, axis=0))
    chosen = plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, chosen)
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -50


@pytest.mark.slow
@pytest.mark.parametrize(
    "grid",
    [
        around(0, 0, pixel_m=(0.01, 0.01), shape=(120, 130)),
        around(0, 0.6, pixel_m=(0.01, 0.01), shape=(100, 130)),
        around(4.2, 0, pixel_m=(0.01, 0.01), shape=(100, 130)),
        around(0, 3, pixel_m=(0.01, 0.01), shape=(100, 130)),
    ],
    ids=["among the channels", "beside them", "at the end", "nearer than the aperture is long"],
)
@pytest.mark.filterwarnings("ignore:the track leads to the grid")  # at the end
def test_pixels_near_the_aperture(grid):
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-45, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, chosen)
    assert relative_error_db(image, backproject(lines, grid, accuracy_db=-85)) <= -45


@pytest.mark.slow
def test_a_grid_that_no_line_reaches_warns_and_is_zero():
    lines, _ = made(straight)
    grid = around(0, 400)
    with pytest.warns(ClsasWarning, match="no pixel"):
        chosen = plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    for each in (chosen, Plan.from_json(chosen.to_json())):
        with pytest.warns(ClsasWarning, match="no pixel"):
            image = factorize(lines, grid, each)
        assert not image.pixels.any()


# Half precision


def halved(case, tolerance_db):
    """A plan with lines in half precision, for any device."""
    return changed(planned(case, tolerance_db), half_precision=True)


@pytest.mark.slow
def test_half_precision_adds_what_is_predicted(device):
    chosen = halved(swaying, -50)
    single = changed(chosen, half_precision=False)
    image, better = (factorize(*made(swaying), each, device=device) for each in (chosen, single))
    expected_db = in_db(1.3 * HALF_ROUNDING * (len(chosen.sides) + 1))
    assert expected_db - 3 <= relative_error_db(image, better) <= expected_db


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:phase centres are")  # closer than any sonar's
@pytest.mark.parametrize(("length_m", "tolerance_db"), thinned([0.3, 1.0], [-50, -56]))
def test_dense_channels_keep_the_tolerance(length_m, tolerance_db):
    """Virtual channels are sums of hundreds of channels, which half precision rounds many times."""
    grid = around(0, 40, shape=(64, 64))
    lines, _ = over(grid, along_x(20000, length_m / 20000))
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    reference = backproject(lines, grid, accuracy_db=-85)
    error_db = relative_error_db(factorize(lines, grid, chosen), reference)
    assert error_db <= chosen.predicted_error_db <= tolerance_db


def test_loud_samples_outside_the_image(platform):
    """They determine the scale of lines. Single precision is used if half is then too coarse."""
    lines, grid = made(straight)
    loud = 1e7 * noise(lines.channels, 300)
    longer = dataclasses.replace(
        lines,
        samples=np.concatenate([loud, lines.samples], axis=1),
        first_range_m=lines.first_range_m - 300 * lines.range_step_m,
    )
    chosen = plan(longer, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    chosen = changed(chosen, half_precision=True)
    with pytest.warns(ClsasWarning, match="single precision, not in half"):
        image = factorize(longer, grid, chosen, device=platform)
    assert relative_error_db(image, exact(straight)) <= -50


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 7e4, 1e25, 1e32])
def test_the_scale_of_samples_does_not_matter(scale, platform):
    lines, grid = made(straight)
    largest = np.abs(lines.samples).max()
    scaled = dataclasses.replace(lines, samples=np.complex64(scale / largest) * lines.samples)
    image = factorize(scaled, grid, halved(straight, -50), device=platform).pixels
    assert relative_error_db(image / np.float32(scale) * largest, exact(straight)) <= -50


def test_lines_too_small_for_half_precision_are_kept_in_single():
    lines, grid = made(straight)
    tiny = dataclasses.replace(lines, samples=np.complex64(1e-37) * lines.samples)
    with pytest.warns(ClsasWarning, match="single precision, not in half"):
        image = factorize(tiny, grid, halved(straight, -50)).pixels
    assert relative_error_db(image / np.float32(1e-37), exact(straight)) <= -50


def test_faint_echoes_next_to_strong_ones_are_kept(platform):
    """Half precision rounds relative to each sample, not to the largest, 80 dB stronger."""
    lines, grid = made(straight)
    range_m = lines.first_range_m[:, None] + np.arange(lines.length) * lines.range_step_m
    fades = 10.0 ** (-4 * np.clip(range_m - 39.5, 0, 1))
    fading = dataclasses.replace(lines, samples=(lines.samples * fades).astype(np.complex64))
    chosen = halved(straight, -50)
    single = changed(chosen, half_precision=False)
    with pytest.warns(ClsasWarning, match="outside the band"):  # fading widens it
        image, better = (
            factorize(fading, grid, each, device=platform).pixels for each in (chosen, single)
        )
    faint = grid.positions_m()[..., 1] > 40.6
    assert np.abs(better[faint]).max() < 1e-3 * np.abs(better).max()
    assert relative_error_db(image[faint], better[faint]) <= -64


# Plans that are reused


@pytest.mark.slow
def test_a_plan_from_text_gives_the_same_image(platform):
    chosen = planned(arc, -50)
    again = Plan.from_json(chosen.to_json())
    image, other = (factorize(*made(arc), each, device=platform).pixels for each in (chosen, again))
    np.testing.assert_array_equal(image, other)


def test_a_plan_holds_its_beam():
    """This includes a beam with an array of directions."""
    lines, grid = made(near)
    beam = BeamWindow(12, "hann", along=np.tile([1.0, 0.02, 0], (lines.channels, 1)))
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    image = factorize(lines, grid, Plan.from_json(chosen.to_json()))
    reference = backproject(lines, grid, accuracy_db=-85, beam=beam)
    assert relative_error_db(image, reference) <= -40


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-50, -75])
def test_a_noise_floor_far_above_the_band(tolerance_db):
    """Echoes from 15 to 25 kHz, sampled at 96 kHz with their carrier; noise of -26 dB to 48 kHz."""
    track = along_x(300, 1 / 30)
    grid = Grid.plane((-4, 4, 160), (38, 46, 300))
    step_m = 1500 / 2 / 96e3
    length = int(13 / step_m)
    echoes, floor = (noise(300, length, occupied=band, seed=n) for n, band in ((1, 0.1), (2, 0.5)))
    floor *= 0.05 * np.linalg.norm(echoes) / np.linalg.norm(floor)
    index = np.arange(length)
    samples = echoes * np.exp(2j * np.pi * 20 / 96 * index) + floor * np.exp(0.5j * np.pi * index)
    lines = RangeLines(samples, 36.0, step_m, track, track, 0.0, 1500.0)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    reference = backproject(lines, grid, accuracy_db=-85)
    assert relative_error_db(factorize(lines, grid, chosen), reference) <= tolerance_db


@pytest.mark.parametrize(("half", "factor"), [(False, 1e3), (True, 1024)])
def test_a_plan_serves_other_samples(half, factor):
    """Scaling by a power of 2 does not change rounding in half precision."""
    lines, grid = made(straight)
    louder = dataclasses.replace(lines, samples=factor * lines.samples)
    chosen = changed(planned(straight, -50), half_precision=half)
    image, loud = (factorize(each, grid, chosen).pixels for each in (lines, louder))
    assert relative_error_db(loud / factor, image) <= -100


def test_a_plan_for_another_band_warns():
    """Lines without power outside the band of the plan are imaged as well as the plan's own."""
    lines, grid = made(straight)
    chosen = planned(straight, -50)
    time = np.arange(lines.length)
    narrow = sum(np.roll(lines.samples, n, axis=1) for n in range(4)) / 4
    narrower = dataclasses.replace(lines, samples=narrow)
    image = factorize(narrower, grid, chosen)
    assert relative_error_db(image, backproject(narrower, grid, accuracy_db=-80)) <= -50
    silent = dataclasses.replace(lines, samples=np.zeros_like(lines.samples))
    assert not factorize(silent, grid, chosen).pixels.any()
    shifted = dataclasses.replace(lines, samples=lines.samples * np.exp(2j * np.pi * 0.3 * time))
    with pytest.warns(ClsasWarning, match="outside the band that the images are made for"):
        wrong = factorize(shifted, grid, chosen)
    right = backproject(shifted, grid, accuracy_db=-80)
    assert relative_error_db(wrong, right) > -50


def test_a_plan_fits_its_own_lines_if_few_of_them_are_loud():
    """The noise of the others fills the band, but has very little power."""
    lines, grid = made(straight)
    loud = np.full((lines.channels, 1), 1e-4)
    loud[some_channels(lines.channels, 256)[100:104]] = 1.0
    rng = np.random.default_rng(5)
    noise = rng.normal(size=lines.samples.shape) * np.hanning(lines.length)
    few = dataclasses.replace(lines, samples=loud * lines.samples + 1e-5 * noise)
    chosen = plan(few, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    factorize(few, grid, chosen)
    factorize(dataclasses.replace(few), grid, chosen)


def test_a_plan_serves_another_device(device):
    """The plan is made for devices of different vector widths."""
    lines, grid = made(straight)
    chosen = plan(lines, grid, tolerance_db=-45, device=device, costs=EXACT_IS_SLOW)
    assert relative_error_db(factorize(lines, grid, chosen), exact(straight)) <= -45


@pytest.mark.parametrize("what", ["line", "grid"])
def test_a_plan_for_something_else_is_refused(what):
    lines, grid = made(straight)
    if what == "line":
        lines = dataclasses.replace(lines, tx_m=beside(lines.tx_m, 1e-6, 0, 0))
    else:
        grid = around(0, 40 + 1e-6)
    with pytest.raises(
        ValueError, match=f"{what}s? must have the geometry for which the plan was made"
    ):
        factorize(lines, grid, planned(straight, -50))


def test_a_beam_beside_a_plan_is_refused():
    with pytest.raises(
        ValueError, match="beam must be left out with a plan, which contains its own"
    ):
        factorize(*made(straight), planned(straight, -50), beam=HANN)


# Progress and interruption


@pytest.mark.slow
def test_progress_counts_pixels(platform):
    lines, grid = made(coarse_pixels)
    calls = []
    chosen = changed(planned(coarse_pixels, -20), roots_at_once=3, roots_prepared=6)
    factorize(lines, grid, chosen, device=platform, progress=lambda *call: calls.append(call))
    done, total = zip(*calls, strict=True)
    assert len(calls) > 2
    assert set(total) == {grid.size} == {done[-1]}
    assert sorted(set(done)) == list(done)


# At the edges of grids, tracks and beams


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 5])
def test_roots_that_overhang_the_grid_keep_the_tolerance(seed):
    """In a root of 512 rows on a grid of 257, pixels are farther from the middle than usual."""
    off_m = np.random.default_rng(seed).normal(0, 0.01, (200, 3)) * [0, 1, 1]
    grid = around(-10.0, 40.0, shape=(257, 100), pixel_m=(0.015, 0.01))
    lines, _ = over(grid, along_x(200, 0.008) + off_m)
    chosen = plan(lines, grid, tolerance_db=-55, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    exact = backproject(lines, grid, accuracy_db=-80)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= -55


@pytest.mark.slow
def test_a_gap_in_the_track_stays_empty(platform):
    """Pixels opposite the gap are visible from no channel, but from virtual channels in the gap."""
    x = np.arange(-14, 14, 0.02)
    x = x[np.abs(x - 0.5) > 7]
    lines, grid = over(
        around(0, 20, shape=(64, 2048), pixel_m=(0.015, 0.012)),
        np.stack([x, *np.zeros((2, len(x)))], axis=1),
    )
    beam = BeamWindow(2.0, "hann")
    request = {"tolerance_db": -40, "beam": beam, "costs": EXACT_IS_SLOW, "device": platform}
    chosen = plan(lines, grid, memory_bytes=15 << 20, **request)
    assert not chosen.is_exact
    exact = backproject(lines, grid, beam=beam, accuracy_db=-80, device=platform)
    image = factorize(lines, grid, chosen, device=platform)
    assert relative_error_db(image, exact) <= -40
    unseen = exact.pixels == 0
    assert unseen.mean() > 0.1
    assert np.abs(image.pixels[unseen]).max() <= 0.01 * np.abs(exact.pixels).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("x", "beam", "tolerance_db"),
    [
        (-30, BeamWindow(8.2, "hamming"), -40),
        (-38, BeamWindow(8.2), -30),
    ],
)
@pytest.mark.filterwarnings("ignore:1 of 457 positions")  # in the middle of the gap
def test_steps_of_a_beam_beside_a_gap_keep_the_tolerance(x, beam, tolerance_db):
    """Samples of the track, which continues through the gap, are coarser than the channels."""
    grid = around(x, 91.5, shape=(64, 84), pixel_m=(0.0029, 0.0014))
    lines, grid = over(grid, with_gap(457, 0.2345, 64.3), carrier_hz=300e3, band=0.1)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)
    exact = backproject(lines, grid, accuracy_db=-80, beam=beam)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= tolerance_db


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap_m", "beam", "tolerance_db"),
    thinned([2, 3, 4], [BeamWindow(39, "hamming"), BeamWindow(20, "hann")], [-20, -40]),
)
def test_pixels_opposite_the_ends_of_a_gap_keep_the_tolerance(beam, gap_m, tolerance_db):
    """Channels near the gap have small weights; the track's average does not describe them."""
    lines, grid = over(around(-0.2, 6.5, shape=(113, 150)), with_gap(300, 0.022, gap_m))
    request = {"beam": beam, "tolerance_db": tolerance_db}
    chosen = plan(lines, grid, costs=EXACT_IS_SLOW, **request)
    exact = backproject(lines, grid, beam=beam, accuracy_db=-80)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= tolerance_db


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "squint_deg", "tolerance_db"),
    [
        ("rectangular", -22.2, -25),
        ("rectangular", -22, -25),
        ("rectangular", -22, -15),
        ("hamming", -22, -25),
        ("taylor", -24, -40),
        ("hann", -22, -40),
    ],
)
def test_an_edge_of_the_beam_that_crosses_the_image(shape, squint_deg, tolerance_db):
    """The edge affects few pixels: most are visible from all of a short track or from none."""
    grid = around(-10.7, 18.8, pixel_m=(0.0144, 0.0184), shape=(214, 164), z=-1.3)
    lines, _ = over(grid, along_x(99, 0.01))
    request = {"beam": BeamWindow(12.2, shape, squint_deg=squint_deg), "tolerance_db": tolerance_db}
    chosen = plan(lines, grid, costs=EXACT_IS_SLOW, **request)
    exact = backproject(lines, grid, beam=request["beam"], accuracy_db=-80)
    assert relative_error_db(factorize(lines, grid, chosen), exact) <= tolerance_db


# Memory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "share", "tolerance_db"),
    thinned(
        itertools.product([None, BeamWindow(20, "hann"), BeamWindow(3, "hann")], [None, 0.0, 0.2]),
        [1.0, 0.7],
        [-50, -20],
    ),
)
def test_device_memory_is_as_planned(monkeypatch, kind, tolerance_db, share):
    beam, relief_m = kind
    lines, grid = over(around(0, 25, shape=(600, 1400)), along_x(700, 0.02))
    if relief_m is not None:
        row, column = np.indices(grid.shape)
        grid = grid.with_height(relief_m * np.sin(row / 30) * np.cos(column / 50))
    request = {"tolerance_db": tolerance_db, "beam": beam, "costs": EXACT_IS_SLOW}
    chosen = plan(lines, grid, **request)
    if share < 1:
        chosen = plan(lines, grid, memory_bytes=int(share * chosen.memory_bytes), **request)
    assert not chosen.is_exact
    peak = peak_device_bytes(monkeypatch, lambda: factorize(lines, grid, chosen), grid.shape)
    assert peak <= 1.1 * chosen.memory_bytes


@pytest.mark.slow
def test_little_memory_makes_small_roots_or_is_refused():
    lines, grid = over(around(0, 40, shape=(600, 700)))
    request = {"tolerance_db": -40, "costs": EXACT_IS_SLOW}
    plenty = plan(lines, grid, **request)
    little_bytes = int(0.7 * plenty.memory_bytes)
    little = plan(lines, grid, memory_bytes=little_bytes, **request)
    assert not little.is_exact
    assert little.memory_bytes <= little_bytes
    with pytest.raises(ValueError, match=r"memory_bytes must be at least [\d.]+ MiB"):
        plan(lines, grid, memory_bytes=1 << 20, **request)


# The thesis's method


@pytest.mark.slow
@pytest.mark.parametrize("width_deg", [3, *also(8), 30])
def test_given_stages_with_a_beam(width_deg):
    """Leaves contain many tiles, which are visible from different channels."""
    lines, grid = over(around(0, 20, shape=(128, 256)), along_x(400, 0.015))
    beam = BeamWindow(width_deg, "hann")
    chosen = plan(lines, grid, stages=[(1, 1), (1, 2)], beam=beam)
    assert chosen.factorization.tile != chosen.sides[-1]
    reference = backproject(lines, grid, accuracy_db=-80, beam=beam)
    assert relative_error_db(factorize(lines, grid, chosen), reference) <= -35


def test_given_stages_refuse_what_they_cannot_do():
    lines, grid = made(straight)
    with pytest.raises(ValueError, match="beam must not normalise"):
        plan(lines, grid, stages=[(1, 2)], beam=BeamWindow(20, "hann", normalise=True))
    with pytest.raises(ValueError, match="lines must have channels at more than one place"):
        plan(lines.select([0]), grid, stages=[(1, 2)])


def array_pings(sway_m, period_m):
    """Overlapping pings of 6 receivers, on an array that keeps its heading."""
    x_m = 0.4 * (np.arange(80) - 39.5)
    sway = sway_m * np.sin(2 * np.pi * x_m / period_m)
    ping_m = np.stack([x_m, sway, np.full(80, 15.0)], axis=1)
    rx_m = ping_m[:, None] + 0.2 * np.outer(np.arange(6) - 2.5, [1, 0, 0])
    return np.repeat(ping_m, 6, axis=0), rx_m.reshape(-1, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beam", "tolerance_db"), thinned([None, BeamWindow(6.0, "hann")], [-25, -45])
)
def test_overlapping_pings_of_a_swaying_array(device, beam, tolerance_db):
    """No curve passes through all these phase centres; ranges are stretched instead."""
    grid = Grid.plane((-3, 3, 150), (36, 44, 200))
    lines, _ = over(grid, *array_pings(0.2, 40.0), carrier_hz=125e3, band=0.12)
    chosen = plan(
        lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW, device=device
    )
    assert not chosen.is_exact
    exact = backproject(lines, grid, device=device, beam=beam, accuracy_db=-80)
    error_db = relative_error_db(factorize(lines, grid, chosen, device=device), exact)
    assert error_db <= chosen.predicted_error_db <= tolerance_db


def swinging():
    track = TRACK.copy()
    track[:, 1] = 0.05 * np.sin(2 * np.pi * track[:, 0] / 2)
    return over(around(0, 40), track)


def wide_circle():
    """Each pixel except the middle is visible from two stretches of the circle."""
    turn = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    track = np.stack([8 * np.cos(turn), 8 * np.sin(turn), 0 * turn + 3], axis=1)
    return over(around(0, 0, pixel_m=(0.03, 0.03)), track, carrier_hz=60e3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "squint_deg", "tolerance_db"),
    thinned([swinging, circle, wide_circle], [0.0, 2.0], [-50, -30]),
    ids=name_of,
)
def test_a_beam_that_swings_as_fast_as_it_passes_by(case, squint_deg, tolerance_db):
    """Weights of all channels are interpolated, from wherever the beam covers a pixel."""
    lines, grid = made(case)
    beam = BeamWindow(8.0, "hann", track_pings=21, squint_deg=squint_deg)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)
    error_db = relative_error_db(factorize(lines, grid, chosen), exact(case, beam))
    assert error_db <= tolerance_db
    assert -4 < error_db - chosen.predicted_error_db < 1


@pytest.mark.slow
@pytest.mark.parametrize("costs", [EXACT_IS_SLOW, Costs(call_ns=1e12)], ids=["stages", "exact"])
def test_data_may_arrive_in_pieces(costs, platform):
    """Images of parts of the lines add up, whether factorized or exact."""
    lines, grid = made(straight)
    whole = backproject(lines, grid, device=platform)
    image = None
    for part in (slice(0, 250), slice(250, 600)):
        some = lines.select(part)
        chosen = plan(some, grid, tolerance_db=-45, costs=costs, device=platform)
        assert chosen.is_exact == (costs is not EXACT_IS_SLOW)
        image = factorize(some, grid, chosen, device=platform, accumulate=image)
    assert relative_error_db(image, whole) < -42
