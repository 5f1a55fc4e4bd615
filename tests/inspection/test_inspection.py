"""Inspections of recordings: a clean one, and one for every defect planted in it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from cases import noise
from click.testing import CliRunner
from tiers import also

import clsas
from clsas.cli import main
from clsas.engine.data.pings import Transmissions
from clsas.engine.data.system import line_array, stacked
from clsas.inspection.checks import levels_of, runs

PINGS, ADVANCE_M = 200, 0.02
GRID = clsas.Grid.plane((1.0, 3.0, 100), (18.0, 20.5, 120))
BEAM = clsas.BeamWindow(20.0)


def scene():
    """Speckle, and twenty bright points in it."""
    random, count = np.random.default_rng(3), 800
    places_m = np.stack(
        [random.uniform(-5, 9, count), random.uniform(18.0, 20.5, count), np.zeros(count)], axis=1
    )
    amplitudes = 0.05 * (random.standard_normal((count, 2)) @ [1, 1j])
    amplitudes[:20] = np.exp(2j * np.pi * random.random(20))
    places_m[:20, 0] = random.uniform(0.5, 3.5, 20)
    return clsas.PointTargets(places_m, amplitudes)


@pytest.fixture(scope="module")
def echoes():
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 1e-3), [[0.0, 0, 0]], tx_length_m=0.06, rx_length_m=0.06
    )
    track = clsas.Track.straight((0, 0, 0), (ADVANCE_M, 0, 0), PINGS, 1.0)
    return clsas.simulate(sonar, track, scene(), range_m=(16.5, 24.0))


@pytest.fixture(scope="module")
def lines(echoes):
    return clsas.compress(echoes)


def names(found):
    return [finding.name for finding in found.findings]


def with_samples(lines, change):
    samples = np.array(lines.samples)
    change(samples)
    return replace(lines, samples=samples)


def moved(lines, change):
    position_m = np.array(lines.tx_m)
    position_m = change(position_m)
    return replace(lines, tx_m=position_m, rx_m=position_m)


@pytest.mark.slow
def test_a_clean_recording_has_no_findings(lines, echoes, platform):
    found = clsas.inspect(lines, GRID, beam=BEAM, device=platform)
    assert found.findings == ()
    assert "No defects found." in found.describe()
    assert (found.geometry, found.channels, found.pings) == ("monostatic", PINGS, PINGS)
    assert found.advance_m == pytest.approx(ADVANCE_M)
    assert found.track_m == pytest.approx(ADVANCE_M * (PINGS - 1))
    assert found.wavelength_m == pytest.approx(0.015, rel=0.01)
    assert np.diff(found.band_hz) == pytest.approx(30e3, rel=0.05)
    assert found.oversampling == pytest.approx(2, rel=0.05)
    assert found.sign.ratio < 0.3
    assert found.speed_m_s is None
    assert names(clsas.inspect(echoes, device=platform)) == []
    assert repr(found).endswith("monostatic, findings: none)")


def test_a_grid_behind_the_elements_is_found(lines):
    mirrored = clsas.Grid.plane((1.0, 3.0, 100), (-20.5, -18.0, 120))
    finding = clsas.inspect(lines, mirrored)["grid_behind"]
    assert (finding.value, finding.limit) == (1.0, 0.01)
    assert finding.message.startswith("the whole grid lies to starboard of the track")
    assert finding.remedy == "use the mirrored grid, --x=1:3:100 --y=18:20.5:120"
    unknown = clsas.inspect(replace(lines, look_direction=None), mirrored)
    assert "grid_behind" not in unknown


@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "looks", "row"),
    [
        ([0, 1, -0.3], "port", "to port"),
        ([0.1, -1, 0], "starboard", "to starboard"),
        ([0, 0, -1], "", "neither to port nor to starboard: mean direction (0.00, 0.00, -1.00)"),
        (None, "", "unknown: the recording does not state the side"),
    ],
)
def test_the_side_that_the_elements_look_to_is_reported(lines, look, looks, row):
    found = clsas.inspect(replace(lines, look_direction=look))
    assert found.looks == looks
    assert re.search(rf"^looks +{re.escape(row)}$", found.describe(), re.M)


def dead(samples):
    samples[5:7] = 0
    samples[100] *= 0.01


def clipped(samples):
    level = np.abs(samples[40])
    ceiling = 0.3 * level.max()
    samples[40, level > ceiling] *= ceiling / level[level > ceiling]


def common(samples):
    samples += 0.1 * noise(1, samples.shape[1], occupied=0.4)[0]


SAMPLES = {
    "dead": (dead, {"dead_channels": (5, 6, 100)}, ("3 of 200 channels", "lines.select")),
    "clipped": (clipped, {"clipped_channels": (40,)}, ("1 of 200 channels", "less gain")),
    "common": (
        common,
        {"background": ()},
        ("is the same in all pings", "without_background('median')"),
    ),
    "constant": (
        lambda samples: np.add(samples, 0.1, out=samples),
        {"offset": (), "background": (), "ends": ()},
        ("a constant at 0 Hz of the lines has", "mean before compression"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("defect", SAMPLES)
def test_defects_of_samples_are_found(lines, defect):
    plant, wanted, words = SAMPLES[defect]
    found = clsas.inspect(with_samples(lines, plant))
    assert {each.name: each.where for each in found.findings} == wanted
    for word in words:
        assert word in found.describe()


@pytest.mark.exhaustive
def test_the_remedy_of_a_background_leaves_nothing_to_find(lines):
    found = clsas.inspect(with_samples(lines, common).without_background("median"))
    assert names(found) == []


def test_a_constant_of_the_recorder_is_found_on_its_frequency():
    """In range lines on a carrier of 20 kHz, 0 Hz of the recorder lies at -20 kHz."""
    rng = np.random.default_rng(0)
    spectrum = rng.standard_normal((20, 600, 2)) @ [1, 1j]
    spectrum[:, np.abs(np.fft.fftfreq(600)) > 0.25] = 0
    step_m = 1500 / (2 * 60e3)
    noise = clsas.RangeLines(
        np.fft.ifft(spectrum), 10.0, step_m, [0, 0, 0], [0, 0, 0], 20e3, 1500.0
    )
    constant = 0.01 * np.exp(-2j * np.pi * 20e3 * np.arange(600) / 60e3)
    assert "offset" not in clsas.inspect(noise)
    finding = clsas.inspect(replace(noise, samples=noise.samples + constant))["offset"]
    assert "0 Hz of the recorded signal" in finding.message
    assert "lines.high_passed(hz)" in finding.remedy
    power_db = 20 * np.log10(0.01) - 10 * np.log10(np.mean(np.abs(noise.samples) ** 2))
    assert finding.value == pytest.approx(power_db, abs=0.5)
    cleaned = replace(noise, samples=noise.samples + constant).high_passed(5e3)
    assert "offset" not in clsas.inspect(cleaned)


@pytest.mark.slow
def test_echoes_are_clipped_where_their_parts_are(echoes):
    samples = np.array(echoes.samples)
    ceiling = 0.4 * np.abs(samples[7].real).max()
    samples[7] = np.clip(samples[7].real, -ceiling, ceiling) + 1j * np.clip(
        samples[7].imag, -ceiling, ceiling
    )
    found = clsas.inspect(replace(echoes, samples=samples))
    assert found["clipped_channels"].where == (7,)


def test_beats_of_overlapping_chirps_are_not_clipped():
    """A dozen scattered peaks lie within a thousandth of each other, but are not equal."""
    level = np.tile(np.linspace(0.1, 0.9, 4000, dtype=np.complex64), (2, 1))
    level[:, ::300] = 1 - 5e-5 * np.arange(14)
    level[1, ::300] = 1
    np.testing.assert_array_equal(levels_of(level, magnitudes=False)[1] > 0, [False, True])


def test_quantised_samples_are_not_clipped():
    rng = np.random.default_rng(0)
    weak = np.rint(1.2 * rng.standard_normal((3, 4000))).astype(np.float32)
    assert not levels_of(weak, magnitudes=False)[1].any()
    strong = np.clip(np.rint(60 * rng.standard_normal((3, 4000))), -127, 127).astype(np.float32)
    assert levels_of(strong, magnitudes=False)[1].all()


@pytest.mark.slow
def test_a_receiver_that_is_dead_in_every_ping_is_named(lines):
    def weaken(samples):
        samples[2::4] *= 0.01

    array = with_samples(in_an_array(lines, receivers=4), weaken)
    finding = clsas.inspect(array)["dead_channels"]
    assert finding.message.startswith("200 of 800 channels are dead")
    assert "in every ping receivers 2 of 4 (from 0)" in finding.message
    power = np.var(array.samples, axis=1)
    weakest_db = 10 * np.log10(power.min() / np.median(power))
    assert finding.value == pytest.approx(weakest_db, abs=0.01)


def silent_once(samples):
    samples[41] = 0


def two_silent(samples):
    samples[2:7] = 0


def clipped_once(samples):
    clipped(samples)


def clipped_in_half(samples):
    samples[1 : len(samples) // 2 : 4, 300:340] = 9 * abs(samples).max()


@pytest.mark.parametrize("defect", [silent_once, clipped_in_half, *also(two_silent, clipped_once)])
def test_a_defect_in_some_pings_names_no_receiver(lines, defect):
    found = clsas.inspect(with_samples(in_an_array(lines, receivers=4), defect))
    defects = [
        each for each in found.findings if each.name in ("dead_channels", "clipped_channels")
    ]
    assert defects
    assert not any("in every ping" in each.message for each in defects)


def halting(position_m):
    """Eighty pings at the position of one."""
    position_m[60:140] = position_m[60]
    position_m[140:, 0] -= 79 * ADVANCE_M
    return position_m


@pytest.mark.slow
def test_pings_taken_standing_still(lines):
    found = clsas.inspect(moved(lines, halting))
    assert "still_pings" in found
    assert found["still_pings"].where == tuple(range(61, 140))
    assert "79 of 200 pings" in found["still_pings"].message
    assert found.advance_m == pytest.approx(ADVANCE_M)
    remedied = moved(lines, halting).without_still_pings()
    assert remedied.channels == 121
    assert "still_pings" not in clsas.inspect(remedied)


@pytest.mark.slow
def test_a_long_halt_hides_what_the_moving_pings_show(lines, platform):
    """The remedy of the finding brings the targets back."""

    def peak_over_median_db(recording):
        image = clsas.backproject(recording, GRID, device=platform, accuracy_db=-40)
        return 20 * np.log10(np.abs(image.pixels).max() / np.median(np.abs(image.pixels)))

    recording = lines.select(np.r_[0:100, np.full(355, 100), 101:PINGS])
    found = clsas.inspect(recording, GRID, device=platform)
    assert names(found) == ["still_pings"]
    assert "354 of 554 pings" in found["still_pings"].message
    clean_db = peak_over_median_db(lines)
    with pytest.warns(clsas.ClsasWarning, match="354 of 554 channels have exactly the position"):
        assert peak_over_median_db(recording) < clean_db - 10
    remedied_db = peak_over_median_db(recording.without_still_pings())
    assert remedied_db == pytest.approx(clean_db, abs=0.1)


@pytest.mark.slow
def test_jitter_of_a_halt_is_no_motion(lines):
    def change(position_m):
        position_m = halting(position_m)
        return position_m + np.random.default_rng(0).normal(0, 1e-4, position_m.shape)

    assert len(clsas.inspect(moved(lines, change))["still_pings"].where) == 79


def test_gaps(lines):
    found = clsas.inspect(lines.select(np.r_[0:50, 51:120, 140:PINGS]), GRID, beam=BEAM)
    assert names(found) == ["gaps"]
    assert found["gaps"].where == (49, 118)
    assert found["gaps"].value == pytest.approx(21 * ADVANCE_M)


@pytest.mark.slow
def test_pings_out_of_order(lines):
    order = np.arange(PINGS)
    order[[80, 82]] = 82, 80
    found = clsas.inspect(lines.select(order))
    assert "order" in found
    assert 80 in found["order"].where
    assert "sort the pings by time" in found["order"].remedy


@pytest.mark.slow
def test_shuffled_pings_are_out_of_order_and_nothing_else(lines):
    shuffled = lines.select(np.random.default_rng(0).permutation(PINGS))
    assert names(clsas.inspect(shuffled)) == ["order"]
    assert names(clsas.inspect(shuffled.select(slice(None, None, 2)), beam=BEAM)) == [
        "order",
        "along_track_spacing",
    ]
    assert shuffled.without_still_pings() is shuffled


@pytest.mark.slow
def test_noisy_positions_are_no_halts_and_no_gaps(lines):
    for jitter_m, wanted in ((0.01, ["order"]), (0.002, [])):
        noise_m = np.random.default_rng(0).normal(0, jitter_m, (PINGS, 3))
        noisy = moved(lines, lambda position_m, noise_m=noise_m: position_m + noise_m)
        assert names(clsas.inspect(noisy)) == wanted
        assert noisy.without_still_pings() is noisy


@pytest.mark.slow
def test_transmitters_that_alternate_fore_and_aft():
    """The receivers advance evenly, while phase centres jump to and fro."""
    platform_m = 0.1 * np.arange(60)
    tx_x = platform_m + np.where(np.arange(60) % 2, 0.3, -0.3)
    rx_x = (platform_m[:, None] + 0.05 * np.arange(8)).ravel()
    tx_m, rx_m = (np.stack([x, 0 * x, 0 * x], axis=1) for x in (np.repeat(tx_x, 8), rx_x))
    array = clsas.RangeLines(noise(480, 400), 16.0, 0.0125, tx_m, rx_m, 100e3, 1500.0)
    found = clsas.inspect(array)
    assert not {"gaps", "order", "still_pings"} & set(names(found))
    assert found.advance_m == pytest.approx(0.1)


def test_positions_that_are_missing(lines):
    found = clsas.inspect(moved(lines, np.zeros_like))
    assert "all 200 pings were taken at one position" in found["still_pings"].message


@pytest.mark.slow
def test_ends_that_do_not_fade(lines):
    cut = replace(
        lines, samples=lines.samples[:, 160:300],
        first_range_m=lines.first_range_m + 160 * lines.range_step_m,
    )  # fmt: skip
    found = clsas.inspect(cut)
    assert names(found) == ["ends"]
    assert found["ends"].value > -10
    assert names(clsas.inspect(cut.tapered_ends(0.2))) == []


@pytest.mark.slow
def test_a_band_that_is_not_sampled_finely_enough(lines):
    coarse = replace(lines, samples=lines.samples[:, ::2], range_step_m=2 * lines.range_step_m)
    found = clsas.inspect(coarse)
    assert "oversampling" in found
    assert found["oversampling"].value < 1.05


@pytest.mark.slow
def test_a_band_beyond_its_carrier(lines):
    found = clsas.inspect(replace(lines, range_step_m=lines.range_step_m / 1000))
    assert found["band"].value == pytest.approx(30e6, rel=0.05)
    assert "check units: `range_step_m` in metres" in found["band"].remedy


@pytest.mark.slow
def test_spacing_against_beam_grid_and_element(lines):
    sparse = lines.select(slice(None, None, 2))
    found = clsas.inspect(sparse, beam=BEAM)
    assert names(found) == ["along_track_spacing"]
    assert found["along_track_spacing"].limit == pytest.approx(
        0.015 / (4 * np.sin(np.radians(10))), rel=0.01
    )
    assert names(clsas.inspect(sparse)) == []
    found = clsas.inspect(sparse, element_length_m=0.06)
    assert found["along_track_spacing"].limit == 0.03


@pytest.mark.parametrize("words", ["`first_range_m` seems to be in samples", "milliseconds"])
def test_slips_of_the_first_range_are_named(lines, words):
    scale = 1000 if words == "milliseconds" else 1 / lines.range_step_m
    found = clsas.inspect(replace(lines, first_range_m=scale * lines.first_range_m), GRID)
    assert found["grid_outside"].value == 1
    assert words in found["grid_outside"].remedy


def test_a_first_range_in_seconds_is_named(lines):
    in_seconds = replace(lines, first_range_m=lines.first_range_m / 750)
    remedy = clsas.inspect(in_seconds, GRID)["grid_outside"].remedy
    assert "a time in seconds, not half the sound speed times it" in remedy
    assert "cover 100 % of the grid" in remedy


def test_a_grid_on_the_track_is_no_slip(lines):
    on_track = clsas.Grid.plane((1.0, 3.0, 21), (-1.0, 1.0, 21))
    remedy = clsas.inspect(lines, on_track)["grid_outside"].remedy
    assert remedy == "choose another grid: the track runs through this one"


def test_positions_in_millimetres_by_their_advance(lines):
    slipped = moved(lines, lambda position_m: 1000 * (position_m + [0.012, 0, 0]))
    finding = clsas.inspect(slipped)["advance"]
    assert "500 wavelengths" in finding.message
    assert "millimetres" in finding.remedy
    partly = clsas.inspect(slipped, clsas.Grid.plane((-8.0, 2.0, 50), (18.0, 20.5, 50)))
    assert 0 < partly["grid_outside"].value < 1
    assert "positions seem to be in millimetres" in partly["grid_outside"].remedy


@pytest.mark.parametrize(
    ("scale", "words"), [(1000, "millimetres, not in metres"), (1e-3, "kilometres, not in metres")]
)
def test_slips_of_all_ranges_are_named(lines, scale, words):
    slipped = replace(
        lines, first_range_m=scale * lines.first_range_m, range_step_m=scale * lines.range_step_m
    )
    found = clsas.inspect(slipped, GRID)
    assert found["grid_outside"].value == 1
    assert words in found["grid_outside"].remedy


def test_positions_in_millimetres(lines):
    found = clsas.inspect(moved(lines, lambda m: 1000 * (m - [0, 1, 0])), GRID)
    assert "positions seem to be in millimetres" in found["grid_outside"].remedy
    assert "order" not in found


def in_an_array(lines, receivers=8):
    """Every ping as if eight receivers had recorded it, half a wavelength apart."""
    along_m = 0.0075 * np.arange(receivers)
    rx_m = np.repeat(lines.rx_m, receivers, axis=0)
    rx_m[:, 0] += np.tile(along_m, lines.channels)
    return replace(
        lines.select(np.repeat(np.arange(lines.channels), receivers)),
        rx_m=rx_m,
        tx_m=np.repeat(lines.tx_m, receivers, axis=0),
    )


def test_an_advance_too_small_for_any_aperture(lines):
    """0.02 m per ping in kilometres is 1/750 of a wavelength of 15 mm."""
    for recording in (lines, in_an_array(lines)):
        found = clsas.inspect(moved(recording, lambda position_m: 1e-3 * position_m))["advance"]
        assert found.value == pytest.approx(2e-5)
        assert "less than 1/50 of the wavelength of 15 mm" in found.message
        assert "not kilometres" in found.remedy
    for slow in (0.02, 1.1 / 66):  # 0.4 mm, and 0.33 mm per ping
        assert "advance" not in clsas.inspect(moved(lines, lambda m, slow=slow: slow * m))
    # An array that overlaps itself almost wholly is slow, and no slip.
    array = in_an_array(lines)
    tx_m = 1e-2 * array.tx_m
    slow_array = replace(array, tx_m=tx_m, rx_m=array.rx_m - array.tx_m + tx_m)
    assert "advance" not in clsas.inspect(slow_array)


def in_khz(lines, middle_hz, share=1.0):
    """Lines that give their carrier in kHz, their band or a share of it about a frequency."""
    rate_hz = lines.sound_speed_m_s / (2 * lines.range_step_m)
    spectrum = np.fft.fft(lines.samples, axis=1)
    spectrum[:, np.abs(np.fft.fftfreq(lines.length, 1 / rate_hz)) > share * 15e3] = 0
    narrow = replace(lines, samples=np.fft.ifft(spectrum, axis=1))
    moved_hz = middle_hz + 100e3 - 100 - np.mean(clsas.inspect(narrow).band_hz)
    turns = moved_hz / rate_hz * np.arange(lines.length)
    return replace(lines, samples=narrow.samples * np.exp(2j * np.pi * turns), carrier_hz=100.0)


@pytest.mark.slow
@pytest.mark.parametrize("middle_hz", [-40.0, *also(0.0, 2.0, 100.0, 300.0, -1000.0)])
def test_a_carrier_in_khz_is_found_wherever_the_band_is(lines, middle_hz):
    """The middle of a band about 0 Hz is chance, and so would be the wavelength there."""
    found = clsas.inspect(in_khz(lines, middle_hz))
    assert np.mean(found.band_hz) == pytest.approx(middle_hz, abs=100)
    assert names(found) == ["band"]
    assert "`carrier_hz` in Hz (not kHz)" in found["band"].remedy
    assert found.wavelength_m == pytest.approx(1500 / 7.5e3, rel=0.1)  # at half of 15 kHz
    narrow = clsas.inspect(in_khz(lines, middle_hz, share=0.02))
    assert {"advance", "band"} <= set(names(narrow))
    assert "`carrier_hz` in Hz (not kHz)" in narrow["advance"].remedy


@pytest.mark.slow
def test_echoes_before_their_transmission(lines, five_points):
    """Echoes at negative ranges are reported, but not lines that are silent there."""
    found = clsas.inspect(replace(lines, first_range_m=-5.0))
    assert found["range_offset"].value > 0.3
    assert "at impossible ranges" in found["range_offset"].message
    assert "time of the first sample" in found["range_offset"].remedy
    begun = np.zeros((lines.channels, 3000), np.complex64)
    begun[:, -lines.length :] = lines.samples
    early = lines.first_range_m - (3000 - lines.length) * lines.range_step_m
    assert early.max() < 0
    assert "range_offset" not in clsas.inspect(replace(lines, samples=begun, first_range_m=early))
    apart = clsas.inspect(replace(lines, rx_m=lines.rx_m + [0, 0, 60.0]))
    assert "up to 30 m" in apart["range_offset"].message


def test_a_time_in_samples_is_beyond_any_range(lines):
    first_m = lines.first_range_m / lines.range_step_m * lines.sound_speed_m_s / 2
    found = clsas.inspect(replace(lines, first_range_m=first_m), GRID)
    assert "in seconds, not in samples" in found["range_offset"].remedy
    before = clsas.inspect(replace(lines, first_range_m=-100.0))
    assert "range_offset" in before


def test_a_grid_partly_beyond_the_lines(lines):
    grid = clsas.Grid.plane((1.0, 3.0, 50), (18.0, 34.0, 100))
    found = clsas.inspect(lines, grid, beam=BEAM)
    assert names(found) == ["grid_outside"]
    assert found["grid_outside"].value == pytest.approx(10 / 16, abs=0.08)
    assert "choose another grid" in found["grid_outside"].remedy


@pytest.mark.slow
@pytest.mark.parametrize("grid", [None, GRID])
def test_a_phase_of_the_opposite_sign(lines, grid, platform):
    conjugate = replace(lines, samples=lines.samples.conj())
    found = clsas.inspect(conjugate, grid, device=platform)
    assert names(found) == ["phase_sign"]
    assert found["phase_sign"].value > 3
    assert "opposite" in found.describe()


@pytest.fixture(scope="module")
def five_points():
    """Ten pings of 64 receivers at 1 MHz, and the echoes of five points: the demo's scene."""
    place_m = np.stack([np.arange(640) * 8.25e-3 - 2.636, np.zeros(640), np.zeros(640)], axis=1)
    targets = [(0, 42.5, 1), (-1.5, 41, 1), (1.5, 41, 0.5), (1.5, 44, 1), (-1.5, 44, 0.5)]
    first_m, step_m, range_step = 39.9, 0.006, np.arange(930)
    samples = np.zeros((640, 930), complex)
    for x, y, amplitude in targets:
        range_m = np.linalg.norm(place_m - [x, y, 0], axis=1)[:, None]
        delay = (first_m + step_m * range_step - range_m) / 0.0075
        window = np.where(np.abs(delay) < 8, np.cos(np.pi * delay / 16) ** 2, 0)
        samples += amplitude * np.sinc(delay) * window * np.exp(-4j * np.pi * 1e6 / 1500 * range_m)
    return clsas.RangeLines(samples, first_m, step_m, place_m, place_m, 1e6, 1500.0)


CROSSINGS = [
    ((-2, 2, 401), (42, 45, 301)),
    ((-0.5, 1.93, 64), (42.3, 45.44, 64)),
    ((-2.34, 2.17, 64), (41.75, 44.89, 64)),
    ((0.1, 1.41, 64), (40.77, 44.63, 64)),
    ((-1.1, 1.07, 64), (41.38, 45.3, 64)),
    ((-3.44, 0.6, 64), (41.28, 43.94, 64)),
]


@pytest.mark.exhaustive
@pytest.mark.parametrize("sides", [CROSSINGS[0], *also(*CROSSINGS[1:])])
def test_crossing_arcs_of_points_do_not_turn_the_sign(five_points, sides):
    """The energy of arcs adds up at empty positions, where neither sign is in focus."""
    grid = clsas.Grid.plane(*sides)
    found = clsas.inspect(five_points, grid)
    assert "phase_sign" not in found
    assert "correct, sharpness" in found.describe()
    assert found.sign.as_given > 20
    conjugate = clsas.inspect(replace(five_points, samples=five_points.samples.conj()), grid)
    assert "phase_sign" in conjugate


def test_the_reason_for_an_undetermined_sign_is_the_true_one(lines):
    beyond = clsas.Grid.plane((1.0, 3.0, 50), (100.0, 104.0, 50))
    angle = np.linspace(0, 2 * np.pi, PINGS)
    circle = 19.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for changed, grid, words in (
        (with_samples(lines, lambda samples: samples.fill(0)), None, "lines are silent"),
        (lines, beyond, "no echoes come from the grid"),
        (replace(lines, carrier_hz=0.0), GRID, "the lines still have their carrier"),
        (lines.select(slice(0, 5)), GRID, "have 5 channels; at least 16 are needed"),
        (replace(lines, first_range_m=-9.0), None, "the brightest echoes have an impossible range"),
        (replace(lines, rx_m=lines.rx_m + [0, 0, 60]), None, "and receiver are 60 m apart"),
        (moved(lines, lambda _: circle + [2, 19.2, 0]), GRID, "m of the track have"),
    ):
        found = clsas.inspect(changed, grid)
        assert found.sign is None
        assert words in found.sign_not_told
        assert words in found.describe()


def test_errors_of_imaging_are_not_hidden(lines, monkeypatch):
    def broken(*_, **__):
        raise ValueError("a defect")

    monkeypatch.setattr("clsas.inspection.phase_sign.backproject", broken)
    with pytest.raises(ValueError, match="a defect"):
        clsas.inspect(lines, GRID)


def test_speckle_leaves_the_sign_unclear(lines):
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((*lines.samples.shape, 2)) @ [1, 1j]
    noise = replace(lines, samples=samples).high_passed(95e3)
    found = clsas.inspect(noise, GRID)
    assert "phase_sign" not in found
    assert "unclear" in found.describe()


def test_a_track_about_the_scene_needs_a_grid(lines):
    """On a circle about the scene, ranges do not change and both signs look alike."""
    angle = np.linspace(-0.1, 0.1, PINGS)
    circle = 19.0 * np.stack([np.sin(angle), -np.cos(angle) + 1, 0 * angle], axis=1)
    found = clsas.inspect(moved(lines, lambda _: circle))
    assert found.sign is None
    assert "a grid is needed" in found.describe()


@pytest.mark.slow
def test_lines_of_zeros_and_short_recordings(lines):
    silent = clsas.inspect(with_samples(lines, lambda samples: samples.fill(0)))
    assert len(silent["dead_channels"].where) == PINGS
    assert silent.sign is None
    assert silent["dead_channels"].message == "all 200 channels are silent"
    assert "select" not in silent["dead_channels"].remedy
    assert "no aperture" in clsas.inspect(lines.select([3]))["aperture"].message
    for some in ([3], [3, 4], [3, 4, 5]):
        assert clsas.inspect(lines.select(some), GRID).pings == len(some)
    single = replace(lines, samples=lines.samples[:, 200:201])
    assert clsas.inspect(single).length == 1
    for carrier_hz in (0.0, 100e3):
        scaled = replace(lines, samples=1e36 * lines.samples, carrier_hz=carrier_hz)
        assert clsas.inspect(scaled).findings == ()


def test_samples_that_are_not_finite_are_refused_with_their_place(lines, tmp_path):
    def plant(samples):
        samples[3, 120:125] = np.nan

    with pytest.raises(ValueError, match=r"got 5 NaN or infinite of \d+ .* first at \[3, 120\]"):
        with_samples(lines, plant)
    clsas.save(tmp_path / "lines.h5", lines)
    with h5py.File(tmp_path / "lines.h5", "r+") as file:
        file["samples"][3, 120:125] = np.nan
    result = CliRunner().invoke(main, ["inspect", str(tmp_path / "lines.h5")])
    assert result.exit_code == 1
    assert "the first at [3, 120]" in result.stderr


@pytest.mark.slow
def test_arrays_moving_receivers_and_carriers(lines):
    tx_m = np.repeat(lines.tx_m[::2], 2, axis=0)
    rx_m = tx_m + np.tile([[0.1, 0, 0], [0.12, 0, 0]], (PINGS // 2, 1))
    array = replace(lines, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=[2.0, 0, 0])
    found = clsas.inspect(array)
    assert (found.geometry, found.pings, found.receivers) == ("array", 100, (2, 2))
    assert found.speed_m_s == 2.0
    assert clsas.inspect(replace(lines, rx_m=lines.rx_m + [0.2, 0, 0])).geometry == "bistatic"
    halt = array.select(np.r_[0:60, np.tile([60, 61], 30), 60:PINGS])
    assert Transmissions.of(halt.tx_m, halt.rx_m).count == 130
    assert halt.without_still_pings().channels == PINGS


def test_arguments_of_another_kind(lines):
    for wrong, words in (
        ({"lines": GRID}, "lines must be of type RangeLines or Echoes"),
        ({"grid": lines}, "grid must be of type Grid"),
        ({"beam": 3}, "beam must be of type BeamWindow"),
        ({"lines": replace(lines, first_range_m=1e300)}, "the largest of first_range_m must be"),
        ({"lines": replace(lines, tx_m=[1e200, 0, 0])}, r"the largest of tx_m .* got 1e\+200"),
        ({"lines": replace(lines, range_step_m=1e300)}, "the length of lines must be"),
        ({"lines": replace(lines, range_step_m=1e-300)}, "range_step_m must be .* >= 7.5e-13 m"),
        ({"lines": replace(lines, sound_speed_m_s=1e300)}, "sound_speed_m_s must be .* <= 3e"),
        ({"lines": replace(lines, carrier_hz=1e300)}, "carrier_hz must be .* <= 1e"),
        ({"element_length_m": -1}, "element_length_m must be finite and > 0 m"),
    ):
        with pytest.raises((TypeError, ValueError), match=words):
            clsas.inspect(**({"lines": lines} | wrong))


def test_the_guide_lists_every_finding():
    root = Path(__file__).parents[2]
    files = [
        file for room in ("inspection", "engine") for file in (root / "clsas" / room).rglob("*.py")
    ]
    made = {name for file in files for name in re.findall(r'Finding\(\s*"(\w+)"', file.read_text())}
    table = (
        (root / "docs/how-to/recordings.md").read_text().split("| finding |")[1].split("\n\n")[0]
    )
    of_others = {"ping_rate", "jumps", "held_fixes"}  # of surveys, tracks and imagers
    assert set(re.findall(r"^\| `(\w+)`", table, re.M)) == made - of_others


def test_runs_of_indices():
    assert runs([0, 1, 2, 7, 9, 10]) == "0-2, 7, 9-10"
    assert runs(range(0, 100, 2)).endswith("22 and 38 more runs")


@pytest.mark.slow
def test_the_command(lines, tmp_path):
    recording, picture = tmp_path / "lines.h5", tmp_path / "lines.png"
    clsas.save(recording, moved(lines, halting))
    grid = ["--x", "1:3:100", "--y", "18:20.5:120", "--beam-deg", "20"]
    run = CliRunner().invoke(main, ["inspect", str(recording), *grid, "--picture", str(picture)])
    assert run.exit_code == 0, run.output
    assert "still_pings: 79 of 200 pings" in run.stdout
    assert "Where: 61-139" in run.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    run = CliRunner().invoke(main, ["inspect", str(recording), "--json"])
    found = json.loads(run.stdout)
    assert found["pings"] == PINGS
    assert found["findings"][0]["name"] == "still_pings"
    assert found["findings"][0]["where"] == list(range(61, 140))
    mended = tmp_path / "mended.h5"
    options = ["--without-still-pings", "--without-background", "median", "--taper-m", "0.2"]
    run = CliRunner().invoke(main, ["convert", str(recording), str(mended), *options])
    assert run.exit_code == 0, run.output
    wanted = moved(lines, halting).without_still_pings().without_background("median")
    np.testing.assert_array_equal(clsas.load(mended).samples, wanted.tapered_ends(0.2).samples)
    run = CliRunner().invoke(
        main, ["convert", str(recording), str(mended), "--high-pass-hz", "5e3"]
    )
    assert run.exit_code == 1
    assert "--high-pass-hz must be finite and > 70" in run.stderr
    assert "contain nothing below 70" in run.stderr


def test_a_scene_gives_grid_beam_and_element(lines, tmp_path):
    (tmp_path / "scene.toml").write_text(
        "[grid]\nx = { start_m = 1, stop_m = 3, count = 50 }\n"
        "y = { start_m = 18, stop_m = 34, count = 100 }\n[image.beam]\nwidth_deg = 20\n"
    )
    clsas.save(tmp_path / "lines.h5", lines)
    scene = ["--scene", str(tmp_path / "scene.toml"), "--json"]
    run = CliRunner().invoke(main, ["inspect", str(tmp_path / "lines.h5"), *scene])
    assert run.exit_code == 0, run.output
    assert [each["name"] for each in json.loads(run.stdout)["findings"]] == ["grid_outside"]


def test_files_without_a_recording_are_refused(tmp_path):
    clsas.save(tmp_path / "image.h5", clsas.Image(np.ones((120, 100), complex), GRID))
    for command in (["inspect"], ["convert", "--taper-m", "1"], ["convert"]):
        to = [] if command == ["inspect"] else [str(tmp_path / "o.cphd")]
        run = CliRunner().invoke(main, [*command, str(tmp_path / "image.h5"), *to])
        assert run.exit_code == 1
        assert "image.h5 must hold range lines" in run.stderr
        assert "got an image" in run.stderr


@pytest.mark.slow
def test_the_picture_has_units_and_marks(lines):
    pytest.importorskip("matplotlib")
    bad = moved(with_samples(lines, dead), halting).select(np.r_[0:160, 170:PINGS])
    found = clsas.inspect(bad, GRID)
    figure = clsas.plot.inspection(found, GRID)
    labels = {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())}
    assert {
        "Range (m)", "Frequency (kHz)", "Power (dB re max)", "Amplitude (dB re max)",
        "Along-track (m)", "Across-track (m)",
    } <= labels  # fmt: skip
    shown = {text for axes in figure.axes for text in axes.get_legend_handles_labels()[1]}
    assert {"taken standing still (79)", "dead (3)", "Gaps (1)", "Grid"} <= shown
    with pytest.raises(TypeError, match="found must be of type Inspection"):
        clsas.plot.inspection(lines)


@pytest.mark.slow
def test_gaps_are_marked_at_their_steps(lines):
    pytest.importorskip("matplotlib")
    found = clsas.inspect(lines.select(np.r_[0:50, 51:120, 140:PINGS]))
    (axes,) = [
        axes for axes in clsas.plot.inspection(found).axes if axes.get_title().startswith("Advance")
    ]
    (marked,) = [line for line in axes.lines if line.get_label() == "Gaps (2)"]
    np.testing.assert_array_equal(marked.get_xdata(), [50, 119])
    usual = np.median(axes.lines[0].get_ydata())
    np.testing.assert_allclose(marked.get_ydata() / usual, [2, 21], rtol=1e-6)


def test_a_device_that_does_not_exist_is_refused_though_none_is_needed(lines):
    still = replace(lines, tx_m=lines.tx_m[0], rx_m=lines.rx_m[0])
    with pytest.raises(clsas.DeviceError, match="no such"):
        clsas.inspect(still, device="no such")


def test_two_banks_are_no_denser_array():
    """A second row of receivers changes no finding, and images are those of one bank."""
    pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    rx_m, numbers = stacked(line_array(4, 0.03), (0.0, 3.0))
    sonar = clsas.Sonar(pulse, rx_m, tx_length_m=0.06, rx_length_m=0.06, bank_numbers=numbers)
    track = clsas.Track.straight((-1, 0, 5), (0.06, 0, 0), 34, 1.0)
    points = clsas.PointTargets([[0.0, 20, 0], [0.3, 20.6, 0]])
    lines = clsas.compress(clsas.simulate(sonar, track, points, range_m=(19.5, 23)))
    grid = clsas.Grid.plane((-0.5, 0.5, 64), (19.7, 21, 64))
    both = clsas.inspect(lines, grid, element_length_m=0.06)
    alone = clsas.inspect(lines.bank(0), grid, element_length_m=0.06)
    assert both.sign.centre_m == alone.sign.centre_m
    assert both.sign.ratio == pytest.approx(alone.sign.ratio, rel=0.01)
    assert both.pings == alone.pings == 34
    assert [each.message for each in both.findings] == [each.message for each in alone.findings]
    assert "8 receivers per ping in 2 banks" in both.describe()


def test_a_baseline_does_not_excuse_a_slip_of_units():
    """Advances in kilometres are found although a long baseline lies across the track."""
    pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    rx_m = [[0, 0, 0], [0.03, 0, 0], [0, 0, 0.5], [0.03, 0, 0.5]]
    sonar = clsas.Sonar(pulse, rx_m, bank_numbers=[0, 0, 1, 1])
    track = clsas.Track.straight((0, 0, 5), (0.06, 0, 0), 34, 1.0)
    lines = clsas.compress(clsas.simulate(sonar, track, clsas.PointTargets([[1.0, 20, 0]])))
    small = replace(lines, tx_m=1e-3 * lines.tx_m, rx_m=1e-3 * lines.rx_m)
    assert "advance" in clsas.inspect(small.bank(0))
    assert "advance" in clsas.inspect(small)
