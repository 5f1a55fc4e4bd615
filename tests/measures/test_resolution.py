import numpy as np
import pytest

import clsas
from clsas.measures.resolution import expected_resolution_m, range_width_m


@pytest.mark.slow
def test_a_plain_aperture():
    """Without beams and far off, lambda R/(2 L) and c/(2 B), 0.886 of them at -3 dB."""
    pulse = clsas.Pulse(carrier_hz=1e5, bandwidth_hz=5e3, duration_s=0.1)
    sonar = clsas.Sonar(pulse, [[0.0, 0.0, 0.0]])
    track = clsas.Track.straight([-5, 0, 0], [1, 0, 0], 1001, 0.01)
    azimuth_m, range_m = expected_resolution_m(sonar, track, np.array([0, 1000.0, 0]))
    assert azimuth_m == pytest.approx(0.8859 * 0.015 * 1000 / (2 * 10.01), rel=1e-3)
    assert range_m == pytest.approx(0.8859 * 1500 / (2 * 5e3), rel=0.02)
    # Hamming widens the main lobe to 1.3 times c/(2 B).
    assert range_width_m(sonar, "hamming") == pytest.approx(1.3 * 1500 / (2 * 5e3), rel=0.02)


@pytest.mark.exhaustive
def test_many_channels_have_the_width_of_few():
    """More channels than are added up one by one, over the same aperture."""
    sonar = clsas.Sonar(clsas.Pulse(1e5, 5e3, 1e-3), [[0.0, 0, 0]], tx_length_m=0.2)
    point_m = np.array([0, 50.0, 0])
    few, many = (
        expected_resolution_m(
            sonar, clsas.Track.straight([-20, 0, 0], [1, 0, 0], n + 1, 40 / n), point_m
        )[0]
        for n in (4000, 40000)
    )
    assert many == pytest.approx(few, rel=1e-3)


@pytest.mark.exhaustive
def test_long_tracks_do_not_shorten_the_width():
    """Side lobes of the elements extend the spectrum far beyond the main lobe."""
    sonar, point_m = clsas.Sonar.edgetech(), np.array([0, 60.0, 0])
    narrow, wide = (
        expected_resolution_m(
            sonar, clsas.Track.straight([-end, 0, 0], [2, 0, 0], 5 * end + 1, 0.2), point_m
        )[0]
        for end in (8, 80)
    )
    assert wide == pytest.approx(narrow, rel=0.1)
    assert wide == pytest.approx(0.6 * 0.1, rel=0.1)  # of the triangle that sinc^2 transforms to
