import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erfc, fresnel

from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.system import Pulse, Sonar, line_array
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.signal.echoes import Echoes
from clsas.simulation.patterns import needed_terms
from clsas.simulation.scenes import Observer, PointTargets, Seabed
from clsas.simulation.simulator import simulate, simulate_lines

C = 1500.0
CARRIER = 1e6
# Fully tapered and four times oversampled: nothing to -115 dB beyond 0.4 sample rates.
SMOOTH = Sonar(Pulse(CARRIER, 100e3, 1e-3, taper=1.0), line_array(3, 16.5e-3), sample_rate_hz=400e3)
TRACK = Track.straight([0, 0, 0], [1.5, 0, 0], 4, 0.35, sway_m=[0.0, 0.01, -0.02, 0.005])
SCENE = PointTargets([[0.2, 40, -3], [1.0, 41.0, 0], [-2.0, 38.5, 1]], [1, 0.5j, -0.25 + 0.3j])


def db(error, reference=1.0):
    return 20 * np.log10(np.max(np.abs(error)) / np.max(np.abs(reference)))


def sample_times(echoes):
    return echoes.start_time_s[:, None] + np.arange(echoes.length) / echoes.sample_rate_hz


def closed_form(echoes, scene, gains=None):
    """Sum of A p(t - tau) exp(-j 2 pi fc tau) at the sample times."""
    total = np.zeros(echoes.samples.shape, complex)
    for s, (point, amplitude) in enumerate(zip(scene.positions_m, scene.amplitudes, strict=True)):
        tau = 2 / C * bistatic_range_m(point, echoes.tx_m, echoes.rx_m, echoes.rx_velocity_m_s, C)
        tau = tau[:, None]
        gain = 1.0 if gains is None else gains[:, s, None]
        echo = echoes.pulse.envelope(sample_times(echoes) - tau)
        total += amplitude * gain * echo * np.exp(-2j * np.pi * echoes.carrier_hz * tau)
    return total


@pytest.mark.parametrize("motion_in_flight", [False, True])
@pytest.mark.parametrize("code", ["up", "down"])
def test_echoes_are_the_closed_form(code, motion_in_flight):
    sonar = replace(SMOOTH, pulse=replace(SMOOTH.pulse, code=code))
    echoes = simulate(sonar, TRACK, SCENE, motion_in_flight=motion_in_flight)
    assert (echoes.rx_velocity_m_s is not None) == motion_in_flight
    assert db(echoes.samples - closed_form(echoes, SCENE), 1.0) < -100


def test_motion_in_flight_matters():
    still = simulate(SMOOTH, TRACK, SCENE, range_m=(35, 45))
    moving = simulate(SMOOTH, TRACK, SCENE, range_m=(35, 45), motion_in_flight=True)
    assert db(still.samples - moving.samples) > -40


def test_antennas_at_phase_centres_are_those_of_a_monostatic_sonar():
    echoes = simulate(SMOOTH, TRACK, SCENE, phase_centres=True, motion_in_flight=True)
    apart = channels(SMOOTH, TRACK)
    assert np.array_equal(echoes.tx_m, echoes.rx_m)
    assert np.array_equal(echoes.tx_m, (apart.tx_m + apart.rx_m) / 2)
    assert db(echoes.samples - closed_form(echoes, SCENE), 1.0) < -100


def test_a_seabed_looks_the_same_from_phase_centres():
    """The same points are lit from the middle between antennas; ranges differ a little."""
    options = {"range_m": (25, 45)}
    apart, together = (
        simulate(SMOOTH, TRACK, box_on_sand(), phase_centres=on, **options) for on in (False, True)
    )
    strength = [np.linalg.norm(each.samples) for each in (apart, together)]
    assert strength[0] == pytest.approx(strength[1], rel=0.05)


def test_without_element_patterns_elements_have_no_sizes():
    sized = replace(SMOOTH, tx_length_m=0.015, rx_length_m=0.015, rx_height_m=0.01)
    without = simulate(sized, TRACK, SCENE, element_pattern=False)
    assert np.array_equal(without.samples, simulate(SMOOTH, TRACK, SCENE).samples)
    with pytest.raises(ValueError, match="must be left out: `element_pattern` is off"):
        simulate(sized, TRACK, SCENE, element_pattern=False, pointing=Pointing.squint(0.1))
    for name in ("element_pattern", "phase_centres"):
        with pytest.raises(TypeError, match=f"{name} must be of type bool"):
            simulate(sized, TRACK, SCENE, **{name: 1})


@pytest.mark.slow
@pytest.mark.parametrize("rate", [125e3, 200e3, 317e3])
def test_rectangular_chirp_through_the_receivers_filter(rate):
    """The stated spectrum, by Fresnel integrals, summed over frequency with period 50 ms."""
    sonar = Sonar(Pulse(CARRIER, 100e3, 1e-3), [[0, 0, 0]], sample_rate_hz=rate)
    echoes = simulate(sonar, Track([[0, 0, 0]], [0.0]), PointTargets([[0.1, 30, 0]], [1j]))
    tau = 2 * np.hypot(0.1, 30) / C
    step = 20.0
    f = np.arange(-rate / 2, rate / 2, step) + step / 2
    sweep, duration = 100e6, 1e-3
    (s0, c0), (s1, c1) = (
        fresnel(np.sqrt(2 * sweep) * (end * duration / 2 - f / sweep)) for end in (-1, 1)
    )
    spectrum = ((c1 - c0) + 1j * (s1 - s0)) / np.sqrt(2 * sweep)
    spectrum *= np.exp(-1j * np.pi * (f**2 / sweep + f * duration))
    # Half height at 0.45 rates, 5.3 standard deviations to either end of the edge.
    spectrum *= erfc((np.abs(f) / rate - 0.45) / 0.05 * 5.3 / np.sqrt(2)) / 2
    t = sample_times(echoes)[0]
    expected = np.exp(2j * np.pi * f * (t[:, None] - tau)) @ spectrum * step
    expected *= 1j * np.exp(-2j * np.pi * CARRIER * tau)
    assert db(echoes.samples[0] - expected) < -100
    # The filter matters here: the echo differs strongly from a rectangular pulse.
    assert db(echoes.samples[0] - closed_form(echoes, PointTargets([[0.1, 30, 0]], [1j]))) > -30


def test_phase_code_echo_in_a_wide_receiver():
    pulse = Pulse.phase_code(CARRIER, 130e-6)
    sonar = Sonar(pulse, [[0, 0, 0]], sample_rate_hz=20e6)
    scene = PointTargets([[0, 10, 0]])
    echoes = simulate(sonar, Track([[0, 0, 0]], [0.0]), scene)
    error = np.abs(echoes.samples - closed_form(echoes, scene))[0]
    tau = 20 / C
    edges = tau + 130e-6 / 13 * np.arange(14)
    away = np.abs(sample_times(echoes)[0][:, None] - edges).min(axis=1) > 90 / 20e6
    assert away.sum() > 200
    # Away from the chips' edges the filter changes nothing.
    assert db(error[away]) < -100


def test_many_points_are_the_sum_of_each():
    rng = np.random.default_rng(5)
    scene = PointTargets(
        rng.uniform([-2, 38, -1], [2, 42, 1], (200, 3)), rng.standard_normal(200) + 0j
    )
    echoes = simulate(SMOOTH, TRACK, scene)
    assert db(echoes.samples - closed_form(echoes, scene), echoes.samples) < -110


@pytest.mark.slow
def test_result_does_not_depend_on_blocks_or_threads(monkeypatch):
    rng = np.random.default_rng(6)
    scene = PointTargets(rng.uniform([-2, 38, -1], [2, 42, 1], (50, 3)))
    sonar = replace(SMOOTH, tx_length_m=0.1, rx_length_m=0.05)
    whole = simulate(sonar, TRACK, scene)
    monkeypatch.setattr("clsas.simulation.recording._BLOCK", 7)
    monkeypatch.setattr("clsas.simulation.recording._PATTERN_BLOCK", 3)
    parts = simulate(sonar, TRACK, scene, workers=1)
    assert db(whole.samples - parts.samples, whole.samples) < -110


def test_spreading_is_one_over_both_legs():
    echoes = simulate(SMOOTH, TRACK, SCENE, spreading=True)
    legs = [
        np.linalg.norm(SCENE.positions_m - end[:, None], axis=-1)
        for end in (echoes.tx_m, echoes.rx_m)
    ]
    expected = closed_form(echoes, SCENE, 1 / (legs[0] * legs[1]))
    assert db(echoes.samples - expected, expected) < -100


def direct_with_patterns(echoes, sonar, scene, axes, sizes):
    """Direct sum of the frequency-domain model, patterns evaluated at every frequency."""
    modes = 8192
    f = np.fft.fftfreq(modes, 1 / echoes.sample_rate_hz)
    filtered = np.abs(f) / echoes.sample_rate_hz
    spectrum = sonar.pulse.spectrum(f) * erfc((filtered - 0.45) / 0.05 * 5.3 / np.sqrt(2)) / 2
    expected = np.empty(echoes.samples.shape, complex)
    for i, (tx, rx) in enumerate(zip(echoes.tx_m, echoes.rx_m, strict=True)):
        total = 0
        along, beam, up = axes[i // sonar.receivers]
        for point, amplitude in zip(scene.positions_m, scene.amplitudes, strict=True):
            a, b = point - tx, point - rx
            tau = (np.linalg.norm(a) + np.linalg.norm(b)) / C
            a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
            if a @ beam <= 0 or b @ beam <= 0:
                continue
            gain = amplitude
            for size, sine in zip(sizes, (a @ along, b @ along, a @ up, b @ up), strict=True):
                if size is not None:
                    gain = gain * np.sinc(size * (f + CARRIER) / C * sine)
            delay = f * (tau - echoes.start_time_s[i]) + CARRIER * tau
            total = total + gain * np.exp(-2j * np.pi * delay)
        lines = np.fft.ifft(total * spectrum) * echoes.sample_rate_hz
        expected[i] = lines[: echoes.length]
    return expected


@pytest.mark.parametrize(
    ("sizes", "pointing"),
    [
        ((15e-3, 10e-3, None, None), None),
        ((15e-3, None, 5e-3, 4e-3), Pointing.squint(0.3, depression_rad=0.1)),
        ((60e-3, 60e-3, None, None), Pointing.scan([-0.2, 0.0])),
        ((None, 30e-3, None, 3e-3), Pointing.spot([0.5, 40, -2])),
    ],
)
def test_element_patterns_against_a_direct_sum(sizes, pointing):
    names = ("tx_length_m", "rx_length_m", "tx_height_m", "rx_height_m")
    sonar = replace(SMOOTH, **dict(zip(names, sizes, strict=True)))
    # Far off broadside, where the patterns depend most on frequency; and one behind.
    scene = PointTargets(
        [[0.3, 38, -3], [20, 25, 1], [-15, 30, 0], [1, -38, 0]], [1, 8, 3 + 4j, 100]
    )
    echoes = simulate(sonar, TRACK, scene, pointing=pointing, range_m=(30, 38.5))
    axes = (pointing or Pointing.broadside()).axes(TRACK)
    expected = direct_with_patterns(echoes, sonar, scene, axes, sizes)
    # The bound of the expansion is 1e-6 of each amplitude.
    faced = np.abs(scene.amplitudes[:3]).max()
    assert np.max(np.abs(echoes.samples - expected)) < 2e-6 * faced
    assert np.max(np.abs(expected)) > 0.03


def test_patterns_are_frequency_dependent():
    """In the direction of the carrier's null, the edges of the band still pass."""
    sonar = replace(SMOOTH, rx_m=[[0, 0, 0]], rx_length_m=0.15)
    angle = np.arcsin(C / CARRIER / 0.15 * 5)
    scene = PointTargets([[40 * np.sin(angle), 40 * np.cos(angle), 0]])
    echoes = simulate(sonar, Track([[0, 0, 0]], [0.0]), scene)
    level = np.abs(echoes.samples[0])
    middle = (sample_times(echoes)[0] - 80 / C) / 1e-3
    assert level[np.argmin(np.abs(middle - 0.5))] < 2e-3
    assert level[np.argmin(np.abs(middle - 0.25))] > 0.01


def test_pointing_moves_the_beam():
    sonar = replace(SMOOTH, tx_length_m=0.05, rx_length_m=0.05)
    track = Track.straight([0, 0, 0], [0, 0, 0], 3, 1.0)
    angle = 0.2
    scene = PointTargets([[40 * np.sin(angle), 40 * np.cos(angle), 0]])

    def level(pointing):
        samples = simulate(sonar, track, scene, pointing=pointing).samples
        return np.abs(samples).max(axis=1).reshape(3, 3).mean(axis=1)

    np.testing.assert_allclose(level(Pointing.squint(angle)), 1, atol=1e-2)
    np.testing.assert_allclose(level(Pointing.spot(scene.positions_m[0])), 1, atol=1e-2)
    assert np.all(level(None) < 0.05)
    scan = level(Pointing.scan([0, angle, -angle]))
    assert scan[1] > 0.99
    assert np.all(scan[[0, 2]] < 0.05)


def test_window_given_cuts_and_never_wraps():
    """Echoes begin before, end after or lie outside the window, which keeps its part."""
    near, far = 39.0, 40.0
    scene = PointTargets([[0, r, 0] for r in (1.0, 38.5, 39.2, 39.9, 40.3, 41.5, 500.0)])
    track = Track([[0, 0, 0]], [0.0])
    echoes = simulate(SMOOTH, track, scene, range_m=(near, far))
    np.testing.assert_allclose(echoes.start_time_s, 2 * near / C)
    duration = (echoes.length - 1) / echoes.sample_rate_hz
    assert duration == pytest.approx(2 * (far - near) / C + 1e-3, abs=1 / 400e3)
    assert db(echoes.samples - closed_form(echoes, scene)) < -100
    cut = simulate(SMOOTH, track, PointTargets([[0, 38.5, 0]]), range_m=(near, far))
    assert np.abs(cut.samples[:, 0]).min() > 0.1
    assert np.abs(cut.samples[:, -1]).max() < 1e-5


def test_automatic_window_holds_every_echo():
    echoes = simulate(SMOOTH, TRACK, SCENE)
    energy = np.sum(np.abs(echoes.samples) ** 2, axis=1)
    apart = [
        simulate(SMOOTH, TRACK, PointTargets(p[None], a[None]), range_m=(30, 50)).samples
        for p, a in zip(SCENE.positions_m, SCENE.amplitudes, strict=True)
    ]
    whole = np.sum(np.abs(sum(apart)) ** 2, axis=1)
    np.testing.assert_allclose(energy, whole, rtol=1e-6)
    assert np.abs(echoes.samples[:, [0, -1]]).max() < 1e-5


def test_rectangular_chirp_never_wraps():
    """The spectrum of the chirp fills the whole band, so that ringing could wrap around."""
    sonar = Sonar(Pulse(CARRIER, 100e3, 1e-3), [[0, 0, 0]])
    track = Track([[0, 0, 0]], [0.0])
    scene = PointTargets([[0, 40, 0]])
    tight = simulate(sonar, track, scene)
    wide = simulate(sonar, track, scene, range_m=(10, 80))
    step = tight.start_time_s[0] - wide.start_time_s[0]
    # The same instants: shift the wide window so that they fall on the tight one's samples.
    offset = step * sonar.sample_rate_hz
    shifted = simulate(
        sonar, track, scene, range_m=(10 + (offset % 1) / sonar.sample_rate_hz * C / 2, 80)
    )
    at = int(np.rint((tight.start_time_s[0] - shifted.start_time_s[0]) * sonar.sample_rate_hz))
    inside = slice(at, at + tight.length)
    assert db(shifted.samples[0, inside] - tight.samples[0]) < -120
    outside = np.delete(shifted.samples[0], inside)
    assert db(outside) < -120


@pytest.mark.slow
def test_noise_has_the_stated_power_and_is_repeatable():
    quiet = simulate(SMOOTH, TRACK, SCENE, range_m=(10, 100))
    loud = simulate(SMOOTH, TRACK, SCENE, range_m=(10, 100), snr_db=12.0, seed=3)
    noise = loud.samples - quiet.samples
    ratio = np.abs(quiet.samples).max() ** 2 / np.mean(np.abs(noise) ** 2)
    assert 10 * np.log10(ratio) == pytest.approx(12.0, abs=0.05)
    # Circular: real and imaginary parts equal and uncorrelated.
    assert np.abs(np.mean(noise**2)) < 0.02 * np.mean(np.abs(noise) ** 2)
    again = simulate(SMOOTH, TRACK, SCENE, range_m=(10, 100), snr_db=12.0, seed=3)
    other = simulate(SMOOTH, TRACK, SCENE, range_m=(10, 100), snr_db=12.0, seed=4)
    np.testing.assert_array_equal(loud.samples, again.samples)
    assert np.any(loud.samples != other.samples)


def test_geometry_and_progress_are_passed_on():
    calls = []
    echoes = simulate(SMOOTH, TRACK, SCENE, progress=lambda *done: calls.append(done))
    assert isinstance(echoes, Echoes)
    assert calls == [(i + 1, 12) for i in range(12)]
    expected = channels(SMOOTH, TRACK)
    np.testing.assert_array_equal(echoes.tx_m, expected.tx_m)
    np.testing.assert_array_equal(echoes.rx_m, expected.rx_m)
    assert echoes.pulse == SMOOTH.pulse


def test_interruption_stops_at_once():
    scene = PointTargets(np.random.default_rng(0).uniform(30, 40, (20000, 3)))
    track = Track.straight([0, 0, 0], [1, 0, 0], 100, 1.0)
    calls = []

    def interrupt(done, total):
        calls.append(done)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(SMOOTH, track, scene, range_m=(20, 80), progress=interrupt)
    assert calls == [1]


def test_large_coordinates_change_nothing():
    offset = np.array([2.0**22, -(2.0**23), 0])
    there = Track(TRACK.positions_m + offset, TRACK.time_s)
    here = Track(there.positions_m - offset, TRACK.time_s)
    scene = PointTargets(np.round(SCENE.positions_m * 64) / 64, SCENE.amplitudes)
    moved = PointTargets(scene.positions_m + offset, scene.amplitudes)
    near = simulate(SMOOTH, here, scene, range_m=(30, 50))
    far = simulate(SMOOTH, there, moved, range_m=(30, 50))
    # 1e-9 m of rounding in a position is 1e-5 rad at 1 MHz.
    assert db(near.samples - far.samples) < -90


# Seabed

NARROW = Sonar(
    Pulse(100e3, 15e3, 1e-3),
    line_array(3, 0.2),
    sample_rate_hz=30e3,
    tx_length_m=0.2,
    rx_length_m=0.2,
)
SWATH = Track.straight([-0.6, 0, 10], [1.5, 0, 0], 4, 0.2, sway_m=[0.0, 0.1, -0.1, 0.05])


def box_on_sand(**others):
    x, y = np.meshgrid(np.linspace(-6, 6, 121), np.linspace(30, 42, 121))
    box = (np.abs(x) <= 1.5) & (np.abs(y - 33) <= 0.5)
    return Seabed((-6, 6), (30, 42), np.where(box, 1.5, 0.0), **{"density_m2": 40, **others})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sonar", "options"),
    [
        (NARROW, {}),
        (NARROW, {"pointing": Pointing.broadside(depression_rad=0.3), "spreading": True}),
        (replace(NARROW, tx_length_m=None, rx_length_m=None), {"motion_in_flight": True}),
        (replace(NARROW, rx_height_m=0.05), {"motion_in_flight": True, "range_m": (30, 40)}),
    ],
)
def test_a_seabed_sounds_like_its_points_that_are_seen(sonar, options):
    """In every ping the echoes are those of the visible points, to a third of the floor."""
    seabed = box_on_sand(floor_db=-60)
    echoes = simulate(sonar, SWATH, seabed, **options)
    for ping in range(SWATH.pings):
        alone = Track(SWATH.positions_m[[ping]], [0.0], velocity_m_s=SWATH.velocity_m_s[[ping]])
        tx, rx, _ = channels(sonar, alone)
        positions, amplitudes = seabed.visible(Observer((tx[0] + rx.mean(axis=0)) / 2))
        points = PointTargets(positions, amplitudes.astype(complex))
        exact = simulate(sonar, alone, points, **{**options, "range_m": (25, 48)})
        for channel in range(3):
            compare(echoes, 3 * ping + channel, exact, channel)


def compare(echoes, channel, exact, of):
    """Assert that two channels agree, whose windows begin at different times."""
    f = np.fft.fftfreq(4096, 1 / echoes.sample_rate_hz)
    shift = exact.start_time_s[of] - echoes.start_time_s[channel]
    spectrum = np.fft.fft(exact.samples[of], 4096) * np.exp(-2j * np.pi * f * shift)
    moved = np.fft.ifft(spectrum)
    # Away from where one of the two windows cuts.
    inner = slice(100, echoes.length - 100)
    apart = echoes.samples[channel, inner] - moved[inner.start : inner.stop]
    assert np.linalg.norm(apart) < 10 ** (-55 / 20) * np.linalg.norm(moved[inner])


def test_the_floor_is_what_is_left_out():
    track = Track([[0, 0, 10.0]], [0.0])
    x_m, y_m = (-40, 40), (30, 34)
    levels = {
        floor: simulate(
            NARROW, track, Seabed(x_m, y_m, np.zeros((5, 81)), density_m2=20, floor_db=floor),
            range_m=(30, 60),
        ).samples
        for floor in (-130, -50, -30)
    }  # fmt: skip
    energy = np.linalg.norm(levels[-130])
    lost = {floor: 20 * np.log10(np.linalg.norm(levels[floor] - levels[-130]) / energy)
            for floor in (-50, -30)}  # fmt: skip
    # The Notes of Seabed: 0.0038/u^3 of the energy beyond u = 1/(pi sqrt(floor)).
    for floor, level in lost.items():
        u = 10 ** (-floor / 40) / np.pi
        stated = 10 * np.log10(0.0038 / u**3)
        # Whole tiles are kept, so that less is lost; the part that is cut has 40 m on either side.
        assert stated - 12 < level < stated + 1.5


def test_echoes_of_several_parts_add():
    seabed, targets = box_on_sand(), PointTargets([[0, 33, 2], [1, 35, 0]], [3, 2j])
    limits = {"range_m": (25, 48)}
    both, one, other = (
        simulate(NARROW, SWATH, part, **limits).samples
        for part in ((seabed, targets), seabed, targets)
    )
    assert db(both - one - other, both) < -120
    noisy = simulate(NARROW, SWATH, (seabed, targets), **limits, snr_db=20.0).samples
    ratio = np.abs(both).max() ** 2 / np.mean(np.abs(noisy - both) ** 2)
    assert 10 * np.log10(ratio) == pytest.approx(20, abs=0.3)
    # The accuracy of a part's sum depends only on that part's own error.
    alone = simulate(NARROW, SWATH, targets, **limits).samples
    np.testing.assert_array_equal(alone, simulate(NARROW, SWATH, (targets,), **limits).samples)


def test_window_of_a_seabed_holds_its_echoes():
    seabed = box_on_sand()
    tight = simulate(NARROW, SWATH, seabed, motion_in_flight=True)
    wide = simulate(NARROW, SWATH, seabed, motion_in_flight=True, range_m=(10, 100))
    np.testing.assert_allclose(
        np.linalg.norm(tight.samples, axis=1), np.linalg.norm(wide.samples, axis=1), rtol=1e-3
    )
    assert tight.length < 0.3 * wide.length


def test_result_does_not_depend_on_threads_or_groups(monkeypatch):
    seabed = box_on_sand()
    one = simulate(NARROW, SWATH, seabed, workers=1).samples
    np.testing.assert_array_equal(one, simulate(NARROW, SWATH, seabed, workers=3).samples)
    monkeypatch.setattr("clsas.simulation.recording._GROUP", 1)
    # Visibility is found for every channel: only edges of shadows and of the beam change.
    apart = simulate(NARROW, SWATH, seabed, range_m=(30, 46)).samples
    monkeypatch.setattr("clsas.simulation.recording._GROUP", 8)
    together = simulate(NARROW, SWATH, seabed, range_m=(30, 46)).samples
    assert 0 < np.linalg.norm(apart - together) < 0.15 * np.linalg.norm(together)


def test_a_seabed_behind_the_sonar_is_silent():
    track = Track([[0, 80, 10.0]], [0.0])
    with pytest.warns(ClsasWarning, match="no echo arrives within the receive window"):
        assert not simulate(NARROW, track, box_on_sand()).samples.any()


def test_lines_of_a_seabed_hold_a_shadow():
    """One ping from above: no echo between the box's top and the end of its shadow."""
    y = np.broadcast_to(np.linspace(30, 42, 241)[:, None], (241, 11))
    wall = np.where(np.abs(y - 33) <= 0.5, 1.5, 0.0)
    seabed = Seabed((-0.5, 0.5), (30, 42), wall, density_m2=300)
    lines = simulate_lines([0, 0, 10], [0, 0, 10], seabed, carrier_hz=CARRIER, bandwidth_hz=BAND)
    r = lines.first_range_m[0] + lines.range_step_m * np.arange(lines.length)
    y = np.sqrt(np.clip(r**2 - 100, 0, None))  # on the ground
    level = np.abs(lines.samples[0]) ** 2
    end = 33.5 * 10 / 8.5
    lit = level[(y > end + 0.3) & (y < 41.8)].mean()
    dark = level[(y > 34) & (y < end - 0.3)].mean()
    assert 10 * np.log10(dark / lit) < -25


# Range lines directly


BAND = 100e3


def lines_closed_form(lines, scene, bandwidth=BAND):
    """Sum of A sinc(2 B (r - rho)/c) exp(-j 2 k rho)."""
    r = lines.first_range_m[:, None] + lines.range_step_m * np.arange(lines.length)
    total = np.zeros(r.shape, complex)
    for point, amplitude in zip(scene.positions_m, scene.amplitudes, strict=True):
        rho = bistatic_range_m(point, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, C)[:, None]
        response = np.sinc(2 * bandwidth / C * (r - rho))
        total += amplitude * response * np.exp(-2j * lines.wavenumber_rad_m * rho)
    return total


@pytest.mark.parametrize("oversampling", [1.0, 1.1, 1.25, np.sqrt(2), 2.0, 3.7, 8.0])
def test_lines_are_sinc_responses(oversampling):
    tx, rx, velocity = channels(SMOOTH, TRACK, motion_in_flight=True)
    length = int(800 * oversampling)
    lines = simulate_lines(
        tx,
        rx,
        SCENE,
        carrier_hz=CARRIER,
        bandwidth_hz=BAND,
        oversampling=oversampling,
        first_range_m=37.0 + 0.1 * np.arange(12),
        length=length,
        rx_velocity_m_s=velocity,
    )
    assert lines.length == length
    assert lines.range_step_m == pytest.approx(C / (2 * oversampling * BAND), rel=1e-6)
    np.testing.assert_allclose(lines.first_range_m, 37.0 + 0.1 * np.arange(12))
    assert db(lines.samples - lines_closed_form(lines, SCENE)) < -120


def test_lines_without_limits_hold_every_point():
    lines = simulate_lines([0, 0, 0], [0.1, 0, 0], SCENE, carrier_hz=CARRIER, bandwidth_hz=BAND)
    rho = bistatic_range_m(SCENE.positions_m, [0, 0, 0], [0.1, 0, 0])
    assert lines.channels == 1
    assert rho.min() - lines.first_range_m[0] >= 90 * lines.range_step_m * 0.999
    assert lines.last_range_m[0] - rho.max() >= 90 * lines.range_step_m * 0.999
    assert db(lines.samples - lines_closed_form(lines, SCENE)) < -120


def test_hamming_lines():
    lines = simulate_lines(
        [0, 0, 0],
        [0, 0, 0],
        PointTargets([[0, 10, 0]]),
        carrier_hz=CARRIER,
        bandwidth_hz=BAND,
        window="hamming",
        first_range_m=9.0,
        length=600,
    )
    x = 2 * BAND / C * (lines.first_range_m[0] + lines.range_step_m * np.arange(600) - 10)
    expected = np.sinc(x) + 0.46 / 0.54 / 2 * (np.sinc(x - 1) + np.sinc(x + 1))
    assert db(lines.samples[0] - expected * np.exp(-2j * lines.wavenumber_rad_m * 10)) < -120


def test_lines_are_a_linear_operator_with_its_adjoint():
    """<A x, y> = <x, A^H y>, the adjoint by direct sums over the closed form."""
    rng = np.random.default_rng(7)
    points = rng.uniform([-2, 38, -1], [2, 42, 1], (40, 3))
    tx, rx, _ = channels(SMOOTH, TRACK)
    limits = {"first_range_m": 37.0, "length": 2000}

    def forward(x):
        return simulate_lines(
            tx, rx, PointTargets(points, x), carrier_hz=CARRIER, bandwidth_hz=BAND, **limits
        )

    x = rng.standard_normal(40) + 1j * rng.standard_normal(40)
    lines = forward(x)
    y = rng.standard_normal(lines.samples.shape) + 1j * rng.standard_normal(lines.samples.shape)
    r = lines.first_range_m[:, None] + lines.range_step_m * np.arange(lines.length)
    rho = bistatic_range_m(points[:, None], tx, rx)
    adjoint = [
        np.sum(
            y
            * np.sinc(2 * BAND / C * (r - rho[s][:, None]))
            * np.exp(2j * lines.wavenumber_rad_m * rho[s][:, None])
        )
        for s in range(40)
    ]
    left = np.vdot(lines.samples.astype(complex), y)
    right = np.vdot(x, adjoint)
    assert abs(left - right) < 1e-6 * np.linalg.norm(lines.samples) * np.linalg.norm(y)


def test_points_outside_a_line_give_it_nothing():
    scene = PointTargets([[0, 10, 0], [0, 9.0, 0], [0, 12.5, 0]])
    limits = {"carrier_hz": CARRIER, "bandwidth_hz": BAND, "first_range_m": 9.5, "length": 500}
    lines = simulate_lines([0, 0, 0], [0, 0, 0], scene, **limits)
    alone = simulate_lines([0, 0, 0], [0, 0, 0], PointTargets([[0, 10, 0]]), **limits)
    np.testing.assert_array_equal(lines.samples, alone.samples)


# Bad input


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"range_m": (40, 30)},
            ValueError,
            r"range_m must be two ascending .* from 0, got \(40, 30",
        ),
        ({"range_m": (-1, 30)}, ValueError, r"range_m must be two ascending .* got \(-1, 30\)"),
        ({"range_m": 40}, ValueError, r"range_m must have shape \(2\)"),
        ({"snr_db": np.nan}, ValueError, "snr_db must be finite .* dB, got nan"),
        ({"snr_db": -1e5}, ValueError, "snr_db must be .* >= -200 and <= 300 dB, got -100000"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"seed": 1.5}, TypeError, "seed must be a whole number, got 1.5"),
        ({"spreading": 1}, TypeError, "spreading must be of type bool, got int"),
        ({"motion_in_flight": "no"}, TypeError, "motion_in_flight must be of type bool, got str"),
        ({"pointing": 0.1}, TypeError, "pointing must be of type Pointing or NoneType, got float"),
        ({"progress": 1}, TypeError, "progress must be a function or None, got 1"),
        ({"sonar": None}, TypeError, "sonar must be of type Sonar, got NoneType"),
        ({"track": SMOOTH}, TypeError, "track must be of type Track, got Sonar"),
        (
            {"scene": [[0, 40, 0]]},
            TypeError,
            "scene must be of type PointTargets or Seabed, got list",
        ),
        ({"range_m": (0, 1e12)}, ValueError, r"range_m must ask for at most .* GiB, .* got .* GiB"),
        ({"range_m": (0, 1e308)}, ValueError, "range_m must ask for at most .* got inf GiB"),
        ({"workers": 0}, ValueError, "workers must be at least 1, got 0"),
        ({"pointing": Pointing.squint(0.1)}, ValueError, "pointing must be left out"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        simulate(**{"sonar": SMOOTH, "track": TRACK, "scene": SCENE, **arguments})


def test_point_on_an_element_with_spreading():
    scene = PointTargets([[0, 40, 0], TRACK.positions_m[0]])
    assert np.isfinite(simulate(SMOOTH, TRACK, scene).samples).all()
    with pytest.raises(ValueError, match=r"scene must have no point on an element .* channel 0"):
        simulate(SMOOTH, TRACK, scene, spreading=True)
    with pytest.raises(ValueError, match=r"scene must have no point on an element .* channel 0"):
        simulate(replace(SMOOTH, rx_length_m=0.1), TRACK, scene)


def test_platform_faster_than_sound():
    track = Track([[0, 0, 0]], [0.0], velocity_m_s=[2000, 0, 0])
    with pytest.raises(ValueError, match="slower than sound"):
        simulate(SMOOTH, track, SCENE, motion_in_flight=True)


def test_nothing_in_the_window():
    with pytest.warns(ClsasWarning, match="no echo arrives within the receive window"):
        echoes = simulate(SMOOTH, TRACK, SCENE, range_m=(100, 110))
    assert not echoes.samples.any()
    with (
        pytest.warns(ClsasWarning),
        pytest.raises(ValueError, match="snr_db must be left out without an echo"),
    ):
        simulate(SMOOTH, TRACK, SCENE, range_m=(100, 110), snr_db=10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bandwidth_hz": 0}, "bandwidth_hz must be finite and >= 1e-06 .* Hz, got 0"),
        ({"carrier_hz": -1}, "carrier_hz must be finite and >= 0 .* Hz, got -1"),
        ({"window": "square"}, "window must be 'none' or .* got 'square'"),
        ({"oversampling": 1e12}, "oversampling must be finite and >= 1 and <= 10000"),
        ({"bandwidth_hz": 1e-320}, "bandwidth_hz must be finite and >= 1e-06 and <= 1e.15 Hz"),
        ({"bandwidth_hz": 1e300}, "bandwidth_hz must be finite and >= 1e-06 and <= 1e.15 Hz"),
        (
            {"bandwidth_hz": 1e-320, "first_range_m": 1.0, "length": 10},
            "bandwidth_hz must be finite",
        ),
        (
            {"sound_speed_m_s": 1e-308, "first_range_m": 1.0, "length": 10},
            "carrier_hz must make at most .* with inf cycles",
        ),
        ({"first_range_m": 1e300, "length": 10}, "carrier_hz must make at most .* over 1e.300 m"),
        ({"first_range_m": 1.0, "length": 10**13}, "length must ask for at most .* GiB"),
        ({"oversampling": 0.9}, "oversampling must be finite and >= 1 and <= 10000, got 0.9"),
        ({"sound_speed_m_s": 0}, "sound_speed_m_s must be finite and > 0 .* m/s"),
        ({"first_range_m": 1.0}, "first_range_m must be given together with `length`"),
        ({"first_range_m": [1, 2, 3], "length": 9}, r"first_range_m must have shape \(2\)"),
        ({"first_range_m": 1.0, "length": 0}, "length must be at least 1, got 0"),
        ({"tx_m": np.zeros((3, 3))}, r"rx_m must have shape \(3, 3\) .* got \(2, 3\)"),
        ({"rx_m": [np.nan, 0, 0]}, "rx_m must be finite"),
        ({"rx_velocity_m_s": [0, 2e3, 0]}, "rx_velocity_m_s must be slower than sound"),
        ({"window": "square"}, "window must be 'none' or a window of SciPy"),
    ],
)
def test_bad_lines(arguments, message):
    good = {"tx_m": [0, 0, 0], "rx_m": np.zeros((2, 3)), "carrier_hz": 1e6, "bandwidth_hz": 1e5}
    with pytest.raises(ValueError, match=message):
        simulate_lines(scene=SCENE, **{**good, **arguments})


@pytest.mark.parametrize("arguments", [{"scene": None}, {"progress": 1}])
def test_line_arguments_of_another_type(arguments):
    good = {"scene": SCENE, "carrier_hz": CARRIER, "bandwidth_hz": BAND}
    with pytest.raises(TypeError, match=f"{next(iter(arguments))} must be "):
        simulate_lines([0, 0, 0], [0, 0, 0], **{**good, **arguments})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"positions_m": np.zeros((0, 3))}, ValueError, "positions_m must have shape .* no empty"),
        ({"positions_m": [[1, 2, np.inf]]}, ValueError, "positions_m must be finite, got 1"),
        ({"amplitudes": [1, 2]}, ValueError, r"amplitudes must have shape \(1\).* got \(2,\)"),
        ({"amplitudes": np.nan}, ValueError, "amplitudes must be finite"),
        ({"amplitudes": "loud"}, TypeError, "amplitudes must be real or complex"),
    ],
)
def test_bad_points(arguments, error, message):
    with pytest.raises(error, match=message):
        PointTargets(**{"positions_m": [[1, 2, 3]], **arguments})


@pytest.mark.parametrize("length_m", [1e6, 1e12, 1e300, 1e308])
@pytest.mark.parametrize("name", ["rx_length_m", "tx_height_m"])
def test_elements_too_long_for_memory_are_an_error_at_once(name, length_m):
    with pytest.raises(ValueError, match="the sonar's element lengths must ask for at most"):
        simulate(replace(SMOOTH, **{name: length_m}), TRACK, PointTargets([[3, 40, 4]]))


def test_the_terms_of_long_elements_pass_what_floats_hold():
    """Powers overflow from about 700 on, before Q! catches up."""
    reach = np.array([5000.0])
    terms = needed_terms(reach, 2.0, 1e-6)
    assert terms == pytest.approx(np.e * 5000, rel=0.01)
    assert terms * np.log(reach[0]) - math.lgamma(terms + 1) + np.log(2 / (terms + 1)) < -13.8


def test_a_survey_too_large_for_memory_is_an_error_before_its_channels_are_laid_out(monkeypatch):
    monkeypatch.setattr("clsas.simulation.simulator.channels", None)
    track = Track.straight((0, 0, 0), (1, 0, 0), pings=10**6, ping_interval_s=0.1)
    sonar = replace(SMOOTH, rx_m=np.zeros((1000, 3)))
    with pytest.raises(ValueError, match=r"sonar and track must ask for at most .* GiB"):
        simulate(sonar, track, SCENE)
    with pytest.raises(ValueError, match=r"range_m must ask for at most .* GiB"):
        simulate(sonar, track, SCENE, range_m=(30, 40))
