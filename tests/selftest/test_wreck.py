"""The wreck's scene: the cache of its range lines, and the contrast of its shadow."""

import numpy as np
import pytest

import clsas
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.selftest import bench, cases, wreck


@pytest.fixture(scope="module")
def shadow():
    return wreck.Shadow(wreck.scene())


@pytest.mark.slow
def test_shadow_lies_behind_the_wreck(shadow):
    ground, dark, light = shadow.masks
    assert not (dark & light).any()
    assert dark.sum() > 1000
    assert light.sum() > 5 * dark.sum()
    # The wreck lies about (0, 60); its mast and hull throw shadows away from the track.
    assert np.abs(ground[dark, 0]).max() < 14
    assert ground[dark, 1].min() > 57
    assert 72 < ground[dark, 1].max() < 82


@pytest.mark.slow
def test_contrast_is_that_of_the_masks(shadow):
    grid = wreck.grid(256)
    ground, dark, _ = shadow.masks
    pixels = np.ones(grid.shape, np.complex64)
    x_m, y_m = grid.axes_m
    column = np.rint((ground[dark, 0] - x_m[0]) / (x_m[1] - x_m[0])).astype(int)
    row = np.rint((ground[dark, 1] - y_m[0]) / (y_m[1] - y_m[0])).astype(int)
    pixels[row, column] = 0.1j
    # Some pixels at the edge of the shadow belong to it.
    assert shadow.contrast_db(Image(pixels, grid)) == pytest.approx(20, abs=0.2)


def few_lines():
    """Replace the simulation, which takes minutes, by noise."""
    tx_m = np.zeros((120, 3))
    tx_m[:, 0] = np.linspace(-20, 20, 120)
    tx_m[:, 2] = 20
    random = np.random.default_rng(0)
    samples = random.standard_normal((120, 1300, 2)) @ np.array([1, 1j])
    return RangeLines(samples, 35.0, 0.05, tx_m, tx_m, 125e3, 1500.0)


def test_lines_are_simulated_once(monkeypatch, tmp_path):
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / "cache"))
    asked = []
    monkeypatch.setattr(wreck, "simulate", lambda *_, **__: asked.append(1))
    monkeypatch.setattr(wreck, "compress", lambda *_, **__: few_lines())
    first, second = wreck.lines(), wreck.lines()
    assert asked == [1]
    np.testing.assert_array_equal(first.samples, second.samples)
    (kept,) = (tmp_path / "cache").iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])  # a damaged file is replaced
    wreck.lines()
    assert asked == [1, 1]


@pytest.mark.watches("clsas/selftest")
def test_benchmark(monkeypatch):
    monkeypatch.setattr(wreck, "lines", lambda progress=None: few_lines())
    monkeypatch.setitem(cases.MOSAIC_CASES, "small", (128, BeamWindow(5.0, "hann")))
    result = bench.run_mosaic("small", repeats=1)
    assert result["case"] == "small"
    assert result["pixels"] == [128, 128]
    assert result["error_db"] <= result["predicted_error_db"] <= -40
    assert abs(result["shadow_contrast_difference_db"]) < 0.2
    assert 0 < result["share_seen"] < 0.2
    for speedup, name in (
        ("speedup", "exact_seconds"),
        ("speedup_unlimited", "unlimited_seconds"),
        ("speedup_over_default", "default_unlimited_seconds"),
    ):
        ratio = result[name]["median"] / result["seconds"]["median"]
        assert ratio > 0
        assert result[speedup] == pytest.approx(ratio)


@pytest.mark.slow
def test_the_scene_of_two_banks_keeps_every_limit():
    """Each bank alone, with the baseline that the scene states."""
    scene = wreck.scene("wreck_two_banks")
    sonar, track, grid = scene.need("sonar", "track", "grid")
    assert sonar.banks == 2
    beam, range_m = scene.image["beam"], scene.simulate["range_m"]
    found = clsas.limits(sonar, track, grid, beam=beam, range_m=range_m)
    assert found.exceeded == ()
    assert found["baseline_m"].value == pytest.approx(20 * sonar.wavelength_m)
    assert found["ambiguity_near_m"].value < 3.5 < found["ambiguity_far_m"].value
