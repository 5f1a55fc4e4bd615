"""Estimates of how dark images are beside what their beams pass."""

import numpy as np
import pytest
from cases import bright_where_coverage_ends
from tiers import also

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.lines import wavelength_m
from clsas.engine.data.visibility import sines
from clsas.engine.signal.ambiguity import brightness
from clsas.engine.signal.spectrum import measure_spectrum

BEAM = BeamWindow(20.0, "hann", along=[1, 0, 0])


def coherent_ratio_db(lines, grid):
    """Power of the whole coherent sum of what the beam passes over that of its terms."""
    points_m = grid.spread(48)
    range_m = np.linalg.norm(points_m[:, None] - lines.tx_m, axis=-1)
    passed = np.zeros(range_m.shape, complex)
    frequency = np.fft.fftfreq(lines.length)
    for channel in range(lines.channels):
        spectrum = np.fft.fft(lines.samples[channel]) / lines.length
        sample = (range_m[:, channel] - lines.first_range_m[channel]) / lines.range_step_m
        turns = sample[:, None] * frequency
        turns += lines.carrier_cycles_per_m * range_m[:, channel, None]
        passed[:, channel] = np.exp(2j * np.pi * turns) @ spectrum
    sine = sines(points_m, lines.phase_centres_m, BEAM.directions(lines)).T
    passed *= BEAM.weights(sine, wavelength_m(lines))
    image = passed.sum(axis=1)
    return 10 * np.log10(np.vdot(image, image).real / np.vdot(passed, passed).real)


@pytest.mark.exhaustive
@pytest.mark.parametrize("x_m", [4.8, *also(4.4)])
def test_points_that_the_beam_hardly_covers_make_dark_images(x_m):
    lines, grid = bright_where_coverage_ends(x_m)
    spectrum = measure_spectrum(lines, grid)
    found = brightness(lines, grid, spectrum, BEAM, BEAM.directions(lines))
    assert 10 * np.log10(found) == pytest.approx(coherent_ratio_db(lines, grid), abs=4)


def test_points_that_the_beam_covers_make_bright_images():
    lines, grid = bright_where_coverage_ends(0.0)
    spectrum = measure_spectrum(lines, grid)
    assert brightness(lines, grid, spectrum, BEAM, BEAM.directions(lines)) == 1
