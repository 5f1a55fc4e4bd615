"""Echoes from elsewhere, against powers that are known and responses that are simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import center_of_mass, maximum_filter, minimum_filter
from tiers import also

import clsas
from clsas.engine.data.decibels import in_db
from clsas.engine.data.system import line_array
from clsas.engine.device.device import open_device
from clsas.interferometry.coherence import Window
from clsas.interferometry.pair import Pair
from clsas.interferometry.side_lobes import from_elsewhere, middle, point_response

SHAPE = (60, 81)
WINDOW = Window(5, 7)
LOBE = 0.01  # power at (10, -20) and (-15, 12) from a point, relative to the point


def response(shape=SHAPE):
    found = np.zeros(shape)
    row, column = middle(shape)
    found[row, column] = 3.0
    found[row + 10, column - 20] = found[row - 15, column + 12] = 3.0 * LOBE
    return found


@pytest.mark.parametrize(("level_db", "masked"), [(0, True), (5, True), (14, False)])
def test_lobes_in_the_dark_are_found_where_they_lie(level_db, masked):
    """A block of 30 dB has lobes of 10 dB, which count where they are most of the power."""
    own = 10 ** (level_db / 10) * np.random.default_rng(1).exponential(size=SHAPE)
    own[20:31, 35:50] *= 10 ** (3 - level_db / 10)
    power = own + LOBE * np.roll(own, (10, -20), (0, 1)) + LOBE * np.roll(own, (-15, 12), (0, 1))
    found = from_elsewhere(power, response(), WINDOW)
    lobes = np.zeros(SHAPE, bool)
    lobes[30:41, 15:30] = lobes[5:16, 47:62] = True
    inside, near = (each(lobes, WINDOW.sides) for each in (minimum_filter, maximum_filter))
    assert inside.sum() > 100
    assert found[inside].mean() > 0.95 if masked else not found[inside].any()
    assert not found[~near].any()


def test_even_seabeds_are_not_masked():
    power = np.random.default_rng(2).exponential(size=SHAPE)
    assert not from_elsewhere(power, response(), WINDOW).any()


@pytest.mark.parametrize("shape", [(60, 81), (61, 80), (1, 50), (40, 1)])
def test_a_point_without_lobes_or_echo_masks_nothing(shape):
    power = np.random.default_rng(3).exponential(size=shape) ** 8
    point = np.zeros(shape)
    window = Window(*(min(side, n) for side, n in zip(WINDOW.sides, shape, strict=True)))
    assert not from_elsewhere(power, point, window).any()
    point[middle(shape)] = 1.0
    assert not from_elsewhere(power, point, window).any()


def survey(receivers_repeated):
    """A sonar of 20 cm elements, whose ambiguities lie 4.3 degrees off; and a track with sway."""
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 5e-3), 2 * line_array(6, 0.1), tx_length_m=0.2, rx_length_m=0.2
    )
    speed_m_s = 0.1 * (6 - receivers_repeated) / 0.2
    track = clsas.Track.straight(
        [-9, 0, 20], [speed_m_s, 0, 0], pings=round(18 / (0.2 * speed_m_s)), ping_interval_s=0.2,
        sway_m=lambda time_s: 0.1 * np.sin(time_s),
    )  # fmt: skip
    return sonar, track


def echoes_of(sonar, track, seabed, **options):
    echoes = clsas.simulate(sonar, track, seabed, range_m=(50, 78), **options)
    return clsas.compress(echoes, window="hamming", equalize=True)


@pytest.mark.exhaustive
@pytest.mark.parametrize("repeated", [1, *also(0)])
@pytest.mark.parametrize("width_deg", [6.0, *also(4.0)])
def test_responses_are_those_of_simulated_points(width_deg, repeated):
    """From speckle, the response follows without knowing elements, pulse and weights."""
    sonar, track = survey(repeated)
    beam = clsas.BeamWindow(width_deg, "hann")
    grid = clsas.Grid.plane((-6, 6, 161), (56, 64, 321))
    random = np.random.default_rng(4)
    places_m = random.uniform([-9, 52, 0], [9, 70, 0], (4000, 3))
    speckle = clsas.PointTargets(places_m, random.standard_normal((4000, 2)) @ [1, 1j])
    lines = clsas.density_compensated(echoes_of(sonar, track, speckle))
    pair = Pair(lines, lines, -40.0, None, beam, open_device(None))
    found = point_response(pair, grid, pair.images(grid).imager)
    point_m = grid.positions_m()[middle(grid.shape)]
    true = clsas.density_compensated(echoes_of(sonar, track, clsas.PointTargets([point_m])))
    expected = np.abs(clsas.backproject(true, grid, beam=beam).pixels.astype(complex)) ** 2
    row, column = middle(grid.shape)
    own = np.s_[row - 12 : row + 13, column - 4 : column + 5]
    left, right = np.s_[:, :40], np.s_[:, -40:]  # ambiguities
    for part in (left, right):
        levels_db = [in_db(each[part].sum() / each[own].sum()) for each in (found, expected)]
        assert levels_db[0] == pytest.approx(levels_db[1], abs=1.0)
        places = [center_of_mass(each[part]) for each in (found, expected)]
        np.testing.assert_allclose(places[0], places[1], atol=4)  # 0.1 m and 0.3 m


def test_silent_lines_have_no_response():
    sonar, track = survey(1)
    lines = echoes_of(sonar, track, clsas.PointTargets([[0, 60, 0]]))
    silent = replace(lines, samples=np.zeros_like(lines.samples))
    pair = Pair(silent, silent, -40.0, None, None, open_device(None))
    grid = clsas.Grid.plane((-1, 1, 11), (59, 61, 41))
    power = np.ones(grid.shape)
    assert not from_elsewhere(
        power, point_response(pair, grid, pair.images(grid).imager), Window(3, 3)
    ).any()
