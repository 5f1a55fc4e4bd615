import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from dense import TRACKS, WAVELENGTH, scene

from clsas.aperture import dense_tracks
from clsas.aperture.dense_channels import SheetRates, first_on_sheet, later_on_sheet
from clsas.aperture.dense_tracks import mean_track_of, sheet, simplest_track, strips
from clsas.aperture.mean_track import APART
from clsas.signal import interpolation
from clsas.signal.spectrum import Spectrum

FLAT = Spectrum(0.0, (np.arange(64) + 0.5) / 128, np.full(64, 1 / 64))


def lines_at(tx_m):
    lines, _ = scene("helix")
    lines = lines.without_samples().select(np.zeros(len(tx_m), int))
    return dataclasses.replace(lines, tx_m=tx_m, rx_m=tx_m)


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
    lines = lines_at(TRACKS[name]())
    found = sheet(lines, WAVELENGTH)
    assert found.is_sheet
    assert np.abs(found.offsets_m(lines.phase_centres_m)).max() < off_m
    for coordinate in (found.coordinate, found.across):
        assert -1e-9 <= coordinate.min() <= coordinate.max() <= 1 + 1e-9


def test_a_closed_ring_meets_at_its_cut():
    found = sheet(lines_at(TRACKS["helix"]()), WAVELENGTH)
    ends_m = found.positions_m(np.array([0.0, 1.0]), np.array([0.3, 0.3]))
    np.testing.assert_allclose(ends_m[0], ends_m[1], atol=1e-5)


def test_a_sheet_of_two_headings_in_a_plane_is_flat_and_as_wide_everywhere():
    passes = [np.linspace([-1, y, 0], [1, y + 0.4, 0], 200) for y in (-0.5, 0.5)]
    found = sheet(lines_at(np.concatenate(passes)), WAVELENGTH)
    along, across = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 5))
    width_m = np.linalg.norm(found.sheet.sideways_m(along, across), axis=-1)
    assert width_m.min() > 0.9 * width_m.max()


def test_channels_on_a_line_have_no_sheet():
    tx_m = np.linspace([0, 0, 0], [5, 1, 0], 400)
    assert sheet(lines_at(tx_m), WAVELENGTH) is None
    assert strips(lines_at(tx_m), WAVELENGTH) is None


def test_each_pass_has_a_strip():
    tx_m = TRACKS["passes"]()
    found = strips(lines_at(tx_m), WAVELENGTH)
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
    found = strips(lines_at(tx_m[given]), WAVELENGTH)
    assert found.strips == 8
    in_passes = found.strip_of(found.coordinate)[np.argsort(given)].reshape(8, 200)
    assert (in_passes == in_passes[:, :1]).all()
    assert len(np.unique(in_passes)) == 8
    assert np.abs(found.offsets_m(tx_m[given])).max() < 1e-9


@pytest.mark.parametrize("name", ["helix", "raster", "spiral", "planar"])
def test_channels_beside_each_other_are_no_passes(name):
    tx_m = np.random.default_rng(2).permutation(TRACKS[name]())
    assert strips(lines_at(tx_m), WAVELENGTH) is None
    assert sheet(lines_at(tx_m), WAVELENGTH).is_sheet


@pytest.mark.slow
def test_short_passes_have_no_strips():
    tx_m = TRACKS["passes"]().reshape(8, 200, 3)[:, :20].reshape(-1, 3)
    assert strips(lines_at(tx_m), WAVELENGTH) is None


def test_only_channels_far_from_any_curve_get_another_shape(monkeypatch):
    tx_m = np.linspace([0, 0, 0], [50, 0, 0], 4000)
    assert simplest_track(lines_at(tx_m), WAVELENGTH)[0] == "track"
    assert simplest_track(lines_at(20 * TRACKS["planar"]()), WAVELENGTH)[0] == "sheet"
    monkeypatch.setattr(dense_tracks, "_SCREENED", 10000)
    assert simplest_track(lines_at(20 * TRACKS["planar"]()), WAVELENGTH)[0] == "track"


def test_points_on_a_sheet_lie_in_the_direction_of_channels():
    """A channel off the sheet is replaced by the point where the line of sight meets the sheet."""
    tx_m = TRACKS["planar"]()
    tx_m[:, 2] += np.random.default_rng(1).normal(0, 0.05, len(tx_m))
    lines = lines_at(tx_m)
    found, point_m = sheet(lines, WAVELENGTH), np.array([[0.4, -0.7, 0.0]])
    along, across = found.apparent_coordinates(point_m, tx_m)
    virtual_m = found.positions_m(along[0], across[0])
    seen, given = (
        each / np.linalg.norm(each, axis=1)[:, None]
        for each in (virtual_m - point_m, tx_m - point_m)
    )
    straight_m = found.positions_m(found.coordinate, found.across) - point_m
    without = straight_m / np.linalg.norm(straight_m, axis=1)[:, None]
    assert np.abs(seen - given).max() < 0.1 * np.abs(without - given).max()


@pytest.mark.parametrize("name", ["helix", "planar", "spiral"])
def test_weights_interpolate_smooth_functions_on_a_sheet(name):
    """There are two stages: from channels to virtual channels, and from these to fewer."""
    track = mean_track_of(lines_at(TRACKS[name]()), "sheet", WAVELENGTH)
    aperture = interpolation.design(6, 2.0, FLAT)
    samples = [line.samples.size for line in (track.line_along(0.5), track.line_across(0.5))]
    rates = [SheetRates(*(np.full((1, n), cycles) for n in samples)) for cycles in (12.0, 6.0)]
    order = np.argsort(track.coordinate)
    coordinates = track.coordinate[order][None], track.across[order][None]
    first, grid = first_on_sheet(track, rates[0], *coordinates, aperture)
    later, last = later_on_sheet(track, rates[1], grid, aperture)

    def function(along, across):
        return np.exp(2j * np.pi * (2.0 * along - 1.7 * across))

    for virtual, given, found in (
        (first, coordinates, grid),
        (later, (grid.coordinate, np.repeat(grid.rows, grid.columns.shape[1], axis=1)), last),
    ):
        width = found.columns.shape[1]
        values = function(found.columns[:, None], found.rows[..., None]).reshape(-1)
        taps = np.arange(virtual.taps)
        index = virtual.base[0][:, None, None] + width * taps[:, None] + taps
        assert 0 <= index.min() <= index.max() < values.size
        across = aperture.weights(virtual.bands.between[0])
        interpolated = np.einsum("nr,nc,nrc->n", across, virtual.weights[0], values[index])
        exact = virtual.ordered(function(*given))[0]
        assert np.abs(interpolated - exact).max() < 0.02
        # Within a band, virtual channels never decrease, and bands hold all channels.
        bounds = virtual.bands.bounds[0]
        assert (bounds[0], bounds[-1]) == (0, len(exact))
        for start, stop in pairwise(bounds):
            assert (np.diff(virtual.base[0][start:stop]) >= 0).all()
