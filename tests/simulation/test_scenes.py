import numpy as np
import pytest
from cases import lattice

from clsas.simulation.scenes import Observer, PointTargets, Seabed

EYE = np.array([0.0, 0.0, 10.0])


def flat(**others):
    return Seabed((-5, 5), (20, 30), np.zeros((101, 101)), **others)


def with_box(height=2.0, offset=(0.0, 0.0, 0.0)):
    """A box of 2 m x 1 m on flat ground whose near side is at y = 25 m."""
    x, y = np.meshgrid(np.linspace(-5, 5, 201), np.linspace(20, 40, 401))
    box = (np.abs(x) <= 1.0001) & (np.abs(y - 25.5) <= 0.5001)
    x_m, y_m = np.add((-5, 5), offset[0]), np.add((20, 40), offset[1])
    return Seabed(x_m, y_m, np.where(box, height, 0.0) + offset[2], density_m2=20)


def marched(seabed, points, eye, steps=800):
    """Return whether straight lines of sight clear the heights, by small steps along them."""
    clear = np.ones(len(points), bool)
    # The last step and a half of the lattice on the ground belongs to the point itself.
    ground = np.linalg.norm(points[:, :2] - eye[:2], axis=1)
    end = 1 - 1.5 * max(seabed.steps_m) / ground
    for share in np.linspace(0, 1, steps):
        way = eye + (points - eye) * (share * end)[:, None]
        clear &= ~(way[:, 2] < seabed.height_m(way[:, 0], way[:, 1]))
    return clear


# Shadows


@pytest.mark.parametrize("eye", [(0, 0, 10), (-12, 31, 6), (3, 60, 15), (1.03, 29.02, 7)])
def test_shadows_are_those_of_marched_rays(eye):
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-5, 5, 101), np.linspace(20, 34, 141))
    heights = np.zeros(x.shape)
    for place in random.uniform([-5, 20], [5, 34], (25, 2)):
        bump = random.uniform(0.3, 3) * np.exp(
            -((x - place[0]) ** 2 + (y - place[1]) ** 2) / random.uniform(0.3, 2)
        )
        heights = np.maximum(heights, bump)
    seabed = Seabed((-5, 5), (20, 34), heights)
    points = np.column_stack([random.uniform([-5, 20], [5, 34], (2000, 2)), np.zeros(2000)])
    points[:, 2] = seabed.height_m(points[:, 0], points[:, 1])
    found, expected = seabed.lit(points, eye), marched(seabed, points, np.array(eye, float))
    assert 0.1 < 1 - expected.mean() < 0.7
    # Differences lie only at edges of shadows, and equally often on either side.
    assert np.mean(found != expected) < 0.035
    assert abs(found.mean() - expected.mean()) < 0.007
    apart = points[found != expected]
    turns = np.arange(8) * np.pi / 4
    ring = 0.25 * np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=-1)
    beside = np.clip(apart[:, None] + ring, [-5, 20, -9], [5, 34, 99])
    beside[..., 2] = seabed.height_m(beside[..., 0], beside[..., 1])
    around = marched(seabed, beside.reshape(-1, 3), np.array(eye, float)).reshape(-1, 8)
    assert np.mean(around.all(axis=1) | ~around.any(axis=1)) < 0.1


@pytest.mark.parametrize(
    ("height", "offset"), [(2, (0, 0, 0)), (3, (0, 0, -7)), (1, (4e5, 6e6, 3))]
)
def test_length_and_width_of_the_shadow_of_a_box(height, offset):
    """Behind the far edge of a box at 26 m, it is h R/(H - h) long and widens with range."""
    seabed = with_box(height, offset)
    points = lattice(seabed)
    lit = seabed.lit(points.reshape(-1, 3), EYE + offset).reshape(points.shape[:2])
    y = np.linspace(20, 40, 401)
    x = np.linspace(-5, 5, 201)
    dark = y[~lit[:, 100] & (y > 26.1)]
    assert dark.min() < 26.2
    assert dark.max() == pytest.approx(26 + height * 26 / (10 - height), abs=0.1)
    across = x[~lit[np.searchsorted(y, 27.0)]]
    # The near corners cast the shadow's sides.
    assert across.max() == pytest.approx(27 / 25, abs=0.1)
    assert across.min() == pytest.approx(-27 / 25, abs=0.1)
    assert lit[y < 24.9].all()
    assert lit[:, np.abs(x) > 1.7].all()


def test_a_thin_mast_casts_a_line():
    x, y = np.meshgrid(np.linspace(-5, 5, 101), np.linspace(20, 40, 201))
    mast = (np.abs(x) < 0.16) & (np.abs(y - 25) < 0.16)
    seabed = Seabed((-5, 5), (20, 40), np.where(mast, 3.0, 0.0))
    lit = seabed.lit(lattice(seabed).reshape(-1, 3), EYE).reshape(x.shape)
    end = 25.1 * 10 / 7
    for distance in (26, 30, 35):
        dark = x[0][~lit[np.searchsorted(y[:, 0], distance)]]
        assert 0.2 < np.ptp(dark) < 0.2 + 0.4 * distance / 25
    assert lit[y[:, 0] > end + 0.3].all()


def test_flat_ground_is_lit_and_slopes_that_face_away_are_not():
    assert flat().lit(lattice(flat()).reshape(-1, 3), EYE).all()
    assert not flat().lit([[0, 25, 0]], [0, 0, -1.0]).any()
    y = np.linspace(20, 30, 101)[:, None]
    ridge = Seabed((-5, 5), (20, 30), np.broadcast_to(2 - 0.8 * np.abs(y - 25), (101, 101)))
    positions, _ = ridge.visible(Observer(EYE))
    assert positions[:, 1].max() < 25 + 0.2
    # From straight above both sides are seen.
    positions, _ = ridge.visible(Observer(np.array([0, 25, 20.0])))
    assert positions[:, 1].max() > 29.9


def test_what_is_between_sonar_and_patch_does_not_matter():
    """There is no seabed outside the patch."""
    near = with_box()
    points = np.array([[0.0, 27.0, 0.0], [0.0, 39.0, 0.0]])
    np.testing.assert_array_equal(near.lit(points, EYE), [False, True])
    np.testing.assert_array_equal(near.lit(points, [0, -500, 200]), [False, True])


# Scatterers


def test_scatterers_are_those_of_the_seed():
    first, again, other = flat(seed=4), flat(seed=4), flat(seed=5)
    for one, two in zip(first.visible(Observer(EYE)), again.visible(Observer(EYE)), strict=True):
        np.testing.assert_array_equal(one, two)
    assert first.visible(Observer(EYE))[1].tobytes() != other.visible(Observer(EYE))[1].tobytes()


def test_density_is_per_surface_and_positions_lie_on_it():
    assert flat(density_m2=300).points == pytest.approx(300 * 100, rel=0.02)
    slope = np.broadcast_to(np.sqrt(3) * np.linspace(0, 10, 101)[:, None], (101, 101))
    seabed = Seabed((-5, 5), (20, 30), slope, density_m2=300)
    assert seabed.points == pytest.approx(2 * 300 * 100, rel=0.02)
    positions, _ = seabed.visible(Observer(EYE))
    np.testing.assert_allclose(positions[:, 2], np.sqrt(3) * (positions[:, 1] - 20), atol=1e-9)
    np.testing.assert_allclose(seabed.height_m(*positions.T[:2]), positions[:, 2], atol=1e-9)


@pytest.mark.parametrize("density", [100.0, 900.0])
def test_intensity_is_lambert_whatever_the_density(density):
    texture = np.full((101, 101), 2.0)
    texture[:, 51:] = 0.5
    positions, amplitudes = flat(texture=texture, density_m2=density).visible(Observer(EYE))
    sine = 10 / np.linalg.norm(positions - EYE, axis=1)
    intensity = np.abs(amplitudes) ** 2 / sine**2 * density
    left, right = positions[:, 0] < 0, positions[:, 0] > 0.1
    assert intensity[left].mean() == pytest.approx(4, rel=0.06)
    assert intensity[right].mean() == pytest.approx(0.25, rel=0.06)
    # Circular Gaussian: intensities of contrast one, no preferred phase.
    assert intensity[left].std() / intensity[left].mean() == pytest.approx(1, abs=0.1)
    assert np.abs(np.mean(amplitudes**2)) < 0.05 * np.mean(np.abs(amplitudes) ** 2)


def test_spheres_hold_what_is_seen():
    seabed = with_box()

    def gain(directions, slack):
        return np.where(np.abs(directions[:, 0]) - slack > 0.05, 1e-4, 1.0)

    for observer in (Observer(EYE), Observer(EYE, 0.3, gain)):
        centres, radii = seabed.spheres(observer)
        positions, _ = seabed.visible(observer)
        away = np.linalg.norm(positions[:, None] - centres, axis=-1) - radii
        assert away.min(axis=1).max() < 1e-9
    # No omitted scatterer is in the beam, and most of the others are not far from it.
    everything, _ = seabed.visible(Observer(EYE))
    assert len(positions) < 0.8 * len(everything)
    in_beam = np.abs(everything[:, 0]) < 0.05 * np.linalg.norm(everything - EYE, axis=1)
    kept = {tuple(p) for p in positions}
    assert all(tuple(p) in kept for p in everything[in_beam])
    # With nothing in the beam no point is visible, but there is still a receive window.
    blind = Observer(EYE, 0.0, lambda directions, slack: np.zeros(len(directions)))
    assert len(seabed.visible(blind)[0]) == len(seabed.visible(blind)[1]) == 0
    assert len(seabed.spheres(blind)[0]) > 0


def test_point_targets_are_always_visible():
    targets = PointTargets([[0, 30, 0], [0, -30, 0]], [1, 2])
    for observer in (
        Observer(EYE),
        Observer(EYE, 0.1, lambda directions, slack: np.zeros(len(directions))),
    ):
        positions, amplitudes = targets.visible(observer)
        np.testing.assert_array_equal(positions, targets.positions_m)
        np.testing.assert_array_equal(amplitudes, [1, 2])
        assert not targets.spheres(observer)[1].any()


def test_points_too_far_for_a_phase_are_refused():
    with pytest.raises(
        ValueError, match=r"farthest of positions_m must be .* <= 1e\+09 m, got 1e\+300"
    ):
        PointTargets([[0, 1e300, 0]])


# Bad input

GOOD = {"x_m": (0, 1), "y_m": (20, 21), "heights_m": np.zeros((3, 4))}


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"x_m": (1, 0)}, ValueError, r"x_m must be first < last in m, got \(1, 0\)"),
        ({"y_m": 3}, ValueError, r"y_m must have shape \(2\)"),
        ({"heights_m": np.zeros((1, 4))}, ValueError, "heights_m must have at least 2 rows"),
        ({"heights_m": np.full((3, 4), np.nan)}, ValueError, "heights_m must be finite"),
        ({"heights_m": "flat"}, TypeError, "heights_m must be real numbers"),
        ({"texture": -1.0}, ValueError, "texture must be at least 0, got -1"),
        ({"texture": np.full((3, 4), -1)}, ValueError, "texture must be at least 0, got -1"),
        ({"texture": np.ones((4, 3))}, ValueError, r"texture must have shape \(3, 4\)"),
        ({"density_m2": 0}, ValueError, "density_m2 must be finite and > 0 per m2, got 0"),
        ({"density_m2": 1e15}, ValueError, "density_m2 must ask for at most .* GiB"),
        ({"seed": 0.5}, TypeError, "seed must be a whole number, got 0.5"),
        ({"floor_db": 0}, ValueError, "floor_db must be finite and >= -200 and <= -10 dB, got 0"),
    ],
)
def test_bad_seabeds(arguments, error, message):
    with pytest.raises(error, match=message):
        Seabed(**{**GOOD, **arguments})


def test_a_seabed_without_scatterers():
    with pytest.raises(
        ValueError, match="density_m2 must put at least one scatterer on the seabed"
    ):
        Seabed(**GOOD, density_m2=1e-6).points  # noqa: B018


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points_m": [1, 2, 3]}, r"points_m must have shape \(any, 3\)"),
        ({"eye_m": [1, 2]}, r"eye_m must have shape \(3\)"),
    ],
)
def test_bad_eyes(arguments, message):
    with pytest.raises(ValueError, match=message):
        flat().lit(**{"points_m": [[0, 25, 0]], "eye_m": EYE, **arguments})
