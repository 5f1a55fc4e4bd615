"""Imagers: any number of images on one grid."""

import dataclasses
import gc
import warnings
import weakref

import numpy as np
import pytest
from factorizing import BEAMS, EXACT_IS_SLOW, arc, around, hills, made, over, straight, swaying
from tiers import thinned

import clsas
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.factorized import stages
from clsas.engine.forming import form, scene_of_plan
from clsas.engine.imaging import backproject, plan


def planned(lines, grid, beam=None, tolerance_db=-40):
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    return chosen


def with_other_samples(lines, seed=3):
    """Lines of the same geometry and band, of another scene."""
    factor = np.exp(2j * np.pi * np.random.default_rng(seed).random((lines.channels, 1)))
    return dataclasses.replace(lines, samples=lines.samples * factor)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "beam"), thinned([straight, swaying, arc, hills], [None, BEAMS[0]])
)
def test_later_images_are_those_of_new_imagers(scene, beam, platform):
    lines, grid = made(scene)
    chosen = planned(lines, grid, beam)
    imager = clsas.Imager(lines, grid, chosen, device=platform)
    for seed in range(3):
        given = with_other_samples(lines, seed)
        expected = clsas.factorize(given, grid, chosen, device=platform)
        np.testing.assert_array_equal(imager(given).pixels, expected.pixels)


# The narrow beam leaves out the first channels.
@pytest.mark.parametrize(
    ("scene", "beam"), thinned([straight, hills], [None, BeamWindow(5.0, "hann")])
)
def test_later_exact_images_are_those_of_backproject(scene, beam, platform):
    lines, grid = made(scene)
    imager = clsas.Imager(lines, grid, accuracy_db=-50, beam=beam, device=platform)
    assert imager.plan is None
    for seed in range(3):
        given = with_other_samples(lines, seed)
        expected = backproject(given, grid, accuracy_db=-80, beam=beam, device=platform)
        assert relative_error_db(imager(given), expected) <= -50


def test_it_plans():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, tolerance_db=-40)
    assert imager.plan.tolerance_db == -40
    expected = backproject(lines, grid, accuracy_db=-80)
    assert relative_error_db(imager(lines), expected) <= -40


def test_a_plan_from_text_forms_the_same_image():
    lines, grid = made(straight)
    chosen = planned(lines, grid)
    read = clsas.Plan.from_json(chosen.to_json())
    expected = clsas.factorize(lines, grid, chosen)
    np.testing.assert_array_equal(clsas.Imager(lines, grid, read)(lines).pixels, expected.pixels)


@pytest.mark.parametrize("scene", [straight, hills])
def test_geometry_is_found_once(scene, monkeypatch):
    lines, grid = made(scene)
    chosen, found = planned(lines, grid), []
    for name in ("sector_of", "geometry_of", "leaf_groups"):
        real = getattr(stages, name)

        def counted(*arguments, real=real, name=name):
            found.append(name)
            return real(*arguments)

        monkeypatch.setattr(stages, name, counted)
    imager = clsas.Imager(lines, grid, chosen)
    imager(lines)
    first = len(found)
    assert first >= 2
    imager(with_other_samples(lines))
    assert len(found) == first


def test_images_are_added():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, planned(lines, grid))
    once = imager(lines)
    np.testing.assert_array_equal(imager(lines, accumulate=once).pixels, 2 * once.pixels)


def test_progress_is_reported():
    lines, grid = made(straight)
    for request in ({"plan": planned(lines, grid)}, {"accuracy_db": -50}):
        imager = clsas.Imager(lines, grid, **request)
        for _ in range(2):
            reports = []
            imager(lines, progress=lambda *n, reports=reports: reports.append(n))
            assert reports[-1][0] == reports[-1][1]


# Lines whose antennas have moved


def moved(lines, sway_m):
    """Lines whose antennas lie off their track by up to `sway_m`, with the same samples."""
    phase = np.linspace(0, 6 * np.pi, lines.channels)
    offset_m = sway_m * np.stack([0 * phase, np.cos(phase), np.sin(phase)], axis=1)
    return dataclasses.replace(lines, tx_m=lines.tx_m + offset_m, rx_m=lines.rx_m + offset_m)


def test_antennas_may_move_without_another_plan(monkeypatch):
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, planned(lines, grid))
    monkeypatch.setattr("clsas.engine.imaging.planned", None)  # would raise
    for others in (moved(lines, 1e-3), lines.select(np.arange(lines.channels - 5)), lines):
        image = imager(others)
        assert relative_error_db(image, backproject(others, grid, accuracy_db=-80)) <= -40
        assert image.formed.certificate.verdict(-40) != "missed"
        assert imager(with_other_samples(others)).formed.certificate is None  # once is enough
    assert imager(moved(lines, 1e-3), certificate=False).formed.certificate is None


def test_antennas_that_move_far_have_another_plan():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, planned(lines, grid, tolerance_db=-50))
    first, others = imager.plan, moved(lines, 0.5)
    assert relative_error_db(
        imager(others, certificate=False), backproject(others, grid, accuracy_db=-80)
    ) > -45  # fmt: skip
    imager = clsas.Imager(lines, grid, first)
    with pytest.warns(ClsasWarning, match="was formed again"):
        image = imager(others)
    assert imager.plan is not first
    assert relative_error_db(image, backproject(others, grid, accuracy_db=-80)) <= -50


def test_a_miss_that_is_only_told_does_not_count_as_a_check():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, planned(lines, grid, tolerance_db=-50))
    others = moved(lines, 0.5)
    imager(others, certificate=False)
    with pytest.warns(ClsasWarning, match="misses its tolerance"):
        imager(others, on_miss="warn")
    with pytest.raises(clsas.ToleranceError):
        imager(others, on_miss="raise")
    with pytest.warns(ClsasWarning, match="was formed again"):
        image = imager(others)
    assert relative_error_db(image, backproject(others, grid, accuracy_db=-80)) <= -50
    assert imager.plan.tolerance_db == -50  # a plan of their own need not be better
    assert imager(others).formed.certificate is None


def test_antennas_that_a_plan_cannot_take_have_another_one():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, planned(lines, grid))
    one = lines.select([lines.channels // 2])
    assert relative_error_db(imager(one), backproject(one, grid, accuracy_db=-80)) <= -40
    assert relative_error_db(imager(lines), backproject(lines, grid, accuracy_db=-80)) <= -40


def test_exact_images_of_antennas_that_have_moved():
    lines, grid = made(straight)
    imager, others = clsas.Imager(lines, grid, accuracy_db=-50), moved(lines, 0.05)
    imager(lines)
    assert relative_error_db(imager(others), backproject(others, grid, accuracy_db=-80)) <= -50


# What it refuses


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("carrier_hz", 90e3, "carrier_hz of lines must stay within 1% of 120000, got 90000"),
        ("range_step_m", 0.01, "range_step_m of lines must stay within 1% of"),
        ("sound_speed_m_s", 1450.0, "sound_speed_m_s of lines must stay within 1% of 1500, got"),
    ],
)
def test_lines_of_another_band_are_refused(name, value, message):
    lines, grid = made(straight)
    other = dataclasses.replace(lines, **{name: value})
    for request in ({"plan": planned(lines, grid)}, {"accuracy_db": -50}):
        imager = clsas.Imager(lines, grid, **request)
        with pytest.raises(ValueError, match=message):
            imager(other)
        assert imager(lines).pixels.any()  # it still works


def test_it_is_closed_after_a_with_block():
    lines, grid = made(straight)
    with clsas.Imager(lines, grid, planned(lines, grid)) as imager:
        imager(lines)
        kept = weakref.ref(imager._imager)
    gc.collect()
    assert kept() is None
    with pytest.raises(ValueError, match="the imager was closed"):
        imager(lines)


@pytest.mark.parametrize(
    ("request_", "error", "message"),
    [
        (
            {},
            ValueError,
            "plan must be given, or one of `tolerance_db` and `accuracy_db`, and only one, got",
        ),
        ({"tolerance_db": -40, "accuracy_db": -40}, ValueError, "and only one, got None, -40, -40"),
        ({"plan": "a plan"}, TypeError, "plan must be of type Plan"),
        ({"tolerance_db": -90}, ValueError, "tolerance_db must be"),
        ({"accuracy_db": 3}, ValueError, "accuracy_db must be"),
        ({"accuracy_db": -50, "beam": 3}, TypeError, "beam must be"),
        ({"accuracy_db": -50, "device": "no such"}, clsas.DeviceError, "No device matches"),
    ],
)
def test_wrong_requests_are_refused(request_, error, message):
    lines, grid = made(straight)
    with pytest.raises(error, match=message):
        clsas.Imager(lines, grid, **request_)


def test_a_beam_beside_a_plan_is_refused():
    lines, grid = made(straight)
    with pytest.raises(ValueError, match="beam must be left out"):
        clsas.Imager(lines, grid, planned(lines, grid), beam=BEAMS[0])


def test_wrong_lines_and_progress_are_refused():
    lines, grid = made(straight)
    imager = clsas.Imager(lines, grid, accuracy_db=-50)
    with pytest.raises(TypeError, match="lines must be"):
        imager(lines.samples)
    with pytest.raises(TypeError, match="progress must be"):
        imager(lines, progress=3)
    loud = dataclasses.replace(lines, samples=lines.samples * np.float32(1e36))
    with pytest.raises(ValueError, match="samples must be at most"):
        imager(loud)


# What it warns of


def warnings_of(lines, grid, request, formed):
    """Warnings of an imager that is made for lines and forms images of others, in words."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        imager = clsas.Imager(lines, grid, **request)
        for each in formed:
            imager(each)
    return [str(each.message) for each in caught if issubclass(each.category, ClsasWarning)]


def test_it_warns_once_that_nothing_is_reached():
    lines = made(straight)[0]
    away = around(0, 400)
    for request in ({"tolerance_db": -40}, {"accuracy_db": -50}):
        found = warnings_of(lines, away, request, [lines, lines])
        assert len(found) == 1
        assert "no pixel of the grid lies within" in found[0]


@pytest.mark.parametrize("method", ["plan", "accuracy_db"])
def test_it_does_not_warn_of_lines_of_zeros(method):
    lines, grid = made(straight)
    request = {"plan": planned(lines, grid)} if method == "plan" else {"accuracy_db": -50}
    silent = dataclasses.replace(lines, samples=0 * lines.samples)
    assert warnings_of(lines, grid, request, [silent]) == []


@pytest.mark.parametrize("method", ["plan", "accuracy_db"])
def test_it_warns_once_of_another_band(method):
    lines, grid = over(around(0, 40))
    request = {"plan": planned(lines, grid)} if method == "plan" else {"accuracy_db": -50}
    turns = np.exp(2j * np.pi * 0.4 * np.arange(lines.length))
    other = dataclasses.replace(lines, samples=lines.samples * turns)
    found = warnings_of(lines, grid, request, [lines, other, dataclasses.replace(other)])
    assert len(found) == 1
    assert "of their power outside the band" in found[0]


# What forms images


def test_a_plan_forms_images_of_a_track_beside_its_own(platform):
    lines, grid = made(swaying)
    chosen = planned(lines, grid, tolerance_db=-50)
    along = np.linspace(0, 2 * np.pi, lines.channels)
    away_m = 0.01 * np.sin(along)[:, None] * [0.0, 1.0, 0.0]
    moved = dataclasses.replace(lines, tx_m=lines.tx_m + away_m, rx_m=lines.rx_m + away_m)
    with pytest.raises(ValueError, match="lines must have the geometry"):
        chosen.check(moved, grid)
    image = form(scene_of_plan(moved, grid, chosen), chosen, platform)
    ideal = backproject(moved, grid, accuracy_db=-75, device=platform)
    assert relative_error_db(image, ideal) <= chosen.tolerance_db
