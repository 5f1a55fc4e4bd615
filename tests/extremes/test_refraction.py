"""Images in water whose sound speed varies with depth, against sums along independent rays."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from bent import travel_times
from cases import along_x, lines_over
from factorizing import EXACT_IS_SLOW
from sums import BentChannels, Points, Sampling
from tiers import also, few

import clsas
from clsas import Grid, RangeLines, SoundSpeed
from clsas.engine.data.decibels import in_db
from clsas.engine.water.refraction import homogeneous
from clsas.selftest import oracle

NOMINAL = 1500.0  # m/s, by which times become ranges
CHANNELS, POINTS, PIXELS = 120, 150, (24, 24)


@dataclass(frozen=True)
class Case:
    carrier_hz: float
    range_m: float
    depths_m: tuple[float, ...]
    speeds_m_s: tuple[float, ...]
    aperture_m: float
    swath_m: float = 5.0
    sonar_m: float = 10.0  # depth
    seabed_m: float = 22.0
    relief_m: float = 0.0


def gradient(per_s, bottom_m=70.0):
    return {"depths_m": (0.0, bottom_m), "speeds_m_s": (1480.0, 1480.0 + per_s * bottom_m)}


THERMOCLINE = {"depths_m": (0.0, 14.0, 17.0, 60.0), "speeds_m_s": (1505.0, 1505.0, 1495.0, 1495.5)}
CASES = {
    "thermocline": Case(100e3, 60, **THERMOCLINE, aperture_m=12),
    "gradient": Case(100e3, 60, **gradient(0.5), aperture_m=12),
    "steep gradient": Case(300e3, 60, **gradient(1.0), aperture_m=5, swath_m=2),
    "falling gradient": Case(100e3, 150, **gradient(-1.0), aperture_m=25, swath_m=20),
    "low frequency": Case(
        60e3, 300, **gradient(-1.0), aperture_m=60, swath_m=30, sonar_m=5, seabed_m=45
    ),
    "far thermocline": Case(200e3, 120, **THERMOCLINE, aperture_m=10, swath_m=4),
    "relief": Case(100e3, 60, **gradient(0.5), aperture_m=12, relief_m=0.5),
    "far relief": Case(60e3, 150, **gradient(-0.3), aperture_m=40, relief_m=1.0),
}
QUICK = "thermocline"


@dataclass(frozen=True)
class Scene:
    """What every channel receives, along rays that share nothing with the library.

    `slowness_s_m` is that along the track, [channels, pixels], of rays to the pixels.
    """

    lines: RangeLines
    grid: Grid
    echoes: list
    pixels_m: np.ndarray
    slowness_s_m: np.ndarray


def made(name):
    """Lines, grid, and the ideal image."""
    scene = scene_of(name)
    return scene.lines, scene.grid, oracle.image(scene.echoes, scene.pixels_m)


@cache
def scene_of(name):
    case = CASES[name]
    random = np.random.default_rng(7)
    middle_m = np.sqrt(case.range_m**2 - (case.seabed_m - case.sonar_m) ** 2)
    x = np.linspace(-0.5, 0.5, CHANNELS) * case.aperture_m
    x += random.uniform(-0.3, 0.3, CHANNELS) * case.aperture_m / CHANNELS
    antennas = np.stack([x, 0 * x, 0 * x - case.sonar_m], axis=1)
    far = middle_m + case.swath_m
    grid = Grid.plane(
        (-1.0, 1.0, PIXELS[1]),
        (middle_m - case.swath_m / 2, middle_m + case.swath_m / 2, PIXELS[0]),
        -case.seabed_m,
    )
    levels = np.array([0.0]) if not case.relief_m else np.linspace(-1, 1, 5) * case.relief_m
    of_pixels = random.integers(len(levels), size=PIXELS)
    if case.relief_m:
        grid = grid.with_height(levels[of_pixels])
    places = random.uniform([-1, -case.swath_m / 2], [1, case.swath_m / 2], (POINTS, 2))
    places[:, 1] += middle_m
    of_points = random.integers(len(levels), size=POINTS)

    def ranges(positions_m, of_level):
        """Ranges, and slowness along x, both [channels, positions]."""
        found, slowness = np.empty((2, CHANNELS, len(positions_m)))
        for index, level in enumerate(levels):
            times = travel_times(
                case.depths_m, case.speeds_m_s, case.sonar_m, case.seabed_m - level,
                np.hypot(far, 1 + case.aperture_m / 2),
            )  # fmt: skip
            here = of_level == index
            offset = positions_m[None, here, :2] - antennas[:, None, :2]
            distance = np.hypot(offset[..., 0], offset[..., 1])
            found[:, here] = NOMINAL * times(distance)
            slowness[:, here] = times(distance, 1) * offset[..., 0] / distance
        return found, slowness

    per_m = 2 * case.carrier_hz / NOMINAL
    band = oracle.Band(per_m, 0.15 * per_m, 0.015 * per_m)
    amplitudes = random.normal(size=(POINTS, 2)) @ [1, 1j]
    echoes = [oracle.Echo(ranges(places, of_points)[0], amplitudes, [band])]
    step_m = 1 / (0.32 * per_m)
    pixels_m, slowness = ranges(grid.positions_m().reshape(-1, 3), of_pixels.ravel())
    ends = (
        min(pixels_m.min(), echoes[0].range_m.min()),
        max(pixels_m.max(), echoes[0].range_m.max()),
    )
    first_m = ends[0] - 80 * step_m
    length = int((ends[1] - first_m) / step_m) + 80
    lines = RangeLines(
        oracle.samples(echoes, first_m, step_m, length, per_m), first_m, step_m, antennas, antennas,
        case.carrier_hz, NOMINAL, sound_speed=SoundSpeed(case.depths_m, case.speeds_m_s),
    )  # fmt: skip
    return Scene(lines, grid, echoes, pixels_m, slowness)


@pytest.mark.slow
@pytest.mark.parametrize("name", few(CASES, often=[QUICK, "far relief"]))
def test_images_are_those_of_exact_rays(name):
    lines, grid, ideal = made(name)
    exact = clsas.backproject(lines, grid, accuracy_db=-62)
    assert exact.grid is grid
    assert oracle.error_db(exact.pixels, ideal) < -50
    plan = clsas.plan(lines, grid, tolerance_db=-55, costs=EXACT_IS_SLOW)
    image = clsas.factorize(lines, grid, plan)
    assert oracle.error_db(image.pixels, ideal) < -50


@dataclass(frozen=True)
class Relief:
    """Waves of 25 m length, oblique to the track."""

    case: Case
    pixel_m: float
    uncorrected_db: float  # at the worst pixel

    def height_m(self, x, y):
        phase = 2 * np.pi * (0.87 * x + 0.5 * y) / 25
        return self.case.relief_m * np.sin(phase)


RELIEFS = {
    "gradient": Relief(
        Case(300e3, 60, **gradient(-1.0), aperture_m=5, swath_m=14, relief_m=3.0), 0.018, -48
    ),
    "thermocline": Relief(
        Case(300e3, 60, **THERMOCLINE, aperture_m=5, swath_m=14, relief_m=0.5), 0.018, -35
    ),
    "far thermocline": Relief(
        Case(60e3, 300, **THERMOCLINE, aperture_m=60, swath_m=40, sonar_m=5, seabed_m=45,
             relief_m=0.5), 0.08, -46
    ),
}  # fmt: skip


@cache
def relief_scene(name):
    """Lines, a grid on waves, some of its pixels, and the ideal image there."""
    relief = RELIEFS[name]
    case = relief.case
    random = np.random.default_rng(5)
    middle_m = np.sqrt(case.range_m**2 - (case.seabed_m - case.sonar_m) ** 2)
    half_m, count = case.swath_m / 2, round(case.swath_m / relief.pixel_m)
    x = np.linspace(-0.5, 0.5, CHANNELS) * case.aperture_m
    antennas = np.stack([x, 0 * x, 0 * x - case.sonar_m], axis=1)
    ends = (middle_m - half_m, middle_m + half_m)
    plane = Grid.plane((-half_m, half_m, count), (*ends, count), -case.seabed_m)
    at = plane.positions_m()
    grid = plane.with_height(relief.height_m(at[..., 0], at[..., 1]))
    pixels = random.integers(grid.size, size=200)
    places = random.uniform(-half_m, half_m, (POINTS, 2)) + [0, middle_m]
    points = np.column_stack([places, relief.height_m(*places.T) - case.seabed_m])
    farthest_m = np.hypot(ends[1], half_m + case.aperture_m / 2) + 1

    def ranges(positions_m):
        found = np.empty((CHANNELS, len(positions_m)))
        for index, position in enumerate(positions_m):
            times = travel_times(
                case.depths_m, case.speeds_m_s, case.sonar_m, -position[2], farthest_m, 1500
            )
            distance = np.hypot(*(position[:2] - antennas[:, :2]).T)
            found[:, index] = NOMINAL * times(distance)
        return found

    per_m = 2 * case.carrier_hz / NOMINAL
    band = oracle.Band(per_m, 0.15 * per_m, 0.015 * per_m)
    echoes = [oracle.Echo(ranges(points), random.normal(size=(POINTS, 2)) @ [1, 1j], [band])]
    pixels_m = ranges(grid.at(pixels))
    step_m = 1 / (0.32 * per_m)
    first_m = min(pixels_m.min(), echoes[0].range_m.min()) - 80 * step_m
    last_m = max(pixels_m.max(), echoes[0].range_m.max())
    length = int((last_m - first_m) / step_m) + 80
    lines = RangeLines(
        oracle.samples(echoes, first_m, step_m, length, per_m), first_m, step_m, antennas, antennas,
        case.carrier_hz, NOMINAL, sound_speed=SoundSpeed(case.depths_m, case.speeds_m_s),
    )  # fmt: skip
    return lines, grid, pixels, oracle.image(echoes, pixels_m)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", few(RELIEFS, often=["thermocline"]))
def test_images_over_relief_are_those_of_exact_rays(name):
    """Two heights of equal delay focus differently, which apparent antennas alone cannot do."""
    lines, grid, pixels, ideal = relief_scene(name)
    alone = homogeneous(lines, grid, None, None, corrected=False)
    assert in_db(alone.error) > RELIEFS[name].uncorrected_db
    exact = clsas.backproject(lines, grid, accuracy_db=-56)
    assert oracle.error_db(exact.pixels.ravel()[pixels], ideal) < -50
    plan = clsas.plan(lines, grid, tolerance_db=-55, costs=EXACT_IS_SLOW)
    assert not plan.is_exact
    image = clsas.factorize(lines, grid, plan)
    assert oracle.error_db(image.pixels.ravel()[pixels], ideal) < -54  # of 200 pixels; asked: -55


@pytest.mark.exhaustive
@pytest.mark.parametrize("speed_m_s", [1.8, *also(0.0)])
def test_arrays_that_move_see_along_exact_rays(speed_m_s):
    """Apparent antennas below a thermocline depend on the pixel if receivers are apart or move."""
    case = Case(300e3, 60, **THERMOCLINE, aperture_m=5)
    random = np.random.default_rng(8)
    middle_m = np.sqrt(case.range_m**2 - (case.seabed_m - case.sonar_m) ** 2)
    tx = np.repeat(np.linspace(-2.5, 2.5, 15), 8)
    tx = np.stack([tx, 0 * tx, 0 * tx - case.sonar_m], axis=1)
    rx = tx + np.outer(np.tile(np.linspace(0.1, 1.3, 8), 15), [1, 0, 0])
    times = travel_times(
        case.depths_m, case.speeds_m_s, case.sonar_m, case.seabed_m, middle_m + 30, 12000
    )
    half_m, count = 12.0, 1200
    grid = Grid.plane(
        (-half_m, half_m, count), (middle_m - half_m, middle_m + half_m, count), -case.seabed_m
    )
    pixels = random.integers(grid.size, size=400)
    points = random.uniform(-half_m, half_m, (POINTS, 2)) + [0, middle_m]

    def ranges(positions_m):
        out, back = (
            times(np.hypot(*(positions_m - each[:, None]).T)).T for each in (tx[:, :2], rx[:, :2])
        )
        for _ in range(5):  # receivers move until the echo arrives
            moved = rx[:, None, :2] + (out + back)[..., None] * [speed_m_s, 0]
            back = times(np.linalg.norm(positions_m - moved, axis=-1))
        return NOMINAL * (out + back) / 2

    per_m = 2 * case.carrier_hz / NOMINAL
    band = oracle.Band(per_m, 0.15 * per_m, 0.015 * per_m)
    echoes = [oracle.Echo(ranges(points), random.normal(size=(POINTS, 2)) @ [1, 1j], [band])]
    pixels_m = ranges(grid.at(pixels)[:, :2])
    step_m = 1 / (0.32 * per_m)
    first_m = min(pixels_m.min(), echoes[0].range_m.min()) - 80 * step_m
    length = int((max(pixels_m.max(), echoes[0].range_m.max()) - first_m) / step_m) + 80
    lines = RangeLines(
        oracle.samples(echoes, first_m, step_m, length, per_m), first_m, step_m, tx, rx,
        case.carrier_hz, NOMINAL, sound_speed=SoundSpeed(case.depths_m, case.speeds_m_s),
        rx_velocity_m_s=[speed_m_s, 0, 0] if speed_m_s else None,
    )  # fmt: skip
    alone = homogeneous(lines, grid, None, None, corrected=False)
    assert in_db(alone.error) > -48
    ideal = oracle.image(echoes, pixels_m)
    exact = clsas.backproject(lines, grid, accuracy_db=-62)
    assert oracle.error_db(exact.pixels.ravel()[pixels], ideal) < -58
    plan = clsas.plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    assert not plan.is_exact
    image = clsas.factorize(lines, grid, plan)
    assert oracle.error_db(image.pixels.ravel()[pixels], ideal) < -50


BEAMS = [
    clsas.BeamWindow(8, "hann", along=[1, 0, 0]),
    clsas.BeamWindow(8, "tukey", 1.0, along=[1, 0, 0]),
]


CLOSE = {
    "heave": (0.02, [0, 3.9, 4.3, 5, 6, 7, 30], [1500, 1499, 1495, 1494, 1490, 1489, 1489], 0.6),
    "gradient": (0.03, [0, 30], [1500, 1530], 0.0),
    "narrow": (0.005, [0, 4, 7, 30], [1490, 1490, 1496, 1497], 0.3),
}


@pytest.mark.parametrize("name", few(CLOSE, often=["heave"]))
def test_narrow_bands_from_steep_to_flat_rays(name):
    """Range axes change by percents of the range, and carriers by more than the sampled band."""
    fraction, depth_m, speed_m_s, heave_m = CLOSE[name]
    x = np.linspace(-1.5, 1.5, 30)
    tx = np.column_stack([x, 0 * x, -4.2 + heave_m * np.sin(4 * x)])
    channels = BentChannels(
        tx, tx, None, np.ones(30), np.tile([1.0, 0, 0], (30, 1)),
        depth_m=np.array(depth_m, float), speed_m_s=np.array(speed_m_s, float), surface_z_m=0.0,
    )  # fmt: skip
    grid = Grid.plane((-1, 1, 12), (3, 40, 40), -8.2)
    pixels_m = grid.positions_m().reshape(-1, 3)
    range_m = channels.ranges_m(pixels_m)
    centre = 2 / NOMINAL * 100e3
    sampling = Sampling(centre, fraction * centre, centre, 0.6 / (fraction * centre))
    rng = np.random.default_rng(0)
    points_m = pixels_m[rng.choice(len(pixels_m), 12)] + 0.003 * rng.normal(size=(12, 3))
    amplitude = rng.normal(size=(12, 2)) @ [1, 1j]
    span_m = float(range_m.min()), float(range_m.max())
    echoes = Points.of(channels, sampling, points_m, amplitude, 0.0, span_m)
    lines = RangeLines(
        echoes.samples(), echoes.first_m, sampling.step_m, tx, tx, 100e3, NOMINAL,
        sound_speed=SoundSpeed(depth_m, speed_m_s),
    )  # fmt: skip
    image = clsas.backproject(lines, grid, accuracy_db=-60)
    assert oracle.error_db(image.pixels.ravel(), echoes.received(range_m).sum(axis=0)) < -60


@pytest.mark.slow
@pytest.mark.parametrize("beam", BEAMS, ids=lambda beam: beam.shape)
@pytest.mark.parametrize("name", [QUICK, *also("low frequency", "far relief")])
def test_weights_are_those_of_the_rays_at_the_sonar(name, beam):
    """The sine of the angle at which a ray leaves the sonar is its slowness times the speed there.

    Those at the seabed are 0.2 to 2.8 % larger or smaller, which would cost up to -27 dB.
    """
    scene, case = scene_of(name), CASES[name]
    speed = np.interp(case.sonar_m, case.depths_m, case.speeds_m_s)
    weights = beam.weights(speed * scene.slowness_s_m, speed / case.carrier_hz)
    ideal = oracle.image(scene.echoes, scene.pixels_m, weights)
    given = scene.lines, scene.grid
    few_db = pytest.warns(clsas.ClsasWarning, match="refraction alone .* up to -5[37] dB")
    with few_db if name == "low frequency" else nullcontext():
        exact = clsas.backproject(*given, beam=beam, accuracy_db=-62)
        plan = clsas.plan(*given, tolerance_db=-55, beam=beam, costs=EXACT_IS_SLOW)
        image = clsas.factorize(*given, plan)
        stored = clsas.factorize(*given, clsas.Plan.from_json(plan.to_json()))
    assert oracle.error_db(exact.pixels, ideal) < -50
    assert oracle.error_db(image.pixels, ideal) < -50
    assert clsas.relative_error_db(stored, image) < -90


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["hamming", *also("rectangular", "taylor")])
@pytest.mark.parametrize("name", [QUICK, *also("low frequency", "far relief")])
def test_steps_of_a_beam_that_lie_elsewhere_are_predicted(name, shape):
    """A channel too many or too few at the edge costs -32 to -62 dB; predictions are bounds."""
    scene, case = scene_of(name), CASES[name]
    beam = clsas.BeamWindow(8, shape, along=[1, 0, 0])
    speed = np.interp(case.sonar_m, case.depths_m, case.speeds_m_s)
    weights = beam.weights(speed * scene.slowness_s_m, speed / case.carrier_hz)
    ideal = oracle.image(scene.echoes, scene.pixels_m, weights)
    exact = clsas.backproject(scene.lines, scene.grid, beam=beam, taps=8, upsampling=8)
    water = homogeneous(scene.lines, scene.grid, beam, None)
    error_db, predicted_db = oracle.error_db(exact.pixels, ideal), 10 * np.log10(water.error)
    assert error_db < predicted_db < error_db + 10


@pytest.mark.slow
def test_a_constant_speed_would_not_do():
    lines, grid, ideal = made(QUICK)
    profile = lines.sound_speed
    for speed in (NOMINAL, profile.mean_m_s(-10, -22)):
        scale = speed / NOMINAL
        straight = replace(
            lines, sound_speed=None, sound_speed_m_s=speed,
            first_range_m=scale * lines.first_range_m, range_step_m=scale * lines.range_step_m,
        )  # fmt: skip
        image = clsas.backproject(straight, grid)
        assert oracle.error_db(image.pixels, ideal) > -20


@pytest.mark.slow
def test_an_imager_takes_other_samples():
    lines, grid, ideal = made(QUICK)
    for request in ({"tolerance_db": -55}, {"accuracy_db": -62}):
        with clsas.Imager(lines, grid, **request) as imager:
            image = imager(replace(lines, samples=0.5j * lines.samples))
            assert oracle.error_db(image.pixels, 0.5j * ideal) < -50
            straight = imager(replace(lines, sound_speed=None))
            assert oracle.error_db(straight.pixels, ideal) > -20


@pytest.mark.slow
@pytest.mark.parametrize("speed_m_s", [1465, *also(1440, 1380)])
def test_a_plan_of_a_narrow_band_over_slow_water_can_be_used(speed_m_s):
    """Wavelengths are shorter there than at the nominal speed, by more than the sampled band."""
    grid = Grid.plane((-2, 2, 60), (60, 64, 60), -20)
    lines = lines_over(grid, along_x(150, 0.08, z=-6.0), carrier_hz=100e3, step_m=0.8)
    lines = replace(
        lines, sound_speed=SoundSpeed([0, 8, 10, 70], [1500, 1499, speed_m_s + 1, speed_m_s])
    )
    plan = clsas.plan(lines, grid, tolerance_db=-30, costs=EXACT_IS_SLOW)
    assert not plan.is_exact
    plan.check(lines, grid)


@pytest.mark.slow
def test_a_plan_belongs_to_the_profile():
    lines, grid, _ = made(QUICK)
    plan = clsas.plan(lines, grid, tolerance_db=-40)
    plan.check(lines, grid)
    with pytest.raises(ValueError, match="lines must have the geometry"):
        plan.check(replace(lines, sound_speed=SoundSpeed([0, 40], [1500, 1501])), grid)
    stored = clsas.Plan.from_json(plan.to_json())
    image = clsas.factorize(lines, grid, stored)
    assert clsas.relative_error_db(image, clsas.factorize(lines, grid, plan)) < -90


@pytest.mark.exhaustive
def test_a_wavenumber_image_of_an_array_that_moves(recwarn):
    """Its grid stays level, although other imagers would correct the ranges of points."""
    tx = np.repeat(along_x(40, 0.12, z=-10), 4, axis=0)
    rx = tx + np.tile(along_x(4, 0.06), (40, 1))
    grid = Grid.plane((-1, 1, 32), (57, 61, 48), -22)
    lines = lines_over(grid, tx, rx, carrier_hz=100e3, step_m=0.02, velocity=[1.8, 0, 0])
    lines = replace(lines, sound_speed=SoundSpeed(*THERMOCLINE.values()))
    assert homogeneous(lines, grid, None, None).corrections is not None
    assert clsas.wavenumber(lines, grid).shape == grid.shape


@pytest.mark.exhaustive
def test_a_wavenumber_image_has_the_same_water():
    lines, grid, ideal = made(QUICK)
    straight = clsas.backproject(replace(lines, sound_speed=None), grid)
    image = clsas.wavenumber(lines, grid)
    # Too few channels for a spectrum along the track; yet the water must not add to that.
    others = clsas.wavenumber(replace(lines, sound_speed=None), grid)
    method_db = oracle.error_db(others.pixels, straight.pixels)
    assert oracle.error_db(image.pixels, ideal) < method_db + 3
    sloping = Grid.oriented([0, 58, -22], [0, 0.1, 0.02], [0.1, 0, 0], (8, 8))
    with pytest.raises(ValueError, match="grid must be level"):
        clsas.wavenumber(lines, sloping)


@pytest.mark.slow
@pytest.mark.parametrize("name", few(list(CASES)[:6], often=[QUICK]))
def test_points_are_where_they_are(name):
    """The phase of a pixel at a point is right to a thousandth of a cycle, and so is its range."""
    case = CASES[name]
    lines, grid, _ = made(name)
    point_m = grid.positions_m()[11, 7]
    times = travel_times(
        case.depths_m, case.speeds_m_s, case.sonar_m, case.seabed_m, case.range_m + case.swath_m
    )
    range_m = NOMINAL * times(np.hypot(*(point_m[:2] - lines.tx_m[:, :2]).T))[:, None]
    per_m = 2 * case.carrier_hz / NOMINAL
    echo = oracle.Echo(range_m, 1.0, [oracle.Band(per_m, 0.15 * per_m, 0.015 * per_m)])
    first_m = lines.first_range_m
    samples = oracle.samples([echo], first_m, lines.range_step_m, lines.length, per_m)
    image = clsas.backproject(replace(lines, samples=samples), grid, accuracy_db=-60)
    brightest = np.unravel_index(np.abs(image.pixels).argmax(), image.shape)
    assert brightest == (11, 7)
    peak = image.pixels[brightest]
    assert np.abs(peak) == pytest.approx(CHANNELS, rel=1e-3)
    assert abs(np.angle(peak)) < 2 * np.pi * 1e-3


@pytest.mark.slow
def test_the_imager_is_the_adjoint_of_the_simulator():
    """<A x, y> = <x, A^H y> for amplitudes x of points, lines y, and both along the same rays."""
    lines, grid, _ = made(QUICK)
    random = np.random.default_rng(11)
    points = grid.positions_m().reshape(-1, 3)[::9]
    x = random.normal(size=(len(points), 2)) @ [1, 1j]
    oversampling, length = 1.6, 1200
    ax = clsas.simulate_lines(
        lines.tx_m, lines.rx_m, clsas.PointTargets(points, x), carrier_hz=100e3,
        bandwidth_hz=20e3, oversampling=oversampling, sound_speed=lines.sound_speed,
        first_range_m=48.0, length=length,
    )  # fmt: skip
    n = np.arange(length)
    y = np.zeros((CHANNELS, length), complex)
    for _ in range(30):  # bursts within the band, which end within the lines
        at, frequency = (
            random.uniform(*ends, (CHANNELS, 1)) for ends in ((300, 800), (-0.15, 0.15))
        )
        envelope = np.exp(-(((n - at) / 9) ** 2) + 2j * np.pi * frequency * n)
        y += (random.normal(size=(CHANNELS, 1, 2)) @ [1, 1j]) * envelope
    image = clsas.backproject(replace(ax, samples=y), clsas.Grid.points(points), accuracy_db=-60)
    left = np.vdot(ax.samples.astype(complex), y)
    right = np.vdot(x, oversampling * image.pixels)
    size = np.linalg.norm(x) * np.linalg.norm(oversampling * image.pixels)
    assert abs(left) > 0.01 * size
    assert abs(left - right) < 1e-3 * size
