"""Heights of simulated reliefs against the reliefs themselves."""

import warnings
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from reliefs import BAND_HZ, CARRIER_HZ, GRID, banks, flat_banks, truth
from tiers import also, few

import clsas
from clsas.engine import promise
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import open_device
from clsas.interferometry.checks import Request
from clsas.interferometry.heights import heights, measure
from clsas.interferometry.pair import Pair

AMBIGUITY_M = 2.06  # 2 pi R/(k B): a wavelength of 15 mm, 34.2 m of range, 0.25 m between the banks
WINDOW_M = 0.22
COHERENT = 0.7
SEEDS = (
    1,
    2,
)  # a scene has about 80 independent windows, so the mean of one varies by 0.11 deviations


def flat(x, y):
    return 0 * x + 0 * y


def facing(x, y):
    return 0.5 * (y - 32) + 0 * x


def averted(x, y):
    return -0.25 * (y - 32) + 0 * x


def across(x, y):
    return 0.5 * x + 0 * y


def dunes(x, y):
    return 0.15 * np.sin(2 * np.pi * (y - 32) / 3) + 0.05 * x


def rock(x, y):
    return 0.3 * np.exp(-2 * (x**2 + (y - 32) ** 2))


def step(x, y):
    return 1.5 * AMBIGUITY_M * (x > 0) + 0 * y


# The far side of the rock is 25 dB darker than the seabed beside it, and full of its side lobes.
LOW_SIDE_LOBES = clsas.BeamWindow(14.0, "hann")

# Receivers ahead of the transmitter, the upper bank more. Yaw moves them across the track.
AHEAD_M = ((0.5, 0.1, 0.0), (0.55, 0.05, 0.25))

SCENES = {
    "flat": (flat, {}),
    "facing": (facing, {}),
    "averted": (averted, {}),
    "across": (across, {}),
    "dunes": (dunes, {}),
    "rock": (rock, {}),
    "step": (step, {}),
    "sway and roll": (dunes, {"sway_m": 0.1, "roll_rad": 0.05}),
    "sway and yaw": (dunes, {"sway_m": 0.1, "yaw_rad": 0.05, "arms_m": AHEAD_M}),
}


@pytest.fixture(scope="module")
def measured():
    """Errors of every scene at two levels of noise, computed once from several seeds each."""
    found = {}

    def of(name, snr_db):
        if (name, snr_db) not in found:
            relief, options = SCENES[name]
            search_m = (-1.0, 4.0) if relief is step else (-1.5, 1.5)
            results = [
                heights(
                    *banks(relief, snr_db=snr_db, seed=seed, **options), GRID,
                    search_m=search_m, window_m=WINDOW_M,
                )
                for seed in SEEDS
            ]  # fmt: skip
            found[name, snr_db] = Errors(
                *(
                    np.stack(each)
                    for each in zip(
                        *(
                            (r.height_m - truth(relief), r.sd_m, r.mask, r.coherence)
                            for r in results
                        ),
                        strict=True,
                    )
                )
            )
        return found[name, snr_db]

    return of


class Errors(NamedTuple):
    """Errors of heights, [seeds, rows, columns]."""

    error_m: np.ndarray
    sd_m: np.ndarray
    mask: np.ndarray
    coherence: np.ndarray


def coherent(result):
    return result.mask & (result.coherence > COHERENT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "snr_db"),
    few(product(SCENES, [17, 7]), often=[("sway and yaw", 17)]),
)
def test_errors_are_as_large_as_predicted(measured, name, snr_db):
    result = measured(name, snr_db)
    some = coherent(result)
    # The side of the dunes and the rock that faces away is too dark at 7 dB.
    assert some.mean() > (0.8 if snr_db == 17 else 0.5)
    rms_m, predicted_m = (
        np.sqrt(np.mean(each[some] ** 2)) for each in (result.error_m, result.sd_m)
    )
    assert 0.7 * predicted_m < rms_m < 1.3 * predicted_m
    assert abs(np.mean(result.error_m[some] / result.sd_m[some])) < 0.3


@pytest.mark.exhaustive
@pytest.mark.parametrize("snr_db", [17, 7])
def test_intervals_contain_the_truth_as_often_as_they_say(measured, snr_db):
    inside = []
    for name in SCENES:
        result = measured(name, snr_db)
        some = coherent(result)
        inside.append(np.mean(np.abs(result.error_m[some]) < 1.96 * result.sd_m[some]))
    assert 0.93 < np.mean(inside) < 0.97


@pytest.mark.exhaustive
@pytest.mark.parametrize("snr_db", [17, 7])
def test_intervals_on_a_rock(snr_db):
    """Eight seeds: the share of two of them alone, 160 windows in all, scatters by 2 %."""
    inside = []
    for seed in range(1, 9):
        lines = banks(rock, snr_db=snr_db, seed=seed)
        result = heights(*lines, GRID, search_m=(-1.5, 1.5), window_m=WINDOW_M)
        some = coherent(result)
        error_m = (result.height_m - truth(rock))[some]
        inside.append(np.mean(np.abs(error_m) < 1.96 * result.sd_m[some]))
    assert 0.93 < np.mean(inside) < 0.97


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "beam"), [("dunes", None), ("rock", LOW_SIDE_LOBES)])
def test_intervals_of_little_noise_contain_curvature_too(name, beam):
    relief, _ = SCENES[name]
    inside = []
    for seed in SEEDS:
        result = heights(
            *banks(relief, snr_db=35, seed=seed), GRID, search_m=(-1.5, 1.5), window_m=WINDOW_M,
            beam=beam,
        )  # fmt: skip
        some = coherent(result)
        assert some.mean() > 0.95
        error_m = (result.height_m - truth(relief))[some]
        inside.append(np.mean(np.abs(error_m) < 1.96 * result.sd_m[some]))
    assert 0.93 < np.mean(inside) < 0.97


@pytest.mark.exhaustive
@pytest.mark.parametrize("snr_db", [17, 7])
def test_no_cycle_is_wrong(measured, snr_db):
    for name in SCENES:
        result = measured(name, snr_db)
        wrong = np.abs(result.error_m[result.mask]) > AMBIGUITY_M / 2
        assert wrong.mean() < 0.005


@pytest.mark.exhaustive
def test_a_swaying_track_does_not_blur_a_step():
    """Images of the plane are blurred at its top, by less than those of the relief correct."""
    lines = banks(step, snr_db=17, sway_m=0.14)
    result = heights(*lines, GRID, search_m=(-1.0, 4.0), window_m=WINDOW_M)
    assert result.mask.mean() > 0.7
    error_m = (result.height_m - truth(step))[result.mask]
    assert np.mean(np.abs(error_m) > AMBIGUITY_M / 2) < 0.005
    assert np.sqrt(np.mean(error_m**2)) < 1.3 * np.sqrt(np.mean(result.sd_m[result.mask] ** 2))


@pytest.mark.exhaustive
def test_relief_of_several_heights_of_ambiguity():
    def tall(x, y):
        return 1.0 * np.sin(2 * np.pi * (y - 32) / 12) + 0.1 * np.sin(np.pi * x)

    grid = clsas.Grid.plane((-0.5, 0.5, 51), (29, 35, 301))
    extent_m = (-0.9, 0.9), (27.5, 36.5)
    lines = banks(tall, snr_db=10, extent_m=extent_m, baseline_m=1.5)
    result = heights(*lines, grid, search_m=(-1.3, 1.3), window_m=0.18)
    some = coherent(result)
    assert some.mean() > 0.7
    ambiguity_m = 2 * np.pi * np.median(np.abs(result.m_per_rad))
    error_m = result.height_m - truth(tall, grid)
    assert np.ptp(truth(tall, grid)) > 5.8 * ambiguity_m
    assert np.mean(np.abs(error_m[result.mask]) > ambiguity_m / 2) < 0.005
    rms_m, predicted_m = (np.sqrt(np.mean(each[some] ** 2)) for each in (error_m, result.sd_m))
    assert rms_m < 1.3 * predicted_m


@pytest.mark.exhaustive
def test_a_coarse_relief_narrows_the_search():
    """The relief is seven heights of ambiguity high, and the search is one high."""

    def coarse(x, y):
        return 1.0 * np.sin(2 * np.pi * (y - 32) / 12) + 0.05 + 0 * x

    def fine(x, y):
        return coarse(x, y) + 0.08 * np.sin(2 * np.pi * y / 3) * np.cos(np.pi * x)

    grid = clsas.Grid.plane((-0.5, 0.5, 51), (29, 35, 301), z=-20)
    lines = banks(fine, snr_db=10, extent_m=((-0.9, 0.9), (27.5, 36.5)), baseline_m=1.5)
    start = grid.with_height(truth(coarse, grid) + 20)
    found = heights(*lines, start, search_m=(-0.15, 0.15), window_m=0.18)
    plane = clsas.Grid.plane((-0.5, 0.5, 51), (29, 35, 301))
    wide = heights(*lines, plane, search_m=(-1.3, 1.3), window_m=0.18)
    error_m = found.height_m - (truth(fine, grid) + 20)
    ambiguity_m = 2 * np.pi * np.median(np.abs(found.m_per_rad))
    assert np.ptp(truth(coarse, grid)) > 6.5 * ambiguity_m
    some = coherent(found)
    assert some.mean() > 0.7
    assert np.mean(np.abs(error_m[found.mask]) > ambiguity_m / 2) < 0.005
    rms_m, predicted_m = (np.sqrt(np.mean(each[some] ** 2)) for each in (error_m, found.sd_m))
    assert rms_m < 1.3 * predicted_m
    both = found.mask & wide.mask
    assert both.mean() > 0.97 * wide.mask.mean()
    apart = (found.height_m - 20 - wide.height_m)[both] / wide.sd_m[both]
    assert np.sqrt(np.mean(apart**2)) < 0.3


@pytest.mark.exhaustive
def test_lit_slopes_of_a_known_relief_are_not_in_shadow():
    """Twice as steep a slope would be: the line of sight falls by 0.37 m per metre."""
    lines = banks(averted, snr_db=17)
    start = GRID.with_height(truth(averted))
    sloping = heights(*lines, start, search_m=(-0.5, 0.5), window_m=WINDOW_M)
    level = heights(*lines, GRID, search_m=(-1.0, 1.0), window_m=WINDOW_M)
    assert level.mask.mean() > 0.8
    assert sloping.mask.mean() > 0.97 * level.mask.mean()


@pytest.mark.exhaustive
def test_a_level_relief_is_a_plane_at_its_height():
    lines = flat_banks()
    low = clsas.Grid.plane((-0.8, 0.8, 81), (30.8, 33.2, 121), z=-0.4)
    start = low.with_height(np.full(low.shape, 0.4))
    raised = heights(*lines, start, search_m=(-0.5, 0.5), window_m=WINDOW_M)
    plane = heights(*lines, GRID, search_m=(-0.5, 0.5), window_m=WINDOW_M)
    assert np.mean(raised.mask == plane.mask) > 0.999
    both = raised.mask & plane.mask
    apart_m = np.abs(raised.height_m - 0.4 - plane.height_m)[both]
    assert apart_m.max() < 0.01 * np.median(plane.sd_m[both])
    assert raised.image.grid.vectors_m[0][2] == -0.4


@pytest.mark.exhaustive
def test_the_tolerance_adds_little_to_the_deviation():
    lines = banks(dunes, snr_db=17)
    device = open_device()
    errors_m = []
    for tolerance_db, accuracy_db in ((-40.0, None), (None, -70.0)):
        pair = Pair(*lines, tolerance_db, accuracy_db, None, device)
        result = measure(pair, GRID, Request((-1.0, 1.0), WINDOW_M, -40.0, 0.5, None), None)
        some = coherent(result)
        errors_m.append(np.sqrt(np.mean((result.height_m - truth(dunes))[some] ** 2)))
    assert errors_m[0] < 1.1 * errors_m[1]


@pytest.mark.slow
def test_low_coherence_is_masked():
    # A signal-to-noise ratio of q gives a coherence of q/(1 + q). From one of 0.3, 2 % of windows
    # with 43 looks reach 0.5 by chance.
    lines = banks(flat, snr_db=10 * np.log10(0.2 / 0.8))
    with pytest.warns(ClsasWarning, match="of the pixels are coherent"):
        result = heights(*lines, GRID, search_m=(-1.5, 1.5), window_m=WINDOW_M)
    assert result.mask.mean() < 0.01
    assert np.isnan(result.height_m[~result.mask]).all()
    assert np.isnan(result.sd_m[~result.mask]).all()
    assert np.median(result.coherence) < 0.45


@pytest.mark.slow
def test_side_lobes_of_a_bright_point_are_masked():
    """They are as coherent as the point, and show its height at other places.

    Without the mask, a quarter of all pixels are valid and wrong, and with it a seventh.
    """
    bright = clsas.PointTargets([[0.0, 32.0, 0.6]], [200.0])
    found = []
    for lines in flat_banks():
        point = clsas.simulate_lines(
            lines.tx_m, lines.rx_m, bright, carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ,
            window="hamming", first_range_m=lines.first_range_m[0], length=lines.length,
        )  # fmt: skip
        found.append(replace(lines, samples=lines.samples + point.samples))
    result = heights(*found, GRID, search_m=(-1.0, 1.0), window_m=WINDOW_M)
    assert np.mean(result.mask & (np.abs(result.height_m) > 0.1)) < 0.18
    assert result.mask[:, np.abs(GRID.axes_m[0]) > 0.4].mean() > 0.7


@pytest.mark.slow
def test_shadow_and_layover_are_masked():
    def cliff(x, y):
        return 1.0 * (y < 31.6) + 0 * x

    def wall(x, y):
        return 1.0 * (y > 32.4) + 0 * x

    shadow = heights(*banks(cliff, snr_db=17), GRID, search_m=(-1.0, 2.0), window_m=WINDOW_M)
    # At a depression of 19 degrees, 1 m casts a shadow of 2.9 m.
    dark = truth(lambda x, y: y + 0 * x) > 31.6
    assert shadow.mask[dark].mean() < 0.01
    assert shadow.mask[truth(lambda x, y: y + 0 * x) < 31.5].mean() > 0.9

    layover = heights(*banks(wall, snr_db=17), GRID, search_m=(-1.0, 2.0), window_m=WINDOW_M)
    # The top of the wall lies at the range of the ground 0.38 m in front of it.
    place = truth(lambda x, y: y + 0 * x)
    mixed = (place > 32.1) & (place < 32.7)
    assert layover.mask[mixed].mean() < 0.2
    error_m = (layover.height_m - truth(wall))[layover.mask]
    assert np.mean(np.abs(error_m) > 5 * layover.sd_m[layover.mask]) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cycles", "snr_db"), few(product([0.3, 1.0, 2.0], [17, 7]), often=[(0.3, 7), (2.0, 17)])
)
def test_searches_beside_the_seabed_warn(cycles, snr_db):
    lines = flat_banks() if snr_db == 17 else banks(flat, snr_db=snr_db)
    off_m = cycles * AMBIGUITY_M
    for search_m, end in (((off_m, off_m + 1.5), "lower"), ((-off_m - 1.5, -off_m), "upper")):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            heights(*lines, GRID, search_m=search_m, window_m=WINDOW_M)
        # Where no pixel finds the seabed in another cycle, a second warning says so.
        assert f"agree best at its {end} end" in str(caught[0].message)
        assert all(each.category is ClsasWarning for each in caught)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "snr_db"),
    few(product(["flat", "facing", "dunes", "rock"], [17, 7]), often=[("rock", 17)]),
)
def test_searches_that_end_at_the_seabed_do_not_warn(name, snr_db):
    relief, _ = SCENES[name]
    lines = banks(relief, snr_db=snr_db)
    low_m, high_m = truth(relief).min(), truth(relief).max()
    for search_m in ((low_m, high_m + 1.5), (low_m - 1.5, high_m)):
        heights(*lines, GRID, search_m=search_m, window_m=WINDOW_M)  # warnings are errors


@pytest.mark.slow
def test_results_describe_themselves():
    result = heights(*flat_banks(), GRID, search_m=(-0.5, 0.5))
    assert 0.2 < result.window_m < 0.4
    assert 30 < np.median(result.looks) < 70
    assert "x 81 pixels" in repr(result)
    assert "% valid, height -0.0" in repr(result)
    assert result.image.grid.height_m is not None
    expected = AMBIGUITY_M / (2 * np.pi)
    assert np.median(np.abs(result.m_per_rad)) == pytest.approx(expected, rel=0.03)
    assert not result.height_m.flags.writeable
    assert not result.mask.flags.writeable


@pytest.mark.slow
def test_banks_in_the_other_order_give_the_same_heights():
    first, second = flat_banks()
    one = heights(first, second, GRID, search_m=(-0.5, 0.5), window_m=WINDOW_M)
    other = heights(second, first, GRID, search_m=(-0.5, 0.5), window_m=WINDOW_M)
    both = one.mask & other.mask
    assert both.mean() > 0.95
    assert np.abs(one.height_m - other.height_m)[both].max() < 0.5 * one.sd_m[both].max()


@pytest.mark.exhaustive
@pytest.mark.parametrize("slope", [-0.25, 0.3])
def test_slopes_without_noise_are_not_masked(slope):
    def relief(x, y):
        return slope * (y - 31.8) + 0 * x

    result = heights(*banks(relief, snr_db=None), GRID, search_m=(-0.7, 0.7))
    assert result.mask.mean() > 0.95


@pytest.mark.slow
def test_planes_and_georeferences_carry_over():
    first, second = flat_banks()
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=90)
    plane = clsas.Grid.oriented([-0.6, 31.0, -0.3], [0, 0.02, 0.002], [0.02, 0, -0.002], (81, 61))
    result = heights(
        replace(first, georeference=place), replace(second, georeference=place), plane,
        search_m=(-0.5, 0.8), window_m=WINDOW_M,
    )  # fmt: skip
    assert result.georeference == place
    assert result.mask.mean() > 0.95
    error_m = result.height_m + plane.positions_m()[..., 2]  # the seabed lies at z = 0
    some = result.mask
    assert np.sqrt(np.mean((error_m[some] / result.sd_m[some]) ** 2)) < 1.3


@pytest.mark.slow
def test_progress_counts_to_its_total():
    calls = []
    heights(
        *flat_banks(), GRID, search_m=(-0.5, 0.5), window_m=WINDOW_M,
        progress=lambda done, total: calls.append((done, total)),
    )  # fmt: skip
    done, totals = zip(*calls, strict=True)
    assert list(done) == sorted(done)
    assert len(set(totals)) == 1
    assert done[-1] == totals[-1]


class TestBadInput:
    def refused(self, match, a=None, b=None, grid=GRID, error=ValueError, **options):
        first, second = flat_banks()
        given = {"search_m": (-0.5, 0.5)} | options
        with pytest.raises(error, match=match):
            heights(first if a is None else a, second if b is None else b, grid, **given)

    def test_a_track_around_the_grid(self):
        angle = 2 * np.pi * np.arange(flat_banks()[0].channels) / flat_banks()[0].channels
        ring_m = [0, 31.8] + 29 * np.column_stack([np.cos(angle), np.sin(angle)])

        def around(lines):
            tx_m, rx_m = (
                np.column_stack([ring_m, each[:, 2]]) for each in (lines.tx_m, lines.rx_m)
            )
            return replace(lines, tx_m=tx_m, rx_m=rx_m)

        self.refused("turns by less than 170 degrees", *map(around, flat_banks()))

    def test_different_pings(self):
        _, second = flat_banks()
        self.refused("same pings.*120 pings.*119 pings", b=second.select(slice(1, None)))
        order = np.r_[1, 0, 2 : second.channels]
        self.refused("same pings in the same order.*channel", b=second.select(order))

    def test_other_carrier(self):
        _, second = flat_banks()
        self.refused("same `carrier_hz`", b=replace(second, carrier_hz=90e3))

    def test_other_water(self):
        first, second = flat_banks()
        profile = clsas.SoundSpeed([0, 30], [1500, 1490], 20.0)
        other = clsas.SoundSpeed([0, 30], [1500, 1480], 20.0)
        refused = "same `sound_speed`.*None and SoundSpeed"
        self.refused(refused, b=replace(second, sound_speed=profile))
        self.refused(
            "same `sound_speed`", replace(first, sound_speed=profile),
            replace(second, sound_speed=other),
        )  # fmt: skip

    def test_silence(self):
        first, _ = flat_banks()
        self.refused("b must contain echoes", b=replace(first, samples=0 * first.samples))

    def test_no_baseline(self):
        first, _ = flat_banks()
        self.refused("apart across the line of sight", b=first)
        along = replace(first, rx_m=first.rx_m + [0.3, 0, 0])
        self.refused("apart across the line of sight", b=along)

    def test_baseline_too_long(self):
        first, _ = flat_banks()
        far = replace(first, rx_m=first.rx_m + [0, 0, 40.0])
        self.refused("closer together, got 40 m between the banks", b=far)

    def test_search(self):
        self.refused("must end below the sonar, which is 12 m", search_m=(-1, 12.5))
        self.refused("within the range of the lines", search_m=(-60, 1))
        self.refused("must end below the sonar", search_m=(-1e6, 1e6))
        self.refused("within the range of the lines", search_m=(-1e6, 1))
        self.refused("search_m must be two ascending numbers in m", search_m=(1, -1))
        self.refused("search_m must have shape", search_m=(1, 2, 3))
        self.refused("search_m must be finite", search_m=(np.nan, 1))

    def test_search_from_a_relief(self):
        high = GRID.with_height(np.full(GRID.shape, 11.8))
        self.refused("must end below the sonar, which is 0.2 m above the grid", grid=high)
        deep = GRID.with_height(np.full(GRID.shape, -60.0))
        self.refused("within the range of the lines", grid=deep)

    def test_grids(self):
        points = clsas.Grid.points(GRID.positions_m())
        self.refused("grid must be a plane or height map.*arbitrary points", grid=points)
        upright = clsas.Grid.oriented([-1, 32, -1], [0, 0, 0.02], [0.02, 0, 0], (99, 99))
        self.refused("a vertical one", grid=upright)
        narrow = clsas.Grid.plane((0, 1, 51), (32, 32, 1))
        self.refused("at least 2 rows and 2 columns", grid=narrow)
        self.refused("grid must be of type Grid", grid=1, error=TypeError)

    def test_windows_and_limits(self):
        self.refused("at least 4 independent samples", window_m=0.03)
        self.refused("window_m must be finite and > 0 and <= 1.62 m", window_m=3.0)
        self.refused("least_coherence must be", least_coherence=1.5)
        self.refused("tolerance_db must be", tolerance_db=-5)
        self.refused("beam must be of type", beam=20, error=TypeError)
        self.refused("a must be of type RangeLines", a=3, error=TypeError)

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore:the error of the image is not known")  # white noise
    def test_nothing_coherent(self):
        first, second = flat_banks()
        random = np.random.default_rng(4)
        noise = (random.standard_normal((*second.samples.shape, 2)) @ [1, 1j]).astype(np.complex64)
        with pytest.warns(ClsasWarning, match="of the pixels are coherent"):
            result = heights(
                first, replace(second, samples=noise), GRID, search_m=(-0.5, 0.5),
                window_m=WINDOW_M,
            )  # fmt: skip
        assert result.mask.mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("height_m", [-1.5, *also(0.2)])
def test_refraction_does_not_displace_heights(height_m):
    """Through a thermocline, heights are right with the profile, and far off without it."""
    random = np.random.default_rng(3)
    places_m = random.uniform([-0.6, 19.2, height_m - 10], [0.6, 21.4, height_m - 10], (8000, 3))
    scene = clsas.PointTargets(places_m, random.standard_normal((8000, 2)) @ [1, 1j])
    tx_m = np.outer(np.linspace(-2, 2, 81), [1, 0, 0]) + [0, 0, -4]
    profile = clsas.SoundSpeed([0, 6, 9, 40], [1510, 1508, 1498, 1497])
    through = [
        clsas.simulate_lines(
            tx_m, tx_m + [0, 0, up_m], scene, carrier_hz=100e3, bandwidth_hz=30e3,
            sound_speed=profile,
        )
        for up_m in (0.0, 0.2)
    ]  # fmt: skip
    grid = clsas.Grid.plane((-0.4, 0.4, 33), (19.8, 20.6, 33), z=-10)
    right, wrong = (
        heights(*pair, grid, search_m=(height_m - 0.5, height_m + 0.5))
        for pair in (through, [replace(lines, sound_speed=None) for lines in through])
    )
    assert right.mask.mean() > 0.9
    errors = (right.height_m - height_m)[right.mask]
    assert abs(errors.mean()) < 0.5 * np.median(right.sd_m[right.mask])
    assert np.sqrt(np.mean(errors**2)) < 1.3 * np.sqrt(np.mean(right.sd_m[right.mask] ** 2))
    assert abs(np.nanmedian(wrong.height_m) - height_m) > 0.1


def test_only_the_last_images_are_certified(monkeypatch):
    """Of both banks, the worse error counts."""
    found = []

    def keep(*arguments, **options):
        found.append(promise.measured(*arguments, **options))
        return found[-1], ""

    monkeypatch.setattr(promise, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr("clsas.interferometry.pair.measured_or_reason", keep)
    part = GRID.window(slice(40, 80), slice(20, 60))
    result = heights(*flat_banks(), part, search_m=(-0.2, 0.2), window_m=WINDOW_M)
    assert len(found) == 2
    assert result.certificate is max(found, key=lambda each: each.error)
    assert result.certificate.error_db < -40
    assert result.certificate.describe() in repr(result)


def test_images_whose_error_cannot_be_measured_are_told(monkeypatch):
    monkeypatch.setattr(promise, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(
        "clsas.interferometry.pair.measured_or_reason", lambda *_: (None, "no guard band")
    )
    part = GRID.window(slice(40, 80), slice(20, 60))
    with pytest.warns(clsas.ClsasWarning, match="images is not known: no guard band"):
        heights(*flat_banks(), part, search_m=(-0.2, 0.2), window_m=WINDOW_M)
