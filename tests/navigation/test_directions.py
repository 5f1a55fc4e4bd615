"""Filters that bring the echoes of two pings to one geometry, and the advance they tell."""

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
from clsas.navigation.advance import surge
from clsas.navigation.directions import ALL, MIDDLE, ranges_m
from clsas.navigation.displacement import Correlator
from clsas.navigation.overlap import Array, overlap
from clsas.navigation.swath import Swath

NEAR_M, FAR_M = 12.0, 16.0


def two_pings(excess_m=0.0):
    """Return what `surge` takes, of an array that advances further than it says."""
    sonar, advance_m = overlapping_array(48, 16)
    said, true = (
        clsas.Track.straight((0, 0, 0), (each, 0, 0), 2, 1.0)
        for each in (advance_m, advance_m + excess_m)
    )
    scene = seabed(true, NEAR_M, FAR_M, 3000)
    echoes = clsas.simulate(sonar, true, scene, range_m=(NEAR_M - 0.5, FAR_M + 0.5))
    lines = said_to_be_on(clsas.compress(echoes), sonar, said)
    swath = Swath(np.linspace(NEAR_M, FAR_M, 3), element_length_m=(WAVELENGTH_M, WAVELENGTH_M))
    array = Array.of(lines)
    return Correlator(lines, swath), lines, array, overlap(lines, array, 0)


def responses(sine, directions):
    """Return what channels of both pings have of an echo, as received and through filters."""
    correlator, lines, array, pairs = two_pings()
    _, frame, filters = correlator.windows(lines, array, pairs, directions)
    range_m = filters.range_m[:1]
    own = frame.rays(correlator.swath, range_m)
    rays = np.sqrt(1 - sine**2)[:, None] * own.mean(axis=0) + sine[:, None] * frame.forward
    points_m = (range_m * rays + frame.centre_m.mean(axis=0))[None]
    band = len(filters.cycles_per_m) // 2
    received, filtered = [], []
    for channels, matrices in ((pairs.first, filters.first), (pairs.second, filters.second)):
        late_m = ranges_m(lines, channels, points_m)
        late_m = late_m - ranges_m(lines, channels, range_m * own + frame.centre_m[:, None])
        received.append(np.exp(-2j * np.pi * filters.cycles_per_m[band] * late_m))
        filtered.append(matrices[0, band] @ received[-1])
    middle = slice(4, -4)  # channels at the ends have partners on one side only
    return [[each[middle] for each in pings] for pings in (received, filtered)]


def test_echoes_off_broadside_arrive_with_one_phase():
    """As received their phases differ along the overlap, which looks like a yaw."""
    received, filtered = responses(np.array([-0.5, 0.5]), ALL)
    error_rad, left_rad = (np.abs(np.angle(a * b.conj())).max() for a, b in (received, filtered))
    assert error_rad > 0.1
    assert left_rad < 0.3 * error_rad


def test_the_middle_of_the_beam_passes_alone():
    _, filtered = responses(np.array([-0.5, 0.0, 0.5]), MIDDLE)
    amplitude = np.abs(filtered[0]).mean(axis=0)
    assert amplitude[1] > 0.9
    assert amplitude[[0, 2]].max() < 0.1


@pytest.mark.parametrize("part", [-0.3, 0.0, 0.3])
def test_an_advance_of_part_of_the_spacing_is_told(part):
    excess_m, deviation_m = surge(*two_pings(part * SPACING_M), MIDDLE)
    assert abs(excess_m - part * SPACING_M) <= 0.03 * SPACING_M
    assert 0 < deviation_m <= 0.03 * SPACING_M


@pytest.mark.parametrize("part", [-1.5, 1.2])
def test_an_advance_beyond_the_spacing_takes_a_step_towards_it(part):
    excess_m, deviation_m = surge(*two_pings(part * SPACING_M), MIDDLE)
    assert excess_m == pytest.approx(np.sign(part) * SPACING_M)
    assert deviation_m == pytest.approx(SPACING_M)
