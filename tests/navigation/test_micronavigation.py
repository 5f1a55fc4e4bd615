"""Micronavigation of unknown motion, and its errors compared with their bound."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from studies.navigating import (
    COHERENCES,
    SPACING_M,
    WAVELENGTH_M,
    against_bound,
    detrended,
    jitter_followed,
    navigated,
    noisy_runs,
    overlapping_array,
    point_against_true,
    residual_m,
    said_to_be_on,
    seabed,
    straight_lines,
    voyage,
)
from tiers import also

import clsas
from clsas.cli import main
from clsas.engine.data.validate import ClsasWarning
from clsas.navigation.micronavigation import micronavigate
from clsas.navigation.overlap import Array, overlap

RECORDED = Path(__file__).parents[2] / "../shared/data/fmc_aluminium/contact_notch_aluminium.mat"


def recorded(sonar, true, nominal, scene, near_m, far_m):
    """Return lines recorded on a true track, with the positions of a nominal one."""
    echoes = clsas.simulate(sonar, true, scene, range_m=(near_m - 0.5, far_m + 0.5))
    return said_to_be_on(clsas.compress(echoes), sonar, nominal)


@pytest.fixture(scope="module")
def straight():
    return straight_lines()


@pytest.fixture(scope="module")
def noisy():
    """Return results for many realisations of noise, by coherence."""
    return noisy_runs()


@pytest.mark.exhaustive
@pytest.mark.parametrize("coherence", COHERENCES)
def test_errors_reach_the_bound(noisy, coherence):
    mean = np.mean([run.coherence.mean() for run in noisy[coherence]])
    assert mean == pytest.approx(coherence, abs=0.02)
    for name in ("sway", "yaw"):
        deviation, bias, _ = against_bound(noisy[coherence], name, coherence)
        assert deviation <= 1.3
        assert abs(bias) < 0.3


@pytest.mark.exhaustive
def test_intervals_cover_the_errors(noisy):
    covers = [
        against_bound(runs, name, coherence)[2]
        for coherence, runs in noisy.items()
        for name in ("sway", "yaw")
    ]
    assert 0.93 <= np.mean(covers) <= 0.97


@pytest.fixture(scope="module")
def moving():
    sonar, advance_m = overlapping_array(56, 24)
    pings = 24
    motion = {
        "sway_m": lambda t: 0.1 * np.sin(2 * np.pi * t / 60 + 0.3),
        "yaw_rad": lambda t: np.radians(1) * np.sin(2 * np.pi * t / 27 + 1),
    }
    course = (0, 0, 0), (advance_m, 0, 0), pings, 1.0
    true, nominal = clsas.Track.straight(*course, **motion), clsas.Track.straight(*course)
    points = seabed(true, 12, 20, 10000)
    target = clsas.PointTargets([[true.positions_m[:, 0].mean(), 14.0, 0.0]], [30.0])
    lines = recorded(sonar, true, nominal, (points, target), 12, 20)
    right = said_to_be_on(lines, sonar, true)
    found = micronavigate(
        lines, range_m=(12, 20), element_length_m=WAVELENGTH_M, sway_sd_m=0.1, yaw_sd_deg=1.15
    )
    return lines, right, found, {name: f(np.arange(pings)) for name, f in motion.items()}


@pytest.mark.exhaustive
def test_unknown_motion_is_found(moving):
    _, _, found, motion = moving
    assert np.std(detrended(found.sway_m - motion["sway_m"])) <= WAVELENGTH_M / 16
    assert np.std(found.yaw_rad - motion["yaw_rad"]) < 1e-3
    steps = np.diff(motion["yaw_rad"])
    misses = np.abs(found.yaw_steps_rad - steps) / found.yaw_steps_sd_rad
    assert np.median(misses) < 3


@pytest.mark.exhaustive
def test_an_image_is_focused(moving, platform):
    lines, right, found, _ = moving
    x = float(lines.phase_centres_m[:, 0].mean())
    grid = clsas.Grid.plane(x=(x - 0.6, x + 0.6, 401), y=(13.7, 14.3, 121))
    peaks = {
        name: np.abs(clsas.backproject(each, grid, device=platform, accuracy_db=-40).pixels).max()
        for name, each in (("nominal", lines), ("true", right), ("found", found.lines))
    }
    assert 20 * np.log10(peaks["found"] / peaks["true"]) >= -0.5
    assert peaks["nominal"] < 0.5 * peaks["true"]


@pytest.mark.exhaustive
def test_a_hundred_pings_of_unknown_motion():
    """The array of Sensotek sways by 0.2 m and yaws by 1 degree within every synthetic aperture.

    The echoes come from uneven directions: few points of speckle, and a bright one among them.
    """
    made = voyage(range_m=(12.0, 15.0), points=5000, bright=30.0)
    found = navigated(made, window_m=1.0)
    assert residual_m(made, made.told) > 0.3 * WAVELENGTH_M
    assert residual_m(made, found.lines) <= WAVELENGTH_M / 16
    peak_db, width = point_against_true(made, found.lines)
    assert peak_db >= -0.5
    assert width <= 1.05
    error_m = detrended((found.lines.ping_centres_m - made.true.ping_centres_m)[:, 1])
    reported_m = np.sqrt(np.mean(found.shape_sd_m**2))
    assert np.std(error_m) < 3 * reported_m
    array = [Array.of(each).forward for each in (made.true, made.told)]
    heading, nominal = (np.arctan2(each[:, 1], each[:, 0]) for each in array)
    misses = found.yaw_steps_rad - np.diff(heading - nominal)
    assert np.std(misses) < 1.5 * np.mean(found.yaw_steps_sd_rad) < 1.5**2 * np.std(misses)


@pytest.mark.slow
def test_the_other_side_and_a_seabed_below():
    """Rays to starboard slope down, and sway is horizontal."""
    sonar, advance_m = overlapping_array(48, 16)
    sway_m = 0.01 * np.array([0, 1, 3, 2, 0, -1])
    course = (0, 0, 6.0), (advance_m, 0, 0), 6, 1.0
    true, nominal = clsas.Track.straight(*course, sway_m=sway_m), clsas.Track.straight(*course)
    scene = seabed(true, 8, 14, 5000, side=-1)
    echoes = clsas.simulate(sonar, true, scene, range_m=(9.5, 14.5), element_pattern=False)
    lines = said_to_be_on(clsas.compress(echoes), sonar, nominal)
    found = micronavigate(lines, range_m=(10, 14), side="starboard", seabed_z_m=0.0)
    assert np.std(detrended(found.sway_m - sway_m)) <= WAVELENGTH_M / 16


@pytest.mark.slow
@pytest.mark.skipif(not RECORDED.exists(), reason=f"no recorded data at {RECORDED}")
def test_jitter_of_a_recorded_array_is_followed():
    """20 ns rms of jitter is added to a recorded full matrix, and is found to 5 ns."""
    true_s, found = jitter_followed(RECORDED, 20e-9)
    followed_s = -2 / found.lines.sound_speed_m_s * found.sway_m
    assert np.std(detrended(followed_s - true_s)) <= 5e-9
    assert found.overlap.min() == 63


@pytest.mark.slow
def test_unsuitable_lines_are_refused(straight):
    def one_ping():
        return straight.select(slice(0, 48))

    def single_receivers():
        return straight.select(straight.ping_starts)

    def without_overlap():
        return straight.select(np.arange(straight.channels) // 48 % 2 == 0)

    def noise():
        rng = np.random.default_rng(0)
        samples = rng.standard_normal((*straight.samples.shape, 2)) @ [1, 1j]
        return replace(straight, samples=samples.astype(np.complex64))

    for make, message in (
        (one_ping, "at least 2 pings"),
        (single_receivers, "at least 2 receivers"),
        (without_overlap, "phase centres that overlap.*got 0 between pings 0 and 1"),
        (noise, "must have a coherence of at least .* from ping to ping"),
    ):
        with pytest.raises(ValueError, match=message):
            micronavigate(make(), range_m=(60, 66))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"side": "left"}, "side"),
        ({"range_m": (50, 66)}, "range_m must lie within"),
        ({"range_m": (66, 60)}, "range_m"),
        ({"window_m": 100.0}, "window_m"),
        ({"element_length_m": -1.0}, "element_length_m"),
        ({"sway_sd_m": 0.0}, "sway_sd_m"),
        ({"yaw_sd_deg": np.ones(3)}, "yaw_sd_deg"),
        ({"most_step_m": 0.0}, "most_step_m"),
        ({"correlation_pings": 0.0}, "correlation_pings"),
        ({"seabed_z_m": np.nan}, "seabed_z_m"),
        ({"unknowns": ("roll",)}, "unknowns"),
        ({"most_step_m": 1e3}, "most_step_m"),
        ({"sway_sd_m": 1e-200}, "sway_sd_m must be finite"),
        ({"yaw_sd_deg": 1e200}, "yaw_sd_deg must be finite"),
        ({"seabed_z_m": -1000.0}, "seabed_z_m must differ .* by less than the nearest range"),
        ({"unknowns": ("yaw",)}, "unknowns must include 'sway'"),
    ],
)
def test_arguments_outside_their_limits(straight, options, message):
    with pytest.raises(ValueError, match=message):
        micronavigate(straight, **options)


@pytest.mark.slow
def test_pings_without_coherence_are_bridged(straight):
    samples = straight.samples.copy()
    rng = np.random.default_rng(0)
    samples[96:144] = rng.standard_normal((48, samples.shape[1], 2)) @ [1, 1j]
    lines = replace(straight, samples=samples)
    with pytest.warns(ClsasWarning, match="2 of 20 pairs of pings are not coherent"):
        found = micronavigate(lines, range_m=(60, 66))
    assert np.isinf(found.sway_steps_sd_m[1:3]).all()
    assert np.isfinite(found.sway_m).all()


@pytest.mark.slow
def test_phase_centres_pair_up(straight):
    usable = np.ones(straight.channels, bool)
    pairs = overlap(straight, Array.of(straight), 0, usable)
    assert pairs.pairs == 24
    centres_m = straight.phase_centres_m
    apart_m = np.abs(centres_m[pairs.first] - centres_m[pairs.second]).max()
    assert apart_m < 1e-9
    assert np.ptp(pairs.along_m) == pytest.approx(23 * SPACING_M)


@pytest.mark.exhaustive
def test_an_advance_that_differs_is_found():
    """The navigated advance is 2 % too small, which is a fraction of the spacing of the array."""
    sonar, advance_m = overlapping_array(56, 24)
    true = clsas.Track.straight((0, 0, 0), (advance_m, 0, 0), 6, 1.0)
    nominal = clsas.Track.straight((0, 0, 0), (0.98 * advance_m, 0, 0), 6, 1.0)
    lines = recorded(sonar, true, nominal, seabed(true, 12, 20, 8000), 12, 20)
    found = micronavigate(lines, range_m=(12, 20), element_length_m=WAVELENGTH_M, surge_sd_m=0.05)
    advanced_m = np.diff(found.track.positions_m[:, 0])
    assert np.abs(advanced_m - advance_m).max() <= 0.05 * SPACING_M


@pytest.mark.exhaustive
@pytest.mark.parametrize("every", [5, *also(2)])
def test_sparse_arrays_do_not_take_side_lobes_for_an_advance(every):
    """Elements are shorter than their spacing, so that neighbours share no speckle."""
    sonar, advance_m = overlapping_array(48, 16)
    pings = np.arange(16)
    course = ((0, 0, 0), (advance_m, 0, 0), 16, 1.0)
    yaw_rad = 3e-3 * np.cos(pings)
    true = clsas.Track.straight(*course, sway_m=4e-3 * np.sin(pings), yaw_rad=yaw_rad)
    lines = recorded(
        sonar, true, clsas.Track.straight(*course), seabed(true, 12, 18, 8000, seed=5), 12, 18
    )
    receivers = np.r_[0:16:every, 16:32:every]
    lines = lines.select((32 * pings[:, None] + receivers).ravel())
    found = micronavigate(lines, range_m=(12, 18), element_length_m=WAVELENGTH_M)
    assert np.abs(np.diff(found.surge_m)).max() <= 1e-4
    error = found.yaw_steps_rad - np.diff(yaw_rad)
    assert np.sqrt(np.mean(error**2)) <= 1.5 * np.sqrt(np.mean(found.yaw_steps_sd_rad**2))


@pytest.mark.slow
def test_the_command(straight, tmp_path):
    clsas.save(tmp_path / "lines.h5", straight)
    arguments = ["navigate", str(tmp_path / "lines.h5"), "-o", str(tmp_path / "corrected.h5")]
    options = ["--range-m", "60:66", "--element-length-m", "0.015", "--json"]
    result = CliRunner().invoke(main, arguments + options)
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["overlap"] == 24
    assert results["coherence"] > 0.99
    corrected = clsas.load(tmp_path / "corrected.h5")
    assert np.abs(corrected.rx_m - straight.rx_m).max() < 0.05
    refused = CliRunner().invoke(main, [*arguments, "--range-m", "66:60"])
    assert refused.exit_code == 2
    assert "two ascending numbers in m" in refused.output


@pytest.mark.exhaustive
def test_the_order_of_receivers_does_not_matter(straight):
    """Receivers may be numbered from the bow or from the stern."""
    order = np.concatenate([np.arange(48)[::-1] + start for start in straight.ping_starts])
    moved_m = 0.004 * np.sin(np.arange(21))
    rx_m = straight.rx_m - np.repeat(moved_m, 48)[:, None] * [0.0, 1.0, 0.0]
    tx_m = straight.tx_m - np.repeat(moved_m, 48)[:, None] * [0.0, 1.0, 0.0]
    nominal = replace(straight, rx_m=rx_m, tx_m=tx_m)  # the navigation is off to starboard
    options = {"range_m": (60, 66), "unknowns": ("sway",), "element_length_m": WAVELENGTH_M}
    found, reversed_ = (micronavigate(each, **options) for each in (nominal, nominal.select(order)))
    np.testing.assert_allclose(reversed_.sway_m, found.sway_m, atol=1e-6)
    assert np.std(detrended(found.sway_m - moved_m)) <= WAVELENGTH_M / 100


def small(pings=8, receivers=56, overlapping=24, **motion):
    """Return lines of a few pings whose navigation is straight, with a motion that it lacks."""
    sonar, advance_m = overlapping_array(receivers, overlapping)
    course = (0, 0, 0), (advance_m, 0, 0), pings, 1.0
    true, nominal = clsas.Track.straight(*course, **motion), clsas.Track.straight(*course)
    return recorded(sonar, true, nominal, seabed(true, 12, 15, 5000), 12, 15)


@pytest.fixture(scope="module")
def swaying():
    return small(sway_m=0.004 * np.sin(np.arange(8)))


@pytest.mark.exhaustive
def test_deviations_are_no_larger_than_those_of_the_navigation(swaying):
    for unknowns in (("sway",), ("sway", "yaw", "surge")):
        for correlation in (None, 2.0, 1e4):
            found = micronavigate(
                swaying, range_m=(12, 15), element_length_m=WAVELENGTH_M, unknowns=unknowns,
                sway_sd_m=0.1, yaw_sd_deg=1.15, surge_sd_m=0.05, correlation_pings=correlation,
            )  # fmt: skip
            assert found.sway_sd_m.max() <= 0.1 * (1 + 1e-6)
            assert found.yaw_sd_rad.max() <= 0.02 * (1 + 1e-6)
            assert found.surge_sd_m.max() <= 0.05 * (1 + 1e-6)


@pytest.mark.slow
def test_dead_receivers_are_left_out(swaying):
    """One of the overlapping receivers is dead, and another one for three pings."""
    options = {"range_m": (12, 15), "element_length_m": WAVELENGTH_M}
    whole = micronavigate(swaying, **options)
    samples = swaying.samples.copy()
    samples[4::48] = 0
    samples[30 : 30 + 3 * 48 : 48] *= 1e-3
    with pytest.warns(ClsasWarning, match=r"11 of 384 channels have no signal.*channel 4\)"):
        found = micronavigate(replace(swaying, samples=samples), **options)
    assert found.overlap.tolist() == [22, 22, 22, 23, 23, 23, 23]
    assert np.std(detrended(found.sway_m - whole.sway_m)) < WAVELENGTH_M / 100


@pytest.mark.exhaustive
def test_implausible_corrections_are_reported():
    """They far exceed the accuracy given for the navigation."""
    lines = small(yaw_rad=np.radians(3) * np.sin(np.arange(8)))
    options = {"range_m": (12, 15), "element_length_m": WAVELENGTH_M}
    with pytest.warns(ClsasWarning, match="the yaw found is .* times the accuracy.*yaw_sd_deg"):
        micronavigate(lines, yaw_sd_deg=0.2, **options)
    micronavigate(lines, yaw_sd_deg=3, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"element_length_m": 30.0}, "element_length_m must be from .* got 30 m"),
        ({"element_length_m": 1e-9}, "element_length_m must be from .* twentieth"),
        ({"yaw_sd_deg": 200.0}, "yaw_sd_deg must be .* <= 180 degrees"),
        ({"sway_sd_m": 1e4}, "sway_sd_m must be finite and >= 1e-09 and <= 1000 m, got 10000"),
        ({"range_m": (12.0, 12.05)}, "range_m must be at least 16 samples long"),
        ({"range_m": (15.0, 12.0)}, "the nearest first"),
    ],
)
@pytest.mark.slow
def test_lengths_in_other_units_are_refused(swaying, options, message):
    with pytest.raises(ValueError, match=message):
        micronavigate(swaying, **options)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.slow
def test_positions_in_other_units_are_refused(swaying, factor):
    scaled = replace(swaying, tx_m=factor * swaying.tx_m, rx_m=factor * swaying.rx_m)
    with pytest.raises(ValueError, match=r"phase centres that extend over .* in metres"):
        micronavigate(scaled, range_m=(12, 15), element_length_m=WAVELENGTH_M)


@pytest.mark.slow
def test_constant_lines_are_refused_with_their_coherence(swaying):
    constant = replace(swaying, samples=np.ones_like(swaying.samples))
    with pytest.raises(
        ValueError, match=r"a coherence of at least [0-9.]+ .* got at most 1\.00 in any window"
    ):
        micronavigate(constant, range_m=(12, 15))
