import sys

import pytest

from clsas.core.validate import ClsasWarning
from clsas.opencl.device import open_device
from clsas.planning import costs
from clsas.planning.calibration import calibrate
from clsas.planning.costs import Costs

module = sys.modules["clsas.planning.calibration"]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of the user's."""
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path / "cache"))
    return costs.path()


@pytest.fixture
def small(monkeypatch):
    """Images of a few milliseconds."""
    monkeypatch.setattr(module, "_SIZES", ((200, 128), (400, 96)))
    monkeypatch.setattr(module, "_SMALL_SIZES", ((50, 32), (100, 64)))


@pytest.fixture
def disturbed(monkeypatch):
    """A function that changes the times of images."""

    def disturb(change):
        run = module.TimedImage.run

        def changed(image, device):
            run(image, device)
            image.seconds[-1] = change(image, image.seconds[-1])

        monkeypatch.setattr(module.TimedImage, "run", changed)

    return disturb


@pytest.mark.slow
def test_what_is_measured_is_stored(cache, small, monkeypatch):
    # Whatever else this machine does.
    monkeypatch.setattr(module, "_MOST_SCATTER", 100.0)
    monkeypatch.setattr(module, "_MOST_MISFIT", 100.0)
    seen = []
    found = calibrate(progress=lambda *n: seen.append(n))
    assert costs.load(open_device()).costs == found != Costs()
    assert seen == [(done, seen[0][1]) for done in range(1, len(seen) + 1)]
    assert found.pixel_ns > 0
    assert found.leaf_ns > 0
    assert found.sample_ns + found.sample_tap_ns > 0


@pytest.mark.slow
def test_measurements_of_a_busy_machine_are_not_stored(cache, small, disturbed):
    """What else there is to do comes and goes: every other run takes half a second more."""
    disturbed(lambda image, seconds: seconds + 0.5 * (len(image.seconds) % 2))
    before = Costs(pixel_ns=0.123)
    costs.save(open_device(), before)
    with pytest.warns(ClsasWarning, match=r"not stored: times of the same image differ by \d+"):
        found = calibrate()
    assert costs.load(open_device()).costs == before != found


@pytest.mark.slow
def test_times_that_no_costs_explain_are_not_stored(cache, small, disturbed):
    """Small images take a thousand times as long as large ones."""
    names = ("leaf_ns", "leaf_point_ns", "pixel_ns", "point_ns")
    disturbed(lambda image, seconds: 1e6 / sum(image.work(names)))
    with pytest.warns(ClsasWarning, match=r"the costs miss the times measured by \d+"):
        calibrate()
    assert not cache.exists()


def test_what_times_cannot_tell_apart_is_divided_as_usual():
    names = ("batch_ns", "call_ns", "sample_ns")
    usual = Costs(batch_ns=1e5, call_ns=2e7, sample_ns=0.02)
    # Twice as fast as usual; batches go with calls, 100 to one.
    work = [[100.0 * calls, calls, samples] for calls, samples in ((1, 1e8), (2, 3e9), (1, 9e9))]
    seconds = [1e-9 * (100 * 5e4 + 1e7) * row[1] + 1e-9 * 0.01 * row[2] for row in work]
    found = module._least_squares(usual, names, work, seconds)
    assert found == pytest.approx({"batch_ns": 5e4, "call_ns": 1e7, "sample_ns": 0.01}, rel=1e-3)
    # One that is not as usual is found where it matters.
    slow = [s + 1e-9 * 0.03 * row[2] for s, row in zip(seconds, work, strict=True)]
    assert module._least_squares(usual, names, work, slow)["sample_ns"] == pytest.approx(0.04, 0.1)
