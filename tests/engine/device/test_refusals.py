"""Errors if OpenCL cannot be used: forked processes, and caches that are not private."""

import errno
import functools
import io
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl
import pytest

from clsas.engine.data.validate import printable
from clsas.engine.device import refusals
from clsas.engine.device.device import DeviceError, list_devices, open_device

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
from clsas.engine.device.device import open_device

try:
    open_device("pocl").kernel("peak", WIDTH=1, CHAINS=8)
    print("built")
except clsas.DeviceError as error:
    print(error)
"""

needs_pocl = pytest.mark.skipif(
    all(info.platform != refusals.POCL for info in list_devices()), reason="PoCL is not here"
)


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


@pytest.fixture
def anew(monkeypatch):
    """Return a function that prepares the caches as a new process does, with other variables."""
    monkeypatch.setattr(refusals, "_platforms", lambda: [SimpleNamespace(name=refusals.POCL)])
    monkeypatch.setattr(pyopencl, "_PYOPENCL_NO_CACHE", False)

    def prepared(**variables):
        for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME", "CLSAS_CACHE"):
            monkeypatch.setenv(name, str(variables.get(name, "")))
        prepare = functools.cache(refusals.prepare_caches.__wrapped__)
        monkeypatch.setattr(refusals, "prepare_caches", prepare)
        return prepare()

    return prepared


def test_a_cache_that_pocl_cannot_write_is_named(anew, no_folder):
    for variable, folder in (
        ("POCL_CACHE_DIR", no_folder),
        ("POCL_CACHE_DIR", "/dev/null"),
        ("CLSAS_CACHE", no_folder),
    ):
        anew(**{variable: folder})
        with pytest.raises(DeviceError) as caught:
            refusals.check_cache(refusals.POCL)
        for error in (refusals.no_device(), caught.value):
            assert f"PoCL cannot be used: the cache folder {folder}" in str(error)
            assert f"environment variable {variable}" in str(error)
            assert "pip install" not in str(error)
        refusals.check_cache("NVIDIA CUDA")


class Disk(io.BytesIO):
    """A file on a disk with 1 MiB of free space, where PoCL begins a build and LLVM fails."""

    def __init__(self, full):
        super().__init__()
        self.full = full

    def write(self, contents):
        if len(contents) > 1 << 20:
            raise OSError(self.full, os.strerror(self.full))
        return super().write(contents)


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EDQUOT])
def test_a_cache_that_is_full_is_named_before_anything_is_built(anew, tmp_path, monkeypatch, full):
    """LLVM ends the process if it cannot write a kernel."""
    device = open_device()
    assert anew(POCL_CACHE_DIR=tmp_path / "cache") == ""

    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: Disk(full))
    monkeypatch.setattr(pyopencl, "Program", lambda *_: pytest.fail("it was built"))
    monkeypatch.setattr(refusals, "POCL", device.info.platform)
    with pytest.raises(DeviceError, match=r"could not build peak.cl with -D.*: PoCL") as caught:
        device.kernel("peak", WIDTH=1, CHAINS=3)
    said = str(caught.value)
    assert f"PoCL cannot write 4 MiB to its cache folder '{tmp_path / 'cache'}' (" in said
    assert os.strerror(full) in said
    assert "environment variable POCL_CACHE_DIR" in said


def test_a_kernel_that_is_refused_comes_with_the_log_of_the_compiler():
    with pytest.raises(DeviceError, match=r"could not build peak.cl with -Dfloat=3:\n  .*\n"):
        open_device().kernel("peak", float=3)


def test_with_a_cache_the_error_is_another(anew, tmp_path):
    anew(POCL_CACHE_DIR=tmp_path / "made" / "anew")
    assert "pip install" in str(refusals.no_device())
    refusals.check_cache(refusals.POCL)


def test_pocl_keeps_kernels_in_the_cache_folder_unless_another_is_named(
    anew, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for variables, folder in (
        ({"CLSAS_CACHE": tmp_path / "a"}, tmp_path / "a" / "kernels"),
        ({"CLSAS_CACHE": tmp_path / "a", "POCL_CACHE_DIR": tmp_path / "b"}, tmp_path / "b"),
        ({"POCL_CACHE_DIR": "relative"}, tmp_path / "relative"),
    ):
        assert anew(**variables) == ""
        assert os.environ["POCL_CACHE_DIR"] == str(folder)
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_pyopencl_uses_its_cache_only_if_it_is_private(anew, open_folder, tmp_path):
    (tmp_path / "own").mkdir(0o700)
    for folder, is_used in ((open_folder, False), (tmp_path / "own", True)):
        pyopencl._PYOPENCL_NO_CACHE = False
        anew(XDG_CACHE_HOME=folder, CLSAS_CACHE=tmp_path / "cache")
        assert is_used != pyopencl._PYOPENCL_NO_CACHE
    assert not list(open_folder.iterdir())


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EDQUOT])
def test_pyopencl_uses_no_cache_that_is_full(anew, tmp_path, monkeypatch, full):
    """Its data base would raise an error that names no file."""
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: Disk(full))
    anew(XDG_CACHE_HOME=tmp_path / "caches", CLSAS_CACHE=tmp_path / "cache")
    assert pyopencl._PYOPENCL_NO_CACHE


ACCOUNT = 4242  # has no entry in the list of users


@pytest.fixture
def open_folder():
    """A folder in which everybody can replace what others have written."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)
        if not all(each.stat().st_mode & stat.S_IXOTH for each in Path(folder).parents):
            pytest.skip("others cannot reach the folder of temporary files")
        yield Path(folder)


@pytest.fixture
def as_account(open_folder):
    """Return a function that builds a kernel as another user, without HOME, and its output."""
    become = [
        *("setpriv", f"--reuid={ACCOUNT}", f"--regid={ACCOUNT}", "--clear-groups"),
        *("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"),  # to read the package
    ]
    if (
        not shutil.which("setpriv")
        or subprocess.run([*become, "true"], capture_output=True).returncode
    ):
        pytest.skip("cannot become another user")

    def formed(**variables):
        done = subprocess.run(
            [*become, sys.executable, "-c", BUILD],
            env={"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)} | variables,
            cwd=open_folder, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    return formed


@needs_pocl
@pytest.mark.slow
def test_an_account_without_a_home_needs_one_variable(as_account, open_folder):
    own = open_folder / "own"
    own.mkdir()
    open_folder.chmod(0o1777)
    os.chown(own, ACCOUNT, ACCOUNT)
    own.chmod(0o755)
    said = as_account()
    assert "PoCL cannot be used: the cache folder ~/.cache/clsas" in said
    assert "set the environment variable CLSAS_CACHE" in said
    assert as_account(CLSAS_CACHE=str(own)) == "built\n"
    assert list((own / "kernels").iterdir())
    assert as_account(POCL_CACHE_DIR=str(own / "pocl")) == "built\n"
    assert list((own / "pocl").iterdir())


@needs_pocl
@pytest.mark.slow
@pytest.mark.parametrize("variable", ["POCL_CACHE_DIR", "CLSAS_CACHE", "XDG_CACHE_HOME", "HOME"])
def test_kernels_of_a_folder_that_others_can_write_to_are_not_loaded(
    as_account, open_folder, variable
):
    said = as_account(**{variable: str(open_folder)})
    assert f"PoCL cannot be used: the cache folder {open_folder}" in said
    assert f"other users can write to {open_folder}" in said
    assert not list(open_folder.iterdir())


@needs_pocl
@pytest.mark.slow
def test_a_command_without_a_cache_names_it(no_folder):
    for folder in (str(no_folder), "/dev/null"):
        said = in_a_process(BUILD, POCL_CACHE_DIR=folder, PYOPENCL_NO_CACHE="1")
        assert f"PoCL cannot be used: the cache folder {folder}" in said


def test_the_command_line_prints_the_advice_line_by_line():
    """Line feeds before lines that are not indented would be escaped."""
    assert "\\n" not in printable(str(refusals.no_device()))
