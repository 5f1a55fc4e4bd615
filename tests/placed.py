"""A scene with a target at a known place on Earth, for tests of maps."""

import numpy as np
import pytest

import clsas

pyproj = pytest.importorskip("pyproj")

UTM_NORTH = clsas.Georeference.projected("EPSG:32632")
UTM_SOUTH = clsas.Georeference.projected("EPSG:32733")
EARTH = pyproj.Geod(ellps="WGS84")
STEPS_M = 0.25, 0.2  # of columns and rows
TARGET_M = np.array([31.3, 52.72, 0.0])


def at(transform, column, row):
    """Where an affine transform of rasterio leads, whose operator depends on its version."""
    a, b, c, d, e, f = transform[:6]
    return a * column + b * row + c, d * column + e * row + f


def in_order(image, values, transform):
    """What was read, at the pixels of the image: looked up by map coordinates."""
    on_map = image.georeference.to_map(image.grid.positions_m())
    column, row = at(~transform, on_map[..., 0], on_map[..., 1])
    np.testing.assert_allclose(column % 1, 0.5, atol=1e-6)
    np.testing.assert_allclose(row % 1, 0.5, atol=1e-6)
    return values[np.floor(row).astype(int), np.floor(column).astype(int)]


def local(heading, latitude=60.39):
    return clsas.Georeference.local(latitude, 5.32, -12.0, heading_deg=heading)


def scene(place, shape=(140, 190), first_m=(10.0, 40.0)):
    """An image of noise with a target, and the target's latitude and longitude by a geodesic."""
    origin_m = np.array([*first_m, 0.0])
    target_m = TARGET_M.copy()
    if place.is_projected:
        shift_m = [500_000, 3_700_000 if place == UTM_SOUTH else 6_700_000, 0]
        origin_m, target_m = origin_m + shift_m, target_m + shift_m
        to_wgs84 = pyproj.Transformer.from_crs(place.crs, "EPSG:4326", always_xy=True)
        longitude, latitude = to_wgs84.transform(*target_m[:2])
    else:
        azimuth = place.heading_deg - np.degrees(np.arctan2(target_m[1], target_m[0]))
        longitude, latitude, _ = EARTH.fwd(
            place.longitude_deg, place.latitude_deg, azimuth, np.hypot(*target_m[:2])
        )
    grid = clsas.Grid.oriented(
        origin_m, [0, STEPS_M[1], 0], [STEPS_M[0], 0, 0], shape, georeference=place
    )
    away_m = (grid.positions_m() - target_m)[..., :2]
    random = np.random.default_rng(3)
    noise = 1e-3 * (random.normal(size=shape) + 1j * random.normal(size=shape))
    pixels = noise + 5 * np.exp(-np.sum(away_m**2, axis=-1) / (2 * 0.5**2))
    pixels[:4, :6] = 0  # where nothing was received
    return clsas.Image(pixels, grid), (longitude, latitude)
