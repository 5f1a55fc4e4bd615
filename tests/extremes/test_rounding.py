"""Rounding at the extremes: far, near, high, fast, large, and far from the coordinates' origin."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from cases import (
    APERTURE,
    CARRIER,
    ORDINARY,
    PITCH,
    STEP,
    along_x,
    beside,
    lines_over,
    made,
    noise,
    patch,
    rounding_error_db,
    thesis_lines,
)
from exactly import execute, prepare, same_interpolator
from sums import SPEED_M_S, Channels, Points, Sampling
from tiers import few

from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.imaging import backproject
from clsas.selftest import oracle
from clsas.selftest.reference import sampled_error_db

FAR = np.array([1e7, -1e7, 1e7])


def moved(grid, shift):
    if grid.points_m is not None:
        return Grid.points(grid.points_m + shift)
    return Grid(
        grid.origin_m + shift, grid.row_step_m, grid.column_step_m, grid.shape, grid.height_m
    )


def offset(case):
    """A case with every coordinate 10 000 km from the origin."""

    def far():
        lines, grid = made(case)
        velocity = lines.rx_velocity_m_s
        return (
            RangeLines(
                lines.samples, lines.first_range_m, lines.range_step_m, lines.tx_m + FAR,
                lines.rx_m + FAR, lines.carrier_hz, lines.sound_speed_m_s, velocity,
            ),
            moved(grid, FAR),
        )  # fmt: skip

    far.__name__ = f"{case.__name__}_offset"
    return far


def at_300_m():
    """1 MHz at 300 m: 2.5 million radians of phase."""
    grid = patch(1.3, 300)
    return thesis_lines(grid, APERTURE), grid


def from_the_air():
    """9.6 GHz from a turning aircraft, 10 km away."""
    angle = np.linspace(-0.01, 0.01, 400)
    radius = 12e3
    rng = np.random.default_rng(7)
    track = np.stack(
        [radius * np.sin(angle), radius * (1 - np.cos(angle)), np.full(400, 4000.0)], axis=1
    ) + rng.normal(0, 0.3, (400, 3))
    grid = patch(-20, 9165, pitch=0.2)
    return lines_over(grid, track, carrier_hz=9.6e9, step_m=0.2, speed=299_792_458.0), grid


def at_10_cm():
    """1 MHz at 0.1 m over fine pixels, as in a tank."""
    track = along_x(64, 0.5e-3)
    grid = patch(-0.002, 0.1, pitch=0.1e-3)
    return lines_over(grid, track, carrier_hz=1e6, step_m=1.5e-3), grid


def inside_the_aperture():
    """Pixels between the antennas, closer to them than to each other."""
    grid = patch(-0.1, -0.08, z=-0.003)
    return thesis_lines(grid, APERTURE[::4]), grid


def in_the_array_plane():
    """Pixels in the very plane of the antennas, some 10 um from one."""
    grid = patch(APERTURE[300, 0] + 1e-5, -0.08)
    return thesis_lines(grid, APERTURE[::4], beside(APERTURE[::4], 0, 0.02, 0)), grid


def large_pixels():
    """Baseband lines without a carrier under pixels many range steps wide."""
    grid = patch(-400, 2000, pitch=20.0)
    return lines_over(grid, along_x(32, 5.0), carrier_hz=0.0, step_m=0.05), grid


def fast_receivers():
    """Ultrasound in air, heard by receivers at a thirtieth of its speed."""
    velocity = np.random.default_rng(8).uniform(-8, 8, (64, 3))
    track = along_x(64, 4e-3)
    grid = patch(0.1, 4, pitch=2e-3)
    lines = lines_over(
        grid, track, beside(track, 0.05, 0, 0.1), carrier_hz=4e4, step_m=8e-3, speed=343.0,
        velocity=velocity,
    )  # fmt: skip
    return lines, grid


def long_scene():
    """Two places 10 km from each other, each seen from 40 m by its own channels."""
    here, there = np.zeros(3), np.array([10e3, 0, 0])
    pixels = patch(1.0, 40, 16, 16).positions_m()
    grid = Grid.points(np.stack([pixels + here, pixels + there]))
    track = np.concatenate([APERTURE[::4] + here, APERTURE[::4] + there])
    length = 2000
    return RangeLines(noise(len(track), length), 36.0, STEP, track, track, CARRIER, 1500.0), grid


def long_strip():
    """A strip of 1 km, seen by a few channels from 40 m at its far end."""
    grid = Grid.oriented([0, 40, 0], [0, PITCH, 0], [PITCH, 0, 0], (2, 204_800))
    track = beside(along_x(4, 0.5), 1000.0, 0, 0)
    return RangeLines(noise(4, 2000), 36.0, STEP, track, track, CARRIER, 1500.0), grid


FAR_AWAY = [offset(case) for case in ORDINARY]
EXTREME = (
    at_300_m,
    from_the_air,
    at_10_cm,
    inside_the_aperture,
    in_the_array_plane,
    large_pixels,
    fast_receivers,
    long_scene,
    long_strip,
)


@pytest.mark.slow
@pytest.mark.parametrize("case", FAR_AWAY, ids=lambda case: case.__name__)
def test_the_origin_of_coordinates_does_not_matter(case, platform):
    assert rounding_error_db(case, platform) <= -80


@pytest.mark.slow
@pytest.mark.parametrize("case", EXTREME, ids=lambda case: case.__name__)
def test_rounding_stays_below_80_db(case, device):
    assert rounding_error_db(case, device) <= -80


@pytest.mark.parametrize("shape", [(1,), (70,)])
@pytest.mark.parametrize("way", ["monostatic", "bistatic", "moving"])
def test_a_pixel_at_an_antenna_is_a_pixel_like_others(device, shape, way):
    """Where the distance to a transmitter is zero, so that no direction is defined."""
    track = along_x(9, 0.01)
    grid = Grid.points(np.broadcast_to(track[4], (*shape, 3)))
    rx = track if way == "monostatic" else beside(track, 0, 0.02, 0)
    velocity = [3.0, 0, 0] if way == "moving" else None
    lines = RangeLines(noise(9, 400), -200 * STEP, STEP, track, rx, CARRIER, 1500.0, velocity)
    preparation = prepare(lines, grid, device=device, taps=6, upsampling=3)
    image = backproject(lines, grid, device=device, taps=6, upsampling=3)
    assert relative_error_db(image, same_interpolator(preparation, grid.points_m)) <= -80


@pytest.mark.parametrize("scale", [1e-36, 1e-30, 1e-10, 1e10, 1e20, 1e30])
@pytest.mark.parametrize("centre", [0.0, 0.3])
def test_the_unit_of_the_samples_does_not_matter(scale, centre):
    """Amplitudes whose squares leave the range of float32."""
    grid = patch(1.3, 42, 7, 5)
    lines = thesis_lines(grid, APERTURE[::40], centre=centre)
    scaled = RangeLines(
        lines.samples * np.complex128(scale), lines.first_range_m, STEP, lines.tx_m, lines.rx_m,
        CARRIER, 1500.0,
    )  # fmt: skip
    image = backproject(lines, grid, accuracy_db=-80).pixels
    large = backproject(scaled, grid, accuracy_db=-80).pixels.astype(np.complex128)
    assert relative_error_db(large / scale, image) <= -80


@pytest.mark.parametrize("far_m", [1e6, 1e8])
@pytest.mark.parametrize("kind", ["plane", "points"])
def test_far_beyond_every_line_is_zero(platform, far_m, kind):
    lines = thesis_lines(patch(1.3, 42, 5, 5), APERTURE[::80])
    grid = patch(far_m, 42, 5, 5)
    if kind == "points":
        grid = Grid.points(grid.positions_m())
    with pytest.warns(ClsasWarning, match="no pixel"):
        assert not backproject(lines, grid, device=platform).pixels.any()


def test_a_distance_that_float32_cannot_square_is_refused():
    lines = thesis_lines(patch(1.3, 42, 5, 5), APERTURE[::80])
    far = dataclasses.replace(lines, tx_m=lines.tx_m + 1e20, rx_m=lines.rx_m + 1e20)
    with pytest.raises(ValueError, match=r"within 1e\+09 m .* got 1e\+20 m"):
        backproject(far, Grid.points([[0, 0, 0]]))


@pytest.mark.parametrize(
    "grid", [patch(0.1, 4, pitch=2e-3), Grid.points(patch(0.1, 4).positions_m())]
)
@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 1, 0], [-0.6, 0.8, 0]])
def test_receivers_as_fast_as_allowed(platform, grid, direction):
    track = along_x(48, 4e-3)
    velocity = np.broadcast_to(0.05 * 1500.0 * np.array(direction), track.shape)
    rx = beside(track, 0.05, 0, 0.1)
    lines = thesis_lines(grid, track, rx, velocity=velocity)
    preparation = prepare(lines, grid, device=platform, taps=6, upsampling=3)
    wanted = same_interpolator(preparation, grid.positions_m())
    assert relative_error_db(execute(preparation), wanted) <= -80
    faster = dataclasses.replace(lines, rx_velocity_m_s=1.01 * velocity)
    with pytest.raises(
        ValueError, match=r"the speed of `rx_velocity_m_s` must be .*<= 75 m/s, got 75\.75"
    ):
        backproject(faster, grid, device=platform)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range_step_m": 1e-300}, "range_step_m must be .*>= 1e-09 and <= 1e\\+09 m, got 1e-300"),
        ({"range_step_m": 1e300}, "range_step_m must be .*got 1e"),
        ({"carrier_hz": 1e15}, "carrier_hz must make at most .* cycles, .* got 1e\\+15 Hz"),
        ({"carrier_hz": 1e300}, "carrier_hz must make at most .* cycles, .* got 1e\\+300 Hz"),
        ({"sound_speed_m_s": 1e-308}, "carrier_hz must make at most .* got .* Hz, with inf cycles"),
    ],
)
def test_numbers_that_no_phase_survives_are_refused(change, message):
    grid = patch(1.3, 42, 5, 5)
    lines = dataclasses.replace(thesis_lines(grid, APERTURE[::80]), **change)
    with pytest.raises(ValueError, match=message):
        backproject(lines, grid)


def test_samples_whose_sum_overflows_are_refused():
    grid = patch(1.3, 42, 5, 5)
    lines = thesis_lines(grid, APERTURE[::80])
    huge = dataclasses.replace(lines, samples=np.full_like(lines.samples, 2e36))
    with pytest.raises(ValueError, match=r"samples must be at most 1.25e.36 .* 8 channels"):
        backproject(huge, grid)


@pytest.mark.slow
@pytest.mark.parametrize("step_m", [0.0065, 0.02, 0.22])
@pytest.mark.parametrize("bearing_rad", [0.0, 1.57])
def test_one_channel_rounds_no_more_than_many(device, bearing_rad, step_m):
    """Coefficients are rounded once per tile and channel: one channel alone averages nothing."""
    wavelength_m = 0.01
    bearing = np.array([np.cos(bearing_rad), np.sin(bearing_rad), 0.05])
    grid = Grid.oriented(
        FAR + 18_700 * wavelength_m * bearing,
        [0, 4 * wavelength_m, 0],
        [0.94 * wavelength_m, 0, 0],
        (162, 130),
    )
    lines = lines_over(
        grid, FAR[None], FAR[None] + 3.0, carrier_hz=150e3, step_m=step_m,
        velocity=np.array([[3.0, -4.0, 1.0]]),
    )  # fmt: skip
    prepared = prepare(lines, grid, device=device, accuracy_db=-85)
    reference = partial(same_interpolator, prepared)
    assert sampled_error_db(execute(prepared), reference) <= -89


@pytest.mark.parametrize(
    ("fraction", "accuracy_db"), few([(1e-4, -80), (3e-4, -84), (5e-5, -75)], often=[(1e-4, -80)])
)
def test_bands_of_a_few_hertz(fraction, accuracy_db):
    """A wave is less than a thousandth of a sample, whose positions are rounded."""
    tx = along_x(60, 0.02)
    channels = Channels(tx, tx, None, np.ones(60), np.tile([1.0, 0, 0], (60, 1)))
    grid = Grid.plane((-0.5, 0.5, 60), (8, 9, 60))
    pixels_m = grid.positions_m().reshape(-1, 3)
    range_m = channels.ranges_m(pixels_m)
    centre = 2 / SPEED_M_S * 100e3
    sampling = Sampling(centre, fraction * centre, centre, 0.625 / (fraction * centre))
    span_m = float(range_m.min()), float(range_m.max())
    points_m = pixels_m[[300, 1200, 2333]] + [0.003, 0.001, 0]
    amplitude = np.array([1, 0.5j, -0.7])
    echoes = Points.of(channels, sampling, points_m, amplitude, 0.0, span_m)
    lines = RangeLines(echoes.samples(), echoes.first_m, sampling.step_m, tx, tx, 100e3, SPEED_M_S)
    image = backproject(lines, grid, accuracy_db=accuracy_db)
    ideal = echoes.received(range_m).sum(axis=0)
    assert oracle.error_db(image.pixels.ravel(), ideal) < accuracy_db
