import dataclasses
import re
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyopencl as cl
import pytest

from clsas.engine.device import device as module
from clsas.engine.device import kernels
from clsas.engine.device.device import (
    ENVIRONMENT_VARIABLE,
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
    words = (
        "No device matches 'gpu', which was requested. Available: 0: Portable Computing Language: "
    )
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
