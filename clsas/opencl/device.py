"""Choosing an OpenCL device, building kernels once, and profiling them."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import statistics
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike

from clsas.core import reprs, validate
from clsas.opencl.kernels import Kernel, kernel_parameters, kernel_source, whole_source
from clsas.opencl.refusals import DeviceError, check_process, no_device, no_match, not_built

ENVIRONMENT_VARIABLE = "CLSAS_DEVICE"
KINDS = ("gpu", "cpu", "accelerator")
"""Kinds of device, from the one that is chosen first."""
_PLATFORMS = {"pocl": "portable computing language"}
"""Names of platforms that people use and that are no part of the full one, in lower case."""
_ALIGNMENT = 4096  # bytes: of pages
# Kernels that a device keeps built: up to 0.6 MiB each with PoCL, 4 MiB with Intel's runtime. An
# image takes 1 to 5 of them.
_MOST_KERNELS = 32

_GROUP = 64  # work-items of a GPU's work-groups: two warps, or a wavefront


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device, and how clsas would drive it.

    Attributes
    ----------
    index : int
        Place in `list_devices()`.
    platform, name, driver : str
        As the driver reports them.
    kind : str
        "gpu", "cpu" or "accelerator".
    compute_units : int
        Cores of a CPU, multiprocessors of a GPU.
    memory_bytes, max_buffer_bytes : int
        Global memory and largest single buffer.
    fp64 : bool
        True if the device has double precision (clsas never needs it).
    width : int
        Float lanes per work-item that clsas uses: 1 on GPUs, and where the driver's compiler
        vectorises across work-items itself.
    stage_width : int
        Float lanes per work-item in factorized images.
    permute : bool
        True if kernels may look samples up in registers, of AVX2 or AVX-512.
    """

    index: int
    platform: str
    name: str
    driver: str
    kind: str
    compute_units: int
    memory_bytes: int
    max_buffer_bytes: int
    fp64: bool
    width: int
    stage_width: int
    permute: bool

    __repr__ = reprs.of_fields

    @property
    def half_precision(self) -> bool:
        """True if kernels load and store half-precision numbers as fast as others.

        Of CPUs those do that permute.
        """
        return self.kind == "gpu" or self.permute

    @property
    def label(self) -> str:
        """Platform and name in one string; what a name is matched against."""
        return f"{self.platform}: {self.name}"


@dataclass(frozen=True)
class KernelTimes:
    """How often a kernel ran on the device, and for how long, in seconds."""

    count: int
    minimum_s: float
    median_s: float
    maximum_s: float
    total_s: float


@dataclass(eq=False)
class Device:
    """An opened device: its context, its queues and the kernels built so far.

    Kernels run in order on `queue`; uploads go through `uploads`, beside them. Threads may share
    a device; `profile` then counts what all of them run.
    """

    info: DeviceInfo
    context: cl.Context
    queue: cl.CommandQueue
    uploads: cl.CommandQueue
    # By name and options; the kernel used last is the last one.
    _kernels: dict[tuple, Kernel] = field(default_factory=dict, repr=False)
    _events: list[tuple[str, cl.Event]] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Return the platform and the name."""
        return reprs.summary(self, repr(self.info.label))

    def __reduce__(self) -> tuple[Callable[[DeviceInfo], Device], tuple[DeviceInfo]]:
        """Pickle as what it is called: the process that reads it opens its own device."""
        return _opened_alike, (self.info,)

    # A kernel holds its arguments from when they are set until it is enqueued.
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)

    def for_stages(self) -> Device:
        """Return the device as factorized images drive it: kernels and profile are shared."""
        if self.info.width == self.info.stage_width:
            return self
        return replace(self, info=replace(self.info, width=self.info.stage_width))

    @property
    def build_seconds(self) -> float:
        """Time that the driver took to build the kernels which the device holds.

        Drivers that compile again when a kernel first runs, as PoCL does, take more in all.
        """
        with self._lock:
            return sum(kernel.build_seconds for kernel in self._kernels.values())

    def kernel(self, name: str, **options: int) -> Kernel:
        """Return the kernel of `cl/<name>.cl`, built once per set of options.

        The device keeps the 32 kernels that were used last. A kernel used again after that is
        built again, which is a lookup in the driver's cache on disk.

        Parameters
        ----------
        name : str
            The kernel, which has a file of its own.
        **options : int
            Preprocessor definitions.

        Raises
        ------
        DeviceError
            If the driver's compiler refuses it; the message holds the compiler's log.
        """
        check_process()
        key = (name, *sorted(options.items()))
        with self._lock:
            kernel = self._kernels.pop(key, None) or self._build(name, options)
            self._kernels[key] = kernel
            while len(self._kernels) > _MOST_KERNELS:
                # Runs hold the kernels they use, and the driver those it was given.
                del self._kernels[next(iter(self._kernels))]
            return kernel

    def _build(self, name: str, options: dict[str, int]) -> Kernel:
        definitions = [f"-D{option}={value}" for option, value in sorted(options.items())]
        text = whole_source(f"{name}.cl")
        parameters = kernel_parameters(text, name, options)
        start = time.perf_counter()
        try:
            program = _built(self.context, text, ["-cl-mad-enable", *definitions])
        except cl.RuntimeError as error:
            what = f"{self.info.label} could not build {name}.cl with {' '.join(definitions)}"
            raise not_built(what, self.info.platform, error) from error
        # Not Program.all_kernels: PyOpenCL never releases what that returns.
        compiled = cl.Kernel(program, name)
        return Kernel(name, parameters, compiled, build_seconds=time.perf_counter() - start)

    def run(
        self,
        kernel: Kernel,
        size: tuple[int, ...],
        /,
        *,
        wait_for: Sequence[cl.Event] = (),
        local: tuple[int, ...] | None = None,
        **arguments: Any,
    ) -> cl.Event:
        """Enqueue a kernel over `size` work-items, with an argument for each of its parameters.

        Unless `local` says otherwise, work-items that hold vectors are work-groups of their own
        (PoCL compiles a kernel anew for every local size). On a GPU 64 along the first axis form
        one, which share what a tile or a line needs, or as many as divide the axis. Elsewhere the
        driver chooses.

        Parameters
        ----------
        kernel : Kernel
            From `Device.kernel`.
        size : tuple of int
            Work-items along each axis.
        wait_for : sequence of Event, optional
            What the kernel starts after, beside what is on the queue.
        local : tuple of int, optional
            Work-items of a work-group along each axis.
        **arguments : Buffer, int, float or array
            By the names of the kernel's parameters: a buffer for every pointer; numbers, converted
            to 32 bits; for `float2` to `float4` as many numbers.

        Raises
        ------
        TypeError
            If an argument is missing, unknown, or does not fit its parameter.
        """
        check_process()
        if local is None and self.info.width > 1:
            local = (1,) * len(size)
        elif local is None and self.info.kind == "gpu":
            local = (math.gcd(size[0], _GROUP), *[1] * (len(size) - 1))
        ordered = kernel.ordered(arguments)
        with self._lock:
            event = kernel.compiled(self.queue, size, local, *ordered, wait_for=wait_for)
            if self._events is not None:
                self._events.append((kernel.name, event))
        return event

    def in_whole_groups(self, items: int) -> int:
        """Return a number of work-items, on a GPU with those that fill the last work-group."""
        return -(-items // _GROUP) * _GROUP if self.info.kind == "gpu" else items

    @contextlib.contextmanager
    def profile(self) -> Iterator[dict[str, KernelTimes]]:
        """Time every kernel run within the block; the yielded dict is filled at its end."""
        times: dict[str, KernelTimes] = {}
        self._events = []
        try:
            yield times
            self.finish()
            seconds = defaultdict(list)
            for name, event in self._events:
                seconds[name].append(1e-9 * (event.profile.end - event.profile.start))
            for name, runs in seconds.items():
                times[name] = KernelTimes(
                    len(runs), min(runs), statistics.median(runs), max(runs), sum(runs)
                )
        finally:
            self._events = None

    def finish(self) -> None:
        """Wait until the device has done all it was given."""
        check_process()
        self.uploads.finish()
        self.queue.finish()

    def buffer(self, bytes_: int) -> cl.Buffer:
        """Return a read-write buffer of anything, to be kept until the device is done with it."""
        check_process()
        flags, bytes_ = cl.mem_flags.READ_WRITE, max(int(bytes_), 4)
        if self.info.kind != "cpu":
            return cl.Buffer(self.context, flags, bytes_)
        # NumPy's memory lies in large pages where the system has them: far fewer faults and
        # misses than in a driver's.
        return self.share(aligned(np.empty, (bytes_,), np.uint8))

    def share(self, array: np.ndarray) -> cl.Buffer:
        """Return a buffer that holds an array: on a CPU its own memory, elsewhere a copy.

        Both are to be kept, and the array left alone, until the device is done with them.
        """
        check_process()
        how = cl.mem_flags.USE_HOST_PTR if self.info.kind == "cpu" else cl.mem_flags.COPY_HOST_PTR
        access = cl.mem_flags.READ_WRITE if array.flags.writeable else cl.mem_flags.READ_ONLY
        return cl.Buffer(self.context, access | how, hostbuf=array)

    def upload(self, array: np.ndarray) -> cl.Buffer:
        """Return a buffer that holds a copy of `array`; one of anything where that is empty."""
        check_process()
        if not array.size:
            return self.buffer(0)
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.context, flags, hostbuf=np.ascontiguousarray(array))

    def zeros(self, bytes_: int) -> cl.Buffer:
        """Return a buffer of zeros."""
        if self.info.kind == "cpu":
            return self.share(aligned(np.zeros, (max(int(bytes_), 4),), np.uint8))
        buffer = self.buffer(bytes_)
        cl.enqueue_fill_buffer(self.queue, buffer, np.zeros(1, np.uint32), 0, buffer.size)
        return buffer


def aligned(make: Callable[..., np.ndarray], shape: tuple[int, ...], kind: DTypeLike) -> np.ndarray:
    """Return np.empty or np.zeros of a shape that begins where vectors and pages do."""
    count = math.prod(shape) * np.dtype(kind).itemsize
    memory = make(count + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + count].view(kind).reshape(shape)


def _built(context: cl.Context, text: str, options: Sequence[str] = ()) -> cl.Program:
    """Return a built program."""
    with warnings.catch_warnings():
        # Some drivers' compilers greet; a failure brings its log anyway.
        warnings.simplefilter("ignore", cl.CompilerWarning)
        return cl.Program(context, text).build(list(options))


def _describe(index: int, device: cl.Device) -> DeviceInfo:
    is_cpu = bool(device.type & cl.device_type.CPU)
    is_gpu = bool(device.type & cl.device_type.GPU)
    platform = device.platform.name
    width, permute, stage_width = 1, False, 1
    if is_cpu and platform.startswith("Intel"):
        # Its compiler vectorises exact images across work-items, faster than through explicit
        # vectors. In stages it fails to, and is twelve times as slow as with them.
        lanes = device.native_vector_width_float
        stage_width = lanes if lanes in (8, 16) else 4
    elif is_cpu:
        width, permute = _compiled_vectors(device)
        stage_width = width
    return DeviceInfo(
        index=index,
        platform=platform,
        name=device.name.strip(),
        driver=device.driver_version,
        kind="gpu" if is_gpu else "cpu" if is_cpu else "accelerator",
        compute_units=device.max_compute_units,
        memory_bytes=device.global_mem_size,
        max_buffer_bytes=device.max_mem_alloc_size,
        fp64="cl_khr_fp64" in device.extensions.split(),
        width=width,
        stage_width=stage_width,
        permute=permute,
    )


@functools.cache
def _compiled_vectors(device: cl.Device) -> tuple[int, bool]:
    """Return the floats of a vector as a CPU's compiler has them, and whether it permutes them."""
    try:
        context = cl.Context([device])
        kernel = cl.Kernel(_built(context, kernel_source("vector_size.cl")), "vector_size")
        size = kernel.get_work_group_info(cl.kernel_work_group_info.COMPILE_WORK_GROUP_SIZE, device)
    except cl.Error:  # whatever is wrong is told where there is work to do
        return 4, False
    lanes, permute, _ = size
    return (lanes, permute == 2) if lanes in (8, 16) else (4, False)


def _raw_devices() -> list[cl.Device]:
    check_process()
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader found no driver at all
        return []
    devices = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.RuntimeError:  # a platform without a device
            continue
    return devices


def list_devices() -> list[DeviceInfo]:
    """Return every OpenCL device of every platform; empty when there is none."""
    return [_describe(index, device) for index, device in enumerate(_raw_devices())]


def choose(wish: str | int | None = None) -> tuple[DeviceInfo, str]:
    """Return the device that `wish` names, and why it was chosen.

    Parameters
    ----------
    wish : str or int, optional
        An index of `list_devices()`, a kind ("gpu", "cpu" or "accelerator"), a platform or part
        of its name ("pocl", "intel", "nvidia", "amd"), or a part of "platform: name"; in any case.
        What comes first in this list and matches counts: "intel" is Intel's platform also where
        other platforms drive an Intel CPU. None takes the environment variable CLSAS_DEVICE.
        Of several devices that match, or without a wish, the first GPU is chosen, then the CPU
        with the widest vectors.

    Raises
    ------
    DeviceError
        If there is no device, saying how to get one, or none that fits, naming those there are.
    """
    devices = list_devices()
    if not devices:
        raise no_device()
    source = ""
    if wish is None and os.environ.get(ENVIRONMENT_VARIABLE):
        wish = os.environ[ENVIRONMENT_VARIABLE]
        source = f" by {ENVIRONMENT_VARIABLE}"
    if wish is None:
        chosen = _first(devices)
        if chosen.kind == "gpu":
            return chosen, "the first GPU"
        widest = f" with vectors of {chosen.width}" if chosen.width > 1 else ""
        return chosen, f"the first {chosen.kind.upper()}{widest}; there is no GPU"
    if isinstance(wish, str) and re.fullmatch(r"\s*[0-9]+\s*", wish, re.ASCII):
        wish = int(wish)
    if isinstance(wish, (int, np.integer)) and not isinstance(wish, bool):
        fitting = [info for info in devices if info.index == wish]
    elif isinstance(wish, str):
        fitting = _named(wish.strip().lower(), devices)
    else:
        raise TypeError(f"device must be a name, an index or None, got {validate.shown(wish)}")
    if not fitting:
        have = "; ".join(f"{info.index}: {info.label}" for info in devices)
        raise no_match(f"{validate.shown(wish)}, asked for{source}. Available: {have}", devices)
    return _first(fitting), f"asked for{source} as {wish!r}"


def _first(devices: Sequence[DeviceInfo]) -> DeviceInfo:
    """Return the device that is chosen of several: a GPU, else the CPU of the widest vectors."""
    return min(devices, key=lambda info: (KINDS.index(info.kind), -info.width, info.index))


def _named(name: str, devices: Sequence[DeviceInfo]) -> list[DeviceInfo]:
    """Return the devices of a kind, else of a platform, else those whose label holds a name."""
    if not name:
        return []
    names = name, _PLATFORMS.get(name, name)
    for fits in (
        lambda info: info.kind == name,
        lambda info: any(each in info.platform.lower() for each in names),
        lambda info: any(each in info.label.lower() for each in names),
    ):
        if fitting := [info for info in devices if fits(info)]:
            return fitting
    return []


@functools.cache
def _open(index: int) -> Device:
    device = _raw_devices()[index]
    context = cl.Context([device])
    queue = cl.CommandQueue(context, properties=cl.command_queue_properties.PROFILING_ENABLE)
    info = _describe(index, device)
    return Device(info, context, queue, cl.CommandQueue(context))


def _opened_alike(info: DeviceInfo) -> Device:
    """Return the device of this process that is like another process's: what unpickling does."""
    alike = [each for each in list_devices() if each.label == info.label]
    if not alike:
        known = ", ".join(each.label for each in list_devices())
        raise DeviceError(
            f"the pickled device {info.label!r} is not on this machine, which has: {known}"
        )
    same = [each for each in alike if each.index == info.index] or alike
    return _open(same[0].index)


def open_device(wish: Device | str | int | None = None) -> Device:
    """Return an opened device: `wish` itself, or what `choose` finds; opened once per process."""
    if isinstance(wish, Device):
        return wish
    return _open(choose(wish)[0].index)
