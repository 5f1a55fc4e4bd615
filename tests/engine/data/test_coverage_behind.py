"""Where elements look, and pixels behind them, which can only show mirror images."""

import re
import tomllib
import warnings
from dataclasses import replace

import numpy as np
import pytest
from cases import along_x

import clsas
from clsas.engine.data import coverage
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.signal.doubts import warn_before_imaging

PORT = clsas.Grid.plane((-0.5, 0.5, 41), (19.5, 20.5, 41))
STARBOARD = clsas.Grid.plane((-0.5, 0.5, 41), (-20.5, -19.5, 41))
POINT = clsas.PointTargets([[0.1, 20.2, 0.0]])


def recorded(pointing=None, *, velocity_m_s=(0.02, 0, 0), start_m=(-1, 0, 5), length_m=0.06):
    """Lines of a point to port, recorded by a sonar of one receiver."""
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 1e-3), [[0.0, 0, 0]], tx_length_m=length_m, rx_length_m=length_m
    )
    track = clsas.Track.straight(start_m, velocity_m_s, 101, 1.0)
    return clsas.compress(clsas.simulate(sonar, track, POINT, pointing=pointing, range_m=(17, 24)))


@pytest.fixture(scope="module")
def lines():
    return recorded(clsas.Pointing.broadside(depression_rad=0.24))


def geometry(tx_m, look, first_m=0.0, last_m=60.0):
    """Lines without echoes, with antennas that look somewhere."""
    samples = np.ones((len(tx_m), int((last_m - first_m) / 0.05) + 1), complex)
    return clsas.RangeLines(samples, first_m, 0.05, tx_m, tx_m, 100e3, 1500.0, look_direction=look)


def heard(form):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form()
    return [str(each.message) for each in caught if issubclass(each.category, ClsasWarning)]


def peak_m(image):
    return image.grid.positions_m()[np.unravel_index(np.abs(image.pixels).argmax(), image.shape)]


def test_a_point_to_port_has_an_equal_image_to_starboard_and_only_the_warning_tells(lines):
    """The physics: ranges from a straight track are equal on both sides."""
    port = clsas.backproject(lines, PORT)
    with pytest.warns(ClsasWarning, match="the whole grid lies to starboard of the track"):
        starboard = clsas.backproject(lines, STARBOARD)
    np.testing.assert_allclose(peak_m(port), [0.1, 20.2, 0], atol=1e-9)
    np.testing.assert_allclose(peak_m(starboard), [0.1, -20.2, 0], atol=1e-9)
    mirrored = starboard.pixels[::-1]
    assert np.abs(mirrored - port.pixels).max() < 1e-3 * np.abs(port.pixels).max()
    unknown = replace(lines, look_direction=None)
    assert heard(lambda: clsas.backproject(unknown, STARBOARD)) == []
    assert clsas.backproject(unknown, STARBOARD).pixels.tobytes() == starboard.pixels.tobytes()


def test_a_point_behind_the_elements_gives_no_echo():
    """The elements are baffled, so whatever is seen on that side comes from the other one."""
    sonar = clsas.Sonar(clsas.Pulse(100e3, 30e3, 1e-3), [[0.0, 0, 0]], tx_length_m=0.06)
    track = clsas.Track.straight((0, 0, 5), (0.02, 0, 0), 3, 1.0)
    behind = clsas.PointTargets([[0, -20, 0]])
    with pytest.warns(ClsasWarning, match="no echo"):
        clsas.simulate(sonar, track, behind, range_m=(17, 24))


WAYS = {
    "plan": lambda lines, grid: clsas.plan(lines, grid, tolerance_db=-40),
    "factorize": lambda lines, grid: clsas.factorize(lines, grid, -40),
    "imager": lambda lines, grid: clsas.Imager(lines, grid, accuracy_db=-40),
    "backproject": lambda lines, grid: clsas.backproject(lines, grid),
    "mosaic": lambda lines, grid: clsas.mosaic(lines, grid, patches=(2, 2)).image(),
    "tradeoff": lambda lines, grid: clsas.tradeoff(
        lines, grid, tolerances_db=[-30, -40], stages=[], repeats=1
    ),
    "planned": lambda lines, grid: clsas.factorize(
        lines, grid, clsas.plan(lines, grid, tolerance_db=-40)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_every_imager_warns_once_of_the_wrong_side_and_names_the_grid_meant(lines, way):
    assert heard(lambda: WAYS[way](lines, PORT)) == []
    assert heard(lambda: WAYS[way](lines, STARBOARD)) == [
        "the whole grid lies to starboard of the track, but the elements look to port. Pixels "
        "there only show the mirror image of the port side. Use the mirrored grid, "
        "--x=-0.5:0.5:41 --y=19.5:20.5:41"
    ]


@pytest.mark.slow
def test_a_wavenumber_image_warns_as_well(lines):
    flat = recorded(start_m=(-1, 0, 0))
    assert heard(lambda: clsas.wavenumber(flat, PORT)) == []
    (message,) = heard(lambda: clsas.wavenumber(flat, STARBOARD))
    assert message.startswith("the whole grid lies to starboard")


def test_a_sonar_that_looks_to_starboard_warns_of_port():
    turned = geometry(along_x(50, 0.05), [0, -2.0, -0.5])
    assert np.linalg.norm(turned.look_direction, axis=1) == pytest.approx(1)
    (message,) = heard(lambda: warn_before_imaging(turned, PORT))
    assert "lies to port of the track, but the elements look to starboard" in message
    assert message.endswith("Use the mirrored grid, --x=-0.5:0.5:41 --y=-20.5:-19.5:41")
    assert heard(lambda: warn_before_imaging(turned, STARBOARD)) == []


def test_the_mirrored_grid_follows_from_the_track_and_keeps_height_and_step():
    track_m = along_x(50, 0.05) + [0, 3.0, 0]
    found = coverage.behind(
        geometry(track_m, [0, 1, 0]), clsas.Grid.plane((1, 2, 5), (-14, -34, 101), -7.5)
    )
    assert found.value == 1
    assert found.remedy.endswith("use the mirrored grid, --x=1:2:5 --y=20:40:101 --z=-7.5")


def test_the_mirrored_grid_is_rounded_to_the_sway_of_the_track():
    sway_m = 0.03 * np.sin(np.arange(50))[:, None] * [0, 1.0, 0]
    track_m = along_x(50, 0.05) + sway_m + [0, 2.012, 0]
    found = coverage.behind(geometry(track_m, [0, 1, 0]), STARBOARD)
    assert found.remedy.endswith("use the mirrored grid, --x=-0.5:0.5:41 --y=23.5:24.5:41")


def test_along_y_the_columns_are_mirrored():
    track_m = along_x(50, 0.05)[:, [1, 0, 2]] + [100, 0, 0]
    lines = geometry(track_m, [-1, 0, 0])  # heads along y, and port is -x
    found = coverage.behind(lines, clsas.Grid.plane((120, 130, 11), (0, 2, 3)))
    assert "to starboard of the track, but the elements look to port" in found.message
    assert found.remedy.endswith("use the mirrored grid, --x=70:80:11 --y=0:2:3")


def test_across_the_axes_the_mirrored_plane_is_given_by_its_steps():
    angle = np.radians(30)
    track_m = np.outer(np.linspace(-1, 1, 41), [np.cos(angle), np.sin(angle), 0])
    port = np.array([-np.sin(angle), np.cos(angle), 0])
    there = clsas.Grid.plane((10, 12, 21), (-30, -28, 21))
    found = coverage.behind(geometry(track_m, port), there)
    assert found.remedy.endswith("shape = [21, 21]")
    _, table = found.remedy.split("use the mirrored grid, ")  # in the notation of a scene file
    grid = clsas.Grid.oriented(**tomllib.loads(f"grid = {{{table}}}")["grid"])
    assert coverage.behind(geometry(track_m, port), grid) is None
    distance_m = [each.positions_m() @ port for each in (grid, there)]
    np.testing.assert_allclose(distance_m[0], -distance_m[1], atol=1e-5)


@pytest.mark.parametrize("kind", ["heights", "points"])
def test_other_grids_are_mirrored_in_words(lines, kind):
    grid = STARBOARD.with_height(np.zeros(STARBOARD.shape))
    if kind == "points":
        grid = clsas.Grid.points(STARBOARD.positions_m().reshape(-1, 3))
    found = coverage.behind(lines, grid)
    assert found.value == 1
    plane = r"the vertical plane through \(\S+ 0\) m with the normal \(-?0, 1\)$"
    assert re.search(f"^mirror the grid about {plane}", found.remedy)


@pytest.mark.parametrize(("low_m", "percent"), [(-0.1, None), (-5, 17), (-25, 50), (-50, 67)])
def test_a_part_of_the_grid_is_reported_by_its_share(low_m, percent):
    lines = geometry(along_x(50, 0.05), [0, 1, 0])
    found = coverage.behind(lines, clsas.Grid.plane((0, 1, 50), (low_m, 25, 1000)))
    if percent is None:  # less than is reported
        assert found is None
        return
    assert 100 * found.value == pytest.approx(percent, abs=2)
    assert f"{100 * found.value:.0f} % of the grid lies to starboard" in found.message
    assert ("keep the grid on the port side" in found.remedy) == (found.value < 0.5)


def ring(radius_m=20.0, outwards=False):
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    inward = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return geometry(-radius_m * inward, -inward if outwards else inward, last_m=50)


def both_sides():
    look = np.tile([[0, 1.0, 0], [0, -1.0, 0]], (50, 1))
    return geometry(np.repeat(along_x(50, 0.05), 2, axis=0), look)


def opposite_legs():
    """Two legs 60 m apart, on opposite headings, that look to port: towards each other."""
    there = along_x(100, 0.1)
    tx_m = np.concatenate([there - [0, 30, 0], there[::-1] + [0, 30, 0]])
    return geometry(tx_m, np.repeat([[0, 1.0, 0], [0, -1.0, 0]], 100, axis=0), last_m=80)


SILENT = {
    "unknown": lambda: (geometry(along_x(50, 0.05), None), STARBOARD),
    "circle around it": lambda: (ring(), clsas.Grid.plane((-5, 5, 20), (-5, 5, 20))),
    "circle inside": lambda: (ring(), clsas.Grid.plane((-45, 45, 20), (-45, 45, 20))),
    "circle, outwards": lambda: (ring(outwards=True), clsas.Grid.plane((-5, 5, 9), (-5, 5, 9))),
    "both sides": lambda: (both_sides(), STARBOARD),
    "straight down": lambda: (geometry(along_x(50, 0.05), [0, 0, -1.0]), STARBOARD),
    "ahead": lambda: (geometry(along_x(50, 0.05), [1.0, 0, 0]), STARBOARD),
    "other leg": lambda: (opposite_legs(), clsas.Grid.plane((-1, 1, 9), (-40, -35, 9))),
    "too far": lambda: (geometry(along_x(50, 0.05), [0, 1, 0], last_m=15), STARBOARD),
    "below": lambda: (
        geometry(along_x(50, 0.05) + [0, 0, 50], [0, 1.0, -1.0], last_m=90),
        clsas.Grid.plane((-1, 1, 9), (-40, -20, 9)),
    ),
    "squinted aft": lambda: (
        geometry(along_x(50, 0.05), [1.0, 1.0, 0]), clsas.Grid.plane((-30, -20, 9), (5, 10, 9)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SILENT)
def test_nothing_is_said(case):
    assert coverage.behind(*SILENT[case]()) is None


def test_a_leg_counts_only_where_its_lines_reach():
    """The second leg looks towards the grid, but ends before it."""
    lines = opposite_legs()
    near = replace(lines, samples=lines.samples[:, :1000])  # 50 m
    found = coverage.behind(near, clsas.Grid.plane((-1, 1, 9), (-60, -55, 9)))
    assert found.value == 1


def test_one_ping_of_an_array_has_no_track_but_sides():
    array_m = along_x(64, 0.01)
    samples = np.ones((64, 800), complex)
    lines = clsas.RangeLines(
        samples, 0, 0.05, [0, 0, 0], array_m, 100e3, 1500.0, look_direction=[0, 1, 0]
    )
    found = coverage.behind(lines, STARBOARD)
    assert found.message.startswith("the whole grid lies behind the elements")
    assert found.remedy.endswith("--y=19.5:20.5:41")
    single = lines.select([0])
    assert coverage.behind(single, STARBOARD).value == 1
    assert coverage.side_of(single, single.look_direction) == ""


def test_large_coordinates_lose_nothing():
    utm_m = np.array([597_300.0, 6_643_100.0, -20.0])
    lines = geometry(along_x(50, 0.05) + utm_m, [0, 1, 0])
    here = clsas.Grid.plane((597_300, 597_301, 11), (6_643_120, 6_643_121, 11), -30)
    assert coverage.behind(lines, here) is None
    there = clsas.Grid.plane((597_300, 597_301, 11), (6_643_079, 6_643_080, 11), -30)
    assert coverage.behind(lines, there).remedy.endswith(
        "--x=597300:597301:11 --y=6643120:6643121:11 --z=-30"
    )


SIDES = {
    "port": [0, 1, -0.3],
    "starboard": [0.2, -1, 0],
    "": [0, 0, -1],
    "both sides": np.tile([[0, 1.0, 0], [0, -1.0, 0]], (25, 1)),
}


@pytest.mark.parametrize("side", SIDES)
def test_sides_follow_from_the_heading(side):
    lines = geometry(along_x(50, 0.05), SIDES[side])
    assert coverage.side_of(lines, lines.look_direction) == side
    other = {"port": "starboard", "starboard": "port"}.get(side, side)
    back = lines.select(slice(None, None, -1))
    assert coverage.side_of(back, back.look_direction) == other


def test_receivers_of_a_ping_may_look_to_both_sides():
    assert coverage.side_of(both_sides(), both_sides().look_direction) == "both sides"


def test_noise_of_the_positions_does_not_change_the_side():
    noise_m = np.random.default_rng(1).normal(0, 0.01, (1000, 3))
    lines = geometry(along_x(1000, 0.01) + noise_m, [0, 1, 0])
    assert coverage.side_of(lines, lines.look_direction) == "port"


def test_a_circle_has_a_side_too():
    assert coverage.side_of(ring(), ring().look_direction) == "port"


@pytest.mark.parametrize(
    ("pointing", "look"),
    [
        (None, [0, 1, 0]),
        (clsas.Pointing.broadside(depression_rad=0.3), [0, np.cos(0.3), -np.sin(0.3)]),
        (clsas.Pointing.squint(0.2), [np.sin(0.2), np.cos(0.2), 0]),
        (clsas.Pointing.squint(np.pi), [0, -1, 0]),
    ],
    ids=["broadside", "down", "squint", "starboard"],
)
def test_echoes_and_lines_look_where_the_pointing_does(pointing, look):
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 1e-3), [[0.0, 0, 0], [0.1, 0, 0]], rx_length_m=0.06
    )
    track = clsas.Track.straight((0, 0, 0), (0.02, 0, 0), 4, 1.0)
    target = clsas.PointTargets([20 * np.array(look)])
    echoes = clsas.simulate(sonar, track, target, pointing=pointing, range_m=(18, 22))
    np.testing.assert_allclose(echoes.look_direction, np.tile(look, (8, 1)), atol=1e-12)
    np.testing.assert_array_equal(clsas.compress(echoes).look_direction, echoes.look_direction)
    omnidirectional = clsas.simulate(sonar, track, target, element_pattern=False, range_m=(18, 22))
    assert omnidirectional.look_direction is None


def test_on_another_heading_the_elements_look_elsewhere():
    lines = recorded(velocity_m_s=(0, -0.02, 0), start_m=(-20, 21, 0))
    np.testing.assert_allclose(lines.look_direction, np.tile([1.0, 0, 0], (101, 1)), atol=1e-12)
    assert coverage.side_of(lines, lines.look_direction) == "port"


@pytest.mark.exhaustive
@pytest.mark.parametrize("shape", [(20_000, 20_000), (1, 10**6), (10**6,), (200, 200, 200)])
def test_pixels_are_sampled_however_many_there_are(shape):
    """The middles of equal parts, so that shares are those of all pixels."""
    if len(shape) == 2:
        grid = clsas.Grid.oriented([0, 0, 0], [0, 1, 0], [1, 0, 0], shape)
    else:
        size = int(np.prod(shape))
        grid = clsas.Grid.points(np.arange(3.0 * size).reshape(*shape, 3))
    assert 30 < len(coverage._sampled(grid)) <= 1024
    middle_m = np.mean(grid.bounds_m, axis=0)
    np.testing.assert_allclose(coverage._sampled(grid).mean(axis=0), middle_m, rtol=0.06, atol=1)
