"""Heights of a wreck from two banks, against the surface from which its echoes are simulated."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scenes import kept
from scipy.ndimage import maximum_filter, minimum_filter

import clsas
from clsas.interferometry.coherence import Window
from clsas.selftest import wreck
from clsas.simulation import seabeds

PINGS = slice(14, 56)  # those that see the grid through the beam
GRID = clsas.Grid.plane((-9.0, 3.0, 241), (52.0, 66.0, 701))
SEABED = seabeds.wreck((-10, 4), (50, 72))
LEVEL_M = 0.1  # largest difference of heights within a window that counts as level


class Truth(NamedTuple):
    """What a sonar abeam of every pixel sees there, [rows, columns] each.

    Attributes
    ----------
    height_m : float64
    lit : bool
        True where no other part of the surface is in the line of sight.
    alone : bool
        True where nothing else at the same range, abeam of the same place, is lit.
    """

    height_m: np.ndarray
    lit: np.ndarray
    alone: np.ndarray


def truth(seabed, altitude_m, window_m):
    """Cast a ray from abeam to every pixel, and compare the ranges of those that arrive."""
    x_m, y_m = GRID.axes_m
    height_m = seabed.height_m(x_m, y_m[:, None])
    lit, alone = np.zeros((2, *height_m.shape), bool)
    range_m = np.hypot(y_m[:, None], altitude_m - height_m)
    bins = np.floor(range_m / (window_m / 2)).astype(int)
    for column, x in enumerate(x_m):
        points_m = np.column_stack([np.full(len(y_m), x), y_m, height_m[:, column]])
        lit[:, column] = seabed.lit(points_m, [x, 0, altitude_m])
        rows = np.flatnonzero(lit[:, column])
        low, high = np.full(bins.max() + 2, np.inf), np.full(bins.max() + 2, -np.inf)
        np.minimum.at(low, bins[rows, column], y_m[rows])
        np.maximum.at(high, bins[rows, column], y_m[rows])
        # A level seabed has one place per range.
        alone[rows, column] = (high - low)[bins[rows, column]] < window_m
    return Truth(height_m, lit, alone)


@kept
def simulated_banks():
    """Return range lines of both banks, of the pings that see the middle of the wreck."""
    scene = wreck.scene("wreck_two_banks")
    sonar, track = scene.need("sonar", "track")
    fields = ("positions_m", "time_s", "velocity_m_s", "yaw_rad", "pitch_rad", "roll_rad")
    part = replace(track, **{name: getattr(track, name)[PINGS] for name in fields})
    options = scene.simulate | {"range_m": [52.0, 72.0]}
    lines = clsas.compress(clsas.simulate(sonar, part, SEABED, **options), **scene.compress)
    # The first receiver repeats the phase centre of the sixth. Counted twice, it would make ghosts
    # every 0.9 m along the track, 10 dB below the deck in all.
    return [clsas.density_compensated(lines.bank(number)) for number in (0, 1)]


@pytest.fixture(scope="module")
def banks():
    return simulated_banks()


def measured(banks):
    """Heights of the wreck."""
    beam = wreck.scene("wreck_two_banks").image["beam"]
    return clsas.heights(*banks, GRID, search_m=(-0.5, 7.0), beam=beam)


@pytest.fixture(scope="module")
def found(banks):
    """Heights of the middle of the wreck, and the truth."""
    (track,) = wreck.scene("wreck_two_banks").need("track")
    result = measured(banks)
    return result, truth(SEABED, float(track.positions_m[:, 2].mean()), result.window_m)


class Shares(NamedTuple):
    """Shares of some pixels that are valid, and of those, that are near the truth."""

    valid: float
    within_2_sd: float
    within_3_sd: float
    within_10_cm: float
    median_m: float


def shares(found, chosen):
    result, true = found
    some = chosen & result.mask
    error_m = (result.height_m - true.height_m)[some]
    deviations = np.abs(error_m) / result.sd_m[some]
    return Shares(
        some.sum() / chosen.sum(),
        np.mean(deviations < 2),
        np.mean(deviations < 3),
        np.mean(np.abs(error_m) < 0.1),
        np.median(error_m),
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("low_m", "high_m"), [(4.3, 4.5), (1.9, 2.3), (-0.15, 0.15)], ids=["wheelhouse", "deck", "sand"]
)
def test_level_parts(found, low_m, high_m):
    result, true = found
    sides = Window.of(GRID, result.window_m).sides
    span_m = maximum_filter(true.height_m, sides) - minimum_filter(true.height_m, sides)
    clear = minimum_filter(true.lit & true.alone, sides) & (span_m < LEVEL_M)
    part = shares(found, clear & (true.height_m > low_m) & (true.height_m < high_m))
    assert part.valid > 0.7
    assert part.within_2_sd > 0.9
    assert part.within_3_sd > 0.99
    assert abs(part.median_m) < 0.01


@pytest.mark.exhaustive
def test_all_that_is_lit(found):
    """Bulwark, walls and edges too: at most a twentieth of the valid pixels is wrong."""
    _, true = found
    ship = shares(found, true.lit & (true.height_m > 0.3))
    assert ship.valid > 0.5
    assert ship.within_2_sd > 0.88
    assert ship.within_3_sd > 0.95
    assert ship.within_10_cm > 0.95
    assert shares(found, true.lit & (true.height_m < 0.15)).within_3_sd > 0.97


@pytest.mark.exhaustive
def test_what_cannot_be_measured(found):
    result, true = found
    layover, mast = true.lit & ~true.alone, true.height_m > 5.5
    assert layover.mean() > 0.05
    assert result.mask[layover].mean() < 0.02
    assert result.mask[mast].mean() < 0.1
    # Side lobes and ambiguities of the bulwark, which is 30 dB brighter than sand, lie in shadows.
    assert (~true.lit).mean() > 0.3
    assert result.mask[~true.lit].mean() < 0.05


@pytest.mark.exhaustive
def test_echoes_from_elsewhere_are_masked_and_few_others(found, banks, monkeypatch):
    """Of the lit pixels that are right, at most a hundredth is lost."""
    result, true = found

    def nowhere(power, response, window):
        return np.zeros(power.shape, bool)

    monkeypatch.setattr("clsas.interferometry.heights.from_elsewhere", nowhere)
    without = measured(banks)
    lost = without.mask & ~result.mask
    right = without.mask & true.lit & (np.abs(without.height_m - true.height_m) < 0.1)
    assert without.mask[~true.lit].mean() > 0.1
    assert lost[right].mean() < 0.01
    assert lost[right & (true.height_m < 0.15)].mean() < 0.01
