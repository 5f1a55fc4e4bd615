"""What inspections say of the recordings."""

import numpy as np
import pytest
import radar
import ultrasound

import clsas


@pytest.mark.slow
def test_a_capture_of_an_ultrasonic_array(recording, platform):
    lines = clsas.load(recording(ultrasound.RECORDING))
    # About the notch: the back wall is a mirror, whose image hardly depends on the sign.
    grid = clsas.Grid.plane((3e-3, 12e-3, 90), (15e-3, 25e-3, 150))
    found = clsas.inspect(lines, grid, device=platform)
    assert (found.geometry, found.pings, found.receivers) == ("array", 64, (1, 64))
    assert found.wavelength_m == pytest.approx(1.26e-3, rel=0.02)
    assert found.advance_m == pytest.approx(0.3e-3 * 0.75, rel=0.02)
    # The transmission's remains fill the first samples.
    assert [finding.name for finding in found.findings] == ["ends"]
    assert found.sign.ratio < 1 / 3


@pytest.mark.slow
def test_a_pass_of_a_radar(recording, platform):
    lines = clsas.load(recording(radar.RECORDINGS[0]))
    grid = clsas.Grid.plane((-40, 40, 100), (-40, 40, 100))
    found = clsas.inspect(lines, grid, device=platform, beam=clsas.BeamWindow(0.5))
    assert (found.geometry, found.pings) == ("monostatic", 117)
    assert np.diff(found.band_hz) == pytest.approx(622e6, rel=0.04)
    assert found.advance_m == pytest.approx(1.055, rel=0.01)
    # Lines over frequency are periodic: what leaves at one end comes in at the other.
    assert [finding.name for finding in found.findings] == ["ends"]
    assert found.sign.ratio < 1 / 3
    conjugate = clsas.inspect(
        clsas.RangeLines(
            lines.samples.conj(), lines.first_range_m, lines.range_step_m, lines.tx_m, lines.rx_m,
            lines.carrier_hz, lines.sound_speed_m_s,
        ),
        grid, device=platform,
    )  # fmt: skip
    assert "phase_sign" in conjugate
    # On a circle about the scene both signs look alike, unless it is known where to look.
    assert clsas.inspect(lines, device=platform).sign is None
