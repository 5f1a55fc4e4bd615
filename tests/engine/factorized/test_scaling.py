import dataclasses
import errno
import itertools
import json

import numpy as np
import pytest
from factorizing import EXACT_IS_SLOW, made, straight

from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import open_device
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.measured_costs import GROUPS, Scale
from clsas.engine.imaging import plan

SAME = Scale(*(1.0 for _ in dataclasses.fields(Scale)))
TWICE = Scale(*(2.0 for _ in dataclasses.fields(Scale)))
REQUEST = {"tolerance_db": -30}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of the user's."""
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / "cache"))
    return costs.path()


@pytest.fixture
def measured(monkeypatch):
    """What measurements return from now on, and the devices that were measured."""

    class Measured(list):
        scale = SAME

    found = Measured()
    monkeypatch.setattr(costs, "measure", lambda device: found.append(device) or found.scale)
    # However small the image is.
    monkeypatch.setattr("clsas.engine.factorized.planner.SEARCH_S", 0.0)
    return found


def scene():
    return made(straight)


def test_the_first_plan_measures_and_later_ones_read_what_it_stored(cache, measured):
    first = plan(*scene(), **REQUEST)
    assert len(measured) == 1
    assert first.prediction.cost_source == "scaled"
    stored = costs.load(open_device())
    assert stored.source == "scaled"
    assert stored.costs == costs.defaults(open_device())
    assert plan(*scene(), **REQUEST).to_json() == first.to_json()
    costs.save(open_device(), EXACT_IS_SLOW)
    assert plan(*scene(), **REQUEST).exact_seconds > 10 * first.exact_seconds
    assert len(measured) == 1


def test_a_device_twice_as_slow_takes_twice_the_time(tmp_path, monkeypatch, measured):
    times = []
    for number, measured.scale in enumerate((SAME, TWICE)):
        monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / str(number)))
        found = plan(*scene(), **REQUEST)
        times.append((found.predicted_seconds, found.exact_seconds))
    assert np.divide(times[1], times[0]) == pytest.approx([2, 2])


def test_every_cost_is_scaled_once():
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(
        field.name for field in dataclasses.fields(Costs)
    )
    assert list(GROUPS) == [field.name for field in dataclasses.fields(Scale)]
    assert SAME.of(EXACT_IS_SLOW) == EXACT_IS_SLOW
    slow_stages = dataclasses.replace(SAME, stages=3.0).of(Costs())
    assert slow_stages.sample_ns == 3 * Costs().sample_ns
    assert slow_stages.leaf_ns == Costs().leaf_ns


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_factors_are_positive(value):
    with pytest.raises(ValueError, match="stages must be"):
        dataclasses.replace(SAME, stages=value)


@pytest.mark.parametrize(
    "request_", [{"stages": []}, {"stages": [(2, 2)]}], ids=["exact", "stages"]
)
def test_plans_without_a_search_measure_nothing(cache, measured, request_):
    assert plan(*scene(), **request_).prediction.cost_source == "default"
    assert not measured
    assert not cache.exists()


def test_nor_do_plans_of_small_images_or_with_given_costs(cache, measured, monkeypatch):
    assert plan(*scene(), **REQUEST, costs=EXACT_IS_SLOW).prediction.cost_source == "given"
    monkeypatch.setattr("clsas.engine.factorized.planner.SEARCH_S", 1e6)
    assert plan(*scene(), **REQUEST).prediction.cost_source == "default"
    assert not measured


def test_another_driver_is_measured_anew(cache, measured):
    device = open_device()
    other = dataclasses.replace(
        device, info=dataclasses.replace(device.info, driver="another"), _kernels={}
    )
    for each in (device, other, device, other):
        plan(*scene(), **REQUEST, device=each)
    assert measured == [device, other]
    keys = {
        costs.key(dataclasses.replace(device.info, **change))
        for change in ({}, {"driver": "x"}, {"name": "x"}, {"compute_units": 99}, {"width": 4})
    }
    assert len(keys) == 5


def test_another_version_of_clsas_measures_anew(cache, measured, monkeypatch):
    plan(*scene(), **REQUEST)
    monkeypatch.setattr(costs, "__version__", "99.0")
    assert costs.load(open_device()).source == "default"


@pytest.mark.parametrize("content", ["", "[]", '{"KEY": {"pixel_ns": 0.5}}', '{"KEY": 5}'])
def test_a_broken_or_foreign_file_is_reported_and_measured_again(cache, measured, content):
    cache.parent.mkdir()
    cache.write_text(content.replace("KEY", costs.key(open_device().info)))
    with pytest.warns(ClsasWarning, match=r"costs stored in .*costs\.json are ignored"):
        found = plan(*scene(), **REQUEST)
    assert found.prediction.cost_source == "scaled"
    assert len(measured) == 1
    assert plan(*scene(), **REQUEST).prediction.cost_source == "scaled"
    assert json.loads(cache.read_text())


def test_costs_of_other_devices_stay(cache, measured):
    cache.parent.mkdir()
    cache.write_text('{"another device": {"of": "a later version"}}')
    plan(*scene(), **REQUEST)
    stored = json.loads(cache.read_text())
    assert stored["another device"] == {"of": "a later version"}
    assert len(stored) == 2


def test_costs_that_cannot_be_stored_are_used_by_this_process(cache, measured, monkeypatch):
    measured.scale = TWICE

    def read_only(*args):
        raise PermissionError(errno.EACCES, "Permission denied", str(cache))

    monkeypatch.setattr(costs, "replacing", read_only)
    with pytest.warns(ClsasWarning, match="cannot be stored, so that every process") as heard:
        found = plan(*scene(), **REQUEST)
    assert len(heard) == 1
    assert found.prediction.cost_source == "scaled"
    again = plan(*scene(), **REQUEST)  # without a warning
    assert again.predicted_seconds == found.predicted_seconds
    assert len(measured) == 1


@pytest.mark.slow
def test_a_device_is_measured(platform):
    """Whatever the machine does meanwhile: factors are within the reach of known devices.

    A CPU's driver that passes for a GPU takes 500 times as long as the GPU of the defaults.
    """
    with platform.profile() as times:
        found = costs.measure(platform)
    assert not times  # of the measurement's own kernels
    assert all(1e-3 < factor < 1e5 for factor in vars(found).values())


def test_images_whose_times_do_not_repeat_are_timed_for_longer(platform, monkeypatch):
    """Runs take 20 ms. Kernels of pixels off the plane take longer from run to run."""
    clock = itertools.count()  # ticks of a microsecond
    runs = {"ExactPrediction": 0, "ExactPrediction off the plane": 0, "Plan": 0}

    def run(image, device):
        for _ in range(20_000):
            next(clock)
        tiled = getattr(image.expected, "tiled", True)  # the planned image lies on a plane
        name = type(image.expected).__name__ + " off the plane" * (not tiled)
        runs[name] += 1
        image.seconds.append(0.02)
        times = dict.fromkeys(("upsample_lines", "stage", "backproject_tiles"), 0.005)
        image.kernels.append(times if tiled else {"backproject_points": 0.01 * runs[name]})

    monkeypatch.setattr(costs.TimedImage, "run", run)
    monkeypatch.setattr(costs.time, "perf_counter", lambda: 1e-6 * next(clock))
    costs.measure(platform)
    assert runs == {
        "ExactPrediction": pytest.approx(6, abs=1),
        "ExactPrediction off the plane": pytest.approx(6 + 15, abs=2),
        "Plan": pytest.approx(6, abs=1),
    }
