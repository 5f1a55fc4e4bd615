import dataclasses
import errno
import json

import numpy as np
import pytest
from factorizing import around, over

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import open_device
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.factorized.costs import Costs, KnownCosts
from clsas.engine.imaging import plan


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of the user's."""
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / "cache"))
    return costs.path()


OTHER = Costs(*(float(n + 1) for n in range(len(dataclasses.fields(Costs)))))


def test_what_was_stored_is_loaded(cache, platform):
    assert costs.save(platform, OTHER) == cache
    assert costs.load(platform).costs == OTHER


def test_without_a_file_there_are_defaults(cache, platform):
    assert costs.load(platform) == KnownCosts(costs.defaults(platform), "default")
    assert not cache.exists()


def test_devices_have_costs_of_their_own(cache, platform):
    info = dataclasses.replace(platform.info, driver="another driver")
    other = dataclasses.replace(platform, info=info, _kernels={})
    costs.save(platform, OTHER)
    assert costs.load(other).source == "default"
    costs.save(other, dataclasses.replace(OTHER, pixel_ns=9.0))
    assert costs.load(other).costs.pixel_ns == 9
    assert costs.load(platform).costs == OTHER


@pytest.mark.parametrize("content", ["", "{", "[]", "null", "5", "\x00", '"text"'], ids=repr)
def test_a_broken_file_is_as_good_as_none_and_is_replaced(cache, platform, content):
    cache.parent.mkdir()
    cache.write_text(content)
    with pytest.warns(ClsasWarning, match="costs.json are ignored"):
        assert costs.load(platform) == KnownCosts(costs.defaults(platform), "default")
    costs.save(platform, OTHER)
    assert costs.load(platform).costs == OTHER


def test_a_broken_entry_costs_no_other_device_its_own(cache, platform):
    costs.save(platform, OTHER)
    stored = json.loads(cache.read_text())
    cache.write_text(json.dumps(stored | {"another device": 5}))
    assert costs.load(platform).costs == OTHER
    info = dataclasses.replace(platform.info, driver="a third driver")
    costs.save(dataclasses.replace(platform, info=info, _kernels={}), OTHER)
    assert costs.load(platform).costs == OTHER


@pytest.mark.parametrize(("field", "value"), [("measured", ""), ("source", "given")])
def test_costs_of_no_measurement_are_ignored(cache, platform, field, value):
    costs.save(platform, OTHER)
    stored = json.loads(cache.read_text())
    next(iter(stored.values()))[field] = value
    cache.write_text(json.dumps(stored))
    with pytest.warns(ClsasWarning, match="must be scaled, at a time"):
        assert costs.load(platform).source == "default"


@pytest.mark.parametrize(
    "value", ["x", None, [], "nan", -1.0, "inf", 10**400, -(10**400), 1e300, True]
)
def test_a_broken_number_is_as_good_as_none(cache, platform, value):
    costs.save(platform, OTHER)
    stored = json.loads(cache.read_text())
    next(iter(stored.values()))["costs"]["pixel_ns"] = value
    cache.write_text(json.dumps(stored))
    with pytest.warns(ClsasWarning, match="costs.json are ignored"):
        assert costs.load(platform) == KnownCosts(costs.defaults(platform), "default")


@pytest.mark.parametrize("digit", range(4))
def test_a_flipped_bit_is_noticed(cache, platform, digit):
    costs.save(platform, OTHER)
    content = bytearray(cache.read_bytes())
    content[content.index(b"_ns") + len('_ns": ') + digit // 2] ^= 1 << digit % 2
    cache.write_bytes(content)
    with pytest.warns(ClsasWarning, match="costs.json are ignored"):
        assert costs.load(platform).source == "default"


def test_a_number_too_few_is_as_good_as_none(cache, platform):
    costs.save(platform, OTHER)
    stored = json.loads(cache.read_text())
    del next(iter(stored.values()))["costs"]["sample_ns"]
    cache.write_text(json.dumps(stored))
    with pytest.warns(ClsasWarning, match="costs.json are ignored: 'sample_ns' is missing"):
        assert costs.load(platform) == KnownCosts(costs.defaults(platform), "default")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 10**400, 1e300])
def test_costs_are_finite_and_not_negative(value):
    """So finite that times are, too."""
    for field in dataclasses.fields(Costs):
        with pytest.raises(ValueError, match=f"{field.name} must be finite.*>= 0 .*<= 1e.15"):
            Costs(**{field.name: value})


def test_costs_are_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Costs().pixel_ns = 1.0


def test_a_plan_asks_for_what_is_stored(cache):
    """With an expensive exact image stored, the plan is another."""
    from factorizing import EXACT_IS_SLOW, made, straight

    lines, grid = made(straight)
    assert isinstance(lines, RangeLines)
    costs.save(open_device(), EXACT_IS_SLOW)
    stored = plan(lines, grid, tolerance_db=-40)
    given = plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    origin = {"cost_source": "scaled", "costs_measured": stored.prediction.costs_measured}
    given = dataclasses.replace(given, prediction=dataclasses.replace(given.prediction, **origin))
    assert stored.to_json() == given.to_json()


@pytest.mark.parametrize("beam", [None, BeamWindow(30, "hann")], ids=["all", "beam"])
def test_what_an_exact_image_takes(beam):
    """Something for the call, and more for more channels and pixels, and off the plane."""
    lines, grid = over(around(0, 40, shape=(64, 64)))

    def seconds(lines, grid):
        return plan(lines, grid, stages=[], beam=beam, costs=Costs()).predicted_seconds

    few = seconds(lines.select(slice(290, 310)), grid)
    assert few > 1e-9 * Costs().call_ns
    whole = seconds(lines, grid)
    wide, _ = over(around(0, 40, shape=(256, 256)))
    assert few < whole < seconds(wide, around(0, 40, shape=(256, 256)))
    assert whole < seconds(lines, grid.with_height(np.zeros(grid.shape)))


def test_a_beam_costs_as_much_as_the_given_costs_say():
    lines, grid = over(around(0, 40))
    sees_all = BeamWindow(150, "hann")
    dear, free = (
        plan(lines, grid, stages=[], beam=sees_all, costs=Costs(beam_ns=beam_ns)).predicted_seconds
        for beam_ns in (1.0, 0.0)
    )
    pixels = (dear - free) / 1e-9 / lines.channels
    assert grid.size <= pixels * (1 + 1e-9) <= 192 * 192 * (1 + 1e-6)  # padded to whole tiles


def test_a_full_disk_leaves_what_was_stored(cache, platform, monkeypatch):
    costs.save(platform, OTHER)
    before = cache.read_text()

    def full(path, text):
        path.touch()
        path.open("w").close()  # what a full disk leaves of a file
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    with pytest.raises(OSError, match="No space left"):
        costs.save(platform, costs.defaults(platform))
    assert cache.read_text() == before
