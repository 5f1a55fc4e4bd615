from dataclasses import replace

import numpy as np
import pytest

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse, Sonar, line_array
from clsas.engine.data.track import Track, channels
from clsas.inspection.sampling import (
    check_sampling,
    grating_lobe_m,
    receive_interval_s,
)
from clsas.measures.assess import survey_lines

GRID = Grid.plane(x=(0, 5, 64), y=(40, 45, 64))
WIDE = Sonar.thesis_wide_beam()


def track(sonar, advance, interval=0.2, pings=10):
    return Track.straight([0, 0, 0], [advance / interval, 0, 0], pings, interval)


def test_receive_interval():
    first, last = receive_interval_s(40.0, 45.0, 1e-3, 1500.0)
    assert first == pytest.approx(80 / 1500)  # [22]
    assert last == pytest.approx(90 / 1500 + 1e-3)  # [23]


def test_phase_centres_are_midpoints():
    sonar = replace(WIDE, tx_m=[0.2, 0, 0])
    survey = track(sonar, 0.528)
    tx, rx, _ = channels(sonar, survey)
    centres = lines_of(sonar, survey).phase_centres_m
    # [32] with u_p the transmitter's position.
    np.testing.assert_allclose(centres[:, 0], tx[:, 0] + (rx[:, 0] - tx[:, 0]) / 2)
    # Gapless: 640 of them, evenly over 5.28 m.
    np.testing.assert_allclose(np.diff(np.sort(centres[:, 0])), 8.25e-3, atol=1e-12)


def test_grating_lobe_is_where_the_aperture_repeats():
    """The array factor of phase centres d apart peaks again at sin theta = lambda/(2 d)."""
    wavelength, spacing, distance = 1.5e-3, 8.25e-3, 40.0
    lobe = grating_lobe_m(wavelength, spacing, distance)
    sine = lobe / distance
    u = spacing * np.arange(64)
    factor = abs(np.exp(4j * np.pi / wavelength * u * sine).mean())
    assert factor == pytest.approx(1)
    assert lobe == pytest.approx(3.636, abs=1e-3)


def test_a_well_sampled_survey_has_no_findings():
    sonar = replace(WIDE, rx_m=line_array(64, 15e-3))
    assert check_sampling(sonar, track(sonar, 0.48), GRID) == []


def test_spacing_finding_carries_its_numbers():
    (finding,) = check_sampling(WIDE, track(WIDE, 0.528), GRID)
    assert finding.name == "along_track_spacing"
    assert finding.value == pytest.approx(8.25e-3)
    assert finding.limit == pytest.approx(7.5e-3)
    assert "8.25 mm apart along the track, but should be at most 7.5 mm apart" in finding.message
    assert "half the element length of 15 mm" in finding.message
    ranges = [float(part) for part in finding.message.split("(")[1].split() if part[0].isdigit()]
    lobes = finding.message.split("grating lobes ")[1].split()
    assert float(lobes[0]) == pytest.approx(grating_lobe_m(1.5e-3, 8.25e-3, ranges[0]), rel=1e-3)
    assert float(lobes[3]) == pytest.approx(grating_lobe_m(1.5e-3, 8.25e-3, ranges[1]), rel=1e-3)


def test_sway_of_a_course_hardly_changes_its_spacing():
    """A spacing of exactly the limit passes, although sway turns the course a little."""
    sonar = replace(WIDE, rx_m=line_array(64, 15e-3))
    for sway_m in (0.0, 0.005):
        survey = Track.straight(
            [0, 0, 0], [2.4, 0, 0], 10, 0.2, sway_m=lambda t, most=sway_m: most * np.sin(3 * t)
        )
        assert check_sampling(sonar, survey, GRID) == []


def test_gap_between_pings_is_found_on_any_course():
    sonar = replace(WIDE, rx_m=line_array(64, 15e-3))
    for course in ([1, 0, 0], [0, 1, 0], [0.6, -0.8, 0]):
        velocity = np.array(course) * 0.6 / 0.2
        survey = Track.straight([0, 0, 0], velocity, 10, 0.2)
        (finding,) = check_sampling(sonar, survey, GRID)
        assert finding.value == pytest.approx(0.6 - 0.48 + 7.5e-3)


def test_ping_rate_finding_carries_its_numbers():
    sonar = replace(WIDE, rx_m=line_array(64, 15e-3))
    (finding,) = check_sampling(sonar, track(sonar, 0.48, interval=0.05), GRID)
    assert finding.name == "ping_rate"
    assert finding.value == pytest.approx(20.0)
    farthest = np.hypot(45, 5 + 0.48)
    assert finding.limit == pytest.approx(1 / (2 * farthest / 1500 + 1e-3), rel=0.02)
    assert "the ping rate of 20 Hz is above" in finding.message


def test_the_grid_limits_the_spacing_of_omnidirectional_elements():
    """At the limit, the grating lobes of targets on the grid lie just off the grid."""
    sonar = Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]])
    grid = Grid.plane(x=(-5, 5, 11), y=(40, 50, 11))
    # At sin theta = 5/sqrt(5^2 + 40^2) to either side.
    spread = 2 * 5 / np.hypot(5, 40)
    limit = 15e-3 / (2 * spread)
    sparse, dense = (
        Track.straight([-0.05, 0, 0], [advance, 0, 0], 3, 1.0)
        for advance in (1.02 * limit, 0.97 * limit)
    )
    (finding,) = check_sampling(sonar, sparse, grid)
    assert finding.limit == pytest.approx(limit, rel=0.01)
    assert "to keep grating lobes off the grid" in finding.message
    assert check_sampling(sonar, dense, grid) == []


def test_any_grid_is_checked():
    sonar = Sonar.edgetech()
    survey = track(sonar, 0.4, interval=0.05, pings=20)
    plane = Grid.plane(x=(0, 10, 5), y=(40, 60, 5), z=-5.0)
    points = Grid.points(plane.positions_m())
    heights = plane.with_height(np.zeros((5, 5)))
    expected = check_sampling(sonar, survey, plane)
    assert [finding.name for finding in expected] == ["ping_rate"]
    assert check_sampling(sonar, survey, points) == expected
    assert check_sampling(sonar, survey, heights) == expected


def lines_of(sonar, survey):
    tx_m, rx_m, _ = channels(sonar, survey)
    samples = np.ones((len(tx_m), 2), complex)
    return RangeLines(samples, 40.0, 0.01, tx_m, rx_m, sonar.pulse.carrier_hz, 1500.0)


def test_lines_are_held_to_the_same_limits():
    survey = track(WIDE, 0.528)
    expected = check_sampling(WIDE, survey, GRID)
    assert check_sampling(lines_of(WIDE, survey), GRID, element_length_m=0.015) == expected
    omnidirectional = Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]])
    survey = track(omnidirectional, 0.2)
    expected = check_sampling(omnidirectional, survey, GRID)
    assert len(expected) == 1
    lines = lines_of(omnidirectional, survey)
    assert check_sampling(lines, GRID) == check_sampling(lines, grid=GRID) == expected
    on_carrier = replace(lines, carrier_hz=0.0)
    assert check_sampling(on_carrier, GRID, wavelength_m=0.015) == expected


def test_a_beam_leaves_grating_lobes_out():
    lines = lines_of(Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]]), track(WIDE, 0.05))
    limit = 0.015 / (4 * np.sin(np.radians(10)))
    (finding,) = check_sampling(lines, beam=BeamWindow(20.0))
    assert finding.limit == pytest.approx(limit)
    assert finding.message.endswith("to keep grating lobes out of the beam of 20 degrees")
    assert "with a beam" in finding.remedy
    assert check_sampling(lines, beam=BeamWindow(8.0)) == []
    # The narrower of beam and grid decides.
    narrow = Grid.plane(x=(0, 1, 4), y=(200, 201, 4))
    assert check_sampling(lines, narrow, beam=BeamWindow(60.0)) == []


def test_one_ping_of_one_receiver_and_one_point():
    sonar = Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]])
    assert check_sampling(sonar, Track([[0, 0, 0]], [0.0]), Grid.points([[0, 0, 0]])) == []


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: receive_interval_s(40, 30, 1e-3), "far_m must be finite and >= 40 m, got 30"),
        (lambda: receive_interval_s(-1, 30, 1e-3), "near_m must be finite and >= 0 m, got -1"),
        (lambda: grating_lobe_m(0, 1, 1), "wavelength_m must be finite and > 0 m, got 0"),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "grid must be given with lines, or `beam` or `element_length_m`"),
        ({"grid": 3}, "grid must be of type Grid, got int"),
        ({"beam": 20.0}, "beam must be of type BeamWindow, got float"),
        (
            {"element_length_m": 0, "wavelength_m": 1},
            "element_length_m must be finite and > 0 m, got 0",
        ),
        ({"grid": GRID, "wavelength_m": -1}, "wavelength_m must be finite and > 0 m, got -1"),
        ({"grid": GRID}, "wavelength_m must be given for lines with `carrier_hz` 0"),
    ],
)
def test_arguments_beside_lines(arguments, message):
    lines = replace(lines_of(WIDE, track(WIDE, 0.5)), carrier_hz=0.0)
    with pytest.raises((TypeError, ValueError), match=message):
        check_sampling(lines, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None, track(WIDE, 0.5), GRID), "sonar must be of type Sonar or RangeLines, got NoneType"),
        (("a", None, GRID), r"sonar must be of type Sonar or RangeLines, got str"),
        ((WIDE, GRID, GRID), "track must be of type Track, got Grid"),
        (
            (lines_of(WIDE, track(WIDE, 0.5)), track(WIDE, 0.5), GRID),
            "track must be left out with range lines.* got Track",
        ),
        ((lines_of(WIDE, track(WIDE, 0.5)), 5, GRID), "track must be left out .* got int"),
        ((WIDE, track(WIDE, 0.5), None), "grid must be of type Grid, got NoneType"),
    ],
)
def test_arguments_of_another_type(arguments, message):
    with pytest.raises(TypeError, match=message):
        check_sampling(*arguments)


def test_banks_are_checked_one_by_one():
    """Two rows above each other are no denser array, however they lie along the track."""
    pulse = Pulse(100e3, 20e3, 1e-3)
    course = Track.straight([0, 0, 10], [2, 0, 0], pings=10, ping_interval_s=0.1)
    grid = Grid.plane((0, 2, 9), (40, 41, 9))
    row_m = line_array(4, 0.1)
    one = Sonar(pulse, row_m, rx_length_m=0.08)
    staggered_m = row_m + [0.05, 0, 0.3]
    two = Sonar(pulse, [*row_m, *staggered_m], rx_length_m=0.08, bank_numbers=[0] * 4 + [1] * 4)
    (expected,) = check_sampling(one, course, grid)
    (found,) = check_sampling(two, course, grid)
    assert found.value == pytest.approx(expected.value)
    assert found.limit == expected.limit
    lines = survey_lines(two, course, grid)
    (of_lines,) = check_sampling(lines, grid, element_length_m=0.08)
    assert of_lines.value == pytest.approx(expected.value)
    # As one array, the receivers would be close enough.
    assert check_sampling(replace(two, bank_numbers=None), course, grid) == []


def test_the_worst_bank_counts():
    pulse = Pulse(100e3, 20e3, 1e-3)
    course = Track.straight([0, 0, 10], [2, 0, 0], pings=2, ping_interval_s=0.01)
    grid = Grid.plane((0, 2, 9), (40, 41, 9))
    rx_m = [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.3], [0.3, 0, 0.3]]
    sonar = Sonar(pulse, rx_m, rx_length_m=0.08, bank_numbers=[0, 0, 1, 1])
    found = {each.name: each for each in check_sampling(sonar, course, grid)}
    assert set(found) == {"along_track_spacing", "ping_rate"}
    (worse,) = (
        each
        for each in check_sampling(sonar.bank(1), course, grid)
        if each.name == "along_track_spacing"
    )
    assert found["along_track_spacing"].value == worse.value
