"""Limits of a survey agree with the thesis's examples, with exact geometry and with images."""

from dataclasses import replace

import numpy as np
import pytest
from tiers import few

import clsas
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.system import Pulse, Sonar, line_array
from clsas.engine.data.track import Pointing, Track
from clsas.files.scene_files import built_in_scene, parse_scene
from clsas.measures.limits import LABELS, Limit
from clsas.selftest.reference import ideal

WIDE = Sonar.thesis_wide_beam()
TRACK = Track.straight([-2.376, 0, 0], [2, 0, 0], 10, 0.264)
GRID = clsas.Grid.plane(x=(-2.5, 2.5, 1024), y=(40, 45, 1024))


@pytest.fixture(scope="module")
def wide():
    """The limits of the demo's scene."""
    return clsas.limits(WIDE, TRACK, GRID, range_m=(39.9, 45.4))


@pytest.fixture(scope="module")
def wreck(tmp_path_factory):
    """The scene of the wreck, and its limits."""
    folder = tmp_path_factory.mktemp("wreck")
    scene = parse_scene(built_in_scene("wreck"), name="wreck", folder=folder)
    return scene, clsas.limits(
        scene.sonar, scene.track, scene.grid, beam=scene.image["beam"], **scene.compress
    )


def monostatic(spacing_m, pings, *, bandwidth_hz=20e3, length_m=None):
    """Return a sonar at 100 kHz with one receiver, and a track centred on the origin."""
    sonar = Sonar(
        Pulse(100e3, bandwidth_hz, 0.05), [[0, 0, 0]], tx_length_m=length_m, rx_length_m=length_m
    )
    return sonar, Track.straight([-spacing_m * (pings - 1) / 2, 0, 0], [spacing_m, 0, 0], pings, 1)


def image_along_x(sonar, track, point_m, x_m, y_m, **options):
    """Return the amplitudes of the exact image of a point, relative to its peak."""
    echoes = clsas.simulate(sonar, track, clsas.PointTargets([point_m]))
    lines = clsas.compress(echoes, window=options.pop("window", "none"), oversampling=4)
    x_m, y_m = np.broadcast_arrays(x_m, y_m)
    points_m = np.stack([x_m, y_m, np.full(x_m.shape, point_m[2])], axis=-1)
    peak = ideal(lines, np.array([point_m]), padding=16, **options)
    return np.abs(ideal(lines, points_m, padding=16, **options) / peak[0])


def test_the_thesis_wide_beam_case(wide):
    """Chapter 5: 5.28 m of 640 phase centres, elements of 15 mm, 7.5 mm of resolution."""
    assert wide["azimuth_resolution_m"].value == pytest.approx(7.5e-3)
    assert wide["range_resolution_m"].value == pytest.approx(7.5e-3)
    assert wide["aperture_m"].value == pytest.approx(5.28)
    advance = wide["advance_m"]
    assert (advance.value, advance.limit) == pytest.approx((0.528, 0.528))
    assert advance.kept
    assert wide["speed_m_s"].limit == pytest.approx(2.0)
    spacing = wide["phase_centre_spacing_m"]
    assert (spacing.value, spacing.limit) == pytest.approx((8.25e-3, 7.5e-3))
    assert wide.exceeded == ("phase_centre_spacing_m", "doppler_bandwidth_hz")
    assert wide.missing == {}


def test_the_thesis_narrow_beam_case(wreck):
    """Chapter 6: 6 elements over 1.2012 m, 15 kHz; 5 cm is c/2B and 10 cm L/2."""
    _, found = wreck
    assert found["range_resolution_m"].value == pytest.approx(0.05)
    assert found["azimuth_resolution_m"].value == pytest.approx(0.1, rel=0.01)
    assert found["advance_m"].limit == pytest.approx(1.2012 / 2, rel=1e-3)  # yaw
    assert found["overlap"].value == pytest.approx(1.5, rel=0.01)
    assert found.exceeded == ()


@pytest.mark.slow
def test_the_thesis_sensotek_case():
    """Chapter 6: 270 m at 1.5 m/s with an overlap of 1.33, 24 of 96 elements."""
    interval_s = 2 * 270 / 1500
    track = Track.straight([0, 0, 0], [1.5, 0, 0], 20, interval_s)
    found = clsas.limits(Sonar.sensotek(), track, range_m=(20, 270))
    assert found["overlap"].value == pytest.approx(1.33, abs=0.005)
    assert "repeats 24 of 96 phase centres" in found["overlap"].meaning
    assert "clsas.density_compensated" in found["overlap"].meaning
    # The thesis neglects the pulse, which ends 5 ms later.
    assert found["last_echo_s"].value == pytest.approx(interval_s + 5e-3)
    assert found["unambiguous_range_m"].value == pytest.approx(270 - 5e-3 * 750)
    exceeded = {"last_echo_s", "ping_rate_hz", "unambiguous_range_m", "swath_m"}
    assert exceeded < set(found.exceeded)
    # The 20 pings are shorter than the footprint at 145 m.
    assert set(found.exceeded) - exceeded == {"aperture_m"}


def test_widths_are_those_that_the_demo_calls_theory(wide):
    assert 1e3 * wide["azimuth_width_m"].value == pytest.approx(6.58, abs=0.005)
    assert 1e3 * wide["range_width_m"].value == pytest.approx(6.86, abs=0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beam", "window"),
    [(BeamWindow(6.0, "hann", squint_deg=1.0), "hamming"), *few([(None, "none")], often=())],
)
def test_an_image_has_the_predicted_widths(beam, window):
    sonar, track = monostatic(0.02, 301, length_m=0.1)
    point_m = np.array([0.2, 20.0, 0.0])
    grid = clsas.Grid.plane(x=(0.0, 0.4, 401), y=(19.8, 20.2, 201))
    found = clsas.limits(sonar, track, grid, beam=beam, window=window)
    for name, offsets_m, axis in (
        ("azimuth_width_m", np.linspace(0, 0.1, 201), 0),
        ("range_width_m", np.linspace(0, 0.06, 121), 1),
    ):
        places_m = point_m + np.outer(offsets_m, np.eye(3)[axis])
        amplitude = image_along_x(
            sonar, track, point_m, places_m[:, 0], places_m[:, 1], beam=beam, window=window
        )
        below = np.flatnonzero(amplitude**2 < 0.5)[0]
        half_m = np.interp(-0.5, -(amplitude[: below + 1] ** 2), offsets_m[: below + 1])
        assert found[name].value == pytest.approx(2 * half_m, rel=0.02), name


def test_an_image_has_grating_lobes_where_they_are_predicted():
    """Narrow band, so that lobes are not smeared: nearly as high as the target."""
    sonar, track = monostatic(0.1, 21, bandwidth_hz=1e3)
    point_m = np.array([0.0, 60.0, 0.0])
    found = clsas.limits(sonar, track, clsas.Grid.plane((-3, 3, 201), (59, 61, 51)))
    lobe_m = found["grating_lobe_m"].value
    assert lobe_m == pytest.approx(60 * 0.015 / (2 * 0.1))
    x_m = np.linspace(1.0, 6.0, 1001)
    amplitude = image_along_x(sonar, track, point_m, x_m, np.sqrt(60**2 - x_m**2))
    assert x_m[amplitude.argmax()] == pytest.approx(lobe_m, rel=0.005)
    level_db = 20 * np.log10(amplitude.max())
    assert found["grating_lobe_db"].value == pytest.approx(level_db, abs=0.3)
    assert level_db > -3
    assert "on the grid for some targets" in found["grating_lobe_m"].meaning


@pytest.mark.slow
def test_pings_that_leave_a_gap_cause_lobes_where_they_are_predicted():
    """An array of 8 receivers whose pings are 12 spacings apart instead of 8."""
    sonar = Sonar(Pulse(100e3, 1e3, 0.05), line_array(8, 0.1))
    track = Track.straight([-1.8, 0, 0], [0.6, 0, 0], 7, 1.0)
    point_m = np.array([0.0, 60.0, 0.0])
    found = clsas.limits(sonar, track, clsas.Grid.plane((-6, 6, 201), (59, 61, 51)))
    assert not found["advance_m"].kept
    assert found["overlap"].value == pytest.approx(0.4 / 0.6)
    x_m = np.linspace(0.4, 1.1, 701)
    amplitude = image_along_x(sonar, track, point_m, x_m, np.sqrt(60**2 - x_m**2))
    assert x_m[amplitude.argmax()] == pytest.approx(found["ping_lobe_m"].value, rel=0.03)
    level_db = 20 * np.log10(amplitude.max())
    assert found["ping_lobe_db"].value == pytest.approx(level_db, abs=0.5)
    assert "Expect grating lobes at multiples of 0.75 m" in found.describe()
    # Without gaps, there is nothing but side lobes.
    whole = Track.straight([-1.8, 0, 0], [0.4, 0, 0], 10, 1.0)
    assert image_along_x(sonar, whole, point_m, x_m, np.sqrt(60**2 - x_m**2)).max() < 0.3
    assert clsas.limits(sonar, whole, range_m=(59, 61))["advance_m"].kept
    assert amplitude.max() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("beam", [None, BeamWindow(5.0, "hann")])
def test_the_level_of_smeared_lobes_is_that_of_an_image(beam):
    """A band of 20 % and elements of 0.2 m lower the lobes by tens of decibels."""
    sonar, track = monostatic(0.1, 81, length_m=0.2)
    point_m = np.array([0.0, 30.0, 0.0])
    grid = clsas.Grid.plane((-4, 4, 201), (29, 31, 201))
    found = clsas.limits(sonar, track, grid, beam=beam)
    lobe_m = found["grating_lobe_m"].value
    x_m, y_m = np.meshgrid(
        np.linspace(lobe_m * 0.85, lobe_m * 1.15, 91), np.linspace(29.7, 30.1, 81)
    )
    amplitude = image_along_x(sonar, track, point_m, x_m, y_m, beam=beam)
    level_db = 20 * np.log10(amplitude.max())
    assert found["grating_lobe_db"].value == pytest.approx(level_db, abs=1.5)
    assert level_db < -12


@pytest.mark.slow
def test_phase_centres_err_as_the_exact_geometry_does(wide):
    """Path to the point and back, for the outermost receiver, over the elements' beam."""
    apart_m, near_m = 31.5 * 16.5e-3, 40.0
    half_rad = BeamWindow.of_element(0.015, 1.5e-3).limits_rad[1]
    excess_m = []
    for angle in (0.0, half_rad):
        point_m = near_m * np.array([np.sin(angle), np.cos(angle), 0])
        ends = np.array([[-apart_m / 2, 0, 0], [apart_m / 2, 0, 0]])
        excess_m.append(2 * (bistatic_range_m(point_m, *ends) - near_m))
    found = {name: wide[f"phase_centre_{name}_m"] for name in ("shift", "error")}
    assert found["shift"].value == pytest.approx(excess_m[0], rel=1e-3)
    assert found["error"].value == pytest.approx(excess_m[0] - excess_m[1], rel=0.01)
    assert found["error"].limit == pytest.approx(1.5e-3 / 8)
    assert found["shift"].limit is None


@pytest.mark.exhaustive
def test_motion_and_squint_enlarge_the_error_of_phase_centres(wide):
    error_m = wide["phase_centre_error_m"].value
    moving = clsas.limits(WIDE, TRACK, GRID, motion_in_flight=True)
    apart_m, moved_m = 31.5 * 16.5e-3, 2.0 * 2 * 40 / 1500
    ratio = ((apart_m + moved_m) / apart_m) ** 2
    assert moving["phase_centre_error_m"].value == pytest.approx(ratio * error_m, rel=1e-3)
    squinted = clsas.limits(WIDE, TRACK, GRID, pointing=Pointing.squint(0.2))
    assert squinted["phase_centre_error_m"].value > 10 * error_m
    spot = clsas.limits(WIDE, TRACK, GRID, pointing=Pointing.spot((0, 42.5, 0)))
    assert spot["phase_centre_error_m"].value == pytest.approx(
        apart_m**2 / (4 * 40) * 2.64**2 / (42.5**2 + 2.64**2), rel=0.05
    )


def test_the_far_field_begins_where_wavefronts_are_plane(wide):
    eighth_m = 1.5e-3 / 8
    half_m, far_m = 31.5 * 16.5e-3, wide["array_far_field_m"].value
    assert np.hypot(far_m, half_m) - far_m == pytest.approx(eighth_m, rel=1e-3)
    far_m = wide["aperture_far_field_m"].value
    assert 2 * (np.hypot(far_m, 2.64) - far_m) == pytest.approx(eighth_m, rel=1e-3)
    assert "lies in its near field" in wide["aperture_far_field_m"].meaning


def test_echoes_from_the_unambiguous_range_end_with_the_ping_interval(wide):
    far_m = wide["unambiguous_range_m"].value
    assert 2 * far_m / 1500 + WIDE.pulse.duration_s == pytest.approx(0.264)
    near_m = wide["first_echo_s"].value * 750
    assert near_m == pytest.approx(40.0, abs=0.01)
    assert wide["swath_m"].limit == pytest.approx(far_m - near_m)
    assert wide["last_echo_s"].value * wide["ping_rate_hz"].limit == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sonar", "advance_m", "interval_s"),
    [
        (WIDE, 0.528, 0.264),
        (WIDE, 0.528, 0.05),
        (replace(WIDE, rx_m=line_array(64, 15e-3)), 0.48, 0.2),
        (replace(WIDE, rx_m=line_array(64, 15e-3)), 0.6, 0.2),
        (Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]]), 0.1, 0.2),
        (Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]]), 0.01, 0.2),
    ],
)
def test_limits_agree_with_check_sampling(sonar, advance_m, interval_s):
    track = Track.straight([0, 0, 0], [advance_m / interval_s, 0, 0], 10, interval_s)
    found = clsas.limits(sonar, track, GRID)
    expected = {finding.name: finding for finding in clsas.check_sampling(sonar, track, GRID)}
    for name, finding in (
        ("phase_centre_spacing_m", "along_track_spacing"), ("ping_rate_hz", "ping_rate"),
    ):  # fmt: skip
        assert (name in found.exceeded) == (finding in expected)
        if finding in expected:
            both = expected[finding].value, expected[finding].limit
            assert (found[name].value, found[name].limit) == pytest.approx(both, rel=1e-6)


@pytest.mark.slow
def test_only_ranges_within_the_beam_count(wreck):
    """Corners of the grid lie 118 m from the farthest ping, but no ping sees them there."""
    scene, found = wreck
    without = clsas.limits(scene.sonar, scene.track, scene.grid)
    assert without["swath_m"].value > found["swath_m"].value + 20
    assert found["last_echo_s"].value == pytest.approx(2 * np.hypot(92, 20) / 1500 + 5e-3, rel=0.01)


@pytest.mark.slow
def test_recorded_ranges_must_contain_the_grid(wide):
    assert wide["recorded_from_m"].kept
    assert wide["recorded_to_m"].kept
    short = clsas.limits(WIDE, TRACK, GRID, range_m=(40.5, 45.0))
    assert {"recorded_from_m", "recorded_to_m"} < set(short.exceeded)
    assert short["recorded_to_m"].limit == pytest.approx(np.hypot(45, 2.5 + 2.64), rel=1e-3)


@pytest.mark.slow
def test_coarse_pixels_miss_targets():
    coarse = clsas.limits(WIDE, TRACK, clsas.Grid.plane((-2.5, 2.5, 501), (40, 45, 1024)))
    assert "azimuth_pixel_m" in coarse.exceeded
    assert coarse["azimuth_pixel_m"].value == pytest.approx(0.01)
    assert coarse["range_pixel_m"].kept
    # On a slanted plane, steps count as far as they lead away from the sonar.
    depth = clsas.Grid.oriented([-1, 42, 0], [0, 0, -0.05], [0.005, 0, 0], (20, 401))
    assert clsas.limits(WIDE, TRACK, depth)["range_pixel_m"].value < 0.001


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "names", "reason"),
    [
        ({}, ("first_echo_s", "ping_rate_hz", "swath_m"), "the recorded range"),
        ({}, ("advance_m", "speed_m_s"), "two or more pings at different positions"),
        ({"track": TRACK}, ("grating_lobe_m", "azimuth_width_m"), "a track and a grid"),
        ({"grid": GRID}, ("range_pixel_m", "azimuth_width_m"), "a track and a grid"),
        ({"range_m": (40, 45)}, ("aperture_m",), "two or more pings at different positions"),
        ({"track": Track([[0, 0, 0]], [0])}, ("unambiguous_range_m",), "two or more pings"),
        ({"track": TRACK, "grid": clsas.Grid.points([[0, 42, 0]])}, ("range_pixel_m",), "plane"),
        ({"track": TRACK, "grid": GRID}, ("recorded_from_m",), "every echo is recorded"),
        (
            {"track": TRACK, "grid": clsas.Grid.plane((90, 91, 9), (40, 45, 9)),
             "beam": BeamWindow(5.0)},
            ("azimuth_width_m", "aperture_m"),
            "the beam covers the middle",
        ),
    ],
)  # fmt: skip
def test_missing_parts_are_named(arguments, names, reason):
    found = clsas.limits(WIDE, **arguments)
    for name in names:
        assert reason in found.missing[name]
        with pytest.raises(KeyError, match=name):
            found[name]
    text = found.describe()
    assert all(LABELS[name] in text for name in names)
    # Whatever is known remains.
    assert found["range_resolution_m"].value == pytest.approx(7.5e-3)


@pytest.mark.slow
def test_every_result_is_given_or_missing(wide):
    names = list(LABELS)[:-3]  # heights require several banks
    assert [each.name for each in wide.results] == names
    names = set(names)
    one = Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]])
    circle = np.linspace(0, 2 * np.pi, 50)
    turning = Track(np.stack([np.cos(circle), np.sin(circle), 0 * circle], -1), np.arange(50.0))
    for sonar, track, grid, range_m in (
        (WIDE, None, None, None), (WIDE, TRACK, None, None), (WIDE, None, GRID, None),
        (WIDE, TRACK, None, (40, 45)), (one, TRACK, GRID, None), (one, None, None, (40, 45)),
        (one, turning, GRID, None), (WIDE, turning, GRID, None), (one, None, None, None),
    ):  # fmt: skip
        found = clsas.limits(sonar, track, grid, range_m=range_m)
        given = [each.name for each in found.results]
        assert len(given) == len(set(given))
        assert set(given) | set(found.missing) == names
        assert not set(given) & set(found.missing)
        assert all(np.isfinite(each.value) for each in found.results)


@pytest.mark.exhaustive
def test_heights_of_two_banks():
    sonar, pings = Sonar.hisas_1030(), 81
    track = Track.straight([-20, 0, 15], [2, 0, 0], pings, 0.25)
    grid = clsas.Grid.plane((-2, 2, 5), (30, 80, 3))
    found = clsas.limits(sonar, track, grid)
    assert found["baseline_m"].value == pytest.approx(0.3)
    # The path to either receiver, at two heights and the range of the nearest or farthest pixel.
    for name, range_m in (("near", np.hypot(30.0, 15)), ("far", np.hypot(80.0, 15))):
        phases = [
            [2 * np.pi / sonar.wavelength_m
             * np.hypot(np.sqrt(range_m**2 - (15 - height_m) ** 2), 15 + z_m - height_m)
             for z_m in (-0.15, 0.15)]
            for height_m in (-0.05, 0.05)
        ]  # fmt: skip
        turn = np.ptp(np.diff(phases, axis=1)) / 0.1
        assert 2 * np.pi / turn == pytest.approx(sonar.wavelength_m * range_m / 0.3, rel=1e-3)
        # The lattice of pixels includes those at x = 0, abeam of a ping.
        assert found[f"ambiguity_{name}_m"].value == pytest.approx(2 * np.pi / turn, rel=1e-4)
    one = clsas.limits(sonar.bank(0), track, grid)
    assert "baseline_m" not in {each.name for each in one.results} | set(one.missing)
    for each in one.results:  # the other results are those of a bank
        assert found[each.name].value == each.value
    assert "requires a track and a grid" in clsas.limits(sonar).missing["ambiguity_far_m"]
    flat = Sonar(sonar.pulse, [[0, 0, 0], [0, 0.3, 0]], bank_numbers=[0, 1])
    level = clsas.limits(flat, track, clsas.Grid.plane((-2, 2, 5), (30, 80, 3), 15.0))
    assert "across the line of sight" in level.missing["ambiguity_near_m"]


def test_a_result_reads_well(wide):
    text = wide.describe()
    assert "  distance per ping          0.528 m    at most 0.528 m   yes   [31]" in text
    assert "2 of 16 limits are not kept:" in text
    assert (
        "phase-centre spacing: 8.25 mm is 10% above the limit of 7.5 mm. Expect grating lobes "
        "3.864 m to either side of a target, 30 dB below it." in text
    )
    assert max(map(len, text.splitlines()[:-4])) <= 110
    assert repr(wide) == (
        "Limits(29 results, limits not kept: phase_centre_spacing_m, doppler_bandwidth_hz)"
    )
    assert "<table>" in wide._repr_html_()
    for each in wide.results:
        assert isinstance(each, Limit)
        assert each.meaning.endswith(".")
        assert (each.limit is None) == (each.kept is None) == (not each.side)
        assert each.equation.startswith("[")
        assert each.consequence or each.limit is None


@pytest.mark.slow
def test_unusual_geometries():
    one = Sonar(Pulse(100e3, 20e3, 1e-3), [[0, 0, 0]])
    rising = Track.straight([0, 0, 0], [0, 0, 0.1], 81, 1)
    assert clsas.limits(one, rising, range_m=(10, 20))["azimuth_width_m"].value < 0.05
    slow = Track.straight([0, 0, 0], [0.1, 0, 0], 81, 1e-3)
    found = clsas.limits(Sonar.edgetech(), slow, range_m=(0, 20))
    assert "beyond end-fire" in found.missing["ping_lobe_db"]
    assert "longer apart than the pulse" in found.missing["unambiguous_range_m"]
    assert "above 0 m" in found.missing["phase_centre_error_m"]
    level = Track.straight([-4, 0, 0], [0.1, 0, 0], 81, 1)
    ahead = clsas.limits(one, level, clsas.Grid.plane((20, 30, 11), (0, 0, 1)))
    assert "several places" in ahead.missing["azimuth_width_m"]
    with pytest.raises(ValueError, match="grid must not have its middle at a phase centre"):
        clsas.limits(one, level, clsas.Grid.plane((-1, 1, 3), (-1, 1, 3)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sonar": None}, "sonar must be of type Sonar"),
        ({"track": GRID}, "track must be of type Track"),
        ({"grid": TRACK}, "grid must be of type Grid"),
        ({"beam": 5.0}, "beam must be of type BeamWindow"),
        ({"pointing": 0.1}, "pointing must be of type Pointing"),
        ({"range_m": (45, 40)}, r"range_m must be 0 <= nearest < farthest in m, got \(45, 40\)"),
        ({"range_m": 40}, "range_m must have"),
        ({"window": "no"}, "window must be"),
        ({"motion_in_flight": 2}, "motion_in_flight must be"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        clsas.limits(**{"sonar": WIDE} | arguments)
