"""Input that cannot be right: every mistake is warned of with its cause, and healthy lines are not.

Lines are sums of analytic points, which share nothing with the simulator.
"""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from families import FAMILIES, draw

import clsas
from clsas.engine.signal.doubts import doubts

SPEED, CARRIER, BAND, STEP = 1500.0, 100e3, 30e3, 0.0125
GRID = clsas.Grid.plane((-2, 2, 101), (18.5, 24, 101))
POINTS_M = np.array([[0.3, 20.0, 0], [-0.8, 21.7, 0], [1.2, 23.1, 0]])


def recorded(points_m=POINTS_M, *, pulse_s=None, pings=240, length=560, noise=0.01, seed=0):
    """Lines of points, compressed or, with the length of a pulse, as chirps."""
    random = np.random.default_rng(seed)
    x = 0.02 * (np.arange(pings) - pings / 2)
    tx_m = np.stack([x, 0.01 * np.sin(x), 0 * x], axis=1)
    ranges = 18.0 + STEP * np.arange(length)
    samples = noise * random.normal(size=(pings, length, 2)) @ [1, 1j]
    for number, point_m in enumerate(points_m):
        range_m = np.linalg.norm(tx_m - point_m, axis=1)[:, None]
        late_s = 2 * (ranges - range_m) / SPEED
        if pulse_s is None:
            envelope = np.sinc(BAND * late_s)
        else:
            envelope = (late_s >= 0) * (late_s < pulse_s)
            envelope = envelope * np.exp(1j * np.pi * BAND / pulse_s * (late_s - pulse_s / 2) ** 2)
        samples += envelope * np.exp(1j * number - 4j * np.pi * CARRIER / SPEED * range_m)
    return clsas.RangeLines(samples, 18.0, STEP, tx_m, tx_m, CARRIER, SPEED)


def speckle(seed=0):
    random = np.random.default_rng(seed)
    places_m = np.stack([random.uniform(-4, 4, 150), random.uniform(18, 25, 150)], axis=1)
    return recorded(np.append(places_m, np.zeros((150, 1)), axis=1), noise=0.0)


@pytest.fixture(scope="module")
def lines():
    return recorded()


def names(lines, grid=GRID, beam=None):
    return [each.name for each in doubts(lines, grid, beam)]


def swapped(lines, order):
    return replace(lines, tx_m=lines.tx_m[:, order], rx_m=lines.rx_m[:, order])


def scaled(lines, factor):
    return replace(lines, tx_m=factor * lines.tx_m, rx_m=factor * lines.rx_m)


MISTAKES = {
    "conjugate": (lambda each: replace(each, samples=each.samples.conj()), ["phase_sign"]),
    "c/fs": (lambda each: replace(each, range_step_m=2 * STEP), ["ranges"]),
    "speed in km/s": (lambda each: replace(each, sound_speed_m_s=1.5), ["sound_speed"]),
    "speed in mm/s": (lambda each: replace(each, sound_speed_m_s=1.5e6), ["sound_speed"]),
    "carrier in kHz": (lambda each: replace(each, carrier_hz=100.0), ["advance"]),
    "carrier in MHz": (lambda each: replace(each, carrier_hz=0.1), ["advance"]),
    "carrier in mHz": (lambda each: replace(each, carrier_hz=1e8), ["advance"]),
    "positions in mm": (lambda each: scaled(each, 1e3), ["advance"]),
    "positions in km": (lambda each: scaled(each, 1e-3), ["advance"]),
    "positions in degrees": (lambda each: scaled(each, 1 / 111e3), ["advance"]),
    "x and y swapped": (lambda each: swapped(each, [1, 0, 2]), ["end_fire"]),
    "real part": (
        lambda each: replace(each, samples=each.samples.real.astype(complex)), ["real_samples"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_found_in_points_whatever_the_order_of_channels(lines, mistake):
    change, said = MISTAKES[mistake]
    order = np.random.default_rng(1).permutation(lines.channels)
    assert names(lines) == names(lines.select(order)) == []
    assert names(change(lines)) == said
    assert names(change(lines.select(order))) == said


@pytest.mark.parametrize("pulse_s", [0.3e-3, 1e-3, 1.7e-3])
def test_uncompressed_chirps_are_found(pulse_s):
    assert names(recorded(pulse_s=pulse_s, noise=0.05)) == ["uncompressed"]


def test_two_way_ranges_are_found_where_lines_reach_the_grid():
    lines = recorded(length=1200)
    wrong = replace(lines, first_range_m=36.0, range_step_m=2 * STEP)
    assert names(wrong, clsas.Grid.plane((-2, 2, 101), (18.5, 60, 101))) == ["ranges"]


@pytest.mark.slow
@pytest.mark.parametrize("sway_m", [0.002, 0.02])
def test_nothing_is_said_of_speckle_or_of_an_image_blurred_by_motion(sway_m):
    assert names(speckle()) == []
    random, lines = np.random.default_rng(2), recorded()
    moved_m = lines.tx_m + sway_m * random.normal(size=lines.tx_m.shape)
    assert names(replace(lines, tx_m=moved_m, rx_m=moved_m)) == []


@pytest.mark.parametrize(
    ("width", "said"), [(20.0, []), (3.0, []), (np.radians(20), ["beam"]), (0.05, ["beam"])]
)
def test_beams_in_radians_and_beams_of_one_channel_are_found(lines, width, said):
    assert names(lines, beam=clsas.BeamWindow(width)) == said


WAYS = {
    "backproject": lambda *given: clsas.backproject(*given),
    "factorize": lambda *given: clsas.factorize(*given, -30),
    "imager": lambda *given: clsas.Imager(*given, accuracy_db=-30),
    "wavenumber": lambda *given: clsas.wavenumber(*given),
    "mosaic": lambda *given: clsas.mosaic(*given, patches=(2, 2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_every_imager_warns_once_with_cause_and_remedy(lines, way):
    wrong = replace(lines, samples=lines.samples.conj())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        WAYS[way](wrong, GRID)
    (message,) = [str(each.message) for each in caught if "focus" in str(each.message)]
    assert "would be if its phase had the opposite sign" in message
    assert message.endswith("samples=lines.samples.conj())`")


@pytest.mark.slow
@pytest.mark.parametrize("family", [each for each in FAMILIES if "profiles" not in each])
def test_nothing_is_said_of_random_scenes(family):
    scene = draw(family, 7001)
    assert names(scene.lines, scene.grid, scene.beam) == []


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(300, 310))
@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_is_said_of_many_random_scenes(family, seed):
    scene = draw(family, seed)
    assert names(scene.lines, scene.grid, scene.beam) == []
