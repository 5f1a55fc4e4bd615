import dataclasses

import numpy as np
import pytest
from cases import (
    APERTURE,
    CARRIER,
    STEP,
    along_x,
    bistatic,
    height_map,
    lines_over,
    made,
    moving,
    noise,
    patch,
    pixels_of,
    points,
    thesis_lines,
)
from exactly import execute, prepare, same_interpolator
from scipy.signal.windows import taylor

from clsas.engine.data.beam import INTERVALS, SHAPES, BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import element_pattern
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.data.visibility import BeamTrack, sines
from clsas.engine.exact.layout import Groups, Tiles
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import backproject
from clsas.selftest import reference
from clsas.selftest.reference import ideal
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

FINE = {"taps": 8, "upsampling": 4}
X = (1.0, 0, 0)
DEGREE = np.pi / 180
ROUNDING_DB = -87  # difference of two images due to rounding in float32


def window(shape, width_deg=20.0, **others):
    """Return a window of any shape; "inverse" is for an element with a beam of its width."""
    return BeamWindow(
        width_deg, shape, element_length_m=0.443 / np.sin(width_deg / 2 * DEGREE), **others
    )


# Weights


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("width_deg", "squint_deg"), [(0.5, 0), (3, -40), (20, 10), (90, 30), (150, -10), (180, 0)]
)
def test_the_table_holds_the_weights(shape, width_deg, squint_deg):
    beam = window(shape, width_deg, squint_deg=squint_deg)
    low, high = np.clip(beam.limits, -1, 1)
    q = np.linspace(low, high, 100_003)[1:-1]
    place = (q - low) / (high - low) * INTERVALS
    interval = place.astype(int)
    c = beam.table(1.0).astype(float)[interval].T
    x = place - interval
    held = c[0] + x * (c[1] + x * (c[2] + x * c[3]))
    np.testing.assert_allclose(held, beam.weights(q, 1.0), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("taper", [0.002, 0.004, 0.01, 0.03, 0.1, 0.2, 0.5, 1.0])
def test_the_table_of_a_window_with_kinks_serves_blocks(taper):
    """A block uses one cubic, even beyond its interval, on either side of a kink."""
    window = BeamWindow(20, "tukey", squint_deg=3, taper=taper)
    low, high = window.limits
    table = window.table().astype(float)
    sine = np.linspace(low, high, 200_001)[1:-1]
    weights, place = window.weights(sine), (sine - low) / (high - low) * INTERVALS

    def error(reach):
        wrong = []
        for aside in np.linspace(-reach, reach, 9):
            number = np.clip(place - aside, 0, INTERVALS - 1e-6).astype(int)
            cubics = np.polynomial.polynomial.polyval(place - number, table[number].T, tensor=False)
            wrong.append(cubics - weights)
        return np.sqrt(np.mean(np.square(wrong)) / np.mean(weights**2))

    assert error(0.0) < 1e-4
    for reach in (0.7, 1.5, 4.0, 8.0, 16.0, 32.0):
        expected = window.block_error((reach + 0.5) / INTERVALS * (high - low))
        assert error(reach) <= expected or expected > 0.05


@pytest.mark.parametrize("shape", SHAPES)
def test_a_window_is_one_in_its_middle_and_nothing_beyond(shape):
    beam = window(shape, 20, squint_deg=5)
    assert beam.weights(np.sin(5 * DEGREE), 1.0) == pytest.approx(1, abs=1e-12)
    inside = beam.weights(np.sin(np.array([-4.99, 14.99]) * DEGREE), 1.0)
    assert np.all(inside > -1e-9)
    assert not beam.weights(np.sin(np.array([-90, -5.01, 15.01, 90]) * DEGREE), 1.0).any()


def test_the_shapes_are_what_their_names_say():
    angle = np.linspace(-9.9, 9.9, 101)
    q, u = np.sin(angle * DEGREE), angle / 20

    def check(beam, wanted):
        np.testing.assert_allclose(beam.weights(q, 0.5), wanted, atol=1e-12)

    check(BeamWindow(20), 1)
    check(BeamWindow(20, "hann"), np.cos(np.pi * u) ** 2)
    check(BeamWindow(20, "hamming"), 0.54 + 0.46 * np.cos(2 * np.pi * u))
    check(BeamWindow(20, "tukey", taper=1), np.cos(np.pi * u) ** 2)
    check(BeamWindow(20, "tukey", taper=0), 1)
    flat = BeamWindow(20, "tukey", taper=0.5).weights(np.sin([4.9 * DEGREE, 7.5 * DEGREE]))
    np.testing.assert_allclose(flat, [1, 0.5])
    check(
        BeamWindow(20, "inverse", element_length_m=1.0),
        element_pattern(1.0, q, 1500.0, 750.0) ** -2,
    )
    places = np.arcsin(np.sin(((np.arange(64) - 31.5) / 64) * 20 * DEGREE))
    np.testing.assert_allclose(
        BeamWindow(20, "taylor").weights(np.sin(places)), taylor(64, 4, 30), atol=1e-12
    )


def test_an_elements_window_is_its_half_power_beam():
    beam = BeamWindow.of_element(0.2, 0.012, "hann", squint_deg=3)
    assert (beam.shape, beam.squint_deg, beam.element_length_m) == ("hann", 3, 0.2)
    edge = element_pattern(0.2, np.sin(beam.width_deg / 2 * DEGREE), 1 / 0.012, 1.0)
    assert edge**2 == pytest.approx(0.5, abs=1e-5)
    assert BeamWindow.of_element(0.001, 0.012).width_deg == 180
    inverse = BeamWindow.of_element(0.2, 0.012, "inverse")
    assert inverse.weights(inverse.limits[1] - 1e-9, 0.012) == pytest.approx(2, abs=1e-4)


# Track's direction


@pytest.mark.parametrize("length", [1e-300, 1e300])
def test_a_direction_may_be_of_any_length(length):
    along = BeamWindow(20, along=(3 * length, 4 * length, 0)).along
    np.testing.assert_allclose(along, [0.6, 0.8, 0], rtol=1e-12)


# Images


def circular():
    """The track is a circle, and its direction at every channel is the tangent."""
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    track = 30 * np.stack([np.cos(angle), np.sin(angle), 0.2 + 0 * angle], axis=1)
    grid = patch(6.0, 2.0)
    return thesis_lines(grid, track, own_start=True), grid


def swaying():
    track = along_x(300, 0.02) + 0.1 * np.sin(np.arange(300) / 40)[:, None] * [0, 1, 0.5]
    grid = patch(0.4, 30)
    return thesis_lines(grid, track), grid


TANGENT = np.stack(
    [-np.sin(np.linspace(0, 2 * np.pi, 300, endpoint=False)),
     np.cos(np.linspace(0, 2 * np.pi, 300, endpoint=False)), np.zeros(300)], axis=1
)  # fmt: skip

WINDOWED = {
    "straight": (bistatic, BeamWindow(3, "hann", squint_deg=2)),
    "edges": (bistatic, BeamWindow(3, squint_deg=2)),
    "normalised": (bistatic, BeamWindow(3, "taylor", squint_deg=2, normalise=True)),
    "moving": (moving, BeamWindow(4, "tukey", squint_deg=2)),
    "swaying": (swaying, BeamWindow(4, "hamming")),
    "circular": (circular, BeamWindow(12, "hann", along=TANGENT)),
    "heights": (height_map, BeamWindow(3, "taylor", squint_deg=2, along=(1, 0.01, 0.02))),
    "points": (points, BeamWindow(4, squint_deg=1, along=X)),
    "normalised points": (points, BeamWindow(4, "hann", squint_deg=1, along=X, normalise=True)),
    "inverse": (swaying, BeamWindow.of_element(0.015, 0.0015, "inverse", along=X)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WINDOWED)
def test_an_image_is_the_weighted_sum(name, device):
    case, beam = WINDOWED[name]
    preparation = prepare(*made(case), device=device, beam=beam, **FINE)
    assert isinstance(preparation.layout, Groups if name[-6:] in ("points", "eights") else Tiles)
    chosen, where = pixels_of(case)
    wanted = same_interpolator(preparation, where)
    seen = (
        beam.weights(sines(where, made(case)[0].phase_centres_m, preparation.scene.along), 0.0015)
        > 0
    )
    assert 0.02 < seen.mean() < 0.98 or name == "inverse"
    assert relative_error_db(execute(preparation).pixels.ravel()[chosen], wanted) <= -75


@pytest.mark.parametrize("taper", [0.0, 1e-3])
def test_a_window_without_taper_is_rectangular(taper):
    bare, plain = BeamWindow(60, "tukey", taper=taper), BeamWindow(60)
    np.testing.assert_array_equal(bare.table(), plain.table())
    q = np.linspace(-0.6, 0.6, 1001)
    np.testing.assert_array_equal(bare.weights(q), plain.weights(q))
    assert bare.plane_error(3e-3) >= plain.plane_error(3e-3) > 1e-3


@pytest.mark.parametrize("shape", ["hann", "hamming", "tukey"])
@pytest.mark.parametrize("accuracy_db", [-50, -70])
def test_an_image_at_the_edge_of_a_window_is_as_accurate(shape, accuracy_db):
    beam = BeamWindow(60, shape, along=X)
    grid = Grid((-23.07, 40, 0), (0.02, 0, 0), (0, 0.02, 0), shape=(48, 48))
    lines = thesis_lines(grid, along_x(150, 0.004))
    preparation = prepare(lines, grid, beam=beam, accuracy_db=accuracy_db)
    chosen, each = (execute(choice) for choice in (preparation, preparation.but(one_cubic=False)))
    assert relative_error_db(chosen, each) <= accuracy_db - 6


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("squint_deg", [0, 10])
@pytest.mark.parametrize("shape", ["hann", "hamming", "taylor", "rectangular"])
def test_one_cubic_of_weights_errs_by_no_more_than_is_expected(shape, squint_deg, turned):
    beam = BeamWindow(8, shape, squint_deg=squint_deg, along=X)
    steps_m = ([0.015, 0.015, 0], [0.015, -0.015, 0]) if turned else ([0.02, 0, 0], [0, 0.02, 0])
    middle = np.array([16 * np.tan(squint_deg * DEGREE), 16, 0])
    grid = Grid(middle - 31.5 * np.sum(steps_m, axis=0), *steps_m, shape=(64, 64))
    lines = thesis_lines(grid, along_x(800, 0.005))
    preparation = prepare(lines, grid, beam=beam, accuracy_db=-60)
    each, one = (execute(preparation.but(one_cubic=choice)) for choice in (False, True))
    tiles = preparation.layout
    nearest_m = tiles.nearest_m(lines.phase_centres_m) - tiles.radius_m
    expected_db = 20 * np.log10(tiles.one_cubic_error(beam, nearest_m, 0.0015))
    assert preparation.one_cubic == (expected_db <= -72)
    measured_db = relative_error_db(one, each)
    assert measured_db <= max(expected_db, ROUNDING_DB)
    # Blocks of one column are lines, for which the error may be much smaller.
    assert measured_db >= expected_db - 25 or tiles.width == 1


@pytest.mark.parametrize("normalise", [False, True])
def test_the_references_weigh_each_channel(normalise):
    """The reference is a sum of images of single channels, with weights computed here."""
    lines, grid = made(bistatic)
    lines = lines.select(slice(0, 640, 64))
    where = grid.positions_m()[::8, ::8]
    beam = BeamWindow(3, "hann", squint_deg=3, along=X, normalise=normalise)
    middle = (lines.tx_m + lines.rx_m) / 2
    offset = where[..., None, :] - middle
    angle = np.arcsin(offset[..., 0] / np.linalg.norm(offset, axis=-1)) / DEGREE
    weights = np.where(abs(angle - 3) < 1.5, np.cos(np.pi * (angle - 3) / 3) ** 2, 0)
    whole = prepare(lines, grid, beam=beam, **FINE)
    wanted = 0
    for channel, weight in enumerate(np.moveaxis(weights, -1, 0)):
        crop = dataclasses.replace(whole.crop, first=whole.crop.first[[channel]])
        alone = lines.select([channel]), whole.but(crop=crop).decision
        wanted += weight * reference.same_interpolator(*alone, where)
    if normalise:
        wanted = (
            np.where(weights.any(axis=-1), 10 / np.maximum(weights.sum(axis=-1), 1e-9), 0) * wanted
        )
    assert 0 < (weights > 0).mean() < 1
    assert relative_error_db(same_interpolator(whole, where), wanted) <= -180
    assert relative_error_db(ideal(lines, where, beam=beam), wanted) <= -80


@pytest.mark.slow
@pytest.mark.parametrize("case", [bistatic, points], ids=lambda case: case.__name__)
def test_a_window_open_on_all_sides_changes_nothing(case, device):
    lines, grid = made(case)
    beam = BeamWindow(180, along=X)
    image = backproject(lines, grid, device=device, beam=beam, **FINE)
    assert relative_error_db(image, backproject(lines, grid, device=device, **FINE)) <= -85


@pytest.mark.slow
def test_pixels_at_the_antennas_and_ahead_of_them_are_finite(platform):
    """The aspect angle is undefined or 90 degrees at points on a line along the track."""
    grid = Grid.points([[0, 0, 0], [1e-3, 0, 0], [1, 0, 0], [5, 0, 0], [-5, 0, 0], [0, 3, 0]])
    lines = RangeLines(np.ones((1, 40), complex), 0.0, 0.25, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    for width, seen in ((180, [1, 1, 1, 1, 1, 1]), (20, [1, 0, 0, 0, 0, 1])):
        beam = BeamWindow(width, along=X)
        pixels = form_exactly(lines, grid, device=platform, beam=beam).pixels
        assert np.isfinite(pixels).all()
        np.testing.assert_array_equal(pixels != 0, seen)


@pytest.mark.slow
def test_normalising_levels_points_along_the_track(platform):
    """Points lie along and beyond the aperture; fewer channels receive from outer ones."""
    x = np.linspace(-6, 6, 9)
    targets = np.stack([x, np.full(9, 20.0), np.zeros(9)], axis=1)
    track = along_x(400, 0.03)
    lines = simulate_lines(
        track, track, PointTargets(targets, np.ones(9)), carrier_hz=1e5, bandwidth_hz=2e4
    )
    grid = Grid.points(targets)
    plain, level = (
        np.abs(backproject(lines, grid, device=platform, beam=beam).pixels) / 400
        for beam in (BeamWindow(12, "hann"), BeamWindow(12, "hann", normalise=True))
    )
    assert plain[[0, -1]].max() < 0.6 * plain[4]
    np.testing.assert_allclose(level, 1, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "y_m", "accuracy_db"),
    [("hann", 13.3, -40), ("hann", 13.3, -50), ("tukey", 18, -31), ("tukey", 26, -40)],
)
def test_normalising_amplifies_no_errors_where_little_is_seen(shape, y_m, accuracy_db):
    """Next to the edge of the visible area, pixels are divided by a small sum of weights."""
    grid = Grid((1.95, y_m, 0), (0, 0.1, 0), (0.077, 0, 0), shape=(154, 184))
    lines = lines_over(grid, along_x(296, 0.077), carrier_hz=20e3, step_m=0.15)
    beam = BeamWindow(10, shape, normalise=True)
    exact = backproject(lines, grid, beam=beam, accuracy_db=-85)
    assert 0.1 < np.mean(exact.pixels == 0) < 0.3
    image = backproject(lines, grid, beam=beam, accuracy_db=accuracy_db)
    assert relative_error_db(image, exact) <= accuracy_db


@pytest.mark.slow
def test_an_unseen_pixel_of_a_normalised_image_is_zero(platform):
    grid = patch(0.0, 42, 400, 3)
    lines = thesis_lines(grid, APERTURE[300:340])
    beam = BeamWindow(1, "hann", normalise=True)
    pixels = backproject(lines, grid, device=platform, beam=beam).pixels
    sums = beam.weights(
        sines(grid.positions_m()[1], lines.phase_centres_m, beam.directions(lines))
    ).sum(axis=0)
    assert 50 < (sums == 0).sum() < 350
    np.testing.assert_array_equal(pixels[1] != 0, sums > 0)


@pytest.mark.slow
def test_a_narrow_beam_costs_little(platform):
    """Few pairs of parts and channels are prepared, and the image needs no others."""
    track = along_x(1500, 0.05)
    grid = Grid.plane((-30, 30, 200), (40, 42, 40))
    lines = lines_over(grid, track, carrier_hz=1e4, step_m=0.05)
    beam = BeamWindow(2, "hann")
    preparation = prepare(lines, grid, device=platform, beam=beam, **FINE)
    layout = preparation.layout
    track = BeamTrack(beam.limits, lines.phase_centres_m, preparation.scene.along)
    ranges = track.spans(layout.boxes(slice(None))).ranges
    assert (ranges[:, 1] - ranges[:, 0]).mean() < 0.1 * 1500
    some = grid.positions_m()[::9, ::9]
    image = execute(preparation)
    assert relative_error_db(image.pixels[::9, ::9], same_interpolator(preparation, some)) <= -70


@pytest.mark.slow
def test_progress_counts_what_is_skipped(platform):
    calls = []
    grid = Grid.plane((-30, 30, 200), (40, 42, 40))
    lines = lines_over(grid, along_x(1500, 0.05), carrier_hz=1e4, step_m=0.05)
    backproject(
        lines, grid, device=platform, beam=BeamWindow(2), progress=lambda *call: calls.append(call)
    )
    done, total = np.array(calls).T
    assert np.all(np.diff(done) > 0)
    assert done[-1] == total[0] == total[-1]


@pytest.mark.parametrize("kind", ["plane", "points"])
def test_a_beam_that_points_elsewhere_warns_and_gives_zeros(platform, kind):
    grid = patch(1.3, 42, 9, 7)
    if kind == "points":
        grid = Grid.points(grid.positions_m())
    lines = thesis_lines(grid, APERTURE[::64])
    beam = BeamWindow(4, squint_deg=-40, normalise=kind == "points")
    says = r"beam spans -42 to -38 degrees, the grid lies at -?\d.* to \d.* degrees; the lines span"
    with pytest.warns(ClsasWarning, match=says):
        image = backproject(lines, grid, device=platform, beam=beam)
    assert not image.pixels.any()


# Bad input


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"width_deg": 0}, ValueError, "width_deg must be .*>= 0.001.*got 0"),
        ({"width_deg": 181}, ValueError, "width_deg must be .*<= 180.*got 181"),
        ({"width_deg": np.nan}, ValueError, "width_deg .*finite"),
        ({"width_deg": "20"}, TypeError, "width_deg must be .*'20'"),
        ({"shape": "gauss"}, ValueError, "shape must be one of 'rectangular', .*got 'gauss'"),
        ({"squint_deg": 81}, ValueError, "squint_deg must be .*<= 80 degrees, got 81"),
        ({"squint_deg": None}, TypeError, "squint_deg must be"),
        ({"taper": 1.1}, ValueError, "taper must be .*<= 1.*got 1.1"),
        ({"shape": "inverse"}, ValueError, "element_length_m must be given"),
        ({"element_length_m": -1}, ValueError, "element_length_m must be .*> 0"),
        ({"along": (1, 0)}, ValueError, "along must have shape"),
        ({"along": (0, 0, 0)}, ValueError, "along must not have a direction of length zero"),
        (
            {"along": [[1, 0, 0], [0, 0, 0]]},
            ValueError,
            "along must not have a direction of length zero",
        ),
        ({"along": (np.inf, 0, 0)}, ValueError, "along must be finite"),
        ({"along": "x"}, (TypeError, ValueError), "along must"),
        ({"normalise": 1}, TypeError, "normalise must be of type bool"),
    ],
)
def test_bad_windows_are_refused(arguments, error, says):
    with pytest.raises(error, match=says):
        BeamWindow(**({"width_deg": 20} | arguments))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((0, 0.01), "length_m must be"),
        ((0.1, -1), "wavelength_m must be"),
        ((0.1, 0.01, "x"), "shape"),
    ],
)
def test_bad_elements_are_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        BeamWindow.of_element(*arguments)


def test_what_does_not_fit_the_lines_is_refused():
    grid = patch(1.3, 42, 4, 4)
    lines = thesis_lines(grid, APERTURE[::64])
    with pytest.raises(TypeError, match=r"beam must be .*BeamWindow.*float"):
        backproject(lines, grid, beam=20.0)
    with pytest.raises(TypeError, match=r"beam must be .*BeamWindow"):
        ideal(lines, [0, 42, 0], beam=20.0)
    with pytest.raises(ValueError, match=r"along must have .* 10 channels, got 2"):
        backproject(lines, grid, beam=BeamWindow(20, along=np.eye(3)[:2]))
    with pytest.raises(ValueError, match="along must be given: 1 channels"):
        backproject(lines.select([0]), grid, beam=BeamWindow(20))
    to_and_fro = np.array([[0, 0, 0], [1, 0, 0]] * 3, float)
    still = RangeLines(noise(6, 300), 42.0, STEP, to_and_fro, -to_and_fro, CARRIER, 1500.0)
    with pytest.raises(ValueError, match=r"along must be given: .*stand still"):
        backproject(still, grid, beam=BeamWindow(20))
    image = backproject(lines, grid)
    with pytest.raises(ValueError, match="accumulate must be None with a beam that normalises"):
        backproject(lines, grid, beam=BeamWindow(20, normalise=True), accumulate=image)
    with pytest.raises(ValueError, match="width_deg must keep 'inverse' within -40 dB"):
        backproject(lines, grid, beam=BeamWindow(20, "inverse", element_length_m=0.015))
    bare = dataclasses.replace(lines, carrier_hz=0.0)
    with pytest.raises(ValueError, match=r"carrier_hz must be above 0 .*'inverse'"):
        backproject(bare, grid, beam=BeamWindow(20, "inverse", element_length_m=0.015))
