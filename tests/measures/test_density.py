"""Weights by the density of phase centres: against direct sums and integrals in float64."""

from dataclasses import replace

import numpy as np
import pytest
from factorizing import EXACT_IS_SLOW

import clsas
from clsas.engine.data.system import line_array
from clsas.measures.density import (
    density_compensated,
    density_weights,
    noise_penalty_db,
    usual_spacing_m,
)

CARRIER_HZ, SPEED_M_S = 100e3, 1500.0
WAVELENGTH_M = SPEED_M_S / CARRIER_HZ
SPACING_M = 0.1  # of phase centres
RECEIVERS = 6


def lines_of(tx_m, rx_m, **fields):
    """Return lines with geometry and ones."""
    return clsas.RangeLines(
        np.ones((len(rx_m), 8), np.complex64), 30.0, 0.025, tx_m, rx_m, CARRIER_HZ, SPEED_M_S,
        **fields,
    )  # fmt: skip


def array_lines(pings_m, heading_rad=0.0, **fields):
    """Return lines of an array of six receivers at positions [pings, 3], ping by ping."""
    heading = np.broadcast_to(heading_rad, len(pings_m))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(pings_m))], axis=-1)
    at_m = 2 * SPACING_M * (np.arange(RECEIVERS) - (RECEIVERS - 1) / 2)
    rx_m = np.asarray(pings_m)[:, None] + at_m[:, None] * ahead[:, None]
    tx_m = np.repeat(pings_m, RECEIVERS, axis=0)
    return lines_of(tx_m, rx_m.reshape(-1, 3), **fields)


def straight(advances, jitter_m=0.0, seed=0):
    """Return positions of pings along x, from the advances in spacings of the phase centres."""
    x_m = SPACING_M * np.append(0, np.cumsum(advances))
    x_m = x_m + np.random.default_rng(seed).uniform(-jitter_m, jitter_m, len(x_m))
    return x_m[:, None] * [1.0, 0, 0]


def integrated(along_m, share_m):
    """Weights by integration: every millimetre belongs to the nearest phase centres.

    The ends extend by half a spacing. Phase centres within `share_m` of the nearest one share.
    """
    ends_m = along_m.min() - SPACING_M / 2, along_m.max() + SPACING_M / 2
    steps = round((ends_m[1] - ends_m[0]) / 1e-4)
    places_m = ends_m[0] + (np.arange(steps) + 0.5) * (ends_m[1] - ends_m[0]) / steps
    found = np.zeros(len(along_m))
    for place_m in places_m:
        distance_m = np.abs(along_m - place_m)
        nearest_m = along_m[distance_m.argmin()]
        sharing = np.abs(along_m - nearest_m) <= share_m
        found[sharing] += 1 / sharing.sum()
    return found / found.mean()


def response(lines, weights, offsets_m, target_m=(0.0, 40.0, 0.0)):
    """Amplitude of a target at points along the track, relative to its own; direct sum."""
    wavenumber = 2 * np.pi / WAVELENGTH_M
    points_m = np.array(target_m) + np.outer(offsets_m, [1.0, 0, 0])

    def path_m(points_m):
        return sum(
            np.linalg.norm(np.asarray(points_m)[..., None, :] - antennas_m, axis=-1)
            for antennas_m in (lines.tx_m, lines.rx_m)
        )

    phase = wavenumber * (path_m(points_m) - path_m(target_m))
    return np.abs(np.exp(1j * phase) @ weights) / weights.sum()


def test_even_spacing_changes_nothing():
    pings_m = straight([RECEIVERS] * 40) + [4e5, 5e6, -30.0]  # UTM coordinates
    lines = array_lines(pings_m)
    noise = np.random.default_rng(1).standard_normal((lines.channels, 8, 2)) @ [1, 1j]
    lines = replace(lines, samples=noise.astype(np.complex64))
    weighted = density_compensated(lines)
    np.testing.assert_allclose(density_weights(lines), 1, atol=1e-7)
    np.testing.assert_array_equal(weighted.samples, lines.samples)
    np.testing.assert_array_equal(weighted.rx_m, lines.rx_m)


@pytest.mark.slow
@pytest.mark.parametrize("jitter_m", [0.0, 0.004, 0.02], ids=["even", "slight", "strong"])
def test_against_integration(jitter_m):
    """Two of six phase centres overlap, which are then up to 2 jitters apart."""
    lines = array_lines(straight([RECEIVERS - 2] * 12, jitter_m))
    along_m = lines.phase_centres_m[:, 0]
    # 0.02 m of jitter also makes groups of two that are a little more than a tenth apart.
    expected = integrated(along_m, 0.1 * SPACING_M)
    np.testing.assert_allclose(density_weights(lines), expected, atol=0.06)
    # The sums over a ping's length do not depend on how neighbours share.
    bins = np.floor((along_m - along_m.min() + SPACING_M / 2) / (4 * SPACING_M)).astype(int)
    sums, wanted = (np.bincount(bins, each) for each in (density_weights(lines), expected))
    np.testing.assert_allclose(sums[1:-1], wanted[1:-1], rtol=0.03)


def test_repeated_phase_centres_share():
    weights = density_weights(array_lines(straight([RECEIVERS - 1] * 20)))
    inner = weights.reshape(-1, RECEIVERS)[1:-1]
    np.testing.assert_allclose(inner / inner[0, 2], [[0.5, 1, 1, 1, 1, 0.5]] * 19, atol=1e-9)
    assert weights.mean() == pytest.approx(1)
    assert weights[0] == pytest.approx(weights[2])  # the ends are not repeated
    # One of six channels adds nothing but a second measurement of the same echo.
    assert noise_penalty_db(inner.ravel()) == pytest.approx(10 * np.log10(6 * 4.5 / 25), abs=1e-6)


@pytest.mark.parametrize("overlap", [1, 2, 3])
def test_ghosts_vanish_and_were_predicted(overlap):
    advance = RECEIVERS - overlap
    pings_m = straight([advance] * 60) - [30 * advance * SPACING_M, 0, 0]
    lines = array_lines(pings_m)
    weights = density_weights(lines)
    # The apertures are longer than the lobes are wide by far: no beam, and constant range.
    near = np.abs(lines.phase_centres_m[:, 0]) < 8
    lines = lines.select(near)
    equal, weights = np.ones(near.sum()), weights[near] / weights[near].mean()
    # Lobes of the first orders; that of order `advance` is the grating lobe of the spacing itself.
    orders = np.arange(1, advance)
    sines = WAVELENGTH_M / (2 * advance * SPACING_M) * orders
    at_m = np.tan(np.arcsin(sines)) * 400.0
    target_m = (0.0, 400.0, 0.0)
    taper = np.cos(np.pi * lines.phase_centres_m[:, 0] / 16) ** 2
    lobes = [
        max(response(lines, each * taper, x_m + np.linspace(-1, 1, 81), target_m))
        for each in (equal, weights)
        for x_m in at_m
    ]
    before, after = np.reshape(lobes, (2, -1))
    density = np.ones(advance)
    density[:overlap] += 1  # phase centres at each place
    predicted = np.abs(np.fft.fft(density))[1:] / density.sum()
    some = predicted > 0.05
    np.testing.assert_allclose(before[some], predicted[some], rtol=0.1)
    assert after.max() < 0.01
    # The sum of all orders is that of the docstring.
    total = np.sum(predicted**2)
    assert np.mean(1 / weights) - 1 == pytest.approx(total, rel=0.05)


def test_ghosts_of_a_jittered_track_vanish():
    """Advances that scatter by a tenth of the spacing; then 20 dB remain of what jitter causes."""
    pings_m = straight([RECEIVERS - 1] * 60, jitter_m=0.01) - [15.0, 0, 0]
    lines = array_lines(pings_m)
    taper = np.cos(np.pi * np.clip(lines.phase_centres_m[:, 0] / 32, -0.5, 0.5)) ** 2
    sines = WAVELENGTH_M / (2 * (RECEIVERS - 1) * SPACING_M)
    offsets_m = 400 * np.tan(np.arcsin(sines)) + np.linspace(-1, 1, 81)
    before, after = (
        response(lines, weights * taper, offsets_m, (0.0, 400.0, 0.0)).max()
        for weights in (np.ones(lines.channels), density_weights(lines))
    )
    assert 20 * np.log10(before) == pytest.approx(20 * np.log10(1 / 6), abs=1)
    assert 20 * np.log10(after) < -30


@pytest.mark.parametrize("lost", [1, 3])
def test_lost_pings(lost):
    """The neighbours of a gap weigh 1.5 times as much as others, however long it is."""
    advances = [RECEIVERS] * 10 + [RECEIVERS * (1 + lost)] + [RECEIVERS] * 10
    weights = density_weights(array_lines(straight(advances)))
    relative = weights / np.median(weights)
    beside = 11 * RECEIVERS + np.array([-1, 0])
    np.testing.assert_allclose(relative[beside], 1.5, atol=1e-9)
    np.testing.assert_allclose(np.delete(relative, beside), 1, atol=1e-9)
    assert noise_penalty_db(weights) < 0.03


@pytest.mark.parametrize("gap_m", [1.5, 24.0, 25.5, 60.0, 5000.0])
@pytest.mark.parametrize("scatter_m", [0.0, 1e-4], ids=["exact", "nearly"])
@pytest.mark.parametrize(
    ("receivers", "advance"),
    [(1, 1), (4, 4), (4, 3), (RECEIVERS, 1)],
    ids=["single", "array", "repeated", "crowded"],
)
def test_gaps_of_any_length(gap_m, scatter_m, receivers, advance):
    """Two gaps, longer than the rest or not, also where phase centres coincide."""
    advances = np.full(59, float(advance))
    x_m = straight(advances, scatter_m)
    whole = array_lines(x_m)
    x_m[20:, 0] += gap_m
    x_m[40:, 0] += gap_m
    parted = array_lines(x_m)
    some = np.flatnonzero(np.arange(whole.channels) % RECEIVERS < receivers)
    whole, parted = whole.select(some), parted.select(some)
    before, after = density_weights(whole), density_weights(parted)
    # Pings that the gaps take apart neither share their places with others as before, nor end
    # where they did.
    ping = np.arange(60).repeat(receivers)
    near = -(-receivers // advance)
    apart = (np.abs(ping[:, None] - [19.5, 39.5]) > near + 1).all(axis=1)
    ratio = after[apart] / before[apart]
    np.testing.assert_allclose(ratio / ratio[0], 1, rtol=1e-6)
    # Those beside a gap stand for as much as other pings' places, and half a spacing more.
    beside = after[~apart] / after[apart].max()
    assert beside.max() < 1.51
    assert usual_spacing_m(parted) == pytest.approx(SPACING_M, rel=0.01)
    assert usual_spacing_m(whole) == pytest.approx(SPACING_M, rel=0.01)


def test_spacing_of_stretches_far_apart():
    x_m = 0.3 * np.arange(50)
    x_m = np.append(x_m, x_m + 14.7 + 40)
    lines = lines_of(x_m[:, None] * [1, 0, 0], x_m[:, None] * [1, 0, 0])
    assert usual_spacing_m(lines) == pytest.approx(0.3)
    # Rows along the short side of a raster are farther apart than the pings along them.
    across, along = np.meshgrid(0.01 * np.arange(5), 0.3 * np.arange(30))
    raster_m = np.stack([along.ravel(), across.ravel(), np.zeros(150)], axis=1)
    assert usual_spacing_m(lines_of(raster_m, raster_m)) == pytest.approx(0.3, rel=1e-3)
    assert usual_spacing_m(lines_of(np.zeros((4, 3)), np.zeros((4, 3)))) == 0


def test_much_noise_is_told():
    """Most pings were taken standing still, and share one place."""
    x_m = straight([RECEIVERS] * 100)
    x_m = np.insert(x_m, [50] * 400, x_m[50] + [1e-5, 0, 0], axis=0)
    with pytest.warns(clsas.ClsasWarning, match=r"raise the noise by 6\.9 dB.*still_pings"):
        weights = density_weights(array_lines(x_m))
    assert noise_penalty_db(weights) == pytest.approx(10 * np.log10(501 / 101), abs=0.05)


@pytest.mark.parametrize("radius_m", [30.0, 100.0])
def test_turning_tracks(radius_m):
    """A track that turns by more than a quarter, with an array along its tangent."""
    angle = (RECEIVERS - 1) * SPACING_M / radius_m * np.arange(100)
    pings_m = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=-1)
    weights = density_weights(array_lines(pings_m, angle)).reshape(-1, RECEIVERS)[1:-1]
    np.testing.assert_allclose(weights / weights[0, 2], [[0.5, 1, 1, 1, 1, 0.5]] * 98, atol=2e-3)


def test_speed_and_yaw_may_vary():
    """Twice the advance in the second half, sway, and an array that crabs by 5 degrees."""
    pings_m = straight([3] * 40 + [6] * 20)
    pings_m[:, 1] = 0.1 * np.sin(pings_m[:, 0] / 3)
    weights = density_weights(array_lines(pings_m, np.radians(5)))
    # In the first half two pings share every place.
    assert weights[60:180].mean() / weights[-60:-12].mean() == pytest.approx(0.5, abs=0.01)


def test_pings_standing_still_share():
    pings_m = straight([RECEIVERS] * 9)
    pings_m = np.insert(pings_m, [5] * 4, pings_m[5] + [1e-5, 0, 0], axis=0)
    weights = density_weights(array_lines(pings_m)).reshape(-1, RECEIVERS)
    relative = weights / weights[0, 0]
    np.testing.assert_allclose(relative[5:10], 0.2, atol=1e-3)
    np.testing.assert_allclose(np.delete(relative, range(5, 10), axis=0), 1, atol=1e-3)


def test_every_bank_has_weights_of_its_own():
    lines = array_lines(straight([RECEIVERS - 1] * 20))
    upper = lines.select(np.arange(lines.channels) % RECEIVERS > 0)  # not repeated
    both = lines_of(
        np.concatenate([lines.tx_m, upper.tx_m]),
        np.concatenate([lines.rx_m, upper.rx_m + [0, 0, 0.3]]),
        bank_numbers=[2] * lines.channels + [5] * upper.channels,
    )
    order = np.argsort(np.append(lines.ping_numbers, upper.ping_numbers), kind="stable")
    both = both.select(order)
    weights = density_weights(both)
    np.testing.assert_allclose(weights[both.bank_numbers == 2], density_weights(lines))
    np.testing.assert_allclose(weights[both.bank_numbers == 5], 1, atol=1e-9)
    np.testing.assert_allclose(
        weights[both.bank_numbers == 2].mean(), weights[both.bank_numbers == 5].mean()
    )


def test_what_has_no_track_is_refused():
    elements_m = line_array(16, 1e-3)
    capture = lines_of(np.repeat(elements_m, 16, axis=0), np.tile(elements_m, (16, 1)))
    for stationary in (array_lines(straight([])), array_lines(straight([0] * 5)), capture):
        with pytest.raises(ValueError, match="must come from receivers that move along a track"):
            density_weights(stationary)
    with pytest.raises(ValueError, match=r"along a track, got a single ping$"):
        density_weights(array_lines(straight([])))
    with pytest.raises(ValueError, match=r"6 pings whose receivers move by 0 m in all"):
        density_weights(array_lines(straight([0] * 5)))
    moving, still = array_lines(straight([RECEIVERS] * 4)), array_lines(straight([]))
    numbers = [2] * moving.channels + [7] * still.channels
    both = lines_of(
        np.concatenate([moving.tx_m, still.tx_m]),
        np.concatenate([moving.rx_m, still.rx_m]),
        bank_numbers=numbers,
    )
    with pytest.raises(ValueError, match=r"^lines must .* a single ping\nbank 7$"):
        density_weights(both)
    there_m = straight([RECEIVERS] * 20)
    with pytest.raises(ValueError, match=r"got 11 steps .* ping 2[0-9] .*: sort pings by time"):
        density_weights(array_lines(np.concatenate([there_m, there_m[::-1] + [0, 0.5, 0]])))
    for function in (density_weights, density_compensated):
        with pytest.raises(TypeError, match="lines must be of type RangeLines"):
            function(np.ones(3))


def test_two_receivers_at_one_place():
    """Without any spacing along the track within a ping, only the pings matter."""
    tx_m = np.repeat(straight([1, 1, 1]), 2, axis=0)
    np.testing.assert_allclose(density_weights(lines_of(tx_m, tx_m + [0, 0, 0.1])), 1, atol=1e-9)


@pytest.mark.slow
def test_factorized_images_keep_their_tolerance():
    """The tolerance refers to the exact image of the same weighted lines."""
    sonar = clsas.Sonar(clsas.Pulse(CARRIER_HZ, 30e3, 1e-3), 2 * line_array(RECEIVERS, SPACING_M))
    velocity_m_s = [(RECEIVERS - 1) * SPACING_M / 0.2, 0, 0]
    track = clsas.Track.straight([-15, 0, 0], velocity_m_s, pings=60, ping_interval_s=0.2)
    random = np.random.default_rng(3)
    places_m = random.uniform([-4, 40, 0], [4, 48, 0], (300, 3))
    scene = clsas.PointTargets(places_m, random.standard_normal((300, 2)) @ [1, 1j])
    lines = density_compensated(clsas.compress(clsas.simulate(sonar, track, scene)))
    grid = clsas.Grid.plane((-4, 4, 200), (40, 48, 320))
    exact = clsas.backproject(lines, grid, accuracy_db=-80)
    chosen = clsas.plan(lines, grid, tolerance_db=-50, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    formed = clsas.factorize(lines, grid, chosen)
    assert clsas.relative_error_db(formed, exact) < -50
