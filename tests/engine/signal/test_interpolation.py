import dataclasses

import numpy as np
import pytest
from cases import burst, flat, noise

from clsas.engine.data.image_error import relative_error_db
from clsas.engine.signal.interpolation import (
    PHASES,
    TAPS,
    UPSAMPLINGS,
    choose,
    design,
    designs,
    resampling,
    upsampler,
)
from clsas.engine.signal.spectrum import Spectrum

NU = np.linspace(-0.5, 0.5, 101)


# Filters


@pytest.mark.parametrize("upsampling", [1.0, 4.0])
def test_two_taps_are_linear_interpolation(upsampling):
    weights = design(2, upsampling, flat(0.8)).weights(NU)
    np.testing.assert_allclose(weights, np.stack([0.5 - NU, 0.5 + NU], axis=-1), atol=1e-15)


@pytest.mark.parametrize("taps", TAPS)
def test_weights_mirror_and_keep_a_constant(taps):
    interpolator = design(taps, 4.0, flat(0.8))
    weights = interpolator.weights(NU)
    assert weights.shape == (101, taps)
    np.testing.assert_allclose(weights, interpolator.weights(-NU)[:, ::-1], atol=1e-14)
    error = 10 ** (interpolator.error_db / 20)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=10 * error + 1e-14)


@pytest.mark.parametrize("frequency", [0.0, 0.1, 0.25])
def test_the_response_is_what_a_tone_of_upsampled_samples_keeps(frequency):
    """It is the average over positions between samples, at cycles per upsampled sample."""
    interpolator = design(8, 1.5, flat(0.8))
    sample = np.arange(-40, 41)
    tone = np.exp(2j * np.pi * frequency * sample)
    kept = []
    for place in np.linspace(-0.5, 0.5, 201) + 0.5:
        taps = tone[40 - 3 : 40 + 5] @ interpolator.weights(place - 0.5)
        kept.append(taps / np.exp(2j * np.pi * frequency * place))
    assert interpolator.response(frequency) == pytest.approx(np.mean(kept).real, abs=1e-3)


@pytest.mark.parametrize("taps", TAPS)
@pytest.mark.parametrize("upsampling", [1.0, 2.0, 5.0])
def test_the_predicted_error_is_that_of_tones(taps, upsampling):
    """A filter turns the tone exp(j 2 pi f n) into itself at any position, but for its error."""
    spectrum = flat(0.7)
    interpolator = design(taps, upsampling, spectrum)
    f = spectrum.frequency[:, None, None] / upsampling
    nu = np.linspace(-0.5, 0.5, 1001)
    weights = interpolator.weights(nu)
    offsets = np.arange(taps) - (taps - 1) / 2
    tones = (np.exp(2j * np.pi * f * offsets) @ weights.T)[:, 0]
    error = np.mean(np.abs(tones - np.exp(2j * np.pi * f[:, 0] * nu)) ** 2, axis=1)
    measured = 10 * np.log10(np.sum(spectrum.power * error))
    assert interpolator.error_db == pytest.approx(measured, abs=0.5)


def test_more_taps_and_more_upsampling_err_less():
    spectrum = flat(0.8)
    error = np.array([[design(t, u, spectrum).error_db for u in (1, 2, 4)] for t in TAPS])
    assert np.all(np.diff(error, axis=0) < 0)
    assert np.all(np.diff(error, axis=1) < 0)


@pytest.mark.parametrize(("taps", "gain_db"), [(2, 12.04), (4, 24.08)])
def test_each_doubling_gains_the_order_of_the_filter(taps, gain_db):
    """The error is of second order in the spacing if linear, of fourth with four taps."""
    errors = [design(taps, upsampling, flat(0.8)).error_db for upsampling in (8, 16)]
    assert errors[0] - errors[1] == pytest.approx(gain_db, abs=0.1)


@pytest.mark.parametrize("taps", [4, 6, 8])
def test_noise_in_a_gap_of_the_band_is_not_amplified(taps):
    """Between two sub-bands, rounding errors would grow in every stage of an image."""
    frequency = (np.arange(128) + 0.5) / 256
    power = np.where((frequency > 0.27) & (frequency < 0.41), 1.0, 0.0)
    spectrum = Spectrum(0.0, frequency, power / power.sum())
    for each in designs(taps, np.geomspace(1, 12, 16), spectrum):
        assert np.mean(np.sum(each.weights(NU) ** 2, axis=1)) < 1.6


def test_least_squares_beats_lagrange():
    """The four-tap cubic is among the filters over which least squares optimises."""
    upsampling, spectrum = 2.0, flat(0.8)
    f = spectrum.frequency[:, None, None] / upsampling
    offsets = np.array([-1.5, -0.5, 0.5, 1.5])
    lagrange = np.stack(
        [
            np.prod([(NU - b) / (a - b) for b in offsets if b != a], axis=0)
            for a in offsets
        ],
        axis=-1,
    )  # fmt: skip
    tones = (np.exp(2j * np.pi * f * offsets) @ lagrange.T)[:, 0]
    error = np.mean(np.abs(tones - np.exp(2j * np.pi * f[:, 0] * NU)) ** 2, axis=1)
    classical = 10 * np.log10(np.sum(spectrum.power * error))
    assert design(4, upsampling, spectrum).error_db < classical - 5


@pytest.mark.parametrize("accuracy_db", [-20.0, -30.0, -50.0, -65.0, -85.0])
@pytest.mark.parametrize("occupied", [0.2, 0.8])
def test_the_choice_is_accurate_enough(accuracy_db, occupied):
    spectrum = flat(occupied)
    chosen = choose(spectrum, accuracy_db)
    assert chosen.error_db <= accuracy_db
    again = design(chosen.taps, chosen.upsampling, spectrum)
    assert again.error_db == chosen.error_db
    coarser = [rate for rate in UPSAMPLINGS if rate < chosen.upsampling]
    assert all(design(chosen.taps, rate, spectrum).error_db > accuracy_db for rate in coarser)


def test_what_is_fixed_is_kept():
    spectrum = flat(0.8)
    assert choose(spectrum, -60, taps=6).taps == 6
    assert choose(spectrum, -60, upsampling=2.0).upsampling == 2.0
    both = choose(spectrum, -60, taps=2, upsampling=1.0)
    assert (both.taps, both.upsampling) == (2, 1.0)


def test_slow_lookups_are_avoided():
    spectrum = flat(0.8)
    free = choose(spectrum, -70)

    def slow_beyond(limit: float, *slow_taps: int):
        return lambda taps, upsampling: 3.0 if taps in slow_taps and upsampling > limit else 1.0

    limit = free.upsampling - 0.1
    bounded = choose(spectrum, -70, lookup_cost=slow_beyond(limit, *TAPS))
    assert bounded.upsampling < free.upsampling
    assert bounded.error_db <= -70
    of_taps = choose(spectrum, -70, lookup_cost=slow_beyond(limit, free.taps))
    assert of_taps.taps != free.taps
    assert of_taps.error_db <= -70
    as_slow = choose(spectrum, -70, lookup_cost=lambda taps, upsampling: 3.0)
    assert (as_slow.taps, as_slow.upsampling) == (free.taps, free.upsampling)


# Resampling


@pytest.mark.parametrize("centre", [0.0, 0.31, -0.48])
@pytest.mark.parametrize("upsampling", [1.0, 1.25, 3.0])
@pytest.mark.parametrize(("dtype", "error_db"), [(np.complex128, -240), (np.complex64, -125)])
def test_resampling_gives_the_closed_form(centre, upsampling, dtype, error_db):
    length = 131
    samples = burst(np.arange(length), centre)[None].astype(dtype)
    spectrum = dataclasses.replace(flat(0.8), centre=centre)
    r = resampling(length, design(4, upsampling, spectrum), spectrum)
    got = r.apply(samples)
    assert got.dtype == dtype
    assert got.shape == (1, r.length)
    assert r.ratio >= upsampling
    assert r.centre_cycles_per_sample == pytest.approx(centre, abs=0.5 / r.period)
    index = (np.arange(r.length) + r.first) / r.ratio - r.lead
    turn = np.exp(-2j * np.pi * r.centre_cycles_per_sample * (index + r.lead))
    assert relative_error_db(got, (burst(index, centre) * turn)[None]) <= error_db


@pytest.mark.parametrize("length", [1, 2, 17, 1000, 1021])
@pytest.mark.parametrize("taps", TAPS)
def test_resampled_lines_hold_every_tap(length, taps):
    spectrum = flat(0.8)
    r = resampling(length, design(taps, 1.7, spectrum), spectrum)
    first, last = ((place + r.lead) * r.ratio - r.first for place in (0, length - 1))
    assert first >= taps // 2 - 1
    assert last <= r.length - taps // 2
    assert r.lead * r.ratio >= r.first >= 0
    assert r.first + r.length <= r.upsampled_period


def test_channels_are_resampled_alone():
    samples = noise(5, 300)
    spectrum = flat(0.8)
    r = resampling(300, design(4, 2.5, spectrum), spectrum)
    np.testing.assert_allclose(
        r.apply(samples), np.concatenate([r.apply(line[None]) for line in samples]), atol=1e-13
    )


@pytest.mark.parametrize("taps", TAPS)
def test_designing_for_many_rates_is_designing_for_each(taps):
    rates, spectrum = (1.0, 2.5, 12.0), flat(0.8)
    for rate, found in zip(rates, designs(taps, rates, spectrum), strict=True):
        alone = design(taps, rate, spectrum)
        assert found.upsampling == rate
        np.testing.assert_allclose(found.coefficients, alone.coefficients, atol=1e-9)
        assert found.error_db == pytest.approx(alone.error_db, abs=1e-6)
        assert found.scatter_db == pytest.approx(alone.scatter_db, abs=1e-6)


@pytest.mark.parametrize("most_db", [-40.0, -75.0])
def test_upsampling_filters_are_least_squares_fits(most_db):
    """They fit exp(j 2 pi f x) at every phase, weighted by the power."""
    spectrum = flat(0.7)
    found = upsampler(spectrum, 16, np.ones_like, most_db)
    weight = np.sqrt(spectrum.power + 1e-13)
    target = np.append(weight, np.zeros(len(weight)))
    for phase in range(PHASES):
        position = np.arange(found.taps) + 1 - found.taps // 2 - phase / PHASES
        angle = 2 * np.pi * np.outer(spectrum.frequency, position)
        matrix = np.concatenate([weight[:, None] * np.cos(angle), weight[:, None] * np.sin(angle)])
        best = np.linalg.lstsq(matrix, target, rcond=None)[0]
        least = np.sum((matrix @ best - target) ** 2)
        assert np.sum((matrix @ found.coefficients[phase] - target) ** 2) < 1.001 * least + 1e-15
