import numpy as np
import pytest

from clsas.engine.factorized import filters
from clsas.engine.factorized.filters import choose, steering_spectrum
from clsas.engine.signal.spectrum import Spectrum

LINES = Spectrum(0.0, (np.arange(128) + 0.5) / 256, np.repeat([1 / 96, 0.0], [96, 32]))


def power(error_db):
    return 10 ** (error_db / 10)


@pytest.mark.parametrize("of_highest", [1.0, np.linspace(0.6, 1.0, 9)])
@pytest.mark.parametrize("aperture_taps", [4, 8])
@pytest.mark.parametrize("stages", [1, 4])
@pytest.mark.parametrize("most_db", [-25.0, -50.0])
def test_filters_use_up_the_error_that_is_allowed(of_highest, aperture_taps, stages, most_db):
    steering = steering_spectrum(of_highest)
    choice = choose(LINES, 6, aperture_taps, stages, most_db)
    found = choice.design(LINES, steering, stages, most_db)
    in_range = stages * power(found.align.scatter_db) + power(found.final.scatter_db)
    together = in_range + stages * power(found.aperture.error_db)
    assert power(most_db - 0.6) <= together <= power(most_db)


def test_few_frequencies_below_the_highest_allow_fewer_virtual_channels():
    wide, narrow = (
        choose(LINES, 6, 8, 4, -50.0).design(LINES, steering_spectrum(of_highest), 4, -50.0)
        for of_highest in (np.linspace(0.5, 1.0, 9), 1.0)
    )
    assert wide.aperture.upsampling < 0.97 * narrow.aperture.upsampling


@pytest.mark.parametrize("of_highest", [1.0, 0.5, np.linspace(0.1, 1.0, 33)])
def test_the_spectrum_of_steering_functions(of_highest):
    """It contains all of the power, and none beyond the fastest phase."""
    spectrum = steering_spectrum(of_highest)
    assert spectrum.power.sum() == pytest.approx(1)
    assert (spectrum.power >= 0).all()
    beyond = spectrum.frequency > (np.max(of_highest) + 1 / filters._BINS) / 2
    assert not spectrum.power[beyond].any()
