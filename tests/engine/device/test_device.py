import dataclasses
import errno
import functools
import io
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from clsas.engine.data.validate import printable
from clsas.engine.device import device as module
from clsas.engine.device import kernels
from clsas.engine.device.device import (
    ENVIRONMENT_VARIABLE,
    POCL,
    DeviceError,
    choose,
    list_devices,
    open_device,
)
from clsas.engine.device.kernels import Kernel

OPTIONS = {
    "WIDTH": 1,
    "TAPS": 4,
    "TILE_ROWS": 16,
    "TILE_COLUMNS": 16,
    "PERMUTE": 0,
    "WINDOWS": 1,
    "BISTATIC": 0,
    "MOVING": 0,
    "PHASE_TERMS": 6,
}

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
    all(info.platform != POCL for info in list_devices()), reason="PoCL is not here"
)


@pytest.fixture(autouse=True)
def no_wish(monkeypatch):
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)


@pytest.fixture
def nothing(monkeypatch):
    """A machine without any device."""
    monkeypatch.setattr(module, "_raw_devices", list)


def test_every_device_is_described():
    devices = list_devices()
    assert [info.index for info in devices] == list(range(len(devices)))
    for info in devices:
        assert info.label == f"{info.platform}: {info.name}"
        assert info.kind in ("gpu", "cpu", "accelerator")
        assert info.width in ((1, 4, 8, 16) if info.kind == "cpu" else (1,))
        assert not info.permute or info.width in (8, 16)
        assert info.driver
        assert info.compute_units >= 1
        assert 0 < info.max_buffer_bytes <= info.memory_bytes


VECTORS = {
    "AVX-512": ("", (16, True)),
    "AVX2": ("#undef __AVX512F__", (8, True)),
    "AVX": ("#undef __AVX512F__\n#undef __AVX2__", (8, False)),
    "none": ("#undef __AVX512F__\n#undef __AVX2__\n#undef __AVX__", (4, False)),
    "broken": ("#error", (4, False)),
}


@pytest.mark.slow
@pytest.mark.parametrize(("macros", "most"), VECTORS.values(), ids=VECTORS)
def test_vectors_are_no_wider_than_the_compilers(macros, most, monkeypatch):
    before = list_devices()
    of_file = module.kernel_source
    monkeypatch.setattr(module, "kernel_source", lambda name: f"{macros}\n{of_file(name)}")
    module._compiled_vectors.cache_clear()
    try:
        for info, narrow in zip(before, list_devices(), strict=True):
            vectors = info.width, info.permute
            assert (narrow.width, narrow.permute) == min(vectors, most)
    finally:
        module._compiled_vectors.cache_clear()


def test_it_agrees_with_opencl():
    raw = [device for platform in cl.get_platforms() for device in platform.get_devices()]
    for info, device in zip(list_devices(), raw, strict=True):
        assert info.name == device.name.strip()
        assert info.platform == device.platform.name
        assert info.memory_bytes > 0.1 * device.global_mem_size  # PoCL reports free memory


def test_chosen_by_index():
    for info in list_devices():
        for wish in (info.index, str(info.index)):
            chosen, why = choose(wish)
            assert chosen.index == info.index
            assert why == f"requested as {info.index}"


def test_chosen_by_a_part_of_its_name():
    devices = list_devices()
    for info in devices:
        first = next(each for each in devices if each.platform == info.platform)
        for wish in (info.platform, info.platform.upper(), info.platform[1:].lower()):
            assert choose(wish)[0].index == first.index


def several_devices():
    """Return an Intel CPU supported by two platforms, and a GPU."""
    info = list_devices()[0]
    told = (
        ("Portable Computing Language", "pthread-Intel(R) Xeon(R)", "cpu", 16),
        ("Intel(R) OpenCL", "Intel(R) Xeon(R)", "cpu", 1),
        ("NVIDIA CUDA", "NVIDIA H200", "gpu", 1),
        ("NVIDIA CUDA", "NVIDIA H200", "gpu", 1),
    )
    return [
        dataclasses.replace(info, index=i, platform=platform, name=name, kind=kind, width=width)
        for i, (platform, name, kind, width) in enumerate(told)
    ]


@pytest.mark.parametrize(
    ("wish", "index"),
    [("pocl", 0), ("PoCL", 0), ("intel", 1), ("nvidia", 2), ("cpu", 0), ("gpu", 2), ("h200", 2)],
)
def test_chosen_by_kind_and_platform(wish, index, monkeypatch):
    monkeypatch.setattr(module, "list_devices", several_devices)
    assert choose(wish) == (several_devices()[index], f"requested as {wish!r}")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, wish)
    assert choose()[0].index == index


def test_a_kind_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(module, "list_devices", lambda: several_devices()[:2])
    words = "No device matches 'gpu' (`device`). Available: 0: Portable Computing Language: "
    with pytest.raises(DeviceError, match=re.escape(words)):
        choose("gpu")


def test_chosen_by_the_environment(monkeypatch):
    info = list_devices()[-1]
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(info.index))
    chosen, why = choose()
    assert chosen.index == info.index
    assert ENVIRONMENT_VARIABLE in why


def test_a_wish_goes_before_the_environment(monkeypatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "nothing like it")
    assert choose(0)[0].index == 0
    with pytest.raises(DeviceError, match=f"'nothing like it'.*{ENVIRONMENT_VARIABLE}"):
        choose()


def test_the_time_of_building_kernels_is_counted_once(platform):
    device = dataclasses.replace(platform, _kernels={}, _build_times_s=[])
    assert device.build_seconds == 0
    options = {"WIDTH": 1, "BEAM": 0, "BISTATIC": 1, "MOVING": 0}
    device.kernel("expand_tiles", **options)
    first_s = device.build_seconds
    assert first_s > 0
    device.kernel("expand_tiles", **options)
    assert device.build_seconds == first_s


def test_threads_do_not_set_each_others_arguments(platform):
    """Setting the arguments of this kernel is slow, so that threads could interfere."""
    entered, most = 0, 0

    class Slow:
        num_args = 1

        def set_scalar_arg_dtypes(self, kinds):
            pass

        def __call__(self, *args, **kwargs):
            nonlocal entered, most
            entered += 1
            most = max(most, entered)
            time.sleep(0.01)
            entered -= 1

    slow = Kernel("slow", {"n": "int"}, Slow())
    with ThreadPoolExecutor(4) as threads:
        for done in [threads.submit(platform.run, slow, (1,), n=n) for n in range(8)]:
            done.result()
    assert most == 1


def test_gpus_go_before_cpus(monkeypatch):
    info = dataclasses.replace(list_devices()[0], width=1)
    kinds = ("accelerator", "cpu", "gpu", "gpu")
    several = [dataclasses.replace(info, index=i, kind=kind) for i, kind in enumerate(kinds)]
    monkeypatch.setattr(module, "list_devices", lambda: several)
    chosen, why = choose()
    assert (chosen.index, why) == (2, "the first GPU")
    monkeypatch.setattr(module, "list_devices", lambda: several[:2])
    chosen, why = choose()
    assert (chosen.index, why) == (1, "the first CPU; there is no GPU")
    wide = dataclasses.replace(info, index=2, kind="cpu", width=8)
    monkeypatch.setattr(module, "list_devices", lambda: [*several[:2], wide])
    assert choose() == (wide, "the first CPU with vectors of 8; there is no GPU")


@pytest.mark.parametrize("wish", ["no such device", 99, "99", -1, "-1"])
def test_an_unknown_device_names_those_there_are(wish):
    with pytest.raises(DeviceError) as error:
        choose(wish)
    assert repr(wish).strip("'") in str(error.value)
    for info in list_devices():
        assert f"{info.index}: {info.label}" in str(error.value)


@pytest.mark.parametrize("wish", [1.0, True, ["0"], b"0"])
def test_a_wish_of_a_wrong_type_is_refused(wish):
    with pytest.raises(TypeError, match=re.escape(f"a name, an index or None, got {wish!r}")):
        choose(wish)


def test_an_index_may_come_from_numpy():
    assert choose(np.int64(0))[0].index == 0


@pytest.mark.parametrize("wish", [None, 0, "portable"])
def test_no_device_at_all_says_how_to_get_one(nothing, wish):
    assert list_devices() == []
    with pytest.raises(DeviceError) as error:
        open_device(wish)
    for part in ("No OpenCL device", "pip install 'pyopencl[pocl]", "/etc/OpenCL/vendors", ".libs"):
        assert part in str(error.value)


def test_a_loader_without_a_driver_is_no_device(monkeypatch):
    def fail():
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", fail)
    assert list_devices() == []


def test_a_platform_without_a_device_is_passed_over(monkeypatch):
    class Empty:
        def get_devices(self):
            raise cl.RuntimeError("clGetDeviceIDs failed: DEVICE_NOT_FOUND")

    platforms = cl.get_platforms()
    names = [info.label for info in list_devices()]
    monkeypatch.setattr(cl, "get_platforms", lambda: [Empty(), *platforms])
    assert [info.label for info in list_devices()] == names


def test_opened_once():
    device = open_device(0)
    assert open_device("0") is device
    assert open_device(device) is device
    assert open_device(device.info.platform).info.platform == device.info.platform


@pytest.mark.slow
def test_kernels_are_built_once(platform):
    kernel = platform.kernel("backproject_tiles", **OPTIONS)
    assert platform.kernel("backproject_tiles", **OPTIONS) is kernel
    reordered = dict(reversed(OPTIONS.items()))
    assert platform.kernel("backproject_tiles", **reordered) is kernel
    other = platform.kernel("backproject_tiles", **(OPTIONS | {"TAPS": 2}))
    assert other is not kernel


@pytest.mark.slow
def test_nothing_is_built_for_a_kernel_that_is_there(platform, monkeypatch):
    options = OPTIONS | {"TAPS": 6}
    names = ("backproject_tiles", "expand_tiles", "backproject_points")
    built = [platform.kernel(name, **options) for name in names]
    monkeypatch.setattr(cl, "Program", None)  # nothing more may be built
    assert [platform.kernel(name, **options) for name in names] == built


@pytest.mark.slow
def test_only_the_kernels_used_last_are_kept(platform, monkeypatch):
    monkeypatch.setattr(module, "_MOST_KERNELS", 3)
    device = dataclasses.replace(platform, _kernels={}, _build_times_s=[])
    first = device.kernel("peak", WIDTH=1, CHAINS=8)
    for unused in range(5):
        assert device.kernel("peak", WIDTH=1, CHAINS=8) is first  # used again and again
        before_s = device.build_seconds
        device.kernel("peak", WIDTH=1, CHAINS=8, UNUSED=unused)
        # The time of kernels that are no longer kept is not taken back.
        assert device.build_seconds > before_s
    assert len(device._kernels) == 3
    for unused in range(3):
        device.kernel("peak", WIDTH=1, CHAINS=8, UNUSED=unused)
    assert len(device._kernels) == 3
    again = device.kernel("peak", WIDTH=1, CHAINS=8)
    assert again is not first
    assert first.compiled.function_name == again.name  # kernels that a run refers to stay alive


def test_kernels_are_released_with_the_last_that_holds_them(platform):
    """Kernels of Program.all_kernels have an extra reference, and never are released."""
    kernel = platform.kernel("backproject_tiles", **OPTIONS)
    assert kernel.compiled.reference_count == 1


def test_a_failed_build_shows_the_compilers_log(platform, monkeypatch):
    broken = "__kernel void broken(__global float *x) { x[0] = no_such_variable; }"
    monkeypatch.setattr(kernels, "kernel_source", lambda name: broken)
    with pytest.raises(DeviceError) as error:
        platform.kernel("broken", WIDTH=1)
    message = str(error.value)
    assert "no_such_variable" in message
    assert "broken.cl" in message
    assert "-DWIDTH=1" in message
    assert platform.info.label in message


def test_a_profile_counts_and_times_what_runs_within(platform):
    kernel = platform.kernel("peak", WIDTH=platform.info.width, CHAINS=8)
    result = platform.buffer(4 * 64)
    platform.run(kernel, (64,), steps=1, factor=0.5, result=result)
    with platform.profile() as times:
        for steps in (1, 10000, 10000):
            platform.run(kernel, (64,), steps=steps, factor=0.5, result=result)
    peak = times.pop("peak")
    assert peak.count == 3
    assert 0 < peak.minimum_s < peak.median_s <= peak.maximum_s
    assert peak.total_s == pytest.approx(peak.minimum_s + peak.median_s + peak.maximum_s)
    assert not times


def test_factorized_images_are_driven_with_lanes_of_their_own(platform):
    """Kernels and profile are shared, whatever the number of lanes in exact images."""
    other = dataclasses.replace(
        platform, info=dataclasses.replace(platform.info, width=1, stage_width=4, permute=False)
    )
    driven = other.for_stages()
    assert driven.info == dataclasses.replace(other.info, width=4)
    with other.profile() as times:
        peak = other.for_stages().kernel("peak", WIDTH=4, CHAINS=8)
        other.for_stages().run(peak, (4,), steps=8, factor=0.5, result=other.buffer(64))
    assert times["peak"].count == 1
    assert other.kernel("peak", WIDTH=4, CHAINS=8) is peak
    alike = dataclasses.replace(
        platform, info=dataclasses.replace(platform.info, stage_width=platform.info.width)
    )
    assert alike.for_stages() is alike


# Processes and caches with which OpenCL cannot be used.


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
    monkeypatch.setattr(cl, "_PYOPENCL_NO_CACHE", False)

    def prepared(**variables):
        pocl = SimpleNamespace(name=module.POCL, get_devices=list)
        monkeypatch.setattr(module, "_platforms", lambda: [pocl])
        for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME", "CLSAS_CACHE"):
            monkeypatch.setenv(name, str(variables.get(name, "")))
        prepare = functools.cache(module._prepare_caches.__wrapped__)
        monkeypatch.setattr(module, "_prepare_caches", prepare)
        return prepare()

    return prepared


def test_a_cache_that_pocl_cannot_write_is_named(anew, no_folder, monkeypatch):
    device = open_device()
    monkeypatch.setattr(module, "POCL", device.info.platform)
    for variable, folder in (
        ("POCL_CACHE_DIR", no_folder),
        ("POCL_CACHE_DIR", "/dev/null"),
        ("CLSAS_CACHE", no_folder),
    ):
        anew(**{variable: folder})
        for use in (choose, lambda: device.kernel("peak", WIDTH=1, CHAINS=5)):
            with pytest.raises(DeviceError) as caught:
                use()
            assert f"PoCL cannot be used: the cache folder {folder}" in str(caught.value)
            assert f"environment variable {variable}" in str(caught.value)
            assert "pip install" not in str(caught.value)


@pytest.mark.parametrize("wish", ["gpu", "no such device", 99])
def test_a_cache_that_pocl_cannot_write_is_named_beside_other_devices(
    anew, no_folder, monkeypatch, wish
):
    others = [info for info in several_devices() if info.platform == "Intel(R) OpenCL"]
    anew(POCL_CACHE_DIR=no_folder)
    monkeypatch.setattr(module, "list_devices", lambda: others)
    with pytest.raises(
        DeviceError, match=r"Available: 1: Intel.*\. PoCL cannot be used: the cache"
    ):
        choose(wish)


def test_other_platforms_need_no_cache_of_pocl(anew, no_folder, monkeypatch):
    device = open_device()
    anew(POCL_CACHE_DIR=no_folder)
    monkeypatch.setattr(module, "POCL", "not this one")
    assert device.kernel("peak", WIDTH=1, CHAINS=8).name == "peak"


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
    monkeypatch.setattr(cl, "Program", lambda *_: pytest.fail("it was built"))
    monkeypatch.setattr(module, "POCL", device.info.platform)
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
    with pytest.raises(DeviceError, match="pip install"):
        choose()


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
        cl._PYOPENCL_NO_CACHE = False
        anew(XDG_CACHE_HOME=folder, CLSAS_CACHE=tmp_path / "cache")
        assert is_used != cl._PYOPENCL_NO_CACHE
    assert not list(open_folder.iterdir())


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EDQUOT])
def test_pyopencl_uses_no_cache_that_is_full(anew, tmp_path, monkeypatch, full):
    """Its data base would raise an error that names no file."""
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: Disk(full))
    anew(XDG_CACHE_HOME=tmp_path / "caches", CLSAS_CACHE=tmp_path / "cache")
    assert cl._PYOPENCL_NO_CACHE


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


def test_the_command_line_prints_the_advice_line_by_line(nothing):
    """Line feeds before lines that are not indented would be escaped."""
    with pytest.raises(DeviceError) as caught:
        choose()
    assert "\\n" not in printable(str(caught.value))
