"""Filters that convert two pings to one geometry, and the advance measured after them."""

import numpy as np
import pytest
from studies.navigating import (
    SPACING_M,
    WAVELENGTH_M,
    overlapping_array,
    said_to_be_on,
    seabed,
)

import clsas
from clsas.navigation.correlation import ALL, MIDDLE, Correlator
from clsas.navigation.displacement import surge
from clsas.navigation.overlap import Array, PairGeometry, Swath, overlap

NEAR_M, FAR_M = 12.0, 16.0


def two_pings(excess_m=0.0):
    """Return the first arguments of `surge`, for an array that advances further than navigated."""
    sonar, advance_m = overlapping_array(48, 16)
    nominal, true = (
        clsas.Track.straight((0, 0, 0), (each, 0, 0), 2, 1.0)
        for each in (advance_m, advance_m + excess_m)
    )
    scene = seabed(true, NEAR_M, FAR_M, 3000)
    echoes = clsas.simulate(sonar, true, scene, range_m=(NEAR_M - 0.5, FAR_M + 0.5))
    lines = said_to_be_on(clsas.compress(echoes), sonar, nominal)
    swath = Swath(np.linspace(NEAR_M, FAR_M, 3), element_length_m=(WAVELENGTH_M, WAVELENGTH_M))
    array = Array.of(lines)
    correlator = Correlator(lines, swath)
    pairs = overlap(lines, array, 0, correlator.live)
    return correlator, PairGeometry.of(lines, array, pairs, swath), array.spacing_m


def responses(sine, half_width):
    """Return the responses of the channels of both pings to an echo, as received and filtered."""
    correlator, geometry, _ = two_pings()
    *_, filters = correlator.windows(geometry, half_width)
    range_m = filters.range_m[:1]
    own = geometry.rays(range_m)
    rays = np.sqrt(1 - sine**2)[:, None] * own.mean(axis=0) + sine[:, None] * geometry.forward
    points_m = (range_m * rays + geometry.centre_m.mean(axis=0))[None]
    own_m = range_m * own + geometry.centre_m[:, None]
    pairs = geometry.pairs
    band = len(filters.cycles_per_m) // 2
    received, filtered = [], []
    for channels, matrices in ((pairs.first, filters.first), (pairs.second, filters.second)):
        excess_m = geometry.ranges_m(channels, points_m) - geometry.ranges_m(channels, own_m)
        received.append(np.exp(-2j * np.pi * filters.cycles_per_m[band] * excess_m))
        filtered.append(matrices[0, band] @ received[-1])
    middle = slice(4, -4)  # channels at the ends have neighbours on one side only
    return [[each[middle] for each in pings] for pings in (received, filtered)]


def test_echoes_off_broadside_arrive_with_one_phase():
    """As received, their phases differ along the overlap, which looks like a yaw."""
    received, filtered = responses(np.array([-0.5, 0.5]), ALL)
    error_rad, left_rad = (np.abs(np.angle(a * b.conj())).max() for a, b in (received, filtered))
    assert error_rad > 0.1
    assert left_rad < 0.3 * error_rad


def test_only_the_middle_of_the_beam_passes():
    _, filtered = responses(np.array([-0.5, 0.0, 0.5]), MIDDLE)
    amplitude = np.abs(filtered[0]).mean(axis=0)
    assert amplitude[1] > 0.9
    assert amplitude[[0, 2]].max() < 0.1


@pytest.mark.parametrize("part", [-0.3, 0.0, 0.3])
def test_an_advance_by_part_of_the_spacing_is_measured(part):
    excess_m, deviation_m = surge(*two_pings(part * SPACING_M), MIDDLE)
    assert abs(excess_m - part * SPACING_M) <= 0.03 * SPACING_M
    assert 0 < deviation_m <= 0.03 * SPACING_M


@pytest.mark.parametrize("part", [-1.5, 1.2])
def test_an_advance_beyond_the_spacing_takes_a_step_towards_it(part):
    excess_m, deviation_m = surge(*two_pings(part * SPACING_M), MIDDLE)
    assert excess_m == pytest.approx(np.sign(part) * SPACING_M)
    assert deviation_m == pytest.approx(SPACING_M)
