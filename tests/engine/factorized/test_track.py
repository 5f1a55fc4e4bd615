import numpy as np
import pytest
from cases import along_x, beside, track_lines
from dense import TRACKS
from dense import WAVELENGTH as LONG_WAVELENGTH

from clsas.engine.factorized.track import APART, mean_track, sheet, simplest_track, strips

WAVELENGTH = 1500.0 / 120e3


def circle(channels, degrees, radius_m=20.0):
    turn = np.radians(np.linspace(0, degrees, channels, endpoint=degrees < 360))
    return radius_m * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


def distance_m(track, centres_m):
    """Distances of phase centres from their positions on the track."""
    return np.linalg.norm(track.positions_m(track.coordinate) - centres_m, axis=1)


def pings():
    """Pings of 6 receivers. The first receiver of a ping is behind the last of the ping before."""
    tx = np.repeat(along_x(60, 0.07), 6, axis=0)
    return tx, tx + np.tile(along_x(6, 0.034), (60, 1))


PATHS = {
    "straight": along_x(300, 0.02),
    "tilted": along_x(300, 0.02) @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0],
    "arc": circle(500, 60),
    "half circle": circle(500, 180),
    "circle": circle(1000, 360),
    "uneven": np.sort(np.random.default_rng(1).uniform(-3, 3, 300))[:, None] * [1, 0.2, 0],
}


@pytest.mark.parametrize("name", PATHS)
def test_the_track_follows_a_smooth_path(name):
    lines = track_lines(PATHS[name])
    track = mean_track(lines, WAVELENGTH)
    assert distance_m(track, PATHS[name]).max() < 0.05 * WAVELENGTH


@pytest.mark.parametrize("name", PATHS)
def test_coordinates_increase_along_a_path(name):
    coordinate = mean_track(track_lines(PATHS[name]), WAVELENGTH).coordinate
    steps = np.diff(coordinate)
    assert (steps > 0).all() or (steps < 0).all()
    assert np.ptp(coordinate) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("name", PATHS)
def test_the_order_of_channels_does_not_matter(name):
    centres_m = PATHS[name]
    order = np.random.default_rng(2).permutation(len(centres_m))
    track = mean_track(track_lines(centres_m[order]), WAVELENGTH)
    assert distance_m(track, centres_m[order]).max() < 0.05 * WAVELENGTH
    steps = np.diff(track.coordinate[np.argsort(order)])
    if name == "circle":  # its track may begin anywhere
        steps = np.delete(steps, np.abs(steps).argmax())
    assert (steps > 0).all() or (steps < 0).all()


def test_the_track_of_pings_of_many_receivers_is_straight():
    lines = track_lines(*pings())
    track = mean_track(lines, WAVELENGTH)
    assert distance_m(track, lines.phase_centres_m).max() < 0.01 * WAVELENGTH
    x = lines.phase_centres_m[:, 0]
    order = np.argsort(x)
    assert (np.diff(track.coordinate[order]) >= -1e-9).all()


def test_the_track_does_not_follow_jitter():
    """Navigation errors that differ from channel to channel do not belong to a smooth path."""
    rng = np.random.default_rng(3)
    lines = track_lines(PATHS["straight"] + rng.normal(0, 0.01, (300, 3)) * [0, 1, 1])
    tangent = mean_track(lines, WAVELENGTH).tangents_m(np.linspace(0, 1, 100))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    assert tangent[:, 0].min() > 0.99


def test_bistatic_channels_are_at_their_phase_centres():
    tx = PATHS["straight"]
    track = mean_track(track_lines(tx, beside(tx, 0.4, 0.1, -0.1)), WAVELENGTH)
    middle_m = beside(tx, 0.2, 0.05, -0.05)
    assert np.linalg.norm(track.positions_m(track.coordinate) - middle_m, axis=1).max() < 1e-6


@pytest.mark.parametrize("channels", [1, 2, 40])
def test_channels_at_one_position_have_no_track(channels):
    assert mean_track(track_lines(np.tile([1.0, 2, 3], (channels, 1))), WAVELENGTH) is None


@pytest.mark.parametrize("channels", [2, 3, 4, 5])
def test_a_few_channels_have_a_track(channels):
    centres_m = along_x(channels, 0.3)
    track = mean_track(track_lines(centres_m), WAVELENGTH)
    assert distance_m(track, centres_m).max() < 1e-9


def test_beyond_its_ends_a_track_is_straight():
    track = mean_track(track_lines(PATHS["arc"]), WAVELENGTH)
    for end, beyond in ((0.0, -0.5), (1.0, 1.5)):
        at_m, far_m = track.positions_m(np.array([end, beyond]))
        np.testing.assert_allclose(
            far_m, at_m + (beyond - end) * track.tangents_m(np.array([end]))[0], atol=1e-9
        )


def test_the_tangent_is_the_derivative():
    track, coordinate = (
        mean_track(track_lines(PATHS["arc"]), WAVELENGTH),
        np.linspace(0.01, 0.99, 50),
    )
    slope = (track.positions_m(coordinate + 1e-6) - track.positions_m(coordinate - 1e-6)) / 2e-6
    np.testing.assert_allclose(track.tangents_m(coordinate), slope, rtol=1e-5, atol=1e-4)


def test_a_channel_off_the_track_appears_in_its_direction():
    centres_m = along_x(200, 0.03) + np.random.default_rng(4).normal(0, 0.05, (200, 3)) * [0, 1, 1]
    track = mean_track(track_lines(centres_m), WAVELENGTH)
    points_m = np.array([[0.5, 40, -5], [30, 30, -5], [-20, 25, 3]])
    coordinates, _ = track.apparent_coordinates(points_m, centres_m)
    for point_m, coordinate in zip(points_m, coordinates, strict=True):
        ways = [position - point_m for position in (track.positions_m(coordinate), centres_m)]
        virtual, real = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways)
        tangent = track.tangents_m(coordinate)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # Along the track, directions agree far better than the angles by which channels are off.
        off = np.abs(np.einsum("ci,ci->c", virtual - real, tangent))
        assert off.max() < 2e-5


def test_channels_on_a_straight_track_appear_where_they_are():
    track = mean_track(track_lines(PATHS["straight"]), WAVELENGTH)
    coordinates, _ = track.apparent_coordinates(
        np.array([[0.0, 10, 0], [5, 3, 1]]), PATHS["straight"]
    )
    np.testing.assert_allclose(coordinates, np.tile(track.coordinate, (2, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "off_m"),
    [
        ("helix", 1e-5),
        ("jittered helix", 0.01),
        ("raster", 1e-6),
        ("spiral", 1e-6),
        ("planar", 5e-3),
    ],
)
def test_a_sheet_follows_its_channels(name, off_m):
    lines = track_lines(TRACKS[name]())
    found = sheet(lines, LONG_WAVELENGTH)
    assert found.is_sheet
    assert np.abs(found.offsets_m(lines.phase_centres_m)).max() < off_m
    for coordinate in (found.coordinate, found.across):
        assert -1e-9 <= coordinate.min() <= coordinate.max() <= 1 + 1e-9


def test_a_closed_ring_meets_at_its_cut():
    found = sheet(track_lines(TRACKS["helix"]()), LONG_WAVELENGTH)
    ends_m = found.positions_m(np.array([0.0, 1.0]), np.array([0.3, 0.3]))
    np.testing.assert_allclose(ends_m[0], ends_m[1], atol=1e-5)


def test_a_sheet_of_two_headings_in_a_plane_is_flat_and_as_wide_everywhere():
    passes = [np.linspace([-1, y, 0], [1, y + 0.4, 0], 200) for y in (-0.5, 0.5)]
    found = sheet(track_lines(np.concatenate(passes)), LONG_WAVELENGTH)
    along, across = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 5))
    width_m = np.linalg.norm(found.sheet.sideways_m(along, across), axis=-1)
    assert width_m.min() > 0.9 * width_m.max()


def test_channels_on_a_line_have_no_sheet():
    tx_m = np.linspace([0, 0, 0], [5, 1, 0], 400)
    assert sheet(track_lines(tx_m), LONG_WAVELENGTH) is None
    assert strips(track_lines(tx_m), LONG_WAVELENGTH) is None


def test_each_pass_has_a_strip():
    tx_m = TRACKS["passes"]()
    found = strips(track_lines(tx_m), LONG_WAVELENGTH)
    assert found.strips == 8
    np.testing.assert_array_equal(found.strip_of(found.coordinate), np.repeat(np.arange(8), 200))
    assert np.abs(found.offsets_m(tx_m)).max() < 1e-9
    local = found.coordinate - APART * found.strip_of(found.coordinate)
    assert -0.1 < local.min() < local.max() < 1.1


@pytest.mark.parametrize("order", ["two platforms in turn", "random", "backwards"])
def test_passes_are_found_in_any_order_of_their_channels(order):
    tx_m = TRACKS["passes"]()
    given = {
        "two platforms in turn": np.arange(1600).reshape(2, 800).T.ravel(),
        "random": np.random.default_rng(2).permutation(1600),
        "backwards": np.arange(1600)[::-1],
    }[order]
    found = strips(track_lines(tx_m[given]), LONG_WAVELENGTH)
    assert found.strips == 8
    in_passes = found.strip_of(found.coordinate)[np.argsort(given)].reshape(8, 200)
    assert (in_passes == in_passes[:, :1]).all()
    assert len(np.unique(in_passes)) == 8
    assert np.abs(found.offsets_m(tx_m[given])).max() < 1e-9


@pytest.mark.parametrize("name", ["helix", "raster", "spiral", "planar"])
def test_channels_beside_each_other_are_no_passes(name):
    tx_m = np.random.default_rng(2).permutation(TRACKS[name]())
    assert strips(track_lines(tx_m), LONG_WAVELENGTH) is None
    assert sheet(track_lines(tx_m), LONG_WAVELENGTH).is_sheet


@pytest.mark.slow
def test_short_passes_have_no_strips():
    tx_m = TRACKS["passes"]().reshape(8, 200, 3)[:, :20].reshape(-1, 3)
    assert strips(track_lines(tx_m), LONG_WAVELENGTH) is None


def test_only_channels_far_from_any_curve_get_another_shape(monkeypatch):
    tx_m = np.linspace([0, 0, 0], [50, 0, 0], 4000)
    assert simplest_track(track_lines(tx_m), LONG_WAVELENGTH)[0] == "track"
    assert simplest_track(track_lines(20 * TRACKS["planar"]()), LONG_WAVELENGTH)[0] == "sheet"
    monkeypatch.setattr("clsas.engine.factorized.track._SCREENED", 10000)
    assert simplest_track(track_lines(20 * TRACKS["planar"]()), LONG_WAVELENGTH)[0] == "track"


def test_points_on_a_sheet_lie_in_the_direction_of_channels():
    """A channel off the sheet is replaced by the point where the line of sight meets the sheet."""
    tx_m = TRACKS["planar"]()
    tx_m[:, 2] += np.random.default_rng(1).normal(0, 0.05, len(tx_m))
    lines = track_lines(tx_m)
    found, point_m = sheet(lines, LONG_WAVELENGTH), np.array([[0.4, -0.7, 0.0]])
    along, across = found.apparent_coordinates(point_m, tx_m)
    virtual_m = found.positions_m(along[0], across[0])
    seen, given = (
        each / np.linalg.norm(each, axis=1)[:, None]
        for each in (virtual_m - point_m, tx_m - point_m)
    )
    straight_m = found.positions_m(found.coordinate, found.across) - point_m
    without = straight_m / np.linalg.norm(straight_m, axis=1)[:, None]
    assert np.abs(seen - given).max() < 0.1 * np.abs(without - given).max()
