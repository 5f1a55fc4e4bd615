import numpy as np
import pytest

from clsas.interferometry.coherence import Window
from clsas.interferometry.refinement import filled
from clsas.interferometry.sweep import STEPS_PER_CYCLE, likeliest, relief_of


def volume(cycles, magnitude_at, shape=(20, 24), heights=31, random=None, noise=0.0):
    """Coherence at heights, for scatterers some cycles above the middle of the search."""
    height = (np.arange(heights) - heights // 2) / STEPS_PER_CYCLE
    apart = height[:, None, None] - np.broadcast_to(cycles, shape)
    coherence = magnitude_at(np.abs(apart)) * np.exp(2j * np.pi * apart)
    if random is not None:
        coherence = coherence + noise * (random.standard_normal((heights, *shape, 2)) @ [1, 1j])
    return coherence.astype(np.complex64)


def envelope(apart):
    return 0.9 * np.sinc(0.3 * apart)


def found_cycles(coherence, coarse):
    return (likeliest(coherence, coarse) - len(coherence) // 2) / STEPS_PER_CYCLE


@pytest.mark.parametrize("cycles", [-1.9, -0.25, 0.0, 1.3])
def test_the_most_coherent_cycle_wins(cycles):
    found = found_cycles(volume(cycles, envelope), Window(5, 5))
    assert found == pytest.approx(cycles, abs=0.6 / STEPS_PER_CYCLE)


def test_large_windows_decide_between_cycles_in_noise():
    random = np.random.default_rng(1)
    noisy = volume(0.2, envelope, random=random, noise=0.12)
    small, large = (
        np.mean(np.abs(found_cycles(noisy, window) - 0.2) > 0.5)
        for window in (Window(1, 1), Window(9, 9))
    )
    assert small > 0.1
    assert large == 0


def test_relief_within_a_large_window_keeps_its_heights():
    slope = np.linspace(-0.8, 0.8, 20)[:, None]
    found = found_cycles(volume(slope, envelope), Window(9, 9))
    assert found == pytest.approx(np.broadcast_to(slope, found.shape), abs=0.6 / STEPS_PER_CYCLE)


def test_steps_of_one_and_a_half_cycles():
    step = np.where(np.arange(24) < 12, -0.7, 0.8)
    found = found_cycles(volume(step, envelope), Window(9, 9))
    assert found == pytest.approx(np.broadcast_to(step, found.shape), abs=0.6 / STEPS_PER_CYCLE)


@pytest.mark.parametrize(("drop_m", "seen"), [(0.3, True), (0.75, False), (1.2, False)])
def test_no_pixel_lies_between_surfaces_that_a_cycle_separates(drop_m, seen):
    """The height of ambiguity is 1 m. Row 12 is below the edge in row 10, or on a steep slope."""
    height_m = np.where(np.arange(20) < 10, 0.0, -drop_m)[:, None] + np.zeros(6)
    moved = np.stack([-10 * height_m, 0 * height_m])  # a row for every 0.1 m
    relief = relief_of(moved, height_m, np.ones((20, 6), bool), ambiguity_m=1.0)
    assert relief.height_m[5] == pytest.approx(0.0, abs=1e-9)
    assert (relief.surfaces[5] == 1).all()
    assert (relief.surfaces[12] == seen).all()


def test_slopes_lie_where_the_curves_have_moved():
    row = np.mgrid[:40, :30][0]
    height_m = 0.02 * (row - 20)
    moved = np.stack([10 * height_m, 0 * height_m + 2])
    relief = relief_of(moved, height_m, np.ones(row.shape, bool), ambiguity_m=1.0)
    # Row r lies on curve q with r = q + 0.2 (q - 20).
    expected = 0.02 * ((row + 4) / 1.2 - 20)
    assert relief.height_m[1:-1, 2:] == pytest.approx(expected[1:-1, 2:])
    assert (relief.surfaces[1:-1, 2:-1] == 1).all()
    assert (relief.surfaces[:, :2] == 0).all()


def test_surfaces_at_the_same_ranges_are_counted():
    """A wall brings its top to the rows before it, which the ground below shares with it."""
    row = np.mgrid[:60, :4][0]
    height_m = np.clip(0.1 * (row - 30), 0, 0.4)
    reliable = np.ones(row.shape, bool)
    relief = relief_of(np.stack([-30 * height_m, 0 * height_m]), height_m, reliable, 1.0)
    assert (relief.surfaces[24:28] == 3).all()
    assert relief.height_m[24:28].max() == pytest.approx(0.4)
    assert (relief.surfaces[:18] == 1).all()
    reliable[20:40] = False
    hidden = relief_of(np.stack([-30 * height_m, 0 * height_m]), height_m, reliable, 1.0)
    assert (hidden.surfaces[20:27] == 0).all()


def test_unknown_pixels_take_the_nearest_value():
    values = np.array([[1.0, np.nan, np.nan], [5.0, np.nan, 7.0]])
    found = filled(values, np.isfinite(values))
    assert found[0, 1] in (1, 5)
    assert found[0, 2] == 7
    assert found[1].tolist() in ([5, 5, 7], [5, 7, 7])
    assert not filled(values, np.zeros(values.shape, bool)).any()
