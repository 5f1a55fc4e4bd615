"""Georeferences: conversions against PROJ's geodesics, and what is refused."""

import warnings

import numpy as np
import pytest

import clsas

pyproj = pytest.importorskip("pyproj")

PLACES = {
    "north": (60.39, 5.32, -50.0, 217.0),
    "south": (-54.8, -68.3, 100.0, 300.5),
    "date line": (0.1, 179.9999, -500.0, 90.0),
}
BERGEN = clsas.Georeference.local(*PLACES["north"][:3], heading_deg=217)
UTM = clsas.Georeference.projected("EPSG:32632")
EARTH = pyproj.Geod(ellps="WGS84")
NEAR_M = np.random.default_rng(3).uniform(-5000, 5000, (300, 3)) * [1, 1, 0.01]


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_distances_within_5_km_of_the_origin_are_right_to_3e_7(place):
    *origin, heading = place
    local = clsas.Georeference.local(*origin, heading_deg=heading)
    plane_m = NEAR_M * [1, 1, 0] / np.sqrt(2)  # the corners of the square are 5 km away
    first, second = local.to_geographic(plane_m), local.to_geographic(plane_m[::-1])
    on_ellipsoid_m = EARTH.inv(first[:, 1], first[:, 0], second[:, 1], second[:, 0])[2]
    radius_m = (
        6378137.0 * np.sqrt(1 - EARTH.es) / (1 - EARTH.es * np.sin(np.radians(origin[0])) ** 2)
    )
    distance_m = on_ellipsoid_m * (1 + origin[2] / radius_m)
    expected_m = np.linalg.norm(plane_m - plane_m[::-1], axis=1)
    np.testing.assert_allclose(distance_m, expected_m, rtol=3e-7)
    assert np.linalg.norm(plane_m, axis=1).max() > 4500


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_the_x_axis_has_the_heading_and_y_points_to_port(place):
    latitude, longitude, height, heading = place
    local = clsas.Georeference.local(latitude, longitude, height, heading_deg=heading)
    for axis, expected in ((np.eye(3)[0], heading), (np.eye(3)[1], heading - 90)):
        there = local.to_geographic(100 * axis)
        azimuth, _, _ = EARTH.inv(longitude, latitude, there[1], there[0])
        assert (azimuth - expected + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)
    assert local.to_geographic([0, 0, 7])[2] == height + 7


@pytest.mark.parametrize("place", [BERGEN, UTM], ids=str)
def test_conversions_invert_each_other(place):
    at_m = NEAR_M + ([500_000, 6_700_000, 0] if place.is_projected else 0)
    np.testing.assert_allclose(place.from_map(place.to_map(at_m)), at_m, atol=1e-8)
    geographic = place.to_geographic(at_m)
    np.testing.assert_allclose(place.from_geographic(*geographic.T), at_m, atol=1e-6)


def test_the_wkt_is_a_transverse_mercator_on_the_origin():
    crs = pyproj.CRS.from_wkt(BERGEN.wkt())
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    np.testing.assert_allclose(to_map.transform(5.32, 60.39), 0, atol=1e-9)
    at_m = BERGEN.to_geographic([30, 40, 0])
    np.testing.assert_allclose(
        to_map.transform(at_m[1], at_m[0]), BERGEN.to_map([30, 40, 0])[:2], atol=1e-8
    )


@pytest.mark.parametrize("heading", [0, 90, 180, 217, 270])
def test_the_affine_transform_leads_from_pixels_to_the_map(heading):
    place = clsas.Georeference.local(1.0, 2.0, heading_deg=heading)
    grid = clsas.Grid.plane((10, 20, 21), (40, 36, 5), georeference=place)
    a, b, c, d, e, f = place.affine(grid)
    row, column = np.mgrid[:5, :21] + 0.5
    on_map = np.stack([a * column + b * row + c, d * column + e * row + f], axis=-1)
    np.testing.assert_allclose(on_map, place.to_map(grid.positions_m())[..., :2], atol=1e-9)
    if heading % 90 == 0:
        assert 0.0 in (a, b)  # exactly, so that files say so too


def test_a_single_row_is_as_wide_as_its_pixels():
    grid = clsas.Grid.plane((0, 10, 11), (5, 5, 1), georeference=UTM)
    assert UTM.affine(grid) == (1, 0, -0.5, 0, 1, 4.5)
    with pytest.raises(ValueError, match="grid must not be vertical"):
        UTM.affine(clsas.Grid.oriented([0, 0, 0], [0, 0, 1], [1, 0, 0], (3, 3)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: clsas.Georeference.projected("EPSG:99999"), "crs must be one that PROJ knows"),
        (lambda: clsas.Georeference.projected("EPSG:4326"), "got 'EPSG:4326', a geographic one"),
        (lambda: clsas.Georeference.projected("EPSG:2263"), "must be in metres"),
        (lambda: clsas.Georeference.projected("EPSG:2048"), "axes point west and south: "),
        (lambda: clsas.Georeference.projected("EPSG:3031"), "north and north: .*, or UTM$"),
        (lambda: clsas.Georeference(crs="EPSG:3413").wkt(), "axes point south and south"),
        (lambda: clsas.Georeference(crs="EPSG:99999").wkt(), "crs must be one that PROJ knows"),
        (lambda: BERGEN.from_geographic([91.0], [10.0], 0), "are probably swapped"),
        (lambda: BERGEN.from_geographic([1.0, 2.0, 3.0], [1.0, 2.0], 0), "the same shape"),
    ],
)  # fmt: skip
def test_other_places_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_names_of_projections_are_those_of_their_authority():
    assert clsas.Georeference.projected("epsg:32632") == UTM
    assert str(UTM) == "EPSG:32632"
    assert str(clsas.Georeference.projected("EPSG:31467")) == "EPSG:31467"  # northing first


@pytest.mark.parametrize("place", [UTM, BERGEN], ids=str)
def test_a_north_up_grid_covers_the_grid_along_the_map(place):
    shift = [500_000.3, 6_700_000.4, -7] if place.is_projected else [0, 0, -7]
    grid = clsas.Grid.oriented(shift, [-0.1, 0.3, 0], [0.4, 0.2, 0], (40, 50), georeference=place)
    for pixel_m in (None, 1.5):
        found = place.north_up(grid, pixel_m)
        a, b, c, d, e, f = place.affine(found)
        size = pixel_m or np.hypot(0.1, 0.3)
        assert (b, d) == (0, 0)
        assert (a, e) == pytest.approx((size, size))
        np.testing.assert_allclose((np.array([c, f]) / size + 0.5) % 1, 0.5, atol=1e-6)
        on_map, covered = (place.to_map(each.positions_m())[..., :2] for each in (grid, found))
        assert (covered.min(axis=(0, 1)) - size / 2 <= on_map.min(axis=(0, 1))).all()
        assert (covered.max(axis=(0, 1)) + size / 2 >= on_map.max(axis=(0, 1))).all()
        assert (np.ptp(covered, axis=(0, 1)) <= np.ptp(on_map, axis=(0, 1)) + 2 * size + 0.6).all()
        assert found.bounds_m[0][2] == found.bounds_m[1][2] == -7
    for other in (grid.with_height(np.zeros((40, 50))), clsas.Grid.oriented(
        shift, [0, 1, 0.1], [1, 0, 0], (2, 2), georeference=place)):  # fmt: skip
        with pytest.raises(ValueError, match="grid must be a horizontal plane"):
            place.north_up(other)


def test_pixels_of_a_north_up_grid_are_no_larger_than_the_grid():
    place = clsas.Georeference.local(60.0, 5.0, heading_deg=30.0)
    grid = clsas.Grid.plane((0.0, 9.0, 10), (0.0, 4.0, 5), georeference=place)
    assert min(place.north_up(grid, 10.0).shape) >= 1
    for pixel_m in (10.1, 1e12, 1e300):
        with pytest.raises(ValueError, match="pixel_m must be at most the longer side of the grid"):
            place.north_up(grid, pixel_m)
    for pixel_m in (1e-6, 5e-324):
        with pytest.raises(ValueError, match=r"pixel_m must ask for at most .* memory"):
            place.north_up(grid, pixel_m)


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude", "used_m", "best_m", "grid"),
    [
        ("EPSG:27700", 52.0, -1.5, 2, 1, "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
        ("EPSG:31467", 50.0, 9.0, 3, 1, "de_adv_BETA2007.tif"),
        ("EPSG:26710", 40.1, -122.0, 7, 2, "ca_nrc_ntv2_0.tif"),
        ("EPSG:26910", 40.0, -123.0, 4, 2, "us_noaa_cnhpgn.tif"),
        ("EPSG:7405", 52.0, -1.5, 2, 1, "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
    ],
)
def test_a_datum_shift_without_its_grid_is_a_warning(
    crs, latitude, longitude, used_m, best_m, grid, without_grids
):
    place = clsas.Georeference.projected(crs)
    said = (
        rf"between WGS 84 and {crs} with an accuracy of {used_m} m instead of {best_m} m, "
        rf"because it lacks {grid}: run `pyproj sync --file {grid}`, or .* PROJ_NETWORK"
    )
    with pytest.warns(clsas.ClsasWarning, match=said) as caught:
        at_m = place.from_geographic(latitude, longitude, 0.0)
    assert len(caught) == 1
    with pytest.warns(clsas.ClsasWarning, match=said) as caught:
        back = place.to_geographic([at_m, at_m])
    assert len(caught) == 1
    np.testing.assert_allclose(back[0], [latitude, longitude, 0], atol=1e-7)
    with pytest.warns(clsas.ClsasWarning, match=said) as caught:
        clsas.Track.from_geographic(
            [latitude] * 3, [longitude] * 3, 0, 90.0, [0, 1, 2], georeference=place
        )
    assert len(caught) == 1


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude"),
    [
        ("EPSG:32632", 60.0, 9.0),  # WGS 84
        ("EPSG:3857", 60.0, 5.0),
        ("EPSG:25832", 60.0, 9.0),  # ETRS 89, for which there is no grid
        ("EPSG:28992", 52.0, 5.0),  # needs none
        ("EPSG:21781", 47.0, 8.0),  # its grid would be no more accurate
        ("EPSG:26910", 50.0, -123.0),  # its grids are those of other places
        ("+proj=utm +zone=32 +ellps=GRS80", 50.0, 9.0),  # of unknown datum
    ],
)
def test_the_best_known_datum_shift_is_no_warning(crs, latitude, longitude, without_grids):
    place = clsas.Georeference.projected(crs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        place.to_geographic(place.from_geographic(latitude, longitude, 0.0))
