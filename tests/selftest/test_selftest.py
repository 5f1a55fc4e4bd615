"""The self-test that users run on their devices."""

import json
import math

import pytest
from click.testing import CliRunner

from clsas.cli import main
from clsas.engine.device.device import DeviceError
from clsas.selftest import accuracy


@pytest.fixture
def small(monkeypatch):
    """Run one exact and one factorized image, without variants of the device."""
    monkeypatch.setattr(accuracy, "other_builds", lambda info: [])
    monkeypatch.setattr(
        accuracy, "_CHECKS", (("flat", "exact", -60.0), ("flat", "factorized", -40.0))
    )


@pytest.mark.exhaustive
def test_every_image_is_within_its_bound(platform, monkeypatch):
    """With the default vectors and with one lane; other tests cover the other builds."""
    monkeypatch.setattr(accuracy, "_BUILDS", ((1, False),))
    told = []
    results = accuracy.run(platform, progress=lambda *done: told.append(done))
    assert [result for result in results if not result.passed] == []
    assert told == [(done, len(results)) for done in range(len(results) + 1)]
    for imager in ("exact", "factorized", "half precision", "mosaic", "wavenumber"):
        assert any(result.case.endswith(f", {imager}") for result in results)


@pytest.mark.exhaustive
def test_other_builds_for_a_device_are_tested_too(platform, monkeypatch):
    """One lane forms every image whose imager runs kernels, other widths form two."""
    checks = (("bistatic", "exact", -60.0), ("flat", "wavenumber", None))
    monkeypatch.setattr(accuracy, "_CHECKS", checks)
    monkeypatch.setattr(accuracy, "other_builds", lambda info: [(1, False), (4, False)])
    device = accuracy.driven(platform, 8, False)
    results = accuracy.run(device)
    assert [result.case for result in results] == [
        "bistatic, exact", "flat, wavenumber", "bistatic, exact, width 1", "flat, exact, width 4",
        "flat, factorized, width 4",
    ]  # fmt: skip
    assert all(result.passed for result in results)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the band of the lines wraps")  # sampled far below its carrier
def test_plans_of_the_scenes_are_factorized(platform):
    """Otherwise the factorized imager would not be tested."""
    for scene, imager, asked_db in accuracy._CHECKS:
        if imager == "factorized":
            known = accuracy._SCENES[scene]()
            assert not accuracy.divided_plan(known, asked_db, platform).is_exact, scene


def test_a_result_that_is_no_number_has_not_passed():
    assert not accuracy.Result("", -60, math.nan, -60).passed
    assert not accuracy.Result("", -60, -59.9, -60).passed
    assert not accuracy.Result("", -60, None, -60, "RuntimeError: no").passed
    assert accuracy.Result("", None, -60.0, -60).passed


def test_the_command_prints_a_table(small):
    result = CliRunner().invoke(main, ["selftest"])
    assert result.exit_code == 0
    assert "flat, exact" in result.stdout
    assert "2 of 2 within bounds" in result.stdout


@pytest.mark.slow
def test_a_miss_is_told_and_is_exit_code_1(small, monkeypatch):
    monkeypatch.setattr(accuracy, "form", _doubled)
    result = CliRunner().invoke(main, ["selftest", "--json"])
    assert result.exit_code == 1
    found = json.loads(result.stdout)
    assert not found["passed"]
    assert [each["verdict"] for each in found["results"]] == ["MISSED", "ok"]
    assert found["results"][0]["measured_db"] == pytest.approx(0, abs=0.1)


def test_an_image_that_cannot_be_formed_is_told_and_the_others_follow(small, monkeypatch):
    monkeypatch.setattr(accuracy, "form", _broken)
    result = CliRunner().invoke(main, ["selftest"])
    assert result.exit_code == 1
    (line,) = (line for line in result.stdout.splitlines() if "flat, exact" in line)
    assert line.split() == [
        "-60", "-", "-60", "FAILED", "flat,", "exact:", "DeviceError:", "out", "of", "lanes",
    ]  # fmt: skip
    assert "1 of 2 within bounds" in result.stdout
    found = json.loads(CliRunner().invoke(main, ["selftest", "--json"]).stdout)
    assert [each["verdict"] for each in found["results"]] == ["FAILED", "ok"]
    assert found["results"][0]["measured_db"] is None
    assert found["results"][0]["failure"] == "DeviceError: out of lanes"


FORM = accuracy.form


def _broken(imager, *given):
    if imager == "exact":
        raise DeviceError("out of lanes")
    return FORM(imager, *given)


def _doubled(imager, *given):
    image = FORM(imager, *given)
    return type(image)((2 if imager == "exact" else 1) * image.pixels, image.grid)
