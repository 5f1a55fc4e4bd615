"""Autofocus of a platform that stood still while its navigation moved."""

from dataclasses import replace

import numpy as np
import pytest
from studies.focusing import GRID, PINGS, SONAR, STEP_M, points, recorded, speckle
from studies.navigating import said_to_be_on, with_noise
from tiers import also, few

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.autofocus import autofocus, halt
from clsas.navigation.checks import mean_wavelength_m
from clsas.navigation.responses import READ_DB, Passage, brightest, contributions


def found_halt(lines, grid):
    """Return the first and last ping of a halt, from the brightest responses of the image."""
    readout = Readout.of(lines, READ_DB)
    passage = Passage.of(lines, ("sway",), mean_wavelength_m(readout))
    points_m = brightest(clsas.factorize(lines, grid, -30), 40, 0.1)
    return halt(passage, readout, contributions(passage, readout, lines, points_m, None))


def standing(scene, coherence, seed, *, still=PINGS):
    """Return lines of `still` pings at one position and others along a track, all navigated."""
    course = clsas.Track.straight((0, 0, 0), (STEP_M, 0, 0), PINGS, 1.0)
    lines, _ = recorded(scene, np.zeros(PINGS))
    samples = lines.samples.copy()
    samples[:still] = samples[still // 2]
    lines = with_noise(replace(lines, samples=samples), coherence, np.random.default_rng(seed))
    return said_to_be_on(lines, SONAR, course)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *also(1)])
@pytest.mark.parametrize(
    ("scene", "coherence"),
    few(
        [(points, 0.99), (points, 0.5), (lambda seed: speckle(20, seed), 0.99)],
        often=[(points, 0.5)],
    ),
)
def test_a_platform_that_stood_still_is_reported(scene, coherence, seed):
    nominal = standing(scene(seed), coherence, seed)
    with pytest.warns(ClsasWarning, match="pings 0 to 399 receive the same echoes"):
        found = autofocus(nominal, GRID)
    assert not found.focused
    np.testing.assert_array_equal(found.lines.tx_m, nominal.tx_m)


@pytest.mark.slow
def test_a_halt_of_some_pings_is_reported():
    """The platform stands still for the first 200 pings, and then moves."""
    nominal = standing(points(3), 0.99, 0, still=200)
    with pytest.warns(ClsasWarning, match=r"pings 0 to (159|239) receive the same echoes"):
        assert not autofocus(nominal, GRID).focused


@pytest.mark.slow
@pytest.mark.parametrize("loud", [1.0, 30.0])
def test_a_passage_is_no_halt(loud):
    """This holds even if one response abeam is much brighter than all others."""
    scene = points(2)
    at = np.vstack([scene.positions_m, [[4.0, 19.5, 0.0]]])
    _, nominal = recorded(
        clsas.PointTargets(at, np.append(scene.amplitudes, loud)), np.zeros(PINGS)
    )
    assert found_halt(nominal, GRID) is None


def test_a_circle_about_the_brightest_response_is_no_halt():
    """Its range is the same in every ping, as the navigation predicts."""
    angle = np.linspace(-0.25, 0.25, 200)
    at = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    random = np.random.default_rng(1)
    around = np.append(random.uniform(-1, 1, (31, 2)), np.zeros((31, 1)), axis=1)
    around[-1] = 0.0
    scene = clsas.PointTargets(around + [0.0, 20.0, 0.0], np.append(np.ones(30), 10.0))
    sonar = clsas.Sonar(SONAR.pulse, SONAR.rx_m)
    track = clsas.Track(at, np.arange(200.0), yaw_rad=angle)
    lines = clsas.compress(clsas.simulate(sonar, track, scene, range_m=(18.0, 22.0)))
    grid = clsas.Grid.plane(x=(-1.2, 1.2, 160), y=(18.8, 21.2, 160))
    assert found_halt(lines, grid) is None
    # The same echoes on a straight track are those of a halt.
    straight = clsas.Track.straight((-5, 0, 0), (0.05, 0, 0), 200, 1.0)
    assert found_halt(said_to_be_on(lines, sonar, straight), grid) is not None
