"""Errors if OpenCL cannot be used: forked processes, and caches that PoCL cannot write."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from clsas.core.validate import printable
from clsas.opencl import refusals
from clsas.opencl.device import DeviceError, list_devices, open_device

FORK = """
import os, sys
import numpy as np
import clsas

tx_m = np.stack([0.02 * np.arange(64), np.zeros(64), np.zeros(64)], axis=1)
lines = clsas.RangeLines(np.ones((64, 400), complex), 39.0, 0.01, tx_m, tx_m, 1e5, 1500.0)
grid = clsas.Grid.plane((0, 1, 40), (40, 41, 40))
if sys.argv[1] == "listed":
    clsas.list_devices()
    use = clsas.list_devices
elif sys.argv[1] == "imaged":
    clsas.backproject(lines, grid)
    use = lambda: clsas.backproject(lines, grid)
else:
    pulse = clsas.Pulse(1e5, 3e4, 1e-3)
    pulse.spectrum([0.0])
    use = lambda: print(abs(pulse.spectrum([0.0])[0]) > 0)
child = os.fork()
if not child:
    try:
        use()
    except clsas.DeviceError as error:
        print("DeviceError:", error)
    sys.exit()
sys.exit(os.waitpid(child, 0)[1])
"""


BUILD = """
import clsas
from clsas.opencl.device import open_device

try:
    open_device("pocl").kernel("peak", WIDTH=1, CHAINS=8)
except clsas.DeviceError as error:
    print(error)
"""


def in_a_process(code, *arguments, **environment):
    """Return what a program prints; a program that hangs is stopped."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=os.environ | environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("before", ["listed", "imaged"])
def test_a_process_forked_after_use_is_told_to_be_spawned(before):
    said = in_a_process(FORK, before)
    assert said.count("DeviceError:") == 1
    assert 'multiprocessing.get_context("spawn")' in said


@pytest.mark.slow
def test_pulses_of_forked_processes_do_not_hang():
    assert in_a_process(FORK, "compressed") == "True\n"


def test_no_device_is_used_in_a_forked_process(monkeypatch):
    device = open_device()
    kernel = device.kernel("peak", WIDTH=1, CHAINS=8)
    monkeypatch.setattr(os, "getpid", lambda: -1)
    for use in (
        list_devices,
        device.finish,
        lambda: device.kernel("peak", WIDTH=1, CHAINS=8),
        lambda: device.run(kernel, (1,)),
        lambda: device.buffer(8),
        lambda: device.zeros(8),
        lambda: device.upload(np.ones(3)),
        lambda: device.share(np.ones(3)),
    ):
        with pytest.raises(DeviceError, match="forked after its parent had used it"):
            use()


@pytest.fixture
def no_folder(tmp_path):
    """Return a path at which nobody can create a folder, not even root."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "folder"


def test_a_cache_that_pocl_cannot_write_is_named(monkeypatch, no_folder):
    monkeypatch.setattr(refusals, "_platforms", lambda: [SimpleNamespace(name=refusals.POCL)])
    for variable, value, folder in (
        ("POCL_CACHE_DIR", no_folder, f"{no_folder}"),
        ("POCL_CACHE_DIR", "", ""),
        ("XDG_CACHE_HOME", no_folder, f"{no_folder}/pocl/kcache"),
        ("HOME", no_folder, f"{no_folder}/.cache/pocl/kcache"),
    ):
        with monkeypatch.context() as patch:
            for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
                patch.delenv(name, raising=False)
            patch.setenv(variable, str(value))
            for error in (
                refusals.no_device(),
                refusals.not_built("image.cl", refusals.POCL, ValueError("a log")),
            ):
                assert f"PoCL cannot write its cache folder {folder!r}" in str(error)
                assert "environment variable POCL_CACHE_DIR" in str(error)
                assert "pip install" not in str(error)
            other = refusals.not_built("image.cl", "NVIDIA CUDA", ValueError("a log"))
            assert str(other) == "image.cl:\n  a log"


def test_with_a_cache_the_error_is_another(monkeypatch, tmp_path):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "made" / "anew"))
    assert "pip install" in str(refusals.no_device())
    said = str(refusals.not_built("image.cl", refusals.POCL, ValueError("a log")))
    assert said == "image.cl:\n  a log"


@pytest.mark.slow
@pytest.mark.skipif(
    all(info.platform != refusals.POCL for info in list_devices()), reason="PoCL is not here"
)
def test_a_command_without_a_cache_names_it(no_folder):
    for folder in (str(no_folder), "/dev/null"):
        said = in_a_process(BUILD, POCL_CACHE_DIR=folder, PYOPENCL_NO_CACHE="1")
        assert f"PoCL cannot write its cache folder {folder!r}" in said


def test_the_command_line_prints_the_advice_line_by_line():
    """Line feeds before lines that are not indented would be escaped."""
    assert "\\n" not in printable(str(refusals.no_device()))
