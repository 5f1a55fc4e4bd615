"""The devices that tests run on, and what they allocate there."""

import os
import signal
import sys
import warnings
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import tiers
from variants import DEFAULT, EVERY_VARIANT, OTHERS, OWN, repeated_in, variant

from clsas.engine import promise
from clsas.engine.device.device import Device, list_devices
from clsas.engine.factorized import measured_costs as costs

os.environ["MPLBACKEND"] = "agg"  # before Matplotlib is imported: figures open no windows
_ALL = OWN | OTHERS
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)

# No test fails because a machine is slow.
hypothesis.settings.register_profile("clsas", deadline=None)
hypothesis.settings.load_profile("clsas")


@pytest.fixture(autouse=True, scope="session")
def stored_costs(tmp_path_factory):
    """A cache folder of the tests' own, with default costs stored for every device.

    So plans depend neither on measured times nor on what the user has stored, also in the processes
    that tests start.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CLSAS_CACHE", str(tmp_path_factory.mktemp("cache")))
        if list_devices():
            for way in _ALL.values():
                device = variant(*way)
                costs.save(device, costs.defaults(device))
        yield


@pytest.fixture(autouse=True, scope="session")
def no_clock():
    """Certify images only on request, so that no warning depends on how long an image takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(promise, "LEAST_SECONDS", np.inf)
        yield


@pytest.fixture(autouse=True, scope="session")
def heeded_ctrl_c():
    """Heed Ctrl-C also where a shell started the tests in the background, which ignores it."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def left_as_found():
    """Fail a test that changes what later tests of its process depend on."""
    before = _shared_state()
    yield
    after = _shared_state()
    changed = {name: after[name] for name in after if after[name] != before.get(name, after[name])}
    assert changed == {}, "the test leaves this changed"


_VARIABLES = ("PYTEST_CURRENT_TEST", "PROJ_CURL_CA_BUNDLE", "GDAL_CURL_CA_BUNDLE")
"""Variables that pytest sets, and rasterio when it is imported."""


def _shared_state():
    """State of a process that tests could change, by name."""
    umask = os.umask(0o077)
    os.umask(umask)
    found = {
        "environment": {k: v for k, v in os.environ.items() if k not in _VARIABLES},
        "working directory": os.getcwd(),
        "mask of modes": umask,
        "folders of modules": list(sys.path),
        "handlers of signals": [signal.getsignal(each) for each in _SIGNALS],
        "display of warnings": warnings.showwarning,
        "floating-point errors": np.geterr(),
        "printing of arrays": np.get_printoptions(),
    }
    if matplotlib := sys.modules.get("matplotlib"):
        found["Matplotlib's settings"] = dict.copy(matplotlib.rcParams)  # asks for no backend
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        found["figures"] = pyplot.get_fignums()
    return found


@pytest.fixture(params=OWN.values(), ids=OWN.keys(), scope="session")
def platform(request):
    """Every platform's first device, as it is used."""
    return variant(*request.param)


@pytest.fixture(params=_ALL.values(), ids=_ALL.keys(), scope="session")
def device(request):
    """Every platform's first device, and a CPU also with other vector widths."""
    return variant(*request.param)


@pytest.fixture(scope="session")
def without_grids():
    """PROJ without grids of datum shifts, as its wheel installs it."""
    pyproj = pytest.importorskip("pyproj")
    if pyproj.network.is_network_enabled():
        pytest.skip("PROJ fetches grids")
    folders = [pyproj.datadir.get_user_data_dir(), *pyproj.datadir.get_data_dir().split(os.pathsep)]
    if any(True for folder in folders for _ in Path(folder).glob("*.tif")):
        pytest.skip("PROJ has grids here")


def pytest_sessionstart(session):
    """Say how to repeat the order of tests; pytest-randomly's own line is not shown with -q."""
    seed = session.config.getoption("randomly_seed", None)
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if seed is not None and reporter:  # processes of pytest-xdist have no reporter
        reporter.write_line(f"random order: repeat it with --randomly-seed={seed}")


def pytest_addoption(parser):
    """Let a run choose its tier."""
    tiers.add_options(parser)


def pytest_configure(config):
    """Begin a run in the process that others report to."""
    if not hasattr(config, "workerinput"):
        tiers.begin(config)
        config.pluginmanager.register(_Reporting(config))


class _Reporting:
    """Remembers the tests that passed, and says at the end which ran."""

    def __init__(self, config):
        self.config = config

    def pytest_runtest_logreport(self, report):
        tiers.keep(self.config, report)

    def pytest_terminal_summary(self, terminalreporter):
        terminalreporter.write_line(tiers.summary(self.config))


def pytest_collection_modifyitems(config, items):
    """Leave out other tiers, and cases that are not worth repeating on another device."""
    kept, left_out = [], []
    for item in items:
        name = _device_of(item)
        test = f"{item.path.name}::{item.originalname}"
        if "device" in item.fixturenames and test not in EVERY_VARIANT and name:
            raise pytest.UsageError(f"{test} takes `device`: say in tests/variants.py which cases")
        if name in (None, DEFAULT):
            kept.append(item)
        elif mark := repeated_in(test, item.name, name):
            item.add_marker(mark)
            kept.append(item)
        else:
            left_out.append(item)
    other_tiers = set(tiers.left_out(config, kept))
    config.hook.pytest_deselected(items=[*left_out, *other_tiers])
    items[:] = [item for item in kept if item not in other_tiers]


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
