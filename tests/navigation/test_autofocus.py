"""Autofocus of lines whose navigation does not contain the motion of the sonar."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.ndimage import gaussian_filter1d
from scipy.signal import resample
from studies.focusing import (
    GRID,
    PINGS,
    RADAR_ERRORS,
    RADAR_GRID,
    SCENES,
    SONAR,
    STEP_M,
    WAVELENGTH_M,
    peak_db,
    points,
    radar_pass,
    recorded,
    reflector_db,
    smooth_m,
    smooth_residual_m,
    speckle,
    swaying,
    white_m,
)
from studies.navigating import detrended
from tiers import also, few

import clsas
from clsas.cli import main
from clsas.engine.data.validate import ClsasWarning
from clsas.navigation.autofocus import autofocus

RECORDED = Path(__file__).parents[2] / "../shared/data/gotcha/data_3dsar_pass1_az001_HH.mat"
CASES = "points-smooth", "points-beyond-resolution", "speckle-smooth"


@pytest.mark.slow
@pytest.mark.parametrize("name", few(CASES, often=CASES[2:]))
def test_smooth_sway_is_found(name):
    scene = SCENES[name]
    sway_m = scene.sway_m
    true, nominal = recorded(scene.targets, sway_m)
    found = autofocus(nominal, GRID)
    assert peak_db(nominal, true) < -3
    assert abs(peak_db(found.lines, true)) <= 0.3
    assert smooth_residual_m(found.correction_m[:, 1] - sway_m) <= WAVELENGTH_M / 100
    assert found.focused
    assert found.sharpness_after > 2 * found.sharpness_before


@pytest.mark.slow
def test_smooth_sway_and_jitter():
    sway_m = smooth_m(2 * WAVELENGTH_M) + white_m(0.05 * WAVELENGTH_M)
    true, nominal = recorded(points(), sway_m)
    found = autofocus(nominal, GRID)
    assert abs(peak_db(found.lines, true)) <= 0.5
    assert smooth_residual_m(found.correction_m[:, 1] - sway_m) <= WAVELENGTH_M / 100


@pytest.mark.exhaustive
def test_jitter_alone():
    true, nominal = recorded(points(), white_m(0.1 * WAVELENGTH_M))
    assert peak_db(nominal, true) < -3
    assert abs(peak_db(autofocus(nominal, GRID).lines, true)) <= 1.0


@pytest.mark.slow
def test_a_focused_image_stays_focused():
    true, _ = recorded(points(), np.zeros(PINGS))
    found = autofocus(true, GRID)
    assert abs(10 * np.log10(found.sharpness_after / found.sharpness_before)) <= 0.1
    assert np.abs(found.correction_m).max() <= WAVELENGTH_M / 16


@pytest.mark.slow
def test_speckle_alone_is_not_focused():
    _, nominal = recorded(speckle(0), smooth_m(0.5 * WAVELENGTH_M))
    with pytest.warns(ClsasWarning, match="no bright responses"):
        found = autofocus(nominal, GRID)
    assert not found.focused
    np.testing.assert_array_equal(found.lines.tx_m, nominal.tx_m)


def seen_from_above(motion, unknowns):
    """Return the result for a track above the scene, and its peak relative to the true track's.

    Responses are seen at different depression angles, which distinguishes sway from heave.
    """
    course = (0, 0, 12.0), (STEP_M, 0, 0), PINGS, 1.0
    track = clsas.Track.straight(*course, **motion)
    rng = np.random.default_rng(0)
    at = np.stack([rng.uniform(1.8, 6.2, 80), rng.uniform(8.2, 20.8, 80), np.zeros(80)], axis=1)
    scene = clsas.PointTargets(at, np.exp(2j * np.pi * rng.random(80)))
    true = clsas.compress(clsas.simulate(SONAR, track, scene, element_pattern=True,
        pointing=clsas.Pointing.broadside(depression_rad=0.6)))  # fmt: skip
    geometry = clsas.channels(SONAR, clsas.Track.straight(*course))
    nominal = replace(true, tx_m=geometry.tx_m, rx_m=geometry.rx_m)
    grid = clsas.Grid.plane(x=(1.5, 6.5, 256), y=(8.0, 21.0, 700))
    found = autofocus(nominal, grid, unknowns=unknowns)
    peaks = [
        20 * np.log10(np.abs(clsas.factorize(each, grid, -40.0).pixels).max())
        for each in (nominal, found.lines, true)
    ]
    assert peaks[0] < peaks[2] - 1
    return found, peaks[1] - peaks[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wavelengths", "most"), few([(0.3, 1 / 100), (2.0, 1 / 20)], often=[(0.3, 1 / 100)])
)
def test_sway_and_heave(wavelengths, most):
    """Both are found together, even if they exceed the range resolution."""
    motion = {
        "sway_m": smooth_m(wavelengths * WAVELENGTH_M, 2),
        "heave_m": smooth_m(wavelengths * WAVELENGTH_M, 3),
    }
    found, peak = seen_from_above(motion, ("sway", "heave"))
    for axis, true_m in zip((1, 2), motion.values(), strict=True):
        residual_m = detrended(found.correction_m[:, axis] - true_m)
        assert np.std(gaussian_filter1d(residual_m, 12)) <= most * WAVELENGTH_M
    assert abs(peak) <= 0.3


@pytest.mark.exhaustive
def test_sway_and_heave_of_single_pings():
    motion = {
        "sway_m": white_m(0.05 * WAVELENGTH_M, 12),
        "heave_m": white_m(0.05 * WAVELENGTH_M, 13),
    }
    found, peak = seen_from_above(motion, ("sway", "heave"))
    assert abs(peak) <= 0.5
    true_m = np.stack(list(motion.values()), axis=1)
    residual_m = found.correction_m[:, 1:] - true_m
    residual_m = np.stack([detrended(each) for each in residual_m.T], axis=1)
    # The results of single axes vary by a tenth between seeds.
    assert np.std(residual_m) <= 0.6 * np.std(true_m)


@pytest.mark.exhaustive
def test_surge():
    """Displacements along the track move responses between images of subapertures."""
    found, peak = seen_from_above({"surge_m": smooth_m(WAVELENGTH_M, 2)}, ("surge",))
    assert found.sharpness_after > 1.9 * found.sharpness_before
    assert abs(peak) <= 0.3


@pytest.mark.exhaustive
@pytest.mark.skipif(not RECORDED.exists(), reason=f"no recorded data at {RECORDED}")
@pytest.mark.parametrize(("smooth", "white"), RADAR_ERRORS)
def test_displacements_of_a_recorded_pass_are_undone(smooth, white):
    """The track of a radar is displaced. Without displacement, autofocus does not degrade it."""
    lines = radar_pass(RECORDED)
    nominal, given_db = swaying(lines, smooth, white), reflector_db(lines)
    found = autofocus(nominal, RADAR_GRID)
    assert found.focused
    assert reflector_db(nominal) - given_db < -2 or not smooth + white
    assert reflector_db(found.lines) - given_db >= (-0.3 if smooth + white else 0.0)


def with_carrier(lines):
    """Return lines whose samples still have their carrier, which need a smaller range step."""
    finer = math.ceil(4 * lines.range_step_m * lines.carrier_cycles_per_m)
    samples = resample(lines.samples, finer * lines.length, axis=1)
    step_m = lines.range_step_m / finer
    range_m = lines.first_range_m[:, None] + step_m * np.arange(samples.shape[1])
    samples = samples * np.exp(2j * np.pi * lines.carrier_cycles_per_m * range_m)
    return replace(lines, samples=samples, range_step_m=step_m, carrier_hz=0.0)


@pytest.mark.exhaustive
def test_lines_with_their_carrier_are_focused_alike():
    sway_m = smooth_m(2 * WAVELENGTH_M)
    _, nominal = recorded(points(), sway_m)
    usual, found = autofocus(nominal, GRID), autofocus(with_carrier(nominal), GRID)
    assert found.focused
    assert np.abs(found.correction_m - usual.correction_m).max() <= WAVELENGTH_M / 30
    assert smooth_residual_m(found.correction_m[:, 1] - sway_m) <= WAVELENGTH_M / 100


@pytest.mark.slow
def test_pings_that_receive_nothing_do_no_harm():
    true, nominal = recorded(points(), smooth_m(2 * WAVELENGTH_M))
    silent = np.arange(PINGS) < 50
    samples = np.where(silent[:, None], 0, nominal.samples)
    found = autofocus(replace(nominal, samples=samples), GRID)
    received = replace(true, samples=samples)
    assert found.focused
    assert abs(peak_db(found.lines, received)) <= 0.3
    assert np.isfinite(found.correction_m).all()


def test_bad_arguments():
    _, nominal = recorded(points(), np.zeros(PINGS))
    with pytest.raises(ValueError, match="at least 10 pings"):
        autofocus(nominal.select(slice(0, 9)), GRID)
    with pytest.raises(ValueError, match="unknowns"):
        autofocus(nominal, GRID, unknowns=("roll",))
    with pytest.raises(ValueError, match="unknowns"):
        autofocus(nominal, GRID, unknowns=())
    with pytest.raises(TypeError, match="lines"):
        autofocus(nominal.samples, GRID)
    with pytest.raises(TypeError, match="grid"):
        autofocus(nominal, None)
    with pytest.raises(ValueError, match=r"carrier_hz must be that of the lines, .* got 0 Hz"):
        autofocus(replace(nominal, carrier_hz=0.0), GRID)


@pytest.mark.slow
def test_the_command(tmp_path):
    true, nominal = recorded(points(), smooth_m(0.3 * WAVELENGTH_M))
    clsas.save(tmp_path / "lines.h5", nominal)
    result = CliRunner().invoke(
        main,
        ["focus", str(tmp_path / "lines.h5"), "-o", str(tmp_path / "focused.h5"), "--json"]
        + ["--x", "1.5:6.5:320", "--y", "18:21:220"],
    )
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["focused"]
    assert results["sharpness_after"] > 2 * results["sharpness_before"]
    assert abs(peak_db(clsas.load(tmp_path / "focused.h5"), true)) <= 0.3


@pytest.mark.slow
def test_a_gap_of_the_track():
    """Pings beyond a gap are focused with the others, and no subaperture lies in the gap."""
    kept = np.r_[0:190, 240:PINGS]
    sway_m = smooth_m(0.3 * WAVELENGTH_M)
    true, nominal = recorded(points(), sway_m)
    found = autofocus(nominal.select(kept), GRID)
    assert np.isfinite(found.lines.tx_m).all()
    assert abs(peak_db(found.lines, true.select(kept))) <= 1.0


@pytest.mark.slow
@pytest.mark.filterwarnings("default::clsas.engine.data.validate.ClsasWarning")
@pytest.mark.parametrize("case", ["zeros", "beyond", "one pixel"])
def test_nothing_to_focus_on(case):
    _, nominal = recorded(points(), np.zeros(PINGS))
    grid = GRID
    if case == "zeros":
        nominal = replace(nominal, samples=np.zeros_like(nominal.samples))
    elif case == "beyond":
        grid = clsas.Grid.plane(x=(0, 1, 20), y=(900, 901, 20))
    else:
        grid = clsas.Grid.plane(x=(3, 3, 1), y=(19, 19, 1))
    with pytest.warns(ClsasWarning, match=r"no bright responses to focus on: the grid has [01] "):
        found = autofocus(nominal, grid)
    assert not found.focused
    np.testing.assert_array_equal(found.lines.tx_m, nominal.tx_m)


@pytest.mark.slow
def test_unknowns_that_cannot_be_distinguished():
    """At a single elevation angle, sway and heave change ranges alike."""
    course = (0, 0, 12.0), (STEP_M, 0, 0), PINGS, 1.0
    at = [[x, 18.0, 0.0] for x in np.linspace(2, 6, 20)]
    scene = clsas.PointTargets(at, np.ones(20))
    lines = clsas.compress(clsas.simulate(SONAR, clsas.Track.straight(*course), scene))
    grid = clsas.Grid.plane(x=(1.5, 6.5, 320), y=(17.9, 18.1, 16))
    with pytest.raises(ValueError, match=r"distinguishable, got \('sway', 'heave'\)"):
        autofocus(lines, grid, unknowns=("sway", "heave"))


@pytest.mark.slow
def test_an_unknown_that_changes_no_range():
    _, nominal = recorded(points(), np.zeros(PINGS))
    with pytest.raises(ValueError, match="got heave, which changes it by"):
        autofocus(nominal, GRID, unknowns="heave")
    with pytest.raises(TypeError, match="unknowns must be one or several"):
        autofocus(nominal, GRID, unknowns=3)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-25, 1e10, 1e30])
def test_the_level_of_samples_does_not_matter(scale):
    """Recorders use units from volts to 32-bit integers."""
    scene = SCENES["points-smooth"]
    true, nominal = recorded(scene.targets, scene.sway_m)
    loud = replace(nominal, samples=(nominal.samples * scale).astype(np.complex64))
    found = autofocus(loud, GRID)
    assert found.focused
    assert abs(peak_db(replace(found.lines, samples=nominal.samples), true)) <= 0.3
    assert np.array_equal(found.lines.samples, loud.samples)
    assert smooth_residual_m(found.correction_m[:, 1] - scene.sway_m) <= WAVELENGTH_M / 100


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", [4, *also(5)])
def test_two_bright_points_are_too_few(seed):
    """Either the scene is reported as having no responses, or the track is found."""
    sway_m = smooth_m(2 * WAVELENGTH_M, seed)
    _, nominal = recorded(speckle(2), sway_m)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = autofocus(nominal, GRID)
    if found.focused:
        assert smooth_residual_m(found.correction_m[:, 1] - sway_m) <= WAVELENGTH_M / 16
    else:
        assert any("no bright responses" in str(each.message) for each in caught)
        assert not found.correction_m.any()
