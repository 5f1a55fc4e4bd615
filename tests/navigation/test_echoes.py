"""Micronavigation over few reflectors, and its uncertainty if the navigation is correct."""

import dataclasses

import numpy as np
import pytest
from studies.navigating import (
    WAVELENGTH_M,
    detrended,
    overlapping_array,
    said_to_be_on,
    seabed,
    with_noise,
)
from tiers import few

import clsas
from clsas.navigation.correlation import independent_echoes, strongest, without_highlights
from clsas.navigation.displacement import block_products
from clsas.navigation.micronavigation import micronavigate

NEAR_M, FAR_M = 12.0, 16.0


def correct(scene_of, pings):
    """Return lines of a straight track, which the navigation contains."""
    sonar, advance_m = overlapping_array(56, 24)
    track = clsas.Track.straight((0, 0, 0), (advance_m, 0, 0), pings, 1.0)
    echoes = clsas.simulate(sonar, track, scene_of(track), range_m=(NEAR_M - 0.5, FAR_M + 0.5))
    return said_to_be_on(clsas.compress(echoes), sonar, track)


def reflectors(count, seed):
    """Return a function that places points abeam of the middle of a track."""
    random = np.random.default_rng(seed)

    def scene(track):
        x = track.positions_m[:, 0]
        along_m = x.mean() + np.ptp(x) / 2 * random.uniform(-1, 1, count)
        across_m = np.linspace(NEAR_M + 0.5, FAR_M - 0.5, count + 2)[1:-1]
        at = np.stack([along_m, random.permutation(across_m), np.zeros(count)], axis=1)
        return clsas.PointTargets(at, np.exp(2j * np.pi * random.random(count)))

    return scene


def navigate(lines, **options):
    return micronavigate(lines, range_m=(NEAR_M, FAR_M), **options)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("count", "noise"), few([(1, False), (1, True), (3, False)], often=[(1, False)])
)
def test_few_reflectors_do_not_determine_yaw(count, noise):
    """Their directions look like a yaw."""
    lines = correct(reflectors(count, 3), 8)
    if noise:
        lines = with_noise(lines, 0.95, np.random.default_rng(count))
    with pytest.raises(ValueError, match=r"at least 8 reflectors, .* got about"):
        navigate(lines)
    with pytest.raises(ValueError, match=r"at least 8 reflectors|a coherence of at least"):
        navigate(lines, element_length_m=WAVELENGTH_M)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_few_reflectors_determine_sway(count):
    found = navigate(correct(reflectors(count, 4), 8), unknowns=("sway",))
    assert np.abs(found.sway_steps_m).max() <= 1e-6 + 3 * found.sway_steps_sd_m.max()
    assert np.std(detrended(found.sway_m)) <= 3 * found.shape_sd_m.max()


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", [12, 30])
def test_deviations_over_some_reflectors_match_the_errors(count):
    """All reflectors are near broadside, whereas the filters expect an even seabed."""
    found = navigate(correct(reflectors(count, 5), 12), element_length_m=WAVELENGTH_M)
    error_rad = np.sqrt(np.mean(found.yaw_steps_rad**2))
    assert error_rad <= 2 * np.sqrt(np.mean(found.yaw_steps_sd_rad**2))


@pytest.mark.exhaustive
def test_one_window_shows_how_errors_persist():
    """One window is the default for a short swath."""
    error_m, reported_m = [], []
    for seed in (20, 26):
        lines = correct(lambda track, seed=seed: seabed(track, NEAR_M, FAR_M, 5000, seed=seed), 40)
        found = navigate(lines, element_length_m=WAVELENGTH_M)
        assert found.coherence.shape[1] == 1
        assert found.persistence > 1
        error_m.append(np.std(detrended(found.lines.ping_centres_m[:, 1])))
        reported_m.append(np.sqrt(np.mean(found.shape_sd_m**2)))
    assert np.sqrt(np.mean(np.square(error_m))) <= 1.4 * np.sqrt(np.mean(np.square(reported_m)))


def window(samples):
    values = np.broadcast_to(samples, (4, len(samples))).astype(np.complex128)
    return values, values


def test_echoes_are_counted():
    """Points with slopes count one by one, and speckle counts by its independent samples."""
    random = np.random.default_rng(0)
    white = random.standard_normal((2, 4, 400, 2)) @ [1, 1j]
    speckle = white[0], white[1]
    assert independent_echoes(speckle, speckle, 400.0, 4.0) == pytest.approx(400, rel=0.05)
    for count in (1, 4):
        samples = np.full(400, 1e-3)
        samples[np.arange(count) * 97 + 20] = 1.0
        points = window(samples)
        assert independent_echoes(points, points, 400.0, 1.0) == pytest.approx(count, rel=0.5)


@pytest.mark.parametrize("brightness_db", [23.0, 25.0, 27.0])
def test_speckle_beside_a_bright_reflector_is_no_gap(brightness_db):
    """Its dips lie below a thousandth of the reflector's power."""
    for seed in range(5):
        random = np.random.default_rng(seed)
        white = random.standard_normal((400, 2)) @ [1, 1j] / np.sqrt(2)
        speckle = np.convolve(white, np.hanning(5)[1:-1], "same")
        speckle[200] += 10 ** (brightness_db / 20) * np.std(speckle)
        one = window(speckle)
        largest = strongest([one])
        weakened = without_highlights(one, largest)
        assert independent_echoes(one, weakened, 200.0, largest) > 150


@pytest.mark.parametrize("lag", [0, 3, -2])
def test_blocks_add_up_to_the_correlation(lag):
    random = np.random.default_rng(1)
    one, other = random.standard_normal((2, 3, 100, 2)) @ [1, 1j]
    expected = sum(
        one[:, n] * other[:, n + lag].conj() for n in range(max(0, -lag), min(100, 100 - lag))
    )
    found = block_products((one, other), lag, 50.0)
    assert found.shape == (3, 6)
    np.testing.assert_allclose(found.sum(axis=1), expected, rtol=1e-12)


@pytest.mark.exhaustive
def test_a_few_pairs_of_few_echoes_are_used_and_counted():
    """The first pings see speckle, and the last ones little more than one bright corner."""
    lines = correct(lambda track: seabed(track, NEAR_M, FAR_M, 5000, seed=3), 16)
    bright = correct(reflectors(1, 3), 16)
    samples = lines.samples.copy()
    last = slice(lines.ping_starts[12], None)
    samples[last] = 1e-3 * samples[last] + bright.samples[last, : lines.length]
    mixed = dataclasses.replace(lines, samples=samples)
    bridged = pytest.warns(clsas.ClsasWarning, match="1 of 15 pairs of pings are not coherent")
    with bridged, pytest.warns(clsas.ClsasWarning, match="3 of 15 pairs .* have echoes of few"):
        found = navigate(mixed)
    assert np.isfinite(found.yaw_steps_sd_rad[12:]).all()
