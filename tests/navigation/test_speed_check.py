"""Warnings of a wrong sound speed, which autofocus mistakes for a bend of the track."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from studies.focusing import GRID, PINGS, SONAR, points, recorded, smooth_m, speckle
from tiers import also

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.navigation.autofocus import autofocus

SPEED_M_S = 1500.0


def with_speed(lines, factor):
    """Return lines with another sound speed: times stay the same, and ranges change."""
    return replace(
        lines,
        sound_speed_m_s=factor * lines.sound_speed_m_s,
        range_step_m=factor * lines.range_step_m,
        first_range_m=factor * lines.first_range_m,
    )


def suggested_m_s(lines, grid):
    """Return the sound speed that a warning of autofocus suggests, None without a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ClsasWarning)
        assert autofocus(lines, grid).focused
    if not caught:
        return None
    (message,) = [str(each.message) for each in caught]
    return float(re.search(r"a wrong sound speed may be the cause: ([0-9.]+) m/s, ", message)[1])


@pytest.mark.slow
@pytest.mark.parametrize("percent", [-1.0, *also(0.3, 1.0)])
@pytest.mark.parametrize("scene", [points(3), *also(speckle(20, 3))], ids=["points", "speckle"])
def test_a_wrong_speed_is_reported(scene, percent):
    true, _ = recorded(scene, np.zeros(PINGS))
    assert true.sound_speed_m_s == SPEED_M_S
    nominal = with_speed(true, 1 + percent / 100)
    assert suggested_m_s(nominal, GRID) == pytest.approx(SPEED_M_S, rel=1e-3)


@pytest.mark.slow
def test_a_correct_speed_is_not_reported():
    true, nominal = recorded(points(3), smooth_m(0.3 * 0.015, 3))
    assert suggested_m_s(nominal, GRID) is None
    assert suggested_m_s(true, GRID) is None


@pytest.mark.exhaustive
def test_an_arc_about_the_scene():
    """Ranges curve less along an arc, and so does the correction."""
    angle = np.linspace(-0.2, 0.2, 400)
    at = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    random = np.random.default_rng(5)
    around = np.append(random.uniform(-1.5, 1.5, (40, 2)), np.zeros((40, 1)), axis=1)
    scene = clsas.PointTargets(around + [0, 20.0, 0], np.exp(2j * np.pi * random.random(40)))
    sonar = clsas.Sonar(SONAR.pulse, SONAR.rx_m)
    track = clsas.Track(at, np.arange(400.0), yaw_rad=angle)
    lines = clsas.compress(clsas.simulate(sonar, track, scene, range_m=(17.5, 22.5)))
    grid = clsas.Grid.plane(x=(-1.8, 1.8, 240), y=(18.0, 22.0, 200))
    assert suggested_m_s(with_speed(lines, 1.01), grid) == pytest.approx(SPEED_M_S, rel=2e-3)
