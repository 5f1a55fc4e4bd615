import numpy as np
import pytest
from cases import lattice

from clsas.simulation import seabeds
from clsas.simulation.scenes import Seabed


def test_the_wreck_has_hull_wheelhouse_and_mast_with_their_shadows():
    wreck = seabeds.wreck(cell_m=0.2, density_m2=1)
    assert wreck.steps_m == pytest.approx((0.2, 0.2))
    points = lattice(wreck)
    hull = points[wreck.heights_m > 0.5]
    assert np.ptp(hull[:, 0]) == pytest.approx(25 * np.cos(np.radians(14)), abs=2)
    assert wreck.heights_m.max() == 6.5
    lit = wreck.lit(points.reshape(-1, 3), [0, 0, 20]).reshape(points.shape[:2])
    y = points[:, 0, 1]

    def end(x):
        return y[~lit[:, np.argmin(np.abs(points[0, :, 0] - x))]].max()

    # THESIS chapter 6: the mast's shadow reaches far beyond the hull's.
    assert end(0.3) == pytest.approx(60 * 20 / 13.5, abs=1)
    assert 70 < end(5) < 76
    assert 74 < end(-6) < 80
    assert lit[:, np.abs(points[0, :, 0]) > 20].mean() > 0.99
    # Brighter than sand.
    assert wreck.texture[wreck.heights_m > 0.5].min() > 2 * wreck.texture[0].max()


def test_without_a_mast_there_is_still_a_deck():
    bare = seabeds.wreck(cell_m=0.5, density_m2=1, mast_m=0)
    assert bare.heights_m.max() == pytest.approx(4.4)
    assert bare.height_m(0, 60) > 1.5


def test_the_pipeline_and_rocks():
    pipe = seabeds.pipeline(density_m2=1, position_m=(3, 50), heading_deg=0)
    assert pipe.heights_m.max() == pytest.approx(0.6, abs=0.02)
    assert pipe.height_m(3, 50) == pytest.approx(0.6, abs=0.02)
    assert (pipe.heights_m > 0.3).any(axis=0).all()
    boulders = seabeds.rocks(density_m2=1, seed=3)
    assert 1 < boulders.heights_m.max() < 2.5
    assert np.any(boulders.heights_m != seabeds.rocks(density_m2=1, seed=4).heights_m)
    fewer = seabeds.rocks(density_m2=1, seed=3, count=5)
    assert (fewer.heights_m > 0.3).sum() < (boulders.heights_m > 0.3).sum()
    # Sand casts no shadow of its own.
    sand = Seabed(pipe.x_m, pipe.y_m, np.where(pipe.texture > 2, 0, pipe.heights_m))
    points = lattice(sand)
    assert sand.lit(points.reshape(-1, 3), [0, 0, 20]).mean() > 0.995


@pytest.mark.parametrize("make", [seabeds.wreck, seabeds.pipeline, seabeds.rocks])
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"x_m": (5, 5)}, ValueError, r"x_m must be first < last in m, got \(5, 5\)"),
        ({"cell_m": 0}, ValueError, "cell_m must be finite and > 0 and <= 1 m, got 0"),
        ({"cell_m": 1e-9}, ValueError, "cell_m must ask for at most .* GiB"),
        ({"position_m": (0, 300)}, ValueError, "position_m must lie on the patch, x .*, got .*300"),
        ({"position_m": 3}, ValueError, r"position_m must have shape \(2\)"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"density_m2": np.inf}, ValueError, "density_m2 must be finite"),
    ],
)
def test_bad_built_ins(make, arguments, error, message):
    with pytest.raises(error, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (seabeds.wreck, {"mast_m": -1}, "mast_m must be finite and >= 0 and <= 100 m, got -1"),
        (seabeds.wreck, {"heading_deg": np.nan}, "heading_deg must be finite degrees, got nan"),
        (seabeds.rocks, {"count": 0}, "count must be at least 1, got 0"),
    ],
)
def test_bad_details(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_boulders_are_as_many_as_a_field_holds():
    with pytest.raises(ValueError, match="count must be at most 100000, got 1000000000"):
        seabeds.rocks(count=10**9)
