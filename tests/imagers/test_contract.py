"""What holds for every imager, on every platform."""

import dataclasses
import warnings
from functools import cache

import numpy as np
import pytest
from cases import APERTURE, CARRIER, beside, noise
from contract import IMAGERS, Scene, near, scene
from factorizing import bistatic_array
from tiers import also, few
from variants import DEFAULT, OWN, variant

import clsas
from clsas import BeamWindow, Grid, PointTargets, simulate_lines
from clsas.engine.data.coverage import UnreachedWarning
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.device.device import Device

BY_NAME = {imager.name: imager for imager in IMAGERS}
FAR_M = np.array([1e7, -1e7, 1e7])


def pairs(cases=None, needs=None, but=()):
    """(imager, way to drive a device) of every imager, with each of its cases if asked for."""
    found = []
    for imager in IMAGERS:
        if imager.name in but or (needs and needs not in imager.options):
            continue
        ways = OWN if "device" in imager.options else {"host": None}
        for name, way in ways.items():
            often = name in (DEFAULT, "host")
            of = f"{imager.name}-{name}"
            if cases is None:
                found.append(_param((imager, way), name=of, often=often, quick=imager.is_quick))
            else:
                # The first case is the smallest.
                found += [
                    _param(
                        (imager, way),
                        case,
                        name=f"{of}-{case.__name__}",
                        often=often,
                        quick=imager.is_quick and not n,
                    )
                    for n, case in enumerate(cases(imager))
                ]
    return found


def _param(*values, name, often, quick):
    """Return a parameter with the mark of its tier; other platforms than the default are rare."""
    mark = pytest.mark.exhaustive if not often else () if quick else pytest.mark.slow
    return pytest.param(*values, id=name, marks=mark)


every_imager = pytest.mark.parametrize("bound", pairs())
every_scene = pytest.mark.parametrize(("bound", "case"), pairs(lambda imager: imager.cases))


def former(bound, like=None):
    """Function of scenes, to the pixels that an imager forms of them.

    With a scene they are all formed alike: by the plan or the filters that it gets.
    """
    imager, way = bound
    device = None if way is None else variant(*way)
    settings = {} if like is None else imager.settings(like)

    def form(scene, **options):
        return imager.form(scene, device, **settings, **options).pixels

    return form


@cache
def image_of(bound, case):
    """Pixels of a scene as it is."""
    return former(bound)(scene(case))


# Accuracy


@every_imager
def test_the_error_against_the_ideal_is_what_was_asked_for(bound):
    assert bound[0].known().error_db(image_of(bound, bound[0].known)) <= bound[0].asked_db


def test_images_are_factorized_where_they_are_said_to_be():
    for imager in (BY_NAME["factorized"], BY_NAME["half precision"]):
        for case in imager.cases:
            chosen = imager.settings(scene(case))["chosen"]
            assert not chosen.is_exact
            assert chosen.half_precision == (imager.name == "half precision")


def straight(imager):
    lines, grid = scene(imager.known).lines, scene(imager.known).grid
    return grid, {
        "tx_m": lines.tx_m, "rx_m": lines.rx_m, "carrier_hz": 200e3, "bandwidth_hz": 20e3,
        "first_range_m": max(float(grid.positions_m()[..., 1].mean()) - 12.5, 0.0),
    }  # fmt: skip


def array(imager):
    lines, grid = scene(bistatic_array).lines, scene(bistatic_array).grid
    return grid, {
        "tx_m": lines.tx_m, "rx_m": lines.rx_m, "carrier_hz": 120e3, "bandwidth_hz": 24e3,
        "first_range_m": 28.0,
    }  # fmt: skip


def anywhere(imager):
    """Antennas and points anywhere, and receivers that move."""
    rng = np.random.default_rng(3)
    tx = APERTURE[::20] + rng.normal(0, 0.1, (32, 3))
    where = Grid.points(rng.uniform([-1, 41, -3], [1, 42, -2], (60, 3)))
    return where, {
        "tx_m": tx, "rx_m": beside(tx, 0.2, 0, 0.1), "rx_velocity_m_s": [2.0, 1, 0],
        "carrier_hz": CARRIER, "bandwidth_hz": 1e5, "first_range_m": 39.0,
    }  # fmt: skip


def geometries(imager):
    return (straight, *{"exact": (anywhere,), "factorized": (array,)}.get(imager.name, ()))


@pytest.mark.slow
@pytest.mark.parametrize(("bound", "geometry"), pairs(geometries))
def test_imaging_is_the_adjoint_of_simulation(bound, geometry):
    """<A x, y> = <x, A^H y>, with A from amplitudes to lines of a flat band.

    A's point response is sinc(2 B r/c), sampled `oversampling` times as finely as that takes. Its
    matched sum over the samples of a line within the band is `oversampling` times the line's
    value, so that A^H is `oversampling` times imaging.
    """
    grid, antennas = geometry(bound[0])
    rng = np.random.default_rng(3)
    oversampling = 1.6
    positions_m = grid.positions_m().reshape(-1, 3)
    chosen = rng.permutation(len(positions_m))[:60]
    x = rng.normal(size=(60, 2)) @ [1, 1j]
    length, channels = 1200, len(antennas["tx_m"])
    points = PointTargets(positions_m[chosen], x)
    ax = simulate_lines(scene=points, oversampling=oversampling, length=length, **antennas)
    # y: bursts within the band (to -120 dB) that end within the lines.
    n = np.arange(length)
    y = np.zeros((channels, length), complex)
    for _ in range(30):
        at, frequency = (
            rng.uniform(low, high, (channels, 1)) for low, high in ((300, 800), (-0.15, 0.15))
        )
        y += (rng.normal(size=(channels, 1, 2)) @ [1, 1j]) * np.exp(
            -(((n - at) / 9) ** 2) + 2j * np.pi * frequency * n
        )
    lines = dataclasses.replace(ax, samples=y)
    pixels = former(bound)(Scene(lines, grid)).ravel()[chosen].astype(complex)
    left = np.vdot(ax.samples.astype(complex), y)
    right = np.vdot(x, oversampling * pixels)
    size = np.linalg.norm(x) * np.linalg.norm(oversampling * pixels)
    assert abs(left) > 0.01 * size  # the two sides do not vanish
    assert abs(left - right) <= 10 ** (bound[0].asked_db / 20) * size


@pytest.mark.slow
@every_imager
def test_a_point_keeps_its_amplitude_and_phase(bound):
    amplitude = 3 * np.exp(1.1j)
    track, grid = scene(bound[0].known).lines.tx_m, scene(bound[0].known).grid
    target = grid.positions_m()[11, 13]
    lines = simulate_lines(
        track, track, PointTargets([target], [amplitude]), carrier_hz=200e3, bandwidth_hz=20e3
    )
    pixel = former(bound)(Scene(lines, grid))[11, 13]
    # The tolerance is an rms over the image, in which all other pixels are small.
    assert abs(pixel / (len(track) * amplitude) - 1) <= 3e-3


# What images have in common


@every_scene
def test_it_is_linear(bound, case):
    one = scene(case)
    shape = one.lines.channels, one.lines.length
    other = one.with_lines(samples=noise(*shape, seed=9))
    a, b = 0.3 - 2j, 1.5j
    both = one.with_lines(samples=a * one.lines.samples + b * other.lines.samples)
    form = former(bound, like=both)
    wanted = a * form(one) + b * form(other)
    assert relative_error_db(form(both), wanted) <= bound[0].linear_db


def moved(given, turn, shift_m):
    """Return a scene turned about the origin and shifted."""
    lines, grid, beam = given.lines, given.grid, given.beam
    velocity = lines.rx_velocity_m_s
    lines = dataclasses.replace(
        lines,
        tx_m=lines.tx_m @ turn.T + shift_m,
        rx_m=lines.rx_m @ turn.T + shift_m,
        rx_velocity_m_s=None if velocity is None else velocity @ turn.T,
    )
    if grid.points_m is not None:
        grid = Grid.points(grid.points_m @ turn.T + shift_m)
    else:
        axes = turn @ grid.row_step_m, turn @ grid.column_step_m
        grid = Grid.oriented(turn @ grid.origin_m + shift_m, *axes, grid.shape)
    if beam is not None and beam.along is not None:
        beam = dataclasses.replace(beam, along=turn @ beam.along)
    return Scene(lines, grid, beam)


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


MOTIONS = {
    "shift": (np.eye(3), np.array([1024.5, -512.25, 64.125])),
    "far": (np.eye(3), FAR_M),
    "rotation": (rotation(1), np.zeros(3)),
}


@every_scene
@pytest.mark.parametrize("motion", few(MOTIONS, often=["far", "rotation"]))
def test_where_the_scene_lies_does_not_matter(bound, case, motion):
    here = scene(case)
    there = moved(here, *MOTIONS[motion])
    form = former(bound)
    assert relative_error_db(form(there), image_of(bound, case)) <= max(bound[0].asked_db, -80)


@every_imager
def test_the_order_of_channels_does_not_matter(bound):
    given = scene(bound[0].known)
    order = np.random.default_rng(6).permutation(given.lines.channels)
    shuffled = dataclasses.replace(given, lines=given.lines.select(order))
    wanted = image_of(bound, bound[0].known)
    assert relative_error_db(former(bound)(shuffled), wanted) <= bound[0].same_db


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the lines are kept in single precision, not in half")
@every_imager
@pytest.mark.parametrize("scale", [1e-36, *also(1e-30, 1e-10, 1e10, 1e20), 1e30])
def test_the_unit_of_the_samples_does_not_matter(bound, scale):
    """Amplitudes whose squares leave the range of float32."""
    given = scene(bound[0].known)
    scaled = given.with_lines(samples=given.lines.samples * np.complex128(scale))
    pixels = former(bound)(scaled).astype(np.complex128) / scale
    assert relative_error_db(pixels, image_of(bound, bound[0].known)) <= max(bound[0].same_db, -80)


@pytest.mark.slow
@every_imager
def test_it_gives_the_same_twice(bound):
    known = bound[0].known
    np.testing.assert_array_equal(former(bound)(scene(known)), image_of(bound, known))


@pytest.mark.parametrize("bound", pairs(needs="accumulate"))
def test_data_may_arrive_in_pieces(bound):
    given = scene(bound[0].known)
    image = None
    for part in (slice(0, 100), slice(100, 240)):
        some = dataclasses.replace(given, lines=given.lines.select(part))
        pixels = former(bound)(some, accumulate=image)
        image = Image(pixels, given.grid)
    assert bound[0].known().error_db(image.pixels) <= bound[0].asked_db + 3


# Progress and interruption


@pytest.mark.slow
@pytest.mark.parametrize(("bound", "case"), pairs(lambda imager: imager.cases, "progress"))
def test_progress_rises_to_its_end(bound, case):
    calls = []
    former(bound)(scene(case), progress=lambda *call: calls.append(call))
    done, total = np.array(calls).T
    assert np.all(np.diff(done) > 0)
    assert np.all(total == total[0])
    assert done[-1] == total[0]


@pytest.mark.parametrize("bound", pairs(needs="progress"))
def test_an_interrupted_run_leaves_the_device_usable(bound):
    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        former(bound)(scene(bound[0].known), progress=interrupt)
    assert bound[0].known().error_db(former(bound)(scene(bound[0].known))) <= bound[0].asked_db


# Nothing to see


@pytest.mark.slow
@every_imager
def test_lines_of_zeros_give_zeros_without_a_warning(bound):
    given = scene(bound[0].known)
    silent = given.with_lines(samples=np.zeros_like(given.lines.samples))
    assert not former(bound)(silent).any()


@pytest.mark.parametrize("y", [5.0, 400.0, -4000.0])
@every_imager
def test_a_grid_that_no_line_reaches_warns_and_is_zero_without_a_kernel(bound, y, monkeypatch):
    given = dataclasses.replace(scene(bound[0].known), grid=Grid.plane((-1, 1, 9), (y, y + 1, 9)))
    monkeypatch.setattr(Device, "kernel", no_kernel)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnreachedWarning)  # of a plan, beside its image's
        form = former(bound, like=given)
    with pytest.warns(UnreachedWarning, match="no pixel") as caught:
        assert not form(given).any()
    assert len([each for each in caught if each.category is UnreachedWarning]) == 1


def no_kernel(*_, **__):
    raise AssertionError("a kernel was built")


@pytest.mark.parametrize(
    ("factor", "cause"),
    [(1e3, "if it were in mm"), (1e-3, "if it were in km"), (10, "Check the grid")],
)
def test_the_warning_names_the_likely_cause(factor, cause):
    given = scene(near)
    x, y = (axis * factor for axis in given.grid.axes_m)
    grid = Grid.plane((x[0], x[-1], 9), (y[0], y[-1], 9))
    with pytest.warns(UnreachedWarning, match=rf"grid lies at [\d.]+ to [\d.]+ m\. .*{cause}"):
        clsas.backproject(given.lines, grid)


def test_the_warning_names_the_beam_where_ranges_are_right():
    given = scene(near)
    beam = BeamWindow(5, squint_deg=60, along=[1, 0, 0])
    with pytest.warns(UnreachedWarning, match=r"beam spans 57.5 to 62.5 degrees.*squint"):
        assert not clsas.backproject(given.lines, given.grid, beam=beam).pixels.any()
