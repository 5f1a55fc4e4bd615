"""Wavenumber images against exact ones, usually at 125 kHz, with 15 kHz, at 60 m."""

import dataclasses
from functools import cache, partial

import numpy as np
import pytest
from cases import along_x
from tiers import few
from wavenumber_sums import wavenumber_sum

from clsas import (
    BeamWindow,
    ClsasWarning,
    Grid,
    Image,
    PointTargets,
    backproject,
    measure_point,
    relative_error_db,
    simulate_lines,
    wavenumber,
)
from clsas.engine.data import validate
from clsas.engine.exact import wavenumber as imager

BAND = {"carrier_hz": 125e3, "bandwidth_hz": 15e3, "window": "hamming"}
SPACING = 0.1
GRID = Grid.plane((-2, 3.08, 128), (57, 62.08, 128))
TRACK = along_x(240, SPACING)
HANN = BeamWindow(8, "hann", along=[1, 0, 0])
exact = partial(backproject, accuracy_db=-80)


def scene(grid=GRID, count=40, seed=1, spread_m=3.0):
    """Points at random in a plane grid, and somewhat beyond its edges."""
    rng = np.random.default_rng(seed)
    rows, columns = grid.shape
    place = rng.uniform(0, [[rows], [columns]], (2, count)).T
    steps = np.stack([grid.row_step_m, grid.column_step_m])
    place += rng.uniform(-spread_m, spread_m, place.shape) / np.linalg.norm(steps, axis=1)
    return PointTargets(grid.origin_m + place @ steps, rng.normal(size=(count, 2)) @ [1, 1j])


def echoes(tx=TRACK, rx=None, grid=GRID, **options):
    return simulate_lines(tx, tx if rx is None else rx, scene(grid), **(BAND | options))


@cache
def straight():
    return echoes()


def error_db(lines, grid=GRID, beam=HANN, **options):
    image = wavenumber(lines, grid, beam=beam, **options)
    assert isinstance(image, Image)
    assert image.grid is grid
    return relative_error_db(image, exact(lines, grid, beam=beam))


# The image of a straight track


@pytest.mark.slow
def test_a_point_is_where_as_large_as_sharp_and_of_the_phase_that_it_should_be():
    grid = Grid.plane((-1.3, 1.7, 101), (58.5, 61.5, 101))
    points = PointTargets([[0.2, 60, 0]], [1 - 2j])
    lines = simulate_lines(TRACK, TRACK, points, **BAND)
    image, wanted = (form(lines, grid, beam=HANN) for form in (wavenumber, exact))
    ours, theirs = (measure_point(each, near=(0.2, 60)) for each in (image, wanted))
    for field in ("x_m", "y_m"):
        assert getattr(ours, field) == pytest.approx(getattr(theirs, field), abs=1e-4)
    for cut in ("azimuth", "range"):
        one, other = getattr(ours, cut), getattr(theirs, cut)
        assert one.resolution_m == pytest.approx(other.resolution_m, rel=1e-3)
    at_peak = np.unravel_index(np.abs(wanted.pixels).argmax(), grid.shape)
    ratio = image.pixels[at_peak] / wanted.pixels[at_peak]
    assert abs(ratio - 1) < 2e-3
    phase = ratio * wanted.pixels[at_peak] / (1 - 2j)
    assert abs(np.angle(phase)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beam", "most_db"),
    [
        (None, -75),
        (BeamWindow(8, "hann", squint_deg=3), -54),
        (BeamWindow(16, "hann"), -64),
        *few(
            [
                (BeamWindow(5, "hann"), -45),
                (BeamWindow(8, "hann"), -54),
                (BeamWindow(16, "tukey", taper=0.8), -54),
                (BeamWindow(16, "hamming"), -30),
                (BeamWindow(16, "rectangular"), -12),
            ],
            often=(),
        ),
    ],
    ids=lambda value: "" if isinstance(value, int) else getattr(value, "shape", "none"),
)
def test_scenes_are_as_if_exact(beam, most_db):
    assert error_db(straight(), beam=beam) <= most_db


@pytest.mark.slow
def test_inverse_beams():
    beam = BeamWindow.of_element(0.06, 0.012, "inverse")
    assert error_db(straight(), beam=beam) <= -7


@pytest.mark.exhaustive
def test_the_error_falls_with_range_and_beamwidth_as_a_hann_windows_edges():
    """It falls as (K R width^2)^(-5/4), which is 7.5 dB per doubling."""
    errors = []
    for scale, width in ((1, 8), (2, 8), (1, 11.3)):
        grid = Grid.plane((-1, 1, 51), (scale * 40, scale * 40 + 2, 51))
        lines = echoes(along_x(160, SPACING), grid=grid)
        errors.append(error_db(lines, grid, BeamWindow(width, "hann")))
    assert errors[1] - errors[0] == pytest.approx(-7.5, abs=2)
    assert errors[2] == pytest.approx(errors[1], abs=3)


@pytest.mark.slow
def test_grating_lobes_are_those_of_the_exact_image():
    """Phase centres are so far apart that the spectrum repeats within the beam."""
    assert error_db(echoes(along_x(60, 0.4)), beam=BeamWindow(16, "hann")) <= -60


@pytest.mark.slow
def test_the_end_of_the_aperture_is_within_the_beam():
    assert error_db(straight().select(slice(0, 130)), beam=BeamWindow(16, "hann")) <= -55


@pytest.mark.slow
def test_one_line_of_pixels_and_one_pixel():
    strongest = np.abs(wavenumber(straight(), GRID, beam=HANN).pixels).max()
    for rows, columns in ((1, 40), (40, 1), (1, 1)):
        grid = GRID.window(slice(60, 60 + rows), slice(50, 50 + columns))
        image, wanted = (form(straight(), grid, beam=HANN) for form in (wavenumber, exact))
        difference = np.abs(image.pixels - wanted.pixels).max()
        assert difference <= 10 ** (-50 / 20) * strongest


@pytest.mark.slow
def test_rows_may_run_backwards_be_skewed_and_be_of_other_steps():
    for row, column in (([0, -0.04, 0], [-0.04, 0, 0]), ([0.02, 0.03, 0], [0.011, 0, 0])):
        grid = Grid.oriented([0.5, 60, 0], row, column, (60, 70))
        assert error_db(echoes(grid=grid), grid) <= -50


@pytest.mark.slow
@pytest.mark.parametrize("altitude_m", [0.0, 30.0])
@pytest.mark.parametrize("offset_m", [0.0, 1e6])
def test_ground_planes_below_the_track_and_far_from_the_origin(altitude_m, offset_m):
    there = np.array([offset_m, -offset_m, 100.0])
    grid = Grid.oriented(GRID.origin_m + there, GRID.row_step_m, GRID.column_step_m, GRID.shape)
    track = TRACK + there + [0, 0, altitude_m]
    assert error_db(echoes(track, grid=grid), grid) <= -52


@pytest.mark.slow
def test_tilted_planes_and_any_direction():
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    tilt = [0, 0.03, -0.02]
    grid = Grid.oriented(turn @ GRID.origin_m, turn @ tilt, turn @ GRID.column_step_m, GRID.shape)
    assert error_db(echoes(TRACK @ turn.T, grid=grid), grid, BeamWindow(8, "hann")) <= -52


@pytest.mark.slow
def test_order_spacing_and_repetition_of_channels_do_not_matter():
    rng = np.random.default_rng(4)
    track = TRACK.copy()
    track[:, 0] += rng.uniform(-0.05, 0.05, len(track))
    track = rng.permutation(np.concatenate([track, track[50:90]]))
    assert error_db(echoes(track)) <= -52


@pytest.mark.slow
def test_lines_may_start_anywhere():
    first = 54 + np.random.default_rng(5).uniform(0, 0.5, len(TRACK))
    assert error_db(echoes(first_range_m=first, length=600)) <= -52


@pytest.mark.exhaustive
def test_lines_may_carry_their_carrier():
    lines = echoes(oversampling=30.0)
    n = np.arange(lines.length) * lines.range_step_m
    turn = np.exp(2j * lines.wavenumber_rad_m * (lines.first_range_m[:, None] + n))
    there = dataclasses.replace(lines, samples=lines.samples * turn, carrier_hz=0.0)
    assert (
        relative_error_db(wavenumber(there, GRID, beam=HANN), wavenumber(lines, GRID, beam=HANN))
        <= -75
    )


# Interpolation


@pytest.mark.slow
@pytest.mark.parametrize("beam", [None, BeamWindow(8, "hann")])
def test_interpolations_have_the_error_that_is_asked_of_them(beam, monkeypatch):
    wanted = wavenumber_sum(straight(), GRID, beam)
    for accuracy_db in (-30, -40, -50, -60, -70, -80):
        monkeypatch.setattr(imager, "ACCURACY_DB", accuracy_db)
        assert relative_error_db(wavenumber(straight(), GRID, beam=beam), wanted) <= accuracy_db


@pytest.mark.slow
@pytest.mark.parametrize(("first_m", "step_m"), [(57.0, 0.04), (57.3, 0.3)])
def test_lines_that_reach_beyond_the_grid_are_cut_without_a_trace(first_m, step_m):
    """Echoes from 42 to 78 m are left out, or wrap around, where they do not matter."""
    points = scene(Grid.plane((-3, 3, 2), (42, 78, 2)), 1000)
    lines = simulate_lines(TRACK, TRACK, points, **BAND)
    grid = Grid.plane((-1, 1, 33), (first_m, first_m + 15 * step_m, 16))
    image = wavenumber(lines, grid, beam=BeamWindow(16, "hann"))
    wanted = wavenumber_sum(lines, grid, BeamWindow(16, "hann"))
    assert relative_error_db(image, wanted) <= -80


@pytest.mark.slow
def test_threads_do_not_matter():
    one, two = (wavenumber(straight(), GRID, beam=HANN, workers=n) for n in (1, 3))
    np.testing.assert_array_equal(one.pixels, two.pixels)


# Motion


def swaying(amplitude_m, grid=GRID, altitude_m=0.0):
    phase = 2 * np.pi * TRACK[:, 0] / 12
    y = amplitude_m * np.sin(phase)
    return echoes(TRACK + np.stack([0 * y, y, altitude_m + 0 * y], axis=1), grid=grid)


@pytest.mark.slow
def test_motion_compensation_restores_a_small_sway_that_destroys_the_image_otherwise():
    lines = swaying(0.01)
    with pytest.warns(ClsasWarning, match=r"0\.01 m off a line .* left there"):
        assert error_db(lines, motion_compensation=False) >= -3
    with pytest.warns(ClsasWarning, match=r"0\.01 m off a line .* moved onto it"):
        assert error_db(lines) <= -40


@pytest.mark.exhaustive
def test_motion_compensation_fails_for_wide_beams_and_wide_swaths():
    with pytest.warns(ClsasWarning, match="not controlled"):
        narrow = error_db(swaying(0.2))
    assert narrow <= -20
    with pytest.warns(ClsasWarning, match="not controlled"):
        wide = error_db(swaying(0.2), beam=BeamWindow(24, "hann", along=[1, 0, 0]))
    assert wide >= narrow + 10
    swath = Grid.plane((-2, 2, 64), (20, 60, 256))
    with pytest.warns(ClsasWarning, match="not controlled"):
        assert error_db(swaying(0.2, swath, 15.0), swath) >= -3


@pytest.mark.slow
def test_it_warns_of_the_errors_that_remain():
    """The track sways by 0.2 m at 15 m altitude; it is corrected for 60 m, not for 30 m."""
    swath = Grid.plane((-2, 2, 3), (20, 100, 3))
    with pytest.warns(ClsasWarning) as caught:
        wavenumber(swaying(0.2, swath, 15.0), swath, beam=HANN)
    assert caught[0].filename == __file__
    said = float(str(caught[0].message).split("errors of up to ")[1].split(" m")[0])
    tilt = np.cos(np.arctan2(15, 60)) - np.cos(np.arctan2(15, 20))
    assert said == pytest.approx(0.2 * tilt, rel=0.1)


@pytest.mark.exhaustive
def test_a_track_turned_a_little_is_compensated():
    track = TRACK @ np.array([[1, 0.001, 0], [-0.001, 1, 0], [0, 0, 1]])
    with pytest.warns(ClsasWarning, match="off a line"):
        assert error_db(echoes(track)) <= -40


@pytest.mark.slow
def test_arrays_are_their_phase_centres():
    tx = np.repeat(TRACK[::4], 4, axis=0)
    rx = tx + np.tile([[0.1, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [0.7, 0, 0]], (60, 1))
    with pytest.warns(ClsasWarning, match=" 0 m off a line"):
        assert error_db(echoes(tx, rx)) <= -33


@pytest.mark.slow
def test_receivers_that_move_along_the_track():
    lines = echoes(rx_velocity_m_s=[2.0, 0, 0])
    with pytest.warns(ClsasWarning, match="range errors"):
        assert error_db(lines) <= -22
    still = dataclasses.replace(lines, rx_velocity_m_s=[0.0, 0, 0])
    wanted = wavenumber(dataclasses.replace(lines, rx_velocity_m_s=None), GRID, beam=HANN)
    assert relative_error_db(wavenumber(still, GRID, beam=HANN), wanted) <= -100


# Nothing to see


def test_a_grid_outside_the_beam_warns_and_is_zero():
    with pytest.warns(ClsasWarning, match="the beam spans -4 to 4 degrees"):
        image = wavenumber(straight(), Grid.plane((30, 32, 9), (58, 60, 9)), beam=HANN)
    assert not image.pixels.any()


# Bad input


@pytest.mark.slow
def test_aspects_near_end_fire_are_refused():
    grid = Grid.plane((-2, 2, 16), (0.5, 60, 16))
    lines = echoes(grid=grid)
    with pytest.raises(ValueError, match=r"aspect angle of grid, .*<= 85 degrees, got 131"):
        wavenumber(lines, grid)


@pytest.mark.slow
def test_memory_is_refused_before_work_begins(monkeypatch):
    asked, lines = [], straight()
    monkeypatch.setattr(validate, "memory", lambda name, size: asked.append((name, size)))
    wavenumber(lines, GRID, beam=HANN)
    ((name, size),) = asked
    assert name == "lines and grid"
    assert 16 * GRID.size < size < 1e9
