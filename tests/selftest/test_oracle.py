"""The oracle itself: independent of the library, and consistent with itself."""

import ast
from pathlib import Path

import numpy as np
import pytest
from bent import travel_times
from rays import rays

from clsas.selftest import oracle
from clsas.selftest.oracle import Band, Echo


def test_it_imports_nothing_but_numpy():
    tree = ast.parse(Path(oracle.__file__).read_text())
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            imported.add(node.module)
    standard = {"__future__", "collections.abc", "dataclasses", "itertools"}
    assert imported - standard == {"numpy", "numpy.typing"}


@pytest.mark.parametrize("tilt_db", [0.0, -10.0, 30.0])
def test_a_pulse_has_the_spectrum_that_it_names(tilt_db):
    """The transform of a long sampled pulse is a tilted box with Gaussian edges."""
    step, count = 0.01, 4096
    band = Band(centre=20.0, width=30.0, edge=0.3, level=2.0 - 1j, tilt_db=tilt_db)
    offset = (np.arange(count) - count // 2) * step
    values = oracle.pulse(offset, [band])
    spectrum = step * np.fft.fft(np.fft.ifftshift(values))
    frequency = np.fft.fftfreq(count, step)
    wanted = np.zeros(count)
    inside = np.abs(frequency - 20) < 13
    wanted[inside] = abs(2 - 1j) * 10 ** (tilt_db / 20 * (frequency[inside] - 20) / 30) / 30
    assert np.abs(spectrum[inside]) == pytest.approx(wanted[inside], rel=1e-6)
    assert np.abs(spectrum[np.abs(frequency - 20) > 17]).max() < 1e-9
    assert values[count // 2] == pytest.approx(oracle.pulse(0.0, [band])[()])


def test_ranges_of_moving_receivers_solve_the_quadratic():
    rng = np.random.default_rng(0)
    points, tx = rng.uniform(-50, 50, (5, 3)), rng.uniform(-1, 1, (7, 3))
    rx, velocity = tx + rng.normal(0, 0.3, (7, 3)), rng.uniform(-40, 40, (7, 3))
    tau = 2 * oracle.ranges_m(points, tx, rx, 1500.0, velocity) / 1500.0
    q = points - tx[:, None]
    d = points - rx[:, None]
    outward = np.linalg.norm(q, axis=-1)
    b = 1500.0 * outward - np.einsum("cpi,ci->cp", d, velocity)
    squares = 1500.0**2 - np.sum(velocity**2, axis=-1)[:, None]
    left = outward**2 - np.sum(d**2, axis=-1)
    roots = (b + np.sqrt(b**2 - squares * left)) / squares
    assert tau == pytest.approx(roots, rel=1e-12)


def test_lines_sampled_at_the_ranges_of_pixels_are_the_image():
    """Sampling mixes out the same carrier phase that imaging restores."""
    x = np.linspace(-0.5, 0.5, 9)
    tx = np.stack([x, 0 * x, 0 * x], axis=1)
    echoes = [Echo(oracle.ranges_m([[0.1, 8, 0]], tx, tx), 1.5j, [Band(60.0, 10.0, 0.1)])]
    pixel = oracle.ranges_m([[0.11, 8.01, 0]], tx, tx)
    one = oracle.samples(echoes, pixel[:, 0], 1.0, 1, 50.0)[:, 0]
    summed = np.sum(one * np.exp(2j * np.pi * 50.0 * pixel[:, 0]))
    assert oracle.image(echoes, pixel)[0] == pytest.approx(summed, rel=1e-12)


PROFILES = {
    "thermocline": ([0, 12, 15, 60], [1505, 1504.5, 1494, 1490]),
    "gradient": ([0, 60], [1480, 1510]),
    "one speed": ([0, 20, 60], [1500, 1500, 1500]),
}


@pytest.mark.parametrize("name", PROFILES)
def test_rays_are_those_of_quadrature(name):
    depth_m, speed_m_s = PROFILES[name]
    distance_m = np.append(np.random.default_rng(1).uniform(0, 80, 500), [1e-3, 80])
    times = travel_times(depth_m, speed_m_s, 6.0, 25.0, 90.0)
    for ends in ((6.0, 25.0), (25.0, 6.0)):
        time_s, slowness = rays(depth_m, speed_m_s, distance_m, *ends)
        np.testing.assert_allclose(time_s, times(distance_m), rtol=0, atol=1e-13)
        np.testing.assert_allclose(slowness, times(distance_m, 1), rtol=0, atol=1e-10)


def test_rays_that_would_turn_are_left_out():
    """In this gradient, arcs from 6 m leave the level of 25 m at 237 m."""
    radius_m = 1500.0 - 25.0
    reach_m = np.sqrt((1500.0 - 6.0) ** 2 - radius_m**2)
    distance_m = reach_m * np.array([0.999, 1.001])
    time_s, _ = rays([0, 60], [1500, 1440], distance_m, 6.0, 25.0)
    assert np.isnan(rays([0, 60], [1500, 1500], 10.0, 6.0, 6.0)[0])
    assert np.isfinite(time_s[0])
    assert np.isnan(time_s[1])
