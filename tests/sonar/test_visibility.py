import numpy as np
from cases import along_x, beside, track_lines

from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import channel_ranges, sines

X = (1.0, 0, 0)


def test_ranges_hold_every_channel_that_sees_a_part_and_few_others():
    rng = np.random.default_rng(1)
    track = along_x(1000, 0.05) + rng.normal(0, 0.05, (1000, 3))
    lines = track_lines(track, beside(track, 0.2, 0, 0.1))
    beam = BeamWindow(6, "hann", squint_deg=10, along=X)
    along = beam.directions(lines)
    centres, radius = rng.uniform([-40, 5, -3], [40, 80, 3], (300, 3)), 0.5
    ranges = channel_ranges(beam, lines, along, centres, radius)
    way = rng.normal(size=(200, 3))
    ball = radius * way / np.linalg.norm(way, axis=1)[:, None]
    channel = np.arange(1000)
    wasted = 0
    for centre, (first, end) in zip(centres, ranges, strict=True):
        seen = (beam.weights(sines(centre + ball, lines.phase_centres_m, along)) > 0).any(axis=1)
        assert np.all(~seen | ((channel >= first) & (channel < end)))
        if seen.any():
            wasted += (end - first) - np.ptp(channel[seen]) - 1
    assert 0 < (ranges[:, 1] - ranges[:, 0]).sum() < 0.2 * 300 * 1000
    assert wasted < 0.15 * (ranges[:, 1] - ranges[:, 0]).sum()
