"""The devices that tests run on, and what they allocate there."""

import hypothesis
import pytest
from variants import DEFAULT, EVERY_VARIANT, OTHERS, OWN, is_repeated, variant

from clsas.opencl.device import Device, list_devices
from clsas.planning import costs

_ALL = OWN | OTHERS

# No test fails because a machine is slow.
hypothesis.settings.register_profile("clsas", deadline=None)
hypothesis.settings.load_profile("clsas")


@pytest.fixture(autouse=True, scope="session")
def stored_costs(tmp_path_factory):
    """A cache folder of the tests' own, with default costs stored for every device.

    So plans depend neither on measured times nor on the user's calibration, also in the processes
    that tests start.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CLSAS_CACHE", str(tmp_path_factory.mktemp("cache")))
        if list_devices():
            for way in _ALL.values():
                device = variant(*way)
                costs.save(device, costs.defaults(device))
        yield


@pytest.fixture(params=OWN.values(), ids=OWN.keys(), scope="session")
def platform(request):
    """Every platform's first device, as it is used."""
    return variant(*request.param)


@pytest.fixture(params=_ALL.values(), ids=_ALL.keys(), scope="session")
def device(request):
    """Every platform's first device, and a CPU also with other vector widths."""
    return variant(*request.param)


def pytest_collection_modifyitems(config, items):
    """Leave out cases that are not worth repeating on another device; repeated ones are slow."""
    kept, left_out = [], []
    for item in items:
        name = _device_of(item)
        test = f"{item.path.name}::{item.originalname}"
        if "device" in item.fixturenames and test not in EVERY_VARIANT and name:
            raise pytest.UsageError(f"{test} takes `device`: say in tests/variants.py which cases")
        if name in (None, DEFAULT):
            kept.append(item)
        elif is_repeated(test, item.name, name):
            item.add_marker(pytest.mark.slow)
            kept.append(item)
        else:
            left_out.append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


def _device_of(item):
    """Name of the device that a test runs on by its fixture `platform` or `device`, or None."""
    parameters = getattr(item, "callspec", None)
    for fixture in ("platform", "device"):
        if parameters and fixture in parameters.params:
            way = parameters.params[fixture]
            return next((name for name, each in _ALL.items() if each == way), None)
    return None


@pytest.fixture
def buffer_bytes(monkeypatch):
    """Sizes of all buffers that are made, as they are."""
    sizes = []

    def recorded(make):
        def made(*args):
            buffer = make(*args)
            sizes.append(buffer.size)
            return buffer

        return made

    for name in ("buffer", "share", "upload", "zeros"):
        monkeypatch.setattr(Device, name, recorded(getattr(Device, name)))
    return sizes
