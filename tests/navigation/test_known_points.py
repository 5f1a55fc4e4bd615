"""Calibration with known points against offsets of the lines."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2

import clsas
from clsas.cli import main
from clsas.engine.data.validate import ClsasWarning
from clsas.navigation.calibration import UNKNOWNS, calibrate_track

SONAR = clsas.Sonar(
    clsas.Pulse(100e3, 30e3, 1e-3),
    [[0.0, 0.0, 0.0]],
    sound_speed_m_s=1490.0,
    tx_length_m=0.03,
    rx_length_m=0.03,
)
POINTS = np.array([[3.0, 6.0, -7.0], [5.0, 21.0, -1.0], [4.0, 15.5, 6.0], [2.0, 10.0, -2.0]])
TRUE = {"time_offset": 4e-4, "sound_speed": -10.0, "forward": 0.2, "port": -0.15, "up": 0.1}
SIZES = {"time_offset": 1e-6, "sound_speed": 0.1, "forward": 1e-3, "port": 1e-3, "up": 1e-3}


def passage(pings=160, length_m=8.0):
    """Return a track that turns and rolls, so that the lever arm matters."""
    at = np.arange(pings) * length_m / (pings - 1)
    yaw = np.radians(4) * np.sin(at)
    positions = np.stack([at, 0.1 * np.sin(0.7 * at), 5 + 0.05 * np.cos(at)], axis=1)
    return clsas.Track(positions, np.arange(pings), yaw_rad=yaw, roll_rad=0.02 * np.sin(2 * at))


def true_lines(points=POINTS, amplitudes=(1.0, 0.5, 2.0, 1.0), track=None, sonar=SONAR):
    scene = clsas.PointTargets(points, list(amplitudes)[: len(points)])
    echoes = clsas.simulate(sonar, track or passage(), scene, range_m=(9.0, 26.0))
    return clsas.compress(echoes)


def with_offsets(lines, track, offsets, sonar_speed=1490.0):
    """Return lines with offsets that a calibration must undo."""
    shift = np.array([offsets.get(name, 0.0) for name in UNKNOWNS[2:]])
    vectors = np.einsum("pij,j->pi", track.rotations.as_matrix(), shift)
    vectors = np.repeat(vectors, lines.channels // track.pings, axis=0)
    speed = sonar_speed - offsets.get("sound_speed", 0.0)
    ratio = speed / sonar_speed
    first = ratio * lines.first_range_m - speed / 2 * offsets.get("time_offset", 0.0)
    return replace(
        lines,
        first_range_m=first,
        range_step_m=ratio * lines.range_step_m,
        sound_speed_m_s=speed,
        tx_m=lines.tx_m - vectors,
        rx_m=lines.rx_m - vectors,
    )


def with_noise(lines, snr_db, rng):
    """Return lines with noise of their own band, at a level below the strongest sample."""
    spectrum = np.sqrt(np.mean(np.abs(np.fft.fft(lines.samples, axis=1)) ** 2, axis=0))
    white = rng.standard_normal((*lines.samples.shape, 2)) @ [1, 1j]
    noise = np.fft.ifft(np.fft.fft(white, axis=1) * spectrum, axis=1)
    noise *= np.abs(lines.samples).max() / np.sqrt(np.mean(np.abs(noise) ** 2))
    noisy = lines.samples + 10 ** (-snr_db / 20) * noise
    return replace(lines, samples=noisy.astype(np.complex64))


@pytest.fixture(scope="module")
def lines():
    return true_lines()


def errors(found, true=TRUE):
    return np.array([found.values[n] - true[name] for n, name in enumerate(found.unknowns)])


def test_all_offsets_are_found_at_once(lines):
    given = with_offsets(with_noise(lines, 45, np.random.default_rng(0)), passage(), TRUE)
    found = calibrate_track(given, POINTS, unknowns=UNKNOWNS, track=passage(), search_m=0.8)
    assert found.unknowns == UNKNOWNS
    assert not found.held
    assert (np.abs(errors(found)) < [SIZES[name] for name in UNKNOWNS]).all(), found
    assert (np.abs(errors(found)) < 4 * found.sd).all(), found
    assert found.phases.all()
    assert (found.residual_rms_m < 1e-3).all()
    assert found.sound_speed_m_s == pytest.approx(1490, abs=0.1)
    assert found.lever_arm_m == pytest.approx([0.2, -0.15, 0.1], abs=1e-3)
    assert found.range_offset_m == pytest.approx(745 * 4e-4, abs=1e-3)
    assert np.diag(found.correlation) == pytest.approx(1)
    assert re.search(r"sound speed 1(490.0|489.9)\d+ ± 0.00\d+ m/s", repr(found)), found


def peaks_db(lines, reference):
    """Return the levels of an image at the points, relative to the image of other lines."""
    grid = clsas.Grid.points(POINTS[None])
    levels = [np.abs(clsas.backproject(each, grid).pixels) for each in (lines, reference)]
    return 20 * np.log10(levels[0] / levels[1])[0]


def test_every_reflector_is_focused_at_its_position(lines):
    given = with_offsets(with_noise(lines, 45, np.random.default_rng(0)), passage(), TRUE)
    assert peaks_db(given, lines).max() < -10
    found = calibrate_track(given, POINTS, unknowns=UNKNOWNS, track=passage(), search_m=0.8)
    assert np.abs(peaks_db(found.lines, lines)).max() < 0.1


@pytest.mark.exhaustive
def test_no_reflector_is_focused_at_the_expense_of_others(lines):
    """The navigation drifts by 2 mm. The strongest point must not determine all corrections."""
    drift = 2e-3 * np.sin(np.arange(160) / 12)[:, None] * np.array([0, 1, 0])
    drifting = replace(lines, tx_m=lines.tx_m + drift, rx_m=lines.rx_m + drift)
    amplitudes = 1.0, 0.1, 10.0, 1.0
    loud = true_lines(amplitudes=amplitudes)
    given = with_offsets(replace(loud, tx_m=drifting.tx_m, rx_m=drifting.rx_m), passage(), TRUE)
    found = calibrate_track(given, POINTS, unknowns=UNKNOWNS, track=passage(), search_m=0.8)
    assert 0.5e-3 < found.misfit_m < 4e-3
    ideal = peaks_db(drifting, lines)  # the drift costs this much in any case
    assert (peaks_db(found.lines, loud) > ideal - 0.5).all()
    assert np.ptp(found.residual_rms_m) < found.residual_rms_m.mean()


@pytest.mark.exhaustive
def test_deviations_match_the_scatter(lines):
    rng, runs = np.random.default_rng(3), 30
    found = [
        calibrate_track(
            with_offsets(with_noise(lines, 35, rng), passage(), TRUE),
            POINTS,
            unknowns=UNKNOWNS,
            track=passage(),
            search_m=0.8,
        )
        for _ in range(runs)
    ]
    scaled = np.array([errors(each) / each.sd for each in found])
    # Of 5 sums of 30 squared standard normal numbers, one is outside in 1 of 1000 cases.
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs)
    assert (low < np.sum(scaled**2, axis=0)).all(), np.sum(scaled**2, axis=0)
    assert (np.sum(scaled**2, axis=0) < high).all(), np.sum(scaled**2, axis=0)
    assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(runs)


@pytest.mark.slow
def test_envelopes_suffice_where_phases_cannot_be_followed(lines):
    """The navigation is off by a wavelength from ping to ping."""
    rng = np.random.default_rng(4)
    jitter = 6e-3 * rng.standard_normal((160, 1)) * np.array([0, 1, 0])
    names = "time_offset", "sound_speed", "forward"
    others = {**TRUE, "port": 0.0, "up": 0.0}
    given = with_offsets(with_noise(lines, 40, rng), passage(), others)
    given = replace(given, tx_m=given.tx_m + jitter, rx_m=given.rx_m + jitter)
    found = calibrate_track(given, POINTS, unknowns=names, track=passage(), search_m=0.8)
    assert not found.phases.any()
    assert (np.abs(errors(found)) < 4 * found.sd).all(), found
    assert found.misfit_m == pytest.approx(6e-3, rel=0.3)


@pytest.mark.exhaustive
def test_deviations_include_an_error_that_persists_along_the_track(lines):
    """Residuals of a drifting navigation are fewer independent measurements than channels."""
    offsets = {name: TRUE[name] for name in ("time_offset", "sound_speed")}
    scaled = []
    for run in range(10):
        drift = 2e-3 * np.sin(np.arange(160) / (20 + 3 * run) + run)[:, None] * np.array([0, 1, 0])
        given = with_offsets(with_noise(lines, 40, np.random.default_rng(run)), passage(), offsets)
        given = replace(given, tx_m=given.tx_m + drift, rx_m=given.rx_m + drift)
        found = calibrate_track(given, POINTS, search_m=0.8)
        scaled.append(errors(found, offsets) / found.sd)
    assert np.sqrt(np.mean(np.square(scaled))) < 2
    assert np.sqrt(np.mean(np.square(scaled))) > 0.2  # nor are they much too large


@pytest.mark.exhaustive
def test_noise_is_no_reflector():
    """A few of many channels exceed any threshold by chance, and must not be used."""
    place_m = np.stack([0.01 * np.arange(640), np.zeros(640), np.zeros(640)], axis=1)
    refused = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        samples = rng.standard_normal((640, 240, 2)) @ [1, 1j]
        noise = clsas.RangeLines(samples, 11.5, 0.0125, place_m, place_m, 1e5, 1500.0)
        with pytest.raises(ValueError, match="points_m must be seen, got none that is") as error:
            calibrate_track(noise, [[3.0, 12.5, 0.0], [4.0, 13.5, 0.0]])
        refused.append(max(map(int, re.findall(r"in (\d+) of", str(error.value)))))
    assert max(refused) >= 3  # so that a count of channels alone would accept them


def test_time_and_speed_cannot_be_distinguished_at_one_range():
    track = clsas.Track.straight((0, 0, 0), (0.02, 0, 0), 20, 1.0)
    at = np.array([[0.2, 15.0, 0.0]])
    offsets = {"time_offset": 3e-4}
    given = with_offsets(true_lines(at, (1.0,), track), track, offsets)
    with pytest.warns(ClsasWarning, match="do not distinguish time_offset and sound_speed"):
        found = calibrate_track(given, at)
    assert found.unknowns == ("time_offset",)
    assert found.held == ("sound_speed",)
    assert found.time_offset_s == pytest.approx(3e-4, abs=1e-6)
    assert found.sound_speed_m_s == given.sound_speed_m_s
    with pytest.warns(ClsasWarning, match="time_offset is held at 0 s"):
        other = calibrate_track(given, at, unknowns=("sound_speed", "time_offset"))
    assert other.unknowns == ("sound_speed",)


@pytest.mark.slow
def test_lever_arm_out_of_a_plane_is_not_determined():
    track = clsas.Track.straight((0, 0, 0), (0.05, 0, 0), 120, 1.0)
    at = np.array([[2.0, 12.0, 0.0], [4.0, 18.0, 0.0]])
    given = with_offsets(true_lines(at, (1.0, 1.0), track), track, {"forward": 0.1})
    with pytest.warns(ClsasWarning, match="do not determine up"):
        found = calibrate_track(given, at, unknowns=("forward", "up"))
    assert found.unknowns == ("forward",)
    assert found.lever_arm_m == pytest.approx([0.1, 0, 0], abs=1e-3)


@pytest.mark.slow
def test_a_point_that_some_channels_do_not_see(lines):
    """One point is outside the beam in half of the pings, and another one does not exist."""
    samples = lines.samples.copy()
    range_m = np.linalg.norm(POINTS[1] - lines.tx_m, axis=1)
    for channel in range(80):
        near = int((range_m[channel] - lines.first_range_m[channel]) / lines.range_step_m)
        samples[channel, near - 30 : near + 30] = 0
    offsets = {"time_offset": 2e-4, "sound_speed": -10.0}
    noisy = with_noise(replace(lines, samples=samples), 40, np.random.default_rng(1))
    given = with_offsets(noisy, passage(), offsets)
    found = calibrate_track(given, POINTS, search_m=0.8)
    assert (np.abs(errors(found, offsets)) < [1e-6, 0.1]).all(), found
    assert found.seen[1] <= 85 < found.seen.min(initial=160, where=[True, False, True, True])
    missing = np.concatenate([POINTS, [[2.0, 18.0, 0.0]]])
    with pytest.warns(ClsasWarning, match="1 of 5 points are not seen"):
        found = calibrate_track(given, missing, search_m=0.8)
    assert (np.abs(errors(found, offsets)) < [1e-6, 0.1]).all(), found
    assert found.seen[4] == 0
    assert np.isnan(found.residual_rms_m[4])


@pytest.mark.slow
def test_receivers_of_an_array_that_move():
    rx_m = [[0.1 * n - 0.35, 0.0, 0.0] for n in range(8)]
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 1e-3), rx_m, sound_speed_m_s=1490.0,
        tx_length_m=0.03, rx_length_m=0.03,
    )  # fmt: skip
    track = clsas.Track.straight((0, 0, 5), (2.0, 0, 0), 20, 0.2)
    scene = clsas.PointTargets(POINTS, np.ones(4))
    echoes = clsas.simulate(sonar, track, scene, range_m=(9.0, 26.0), motion_in_flight=True)
    given = with_offsets(clsas.compress(echoes), track, TRUE)
    found = calibrate_track(given, POINTS, unknowns=UNKNOWNS, search_m=0.8)
    assert (np.abs(errors(found)) < [SIZES[name] for name in UNKNOWNS]).all(), found


@pytest.mark.slow
def test_reflectors_are_not_mistaken_for_each_other(lines):
    """Two of the reflectors are 1.2 m apart in range, less than 50 resolution cells."""
    given = with_offsets(with_noise(lines, 40, np.random.default_rng(1)), passage(), TRUE)
    found = calibrate_track(given, POINTS, unknowns=UNKNOWNS, track=passage())
    assert (np.abs(errors(found)) < 4 * found.sd).all(), found
    wrong = POINTS + [0.0, 0.03, 0.0] * np.array([[1], [-1], [1], [-1]])
    with pytest.warns(ClsasWarning, match="reflectors are mistaken for each other"):
        calibrate_track(lines, wrong)


@pytest.mark.slow
def test_bad_input(lines):
    with pytest.raises(TypeError, match="lines must be of type RangeLines"):
        calibrate_track(POINTS, POINTS)
    with pytest.raises(ValueError, match="points_m must have shape"):
        calibrate_track(lines, [1.0, 2.0])
    with pytest.raises(ValueError, match="points_m must be finite"):
        calibrate_track(lines, [[1.0, np.nan, 0.0]])
    with pytest.raises(ValueError, match="every entry of unknowns must be one of"):
        calibrate_track(lines, POINTS, unknowns=("time",))
    with pytest.raises(ValueError, match="unknowns must be one or several"):
        calibrate_track(lines, POINTS, unknowns=())
    with pytest.raises(ValueError, match="search_m must be finite"):
        calibrate_track(lines, POINTS, search_m=0.0)
    with pytest.raises(ValueError, match="got point 1 at ranges from 1"):
        calibrate_track(lines, [POINTS[0], [0.0, 100.0, 0.0]])
    with pytest.raises(ValueError, match="points_m must be seen, got none that is: echoes must"):
        calibrate_track(with_noise(lines, 0, np.random.default_rng(0)), [[4.0, 22.5, 0.0]])
    with pytest.raises(ValueError, match="track must have a pose for each of the 160 pings"):
        calibrate_track(lines, POINTS, track=passage(20))
    with pytest.raises(TypeError, match="track must be of type Track"):
        calibrate_track(lines, POINTS, track=1)
    still = replace(lines, tx_m=lines.tx_m[0], rx_m=lines.rx_m[0])
    with pytest.raises(ValueError, match="track must be given"):
        calibrate_track(still, POINTS, unknowns=("forward",))
    silent = replace(lines, samples=np.zeros_like(lines.samples))
    with pytest.raises(ValueError, match="points_m must be seen"):
        calibrate_track(silent, POINTS)


@pytest.mark.slow
def test_command(lines, tmp_path):
    given = with_offsets(lines, passage(), {"time_offset": 2e-4, "sound_speed": -10.0})
    source, corrected = tmp_path / "lines.h5", tmp_path / "corrected.h5"
    clsas.save(source, given)
    points = [part for at in POINTS for part in ("--point", ",".join(map(str, at)))]
    command = ["known-points", str(source), *points, "--search-m", "0.8", "-o", str(corrected)]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.output
    assert "time offset" in done.output
    assert "at 4 points" in done.output
    assert "no displacement or bend of the whole track" in done.output
    done = CliRunner().invoke(main, [*command, "--json"])
    results = json.loads(done.output)
    assert results["sound_speed_m_s"] == pytest.approx(1490, abs=0.1)
    assert results["unknowns"] == ["time_offset", "sound_speed"]
    assert clsas.load(corrected).sound_speed_m_s == pytest.approx(1490, abs=0.1)
    assert CliRunner().invoke(main, ["known-points", str(source)]).exit_code == 2
