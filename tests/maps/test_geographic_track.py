"""Tracks of latitudes and longitudes."""

import numpy as np
import pytest

import clsas

pyproj = pytest.importorskip("pyproj")

EARTH = pyproj.Geod(ellps="WGS84")


def course(azimuth_deg, pings=20, latitude=60.41, longitude=5.4, step_m=1.5):
    """Latitudes and longitudes of a straight course."""
    ahead = step_m * np.arange(pings)
    ends = EARTH.fwd(*(np.full(pings, v) for v in (longitude, latitude, azimuth_deg)), ahead)
    return ends[1], ends[0]


@pytest.mark.parametrize("place", ["default", "local", "projected", "south"])
def test_the_bow_points_along_the_course(place):
    """Also 4 km off the origin, where the map's north differs from true north."""
    latitude = -33.85 if place == "south" else 60.41
    at = course(250.0, latitude=latitude)
    frame = {
        "local": clsas.Georeference.local(60.39, 5.32, -20, heading_deg=217),
        "projected": clsas.Georeference.projected("EPSG:32632"),
    }.get(place)
    track = clsas.Track.from_geographic(
        *at, -20.0, 250.0, 0.5 * np.arange(20), pitch_deg=2.0, roll_deg=3.0, georeference=frame
    )
    moved = np.diff(track.positions_m, axis=0)
    yaw = np.arctan2(moved[:, 1], moved[:, 0])
    np.testing.assert_allclose(np.angle(np.exp(1j * (track.yaw_rad[1:] - yaw))), 0, atol=2e-5)
    scale = 1e-3 if frame is not None and frame.is_projected else 1e-6
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.5, rtol=4 * scale)
    np.testing.assert_allclose(
        track.velocity_m_s[:, :2], np.tile(2 * moved[0, :2], (20, 1)), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(np.degrees(track.pitch_rad), -2)
    np.testing.assert_allclose(np.degrees(track.roll_rad), 3)
    geographic = track.georeference.to_geographic(track.positions_m)
    np.testing.assert_allclose(geographic[:, :2].T, at, atol=1e-11)
    np.testing.assert_allclose(geographic[:, 2], -20, atol=1e-9)
    if place == "default":
        assert track.georeference.heading_deg == 250.0
        assert np.abs(track.positions_m.mean(axis=0)).max() < 0.2


def test_headings_in_radians_and_swapped_angles_are_refused():
    latitude, longitude = course(250.0)
    time_s = np.arange(20.0)
    with pytest.raises(ValueError, match=r"heading_deg must be in degrees.* `numpy\.degrees`"):
        clsas.Track.from_geographic(latitude, longitude, 0.0, np.radians(250.0), time_s)
    clsas.Track.from_geographic(*course(3.0), 0.0, np.full(20, 3.0), time_s)  # as degrees right
    with pytest.raises(ValueError, match="probably swapped"):
        clsas.Track.from_geographic(100 + latitude, longitude, 0.0, 250.0, time_s)
    with pytest.raises(ValueError, match="longitude_deg must have shape"):
        clsas.Track.from_geographic(latitude, longitude[1:], 0.0, 250.0, time_s)
    with pytest.raises(ValueError, match="heading_deg must be from"):
        clsas.Track.from_geographic(latitude, longitude, 0.0, 400.0, time_s)


def with_value(values, numbers, value):
    values = np.array(values)
    values[numbers] = value
    return values


@pytest.mark.parametrize("longitude", [5.4, -47.3])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda each: with_value(each, 7, 0.0), "ping 7 is at latitude 0, longitude 0"),
        (lambda each: with_value(each, 30, each[30] + 0.01), r"jumps at 2 of 39 steps, by up to"),
        (lambda each: np.where(np.arange(40) < 25, each, each - 0.003), "jumps at 1 of 39 steps"),
        (lambda each: each[np.arange(40) // 10 * 10], "36 of 40 pings have exactly the position"),
        (lambda each: each.astype(np.float32), "are rounded to .* as single precision"),
    ],
)
def test_fixes_that_cannot_be_right_are_warned_of_once(change, said, longitude):
    at = [change(each) for each in course(30.0, pings=40, longitude=longitude)]
    with pytest.warns(clsas.ClsasWarning, match=said) as caught:
        clsas.Track.from_geographic(*at, -10.0, 30.0, 0.2 * np.arange(40))
    assert len(caught) == 1


def test_a_fix_on_the_other_side_of_the_earth_is_refused():
    latitude, longitude = (with_value(each, 7, 0.0) for each in course(30.0, longitude=179.0))
    with pytest.raises(ValueError, match="those of ping 7, 0 and 0, are on another side"):
        clsas.Track.from_geographic(latitude, longitude, -10.0, 30.0, 0.2 * np.arange(20))


def test_nothing_is_said_of_noisy_fixes_lost_pings_and_digits_as_receivers_write_them():
    random = np.random.default_rng(0)
    kept = np.sort(random.permutation(200)[:150])
    latitude, longitude = (each[kept] for each in course(70.0, pings=200, step_m=0.15))
    latitude = (latitude + 3e-7 * random.normal(size=150)).round(8)
    clsas.Track.from_geographic(latitude, longitude.round(8), -10.0, 70.0, 0.1 * kept)


def test_a_track_across_the_date_line_lies_together():
    track = clsas.Track.from_geographic(
        *course(90.0, longitude=179.9999), 0.0, 90.0, np.arange(20.0)
    )
    assert np.ptp(track.positions_m[:, 0]) == pytest.approx(1.5 * 19, rel=1e-5)


@pytest.mark.slow
def test_the_place_of_a_track_reaches_the_image():
    """Through echoes, lines and grid."""
    track = clsas.Track.from_geographic(
        *course(250.0, pings=5, step_m=0.02), 0.0, 250.0, np.arange(5.0)
    )
    sonar = clsas.Sonar(clsas.Pulse(30e3, 10e3, 1e-3), [[0.0, 0.0, 0.0]])
    echoes = clsas.simulate(sonar, track, clsas.PointTargets([[0, 20, 0]]))
    lines = clsas.compress(echoes)
    grid = clsas.Grid.plane((-0.1, 0.1, 3), (19.9, 20.1, 3))
    for image in (
        clsas.backproject(lines, grid),
        clsas.factorize(lines, grid, -40),
        clsas.mosaic(lines, grid).image(),
    ):
        assert image.georeference == track.georeference
    utm = clsas.Georeference.projected("EPSG:32632")
    elsewhere = clsas.Grid.plane((-0.1, 0.1, 3), (19.9, 20.1, 3), georeference=utm)
    for form in (clsas.backproject, clsas.wavenumber, clsas.mosaic):
        with pytest.raises(ValueError, match="grid must have the georeference of the lines"):
            form(lines, elsewhere)
    with pytest.raises(ValueError, match="grid must have the georeference of the lines"):
        clsas.plan(lines, elsewhere, tolerance_db=-40)
