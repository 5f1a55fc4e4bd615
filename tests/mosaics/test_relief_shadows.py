"""Shadows that are longer than the patches of a mosaic of heights."""

import numpy as np
import pytest
from reliefs import BAND_HZ, CARRIER_HZ, track

import clsas
from clsas.engine.data.digests import grid_digest
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import Window
from clsas.interferometry.shadows import in_shadow
from clsas.mosaics.document import Record
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.patches import Layout, with_margin
from clsas.mosaics.relief_shadows import mask_shadows, of_shadows

GRID = clsas.Grid.plane((0, 5.9, 60), (30, 41.9, 120))
PATCH, MARGIN, WINDOW = (17, 23), (14, 12), Window(7, 5)
SD_M = 0.01


def tangents(corner=(0, 0), shape=GRID.shape):
    """Lines of sight that rise by 0.5 m per metre across, and turn along the track."""
    rows, columns = (np.array([0.0, count - 1]) for count in shape)
    values = np.empty((2, 2, 2, 3))
    values[..., 0] = 3.0
    values[..., 1] = 5.0
    values[..., 2] = 0.02 * (corner[1] + columns - 30)[:, None]
    return Lattice(rows, columns, np.array([-1.0, 5.0]), values)


def seabed(seed=5):
    """Heights of walls and dunes, float32, NaN in places; their shadows cross several patches."""
    random = np.random.default_rng(seed)
    height_m = 0.1 * np.sin(np.arange(120) / 4)[:, None] + 0.02 * random.standard_normal(GRID.shape)
    height_m[8:16, 5:50] = 2.5
    height_m[60:69, 30:41] += 1.2
    height_m[random.random(GRID.shape) < 0.01] = np.nan
    return height_m.astype(np.float32)


def write(store, index, height_m, shadowed):
    """Write a patch whose own measurement has found some pixels to be in shadow."""
    window = Layout(GRID, PATCH).window(index)
    rows, columns = window.rows, window.columns
    layers = {name: np.ones(window.grid.shape, np.float32) for name in LAYERS}
    own, hidden = height_m[rows, columns], shadowed[rows, columns]
    sd_m = np.where(np.isnan(own), np.nan, np.float32(SD_M))
    for name, values in {"height_m": own, "sd_m": sd_m}.items():
        layers[name] = np.where(hidden, np.nan, values).astype(np.float32)
        layers[f"shadow_{name}"] = np.where(hidden, values, np.nan).astype(np.float32)
    around = with_margin(window, MARGIN, GRID.shape)[:2]
    shape = tuple(part.stop - part.start for part in around)
    sights = tangents(tuple(part.start for part in around), shape)
    heights = {"valid": 0.0, "converged": True} | of_shadows(layers, window.grid, sights)
    record = Record(channels=1, survey_channels=1, has_pixels=True, heights=heights)
    pixels = np.ones(window.grid.shape, np.complex64)
    store.write(*index, rows, columns, pixels, record, layers)


def begun(path):
    store = clsas.Store.at(path)
    inputs = {
        "parts": [], "pixels": list(GRID.shape), "grid": grid_digest(GRID), "margin": list(MARGIN),
        "window_m": 0.5,
    }  # fmt: skip
    store.begin(inputs, GRID, PATCH, WINDOW.sides)
    return store


def expected_of(height_m):
    valid = ~np.isnan(height_m)
    sd_m = np.full(height_m.shape, np.float32(SD_M), np.float64)
    height_m = np.nan_to_num(height_m).astype(np.float64)
    return in_shadow(GRID, height_m, sd_m, valid, tangents(), WINDOW)


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", [1, 2])
def test_shadows_are_those_of_a_relief_in_memory(tmp_path, seed):
    """In any order of the patches, and whatever each of them took for shadow."""
    random = np.random.default_rng(seed)
    height_m, store = seabed(), begun(tmp_path / "a.zarr")
    expected = expected_of(height_m)
    assert expected[30:].mean() > 0.1
    order = list(Layout(GRID, PATCH).indices())
    random.shuffle(order)
    for index in order:
        write(store, index, height_m, ~np.isnan(height_m) & (random.random(GRID.shape) < 0.1))
    assert mask_shadows(store) > 1
    for name, values in (
        ("height_m", height_m),
        ("sd_m", np.where(np.isnan(height_m), np.nan, SD_M)),
    ):
        values = values.astype(np.float32)
        np.testing.assert_array_equal(
            store.read_layer(name), np.where(expected, np.float32(np.nan), values)
        )
        np.testing.assert_array_equal(
            store.read_layer(f"shadow_{name}"), np.where(expected, values, np.float32(np.nan))
        )
    assert not store.damage()
    for index, record in store.records().items():
        window = Layout(GRID, PATCH).window(index)
        mask = store.heights(window.rows, window.columns).mask
        assert record.heights["valid"] == mask.mean()
    assert mask_shadows(store) == 0


@pytest.mark.exhaustive
def test_pixels_leave_the_shadow_if_its_patch_is_measured_again(tmp_path):
    height_m, store = seabed(), begun(tmp_path / "a.zarr")
    none = np.zeros(GRID.shape, bool)
    for index in Layout(GRID, PATCH).indices():
        write(store, index, height_m, none)
    mask_shadows(store)
    level_m = np.where(height_m > 0.5, np.float32(0), height_m)
    rows = slice(0, PATCH[0])
    height_m[rows] = level_m[rows]
    for column in range(Layout(GRID, PATCH).shape[1]):
        write(store, (0, column), height_m, none)
    mask_shadows(store)
    assert np.array_equal(
        np.isnan(store.read_layer("height_m")), np.isnan(height_m) | expected_of(height_m)
    )
    assert expected_of(height_m).any()


@pytest.mark.exhaustive
def test_patches_without_heights_hide_nothing(tmp_path):
    height_m, store = seabed(), begun(tmp_path / "a.zarr")
    of_wall = slice(0, PATCH[0])
    height_m[of_wall] = np.nan
    for index in Layout(GRID, PATCH).indices():
        write(store, index, height_m, np.zeros(GRID.shape, bool))
        if index[0] == 0:
            window = Layout(GRID, PATCH).window(index)
            layers = {
                name: np.full(window.grid.shape, np.nan, np.float32)
                for name in (*LAYERS, *SHADOWED)
            }
            record = Record(1, 1, heights={"reason": "the track passes above"})
            pixels = np.zeros(window.grid.shape, np.complex64)
            store.write(*index, window.rows, window.columns, pixels, record, layers)
    mask_shadows(store)
    hidden = ~np.isnan(store.read_layer("shadow_height_m"))
    assert np.array_equal(hidden, expected_of(height_m))
    assert hidden.any()


def see_through_banks(wall_m):
    """Both banks over a wall before a level seabed, with echoes from its shadow."""
    random = np.random.default_rng(4)
    places_m = random.uniform([-1.0, 30.0, 0], [1.0, 34.4, 0], (20000, 3))
    places_m[:, 2] = np.where(places_m[:, 1] < 31, wall_m, 0.0)
    points = clsas.PointTargets(places_m, random.standard_normal((20000, 2)) @ [1, 1j])
    tx_m, *receivers_m = track()
    return [
        clsas.simulate_lines(
            tx_m, rx_m, points, carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ, window="hamming",
            first_range_m=31.0, length=600,
        )
        for rx_m in receivers_m
    ]  # fmt: skip


@pytest.mark.exhaustive
def test_the_shadow_of_a_wall_crosses_patches(tmp_path):
    lines = see_through_banks(0.9)
    grid = clsas.Grid.plane((-0.4, 0.4, 41), (29.9, 34, 206))
    request = {"search_m": (-0.4, 1.3), "window_m": 0.22}
    whole = clsas.heights(*lines, grid, **request)
    store = clsas.mosaic_heights(*lines, grid, tmp_path / "a.zarr", **request, patch_m=0.6)
    assert len(store.records()) > 10
    found = store.heights()
    # The wall ends at 31 m, and hides 2.3 m of the seabed where it fills a window.
    first, last, beyond = np.searchsorted(grid.axes_m[1], [31.1, 33.0, 33.4])
    shadow = slice(first, last), slice(7, -7)
    assert not whole.mask[shadow].any()
    assert not found.mask[shadow].any()
    assert found.mask[beyond:].mean() > 0.95
    assert np.mean(found.mask != whole.mask) < 0.04  # edges, as on any relief
    seen_m = store.read_layer("shadow_height_m")[shadow]
    assert np.mean(np.abs(seen_m) < 0.02) > 0.95
