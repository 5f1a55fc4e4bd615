import dataclasses

import numpy as np
import pytest
from dense import TRACKS, WAVELENGTH, scene, to_and_fro, turning
from factorizing import BEAMS, arc, made

from clsas.aperture.beam_directions import beam_rate, directions_of
from clsas.aperture.dense_tracks import mean_track_of
from clsas.aperture.mean_track import mean_track
from clsas.sonar.beam import BeamWindow

PAST_THE_ENDS = np.array([-0.1, -0.05, 0.3, 1.05, 1.1])


def lines_at(tx_m):
    lines, _ = scene("helix")
    lines = lines.without_samples().select(np.zeros(len(tx_m), int))
    return dataclasses.replace(lines, tx_m=tx_m, rx_m=tx_m)


@pytest.mark.parametrize("turns", ["circle", "helix"])
def test_a_beam_on_a_target_stays_there_past_the_ends(turns):
    """Past the ends positions continue straight; with constant headings the beam would miss."""
    tx_m = TRACKS["helix"]() if turns == "helix" else TRACKS["helix"]()[:180] * [1, 1, 0]
    lines = lines_at(tx_m)
    track = (
        mean_track_of(lines, "sheet", WAVELENGTH)
        if turns == "helix"
        else mean_track(lines, WAVELENGTH)
    )
    found = directions_of(BeamWindow(20, "hann"), turning(tx_m), track)
    sight = -track.positions_m(PAST_THE_ENDS) * [1, 1, 0]
    sine = np.einsum("pi,pi->p", sight, found.at(PAST_THE_ENDS))
    assert np.abs(sine / np.linalg.norm(sight, axis=1)).max() < 0.1


@pytest.mark.parametrize("squint_deg", [0.0, 5.0])
def test_a_scan_to_and_fro_has_one_heading_without_a_squint(squint_deg):
    track = mean_track_of(lines_at(TRACKS["raster"]()), "sheet", WAVELENGTH)
    beam = BeamWindow(20, "hann", squint_deg=squint_deg)
    along = directions_of(beam, to_and_fro(), track).at(track.coordinate, track.across)
    assert (np.ptp(along @ [1.0, 0.0, 0.0]) < 1e-6) == (squint_deg == 0)


def test_rates_hold_all_over_a_box():
    """Around the centre of a circle, weights change at the corners of a box, not in its middle."""
    tx_m = TRACKS["helix"]()[:180] * [1, 1, 0]
    track = mean_track(lines_at(tx_m), WAVELENGTH)
    beam = BeamWindow(20, "hann")
    along = directions_of(beam, turning(tx_m), track).along
    sides_m = np.diag([0.2, 0.2, 0.0])[:2]
    inside = track.on_track
    middle, box = (
        beam_rate(beam, track, along, np.zeros((1, 3)), sides)[0, inside]
        for sides in (0 * sides_m, sides_m)
    )
    corners_m = np.array([[x, y, 0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    at_corners = beam_rate(beam, track, along, corners_m, 0 * sides_m)[:, inside].max(axis=0)
    np.testing.assert_allclose(box, np.maximum(at_corners, middle), rtol=1e-9)
    assert middle.max() < 0.2 * box.max()


def test_directions_between_channels_are_of_length_one():
    lines, _ = made(arc)
    track = mean_track(lines, WAVELENGTH)
    along = directions_of(BEAMS[0], BEAMS[0].directions(lines), track).at(np.linspace(-1, 2, 50))
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1)
