"""Errors of a pair that simulated heights show, against those that were simulated."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import reliefs
import swaths
from reliefs import flat_banks
from tiers import few

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import open_device
from clsas.interferometry import pair_errors
from clsas.interferometry.misregistration import ConstantPhase, constant_phase
from clsas.interferometry.pair import Pair
from clsas.interferometry.pair_errors_result import PairErrors, turned

CYCLE_S = 1 / reliefs.CARRIER_HZ
UNITS = {"phase": "phase_rad", "delay": "delay_s", "roll": "roll_rad"}
ERRORS = {
    "phase": {"phase_rad": 0.5},
    "third of a cycle": {"delay_s": CYCLE_S / 3},
    "one and a half cycles": {"delay_s": 1.5 * CYCLE_S},
    "roll": {"roll_rad": 2e-3},
    "all": {"phase_rad": 0.5, "delay_s": CYCLE_S / 3, "roll_rad": 2e-3},
}


def flat(x, y):
    return 0 * x + 0 * y


def dunes(x, y):
    return 0.05 * np.sin(2 * np.pi * (y - 32) / 3) + 0.05 * x


def measured(lines, grid=swaths.GRID, search_m=(-1.5, 1.5), window_m=swaths.WINDOW_M):
    return clsas.heights(*lines, grid, search_m=search_m, window_m=window_m)


@cache
def estimated(name, seed, relief=flat):
    """Lines with errors, and the errors that were estimated from the known relief."""
    lines = swaths.banks(relief, seed, **ERRORS[name])
    search_m = (-5.0, 1.0) if name == "one and a half cycles" else (-1.5, 1.5)
    known_m = reliefs.truth(relief, swaths.GRID)
    found = measured(lines, search_m=search_m)
    return lines, clsas.pair_errors(*lines, found, known_height_m=known_m)


def deviations(errors, true):
    """Errors of the estimates in their standard deviations."""
    expected = [true.get(UNITS[name], 0.0) for name in errors.unknowns]
    return (errors.values - expected) / errors.sd


ALSO = few([*((name, 1) for name in ERRORS if name != "all"), ("all", 2)], often=())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("all", 1), *ALSO])
def test_errors_are_recovered_and_removed(name, seed):
    lines, errors = estimated(name, seed)
    assert errors.unknowns == ("phase", "delay", "roll")
    assert np.abs(deviations(errors, ERRORS[name])).max() < 2
    sd = dict(zip(errors.unknowns, errors.sd, strict=True))
    assert sd["phase"] < 0.05
    assert sd["delay"] < CYCLE_S / 100
    assert sd["roll"] < 0.5e-3
    corrected = lines[0], errors.corrected(*lines)
    right = measured(corrected, search_m=(-1.0, 1.0))
    some = right.mask
    assert some.mean() > 0.95
    relative = right.height_m[some] / right.sd_m[some]
    assert abs(relative.mean()) < 0.3
    assert np.sqrt(np.mean(relative**2)) < 1.15


@pytest.mark.exhaustive
def test_deviations_are_honest():
    found = [
        deviations(estimated("all", seed, flat if seed % 2 else dunes)[1], ERRORS["all"])
        for seed in range(1, 9)
    ]
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    # 95 % of the rms values of 8 Gaussian samples lie between 0.52 and 1.48.
    assert np.all(rms > 0.45)
    assert np.all(rms < 1.48)


@pytest.mark.exhaustive
def test_a_second_estimate_finds_inverted_polarity():
    first, second = swaths.banks(flat, 1, phase_rad=np.pi)
    rotation, delay_s = 0.0, 0.0
    for search_m in ((-2.5, 2.5), (-0.8, 0.8)):
        found = measured((first, second), search_m=search_m)
        errors = clsas.pair_errors(
            first, second, found, known_height_m=0.0, unknowns=("phase", "delay")
        )
        second = errors.corrected(first, second)
        rotation, delay_s = rotation + errors.phase_rad, delay_s + errors.delay_s
    sd = dict(zip(errors.unknowns, errors.sd, strict=True))
    assert abs(np.angle(np.exp(1j * (rotation - np.pi)))) < 2 * sd["phase"]
    assert abs(delay_s) < 2 * sd["delay"]
    assert found.mask.mean() > 0.95


@pytest.mark.exhaustive
def test_two_tracks_show_the_errors_without_known_heights():
    true = ERRORS["all"]
    here, there = (swaths.banks(flat, 1, track_y_m=y_m, **true) for y_m in (0.0, -10.0))
    found, other = measured(here), (*there, measured(there))
    errors = clsas.pair_errors(*here, found, other=other)
    assert errors.unknowns == ("phase", "delay", "roll")
    assert np.abs(deviations(errors, true)).max() < 2
    right = measured((here[0], errors.corrected(*here)))
    before_m, after_m = (each.height_m[each.mask] for each in (found, right))
    assert abs(before_m.mean()) > 0.3
    assert abs(after_m.mean()) < 2 * max(errors.height_sd_m) < 0.03


@pytest.mark.exhaustive
def test_tracks_that_mirror_each_other_do_not_show_roll():
    true = {"phase_rad": 0.5}
    here, there = (
        swaths.banks(flat, 1, track_y_m=y_m, heading=heading, **true)
        for y_m, heading in ((0.0, 1), (48.0, -1))
    )
    other = (*there, measured(there))
    with pytest.warns(ClsasWarning, match="roll is not observable here"):
        errors = clsas.pair_errors(*here, measured(here), other=other)
    assert errors.held == ("roll",)
    assert np.abs(deviations(errors, true)).max() < 2
    assert min(np.abs(errors.roll_cost_m)) > 5e-3


@cache
def narrow():
    """Lines of a narrow swath with a phase of 0.5 rad, and their heights."""
    first, second = flat_banks()
    erring = second.weighted(np.full(second.channels, np.exp(0.5j)))
    return first, erring, measured((first, erring), reliefs.GRID, window_m=0.22)


def test_a_narrow_swath_does_not_show_roll():
    first, second, found = narrow()
    with pytest.warns(ClsasWarning, match="roll is not observable here.* 1 mrad of roll adds"):
        errors = clsas.pair_errors(
            first, second, found, known_height_m=0.0, unknowns=("phase", "roll")
        )
    assert errors.unknowns == ("phase",)
    assert errors.held == ("roll",)
    assert abs(errors.phase_rad - 0.5) < 2 * errors.sd[0]
    # 1 mrad of roll takes 1 mm per metre of ground range, less what the phase absorbs.
    near_m, far_m = errors.roll_cost_m
    assert near_m > 0 > far_m
    ground_m = np.sqrt(np.square(errors.range_m) - reliefs.ALTITUDE_M**2)
    absorbed = (1e-3 * ground_m + [near_m, far_m]) / errors.range_m
    assert absorbed[0] == pytest.approx(absorbed[1], rel=1e-3)
    assert "roll held" in errors.describe()
    assert "roll is not observable here" in errors.describe()


def test_roll_may_come_first():
    first, second, found = narrow()
    with pytest.warns(ClsasWarning, match="phase is not observable here, because roll"):
        errors = clsas.pair_errors(
            first, second, found, known_height_m=0.0, unknowns=("roll", "phase")
        )
    assert errors.unknowns == ("roll",)
    # A seabed to port seems lower if the port side is up.
    assert errors.roll_rad == pytest.approx(-0.5 / (2 * np.pi / 0.015 * 0.25 * 0.937), rel=0.1)


def test_phase_and_delay_alone_displace_heights_alike():
    first, second, found = narrow()
    one, other = (
        clsas.pair_errors(first, second, found, known_height_m=0.0, unknowns=(name,))
        for name in ("phase", "delay")
    )
    assert other.delay_s == pytest.approx(-one.phase_rad / (2 * np.pi * 100e3), rel=1e-3)
    assert one.residual_m == pytest.approx(other.residual_m)


def test_phase_and_delay_are_told_apart_by_the_band():
    first, second, found = narrow()
    errors = clsas.pair_errors(
        first, second, found, known_height_m=0.0, unknowns=("phase", "delay")
    )
    assert np.abs(deviations(errors, {"phase_rad": 0.5})).max() < 2.5
    assert errors.sd[0] < 0.1
    assert errors.correlation[0, 1] > 0.9


@pytest.mark.exhaustive
@pytest.mark.parametrize(("known_m", "held"), [(0.0, "delay"), (1.3, "phase")])
def test_a_band_too_narrow_leaves_phase_or_delay_alone(monkeypatch, known_m, held):
    first, second, found = narrow()
    monkeypatch.setattr(pair_errors, "constant_phase", lambda *_: ConstantPhase(0.0, np.inf))
    with pytest.warns(ClsasWarning, match=f"{held} is not observable here, because the band"):
        errors = clsas.pair_errors(
            first, second, found, known_height_m=known_m, unknowns=("phase", "delay")
        )
    # More than half a cycle displaces heights only if it is a delay.
    assert errors.held == (held,)
    assert errors.values[0] > 0


def test_a_single_window_shows_no_slope_over_the_band():
    first, second, found = narrow()
    mask = np.zeros_like(found.mask)
    mask[11:22, 11:22] = True
    pair = Pair(first, second, -40.0, None, None, open_device())
    assert constant_phase(pair, replace(found, mask=mask)).sd_rad == np.inf


def test_heights_of_another_seabed_warn():
    first, second, found = narrow()
    row, _ = np.indices(reliefs.GRID.shape)
    other_m = 0.1 * np.sin(row / 6)
    with pytest.warns(ClsasWarning, match=r"still differ from those expected by 0\.0\d* m rms, "):
        errors = clsas.pair_errors(
            first, second, found, known_height_m=other_m, unknowns=("phase",)
        )
    assert errors.misfit > 5


def test_points_without_a_height_are_reported():
    first, second, found = narrow()
    points_m = [[0, 32, 0], [0, 200, 0], [0.2, 31.5, 0]]
    with pytest.warns(ClsasWarning, match="1 of 3 `points_m` lie where no height is valid"):
        clsas.pair_errors(first, second, found, points_m=points_m, unknowns=("phase",))


@pytest.mark.slow
def test_control_points_and_heights_between_nan():
    first, second, found = narrow()
    x_m, y_m = (each.ravel() for each in np.meshgrid([-0.5, 0.0, 0.5], [31.2, 32.0, 32.8]))
    points_m = np.column_stack([x_m, y_m, 0 * x_m])
    few = clsas.pair_errors(first, second, found, points_m=points_m, unknowns=("phase",))
    assert few.samples == pytest.approx(9, abs=0.5)
    assert abs(few.phase_rad - 0.5) < 2 * few.sd[0]
    known_m = np.full(reliefs.GRID.shape, np.nan)
    known_m[20:61, 20:61] = 0.0
    part = clsas.pair_errors(first, second, found, known_height_m=known_m, unknowns=("phase",))
    whole = clsas.pair_errors(first, second, found, known_height_m=0.0, unknowns=("phase",))
    assert part.samples < 0.5 * whole.samples
    assert whole.sd[0] < part.sd[0] < few.sd[0]
    assert abs(part.phase_rad - 0.5) < 2 * part.sd[0]
    known_m[:] = np.nan
    known_m[41, 50] = 0.0
    single = clsas.pair_errors(first, second, found, known_height_m=known_m, unknowns=("phase",))
    assert single.samples == 1
    uncertain = clsas.pair_errors(
        first, second, found, known_height_m=known_m, unknowns=("phase",), known_sd_m=0.1
    )
    assert uncertain.sd[0] == pytest.approx(0.1 / 0.327, rel=0.05)


@pytest.mark.exhaustive
def test_tilted_planes_and_other_axes():
    first, second, _ = narrow()
    plane = clsas.Grid.oriented([-0.6, 31.0, -0.3], [0, 0.02, 0.002], [0.02, 0, -0.002], (81, 61))
    found = measured((first, second), plane, (-0.5, 0.9), window_m=0.22)
    known_m = -plane.positions_m()[..., 2]  # the seabed lies at z = 0
    errors = clsas.pair_errors(first, second, found, known_height_m=known_m, unknowns=("phase",))
    assert abs(errors.phase_rad - 0.5) < 2 * errors.sd[0]
    points_m = plane.positions_m()[10:71:20, 10:51:20].reshape(-1, 3) * [1, 1, 0]
    few = clsas.pair_errors(first, second, found, points_m=points_m, unknowns=("phase",))
    assert abs(few.phase_rad - 0.5) < 2 * few.sd[0]


@pytest.mark.exhaustive
def test_lines_with_a_profile_of_the_sound_speed():
    random = np.random.default_rng(3)
    places_m = random.uniform([-0.6, 19.2, -10], [0.6, 21.4, -10], (8000, 3))
    scene = clsas.PointTargets(places_m, random.standard_normal((8000, 2)) @ [1, 1j])
    tx_m = np.outer(np.linspace(-2, 2, 81), [1, 0, 0]) + [0, 0, -4]
    profile = clsas.SoundSpeed([0, 6, 9, 40], [1510, 1508, 1498, 1497])
    grid = clsas.Grid.plane((-0.4, 0.4, 33), (19.8, 20.6, 33), z=-10)

    def errors_in(water):
        first, second = (
            clsas.simulate_lines(
                tx_m, tx_m + [0, 0, up_m], scene, carrier_hz=100e3, bandwidth_hz=30e3,
                sound_speed=water,
            )
            for up_m in (0.0, 0.2)
        )  # fmt: skip
        second = second.weighted(np.full(second.channels, np.exp(0.5j)))
        found = measured((first, second), grid, (-0.5, 0.5), None)
        errors = clsas.pair_errors(first, second, found, known_height_m=0.0, unknowns=("phase",))
        return first, second, found, errors

    first, second, found, errors = errors_in(profile)
    assert abs(errors.phase_rad - 0.5) < 0.01
    # Sensitivities are those of straight rays on a level plane, which err by parts in a thousand of
    # 0.5 rad. What is left is the scatter of the same speckle, as in water of one speed.
    *_, straight = errors_in(None)
    assert abs(errors.phase_rad - straight.phase_rad) < 2 * errors.sd[0] < 0.005
    right = measured((first, errors.corrected(first, second)), grid, (-0.5, 0.5), None)
    assert abs(np.nanmean(right.height_m)) < 0.1 * np.nanmean(found.height_m)


def test_outliers_do_not_matter():
    first, second, found = narrow()
    known_m = np.zeros(reliefs.GRID.shape)
    known_m[:, 80:] = -0.4  # a wreck that the chart does not show
    errors = clsas.pair_errors(first, second, found, known_height_m=known_m, unknowns=("phase",))
    assert abs(errors.phase_rad - 0.5) < 2 * errors.sd[0]
    assert errors.misfit < 1.3


def test_corrections_undo_what_errors_do():
    first, second = flat_banks()
    frequency_hz = 100e3 + np.fft.fftfreq(second.length, 1 / 60e3)
    response = np.exp(1j * (0.7 - 2 * np.pi * frequency_hz * 4e-6))
    erring = replace(
        second, samples=np.fft.ifft(np.fft.fft(second.samples) * response).astype(np.complex64)
    )
    errors = result(("phase", "delay"), [0.7, 4e-6])
    grid = clsas.Grid.plane((-0.2, 0.2, 21), (31.8, 32.2, 41))
    images = [
        clsas.backproject(lines, grid, accuracy_db=-60)
        for lines in (second, errors.corrected(first, erring))
    ]
    assert clsas.relative_error_db(images[1], images[0]) < -50


@pytest.mark.parametrize("heading", [1, -1])
def test_roll_lifts_the_port_side(heading):
    along_m = np.outer(heading * np.linspace(-1, 1, 20), [1.0, 0, 0])
    blank = np.zeros((20, 4), complex)
    first = clsas.RangeLines(blank, 10, 0.01, along_m, along_m, 100e3, 1500)
    port_m = [0.0, 0.2 * heading, 0.0]  # at a heading along x, y lies to port
    second = replace(first, rx_m=along_m + port_m + [0.03, 0, 0])
    receivers_m = turned(first, second, 0.1) - along_m
    assert receivers_m[:, 2] == pytest.approx(0.2 * np.sin(0.1))
    assert receivers_m[:, 1] == pytest.approx(0.2 * heading * np.cos(0.1))
    assert receivers_m[:, 0] == pytest.approx(0.03)


def test_results_describe_themselves():
    errors = result(("phase", "delay", "roll"), [0.5, 3.3e-6, 2e-3])
    found = "phase 0.500 ± 0.020 rad, delay 3.300 ± 0.020 µs, roll 2.00 ± 0.20 mrad, residual 4 mm"
    assert repr(errors) == f"PairErrors({found} rms at 120 independent places)"
    assert "3 mm in heights at 17 m" in errors.describe()
    assert errors.figures["sd"][0] == pytest.approx(0.02)
    assert errors.figures["unknowns"] == ["phase", "delay", "roll"]
    both = replace(
        errors, unknowns=("phase", "delay"), values=errors.values[:2],
        covariance=errors.covariance[:2, :2], held=("roll",),
    )  # fmt: skip
    assert "the estimate is of phase and delay alone" in both.describe()


def result(unknowns, values):
    sd = np.array([{"phase": 0.02, "delay": 2e-8, "roll": 2e-4}[name] for name in unknowns])
    return PairErrors(
        unknowns, np.array(values), np.diag(sd**2), (), 4e-3, 1.0, 120.0, (17.0, 38.0),
        (3e-3, 4e-3), (-1e-3, 2e-3),
    )  # fmt: skip


class TestBadInput:
    def refused(self, match, error=ValueError, **given):
        first, second, found = narrow()
        lines = {"a": first, "b": second, "found": found}
        with pytest.raises(error, match=match):
            clsas.pair_errors(**({"known_height_m": 0.0} | lines | given))

    @pytest.mark.slow
    def test_what_is_known(self):
        shape = reliefs.GRID.shape
        self.refused(
            "known_height_m must be given, or one of `points_m` .* only one, got none",
            known_height_m=None,
        )
        self.refused("got `known_height_m` and `points_m`", points_m=[[0, 32, 0]])
        self.refused("got NaN everywhere", known_height_m=np.full(shape, np.nan))
        self.refused("known_height_m must be finite", known_height_m=np.inf)
        self.refused("must be finite and >= -1e.09 and <= 1e.09 m", known_height_m=1e300)
        self.refused(
            "known_height_m must lie within 1e.09 m", known_height_m=np.full(shape, -1e300)
        )
        self.refused(
            r"the shape of the heights, \(121, 81\), got \(3, 4\)", known_height_m=np.zeros((3, 4))
        )
        self.refused("must be a real number or an array", TypeError, known_height_m="deep")
        self.refused("points_m must have shape", known_height_m=None, points_m=[[0, 32]])
        self.refused(
            "no valid height lies at one of `points_m`", known_height_m=None, points_m=[[0, 50, 0]]
        )
        self.refused("known_sd_m must be", known_sd_m=-1)

    def test_heights_too_far_from_those_known(self):
        self.refused("known_height_m must lie close enough to the heights", known_height_m=-30.0)

    def test_heights_of_other_lines(self):
        first, second, found = narrow()
        self.refused(
            "found must be measured from the lines given, in the same order", a=second, b=first
        )
        nothing = replace(found, mask=np.zeros_like(found.mask))
        self.refused("found must have valid heights", found=nothing)
        self.refused("found must be of type Heights", TypeError, found=3)
        self.refused("same pings", b=second.select(slice(1, None)))

    def test_another_track(self):
        first, second, found = narrow()
        self.refused(
            "other must be .a, b, found. of another track", TypeError, known_height_m=None, other=3
        )
        self.refused(
            "other must be .a, b, found.*got 2 entries", known_height_m=None, other=(first, second)
        )
        self.refused(
            "every entry of other must be of type Heights",
            TypeError,
            known_height_m=None,
            other=(first, second, 3),
        )
        self.refused(
            "other: a and b must contain the same pings",
            known_height_m=None,
            other=(first, second.select(slice(1, None)), found),
        )
        aside = replace(found, image=replace(found.image, grid=moved(found.image.grid, 50.0)))
        self.refused(
            "no valid height lies at a place that `other` measured",
            known_height_m=None,
            other=(shifted(first, 50.0), shifted(second, 50.0), aside),
        )
        # From the same track, all errors displace both alike.
        self.refused(
            "unknowns must be observable .* 0.5 rad of phase, got phase with",
            known_height_m=None,
            other=(first, second, found),
        )

    def test_options(self):
        self.refused(
            "unknowns must be one or several of phase, delay, roll, each once", unknowns=()
        )
        self.refused("each once", unknowns=("phase", "phase"))
        self.refused("every entry of unknowns must be one of", unknowns=("pitch",))
        self.refused("tolerance_db must be", tolerance_db=-5)
        self.refused("beam must be of type", TypeError, beam=20)


def moved(grid, aside_m):
    return replace(grid, origin_m=grid.origin_m + [aside_m, 0, 0])


def shifted(lines, aside_m):
    step_m = np.array([aside_m, 0, 0])
    return replace(lines, tx_m=lines.tx_m + step_m, rx_m=lines.rx_m + step_m)
