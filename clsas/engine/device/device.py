"""OpenCL devices: choosing and opening one, and running kernels on it.

Errors say what is missing: a driver, a private cache for PoCL, or a process that was not forked.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import statistics
import tempfile
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike

from clsas.engine.data import reprs, validate
from clsas.engine.data.cache import made_private, private_folder, user_caches
from clsas.engine.data.extras import install_command
from clsas.engine.data.validate import ArgumentTypeError
from clsas.engine.device.kernels import Kernel, kernel_parameters, kernel_source, whole_source

ENVIRONMENT_VARIABLE = "CLSAS_DEVICE"
KINDS = ("gpu", "cpu", "accelerator")
"""Kinds of device, in the order in which they are preferred."""
POCL = "Portable Computing Language"
"""Name of PoCL's platform."""
_PLATFORMS = {"pocl": POCL.lower()}
"""Common names of platforms that are not part of the full name, in lower case."""

_HOW_TO_GET_A_DEVICE = """\
No OpenCL device was found. Any one of the following provides one:
  - a CPU driver from PyPI:  {command}
  - the vendor's driver of your GPU or CPU, which installs an .icd file in /etc/OpenCL/vendors;
    PyOpenCL's wheel looks there and in {folder}
    (copy or write an .icd file there if the driver is part of your Python environment:
    it is one line, the path of the driver's shared library).
  The environment variable OCL_ICD_VENDORS, if it is set, replaces these folders."""

_POCL_VARIABLE = "POCL_CACHE_DIR"
# Space that PoCL needs to build a kernel. Those of an image took up to 1.2 MiB at a time, most of
# which PoCL frees again. If less is left, LLVM ends the process.
_KERNEL_BYTES = 4 << 20
# Built kernels that a device keeps. They take up to 0.6 MiB each with PoCL, and up to 4 MiB with
# Intel's runtime. An image uses 1 to 5 kernels.
_MOST_KERNELS = 32
_ALIGNMENT = 4096  # bytes: size of a page
_GROUP = 64  # work-items of a work-group on a GPU: two warps, or a wavefront


class DeviceError(RuntimeError):
    """Error if no OpenCL device matches, a kernel cannot be built, or the process was forked."""


@dataclass(frozen=True)
class DeviceInfo:
    """Properties of an OpenCL device, and the way in which clsas uses it.

    Attributes
    ----------
    index : int
        Position in `list_devices()`.
    platform, name, driver : str
        Platform, name and driver version, as reported by the driver.
    kind : str
        "gpu", "cpu" or "accelerator".
    compute_units : int
        Number of cores of a CPU, or of multiprocessors of a GPU.
    memory_bytes, max_buffer_bytes : int
        Size of the global memory and of the largest single buffer.
    fp64 : bool
        True if the device has double precision, which clsas does not need.
    width : int
        Float lanes per work-item that clsas uses. It is 1 on GPUs, and on CPUs whose compiler
        vectorises across work-items.
    stage_width : int
        Float lanes per work-item in factorized images.
    permute : bool
        True if kernels may look up samples in registers of AVX2 or AVX-512.
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
        """True if kernels load and store half-precision numbers as fast as single precision.

        Among CPUs, those with `permute` do.
        """
        return self.kind == "gpu" or self.permute

    @property
    def usable_bytes(self) -> int:
        """Memory that an image may use: half, as other programs and drivers need some, too."""
        return self.memory_bytes // 2

    @property
    def label(self) -> str:
        """Platform and name in one string, with which the names that users give are compared."""
        return f"{self.platform}: {self.name}"


@dataclass(frozen=True)
class KernelTimes:
    """Number of runs of a kernel on the device, and their times in seconds."""

    count: int
    minimum_s: float
    median_s: float
    maximum_s: float
    total_s: float


def open_device(request: Device | str | int | None = None) -> Device:
    """Return `request` if it is an open device, or else the device that `choose` returns.

    Every device is opened once per process.
    """
    if isinstance(request, Device):
        return request
    return _open(choose(request)[0].index)


def choose(request: str | int | None = None) -> tuple[DeviceInfo, str]:
    """Return the device that a request names, and the reason for the choice.

    Parameters
    ----------
    request : str or int, optional
        An index of `list_devices()`, a kind ("gpu", "cpu" or "accelerator"), a platform or part of
        its name ("pocl", "intel", "nvidia", "amd"), or part of "platform: name". Upper and lower
        case are the same. The first of these that matches is used, so that "intel" is Intel's
        platform even if other platforms also support the Intel CPU. By default the environment
        variable CLSAS_DEVICE is the request. If several devices match, or there is no request, the
        first GPU is chosen, or else the CPU with the widest vectors.

    Raises
    ------
    DeviceError
        If there is no device, or none that matches. The message says how to get a device, or lists
        the available ones.
    """
    devices = list_devices()
    if not devices:
        if why := _why_without_pocl(devices):
            raise DeviceError(f"No OpenCL device was found: {why}")
        folder, command = Path(cl.__file__).parent / ".libs", install_command("pocl")
        raise DeviceError(_HOW_TO_GET_A_DEVICE.format(folder=folder, command=command))
    source = ""
    if request is None and os.environ.get(ENVIRONMENT_VARIABLE):
        request = os.environ[ENVIRONMENT_VARIABLE]
        source = f" by {ENVIRONMENT_VARIABLE}"
    if request is None:
        chosen = _first(devices)
        if chosen.kind == "gpu":
            return chosen, "the first GPU"
        widest = f" with vectors of {chosen.width}" if chosen.width > 1 else ""
        others = ". ".join(filter(None, ("there is no GPU", _prepare_caches())))
        return chosen, f"the first {chosen.kind.upper()}{widest}; {others}"
    if isinstance(request, str) and re.fullmatch(r"\s*[0-9]+\s*", request, re.ASCII):
        request = int(request)
    if isinstance(request, (int, np.integer)) and not isinstance(request, bool):
        matching = [info for info in devices if info.index == request]
    elif isinstance(request, str):
        matching = _named(request.strip().lower(), devices)
    else:
        given = validate.shown(request)
        raise ArgumentTypeError("device", "be a name, an index or None", given)
    if not matching:
        have = "; ".join(f"{info.index}: {info.label}" for info in devices)
        why = _why_without_pocl(devices)
        asked = f", which was requested{source}" if source else " (`device`)"
        raise DeviceError(
            f"No device matches {validate.shown(request)}{asked}. "
            f"Available: {have}{why and f'. {why}'}"
        )
    return _first(matching), f"requested{source} as {request!r}"


def _first(devices: Sequence[DeviceInfo]) -> DeviceInfo:
    """Return the preferred device of several: a GPU, or else the CPU with the widest vectors."""
    return min(devices, key=lambda info: (KINDS.index(info.kind), -info.width, info.index))


def _named(name: str, devices: Sequence[DeviceInfo]) -> list[DeviceInfo]:
    """Return the devices of a kind, or else of a platform, or else with a name in their label."""
    if not name:
        return []
    names = name, _PLATFORMS.get(name, name)
    for matches in (
        lambda info: info.kind == name,
        lambda info: any(each in info.platform.lower() for each in names),
        lambda info: any(each in info.label.lower() for each in names),
    ):
        if matching := [info for info in devices if matches(info)]:
            return matching
    return []


def _why_without_pocl(devices: Sequence[DeviceInfo]) -> str:
    """Return why PoCL has no device although it is installed; "" if it has one, or is not."""
    if any(info.platform == POCL for info in devices):
        return ""
    return _pocl_problem() if any(each.name == POCL for each in _platforms()) else ""


def list_devices() -> list[DeviceInfo]:
    """Return all OpenCL devices of all platforms.

    Returns
    -------
    list of DeviceInfo
        Empty if there is no device.

    Raises
    ------
    DeviceError
        In a process that was forked after its parent had used OpenCL.

    Examples
    --------
    >>> import clsas
    >>> for device in clsas.list_devices():
    ...     print(device.index, device.label)  # doctest: +SKIP
    0 Portable Computing Language: pthread-AMD EPYC 7763 64-Core Processor
    """
    return [_describe(index, device) for index, device in enumerate(_raw_devices())]


def _raw_devices() -> list[cl.Device]:
    _check_process()
    no_pocl = _prepare_caches()
    devices = []
    for platform in _platforms():
        if no_pocl and platform.name == POCL:
            continue
        try:
            devices += platform.get_devices()
        except cl.RuntimeError:  # a platform without a device
            continue
    return devices


def _platforms() -> list[cl.Platform]:
    try:
        return cl.get_platforms()
    except cl.LogicError:  # the loader found no driver at all
        return []


def _describe(index: int, device: cl.Device) -> DeviceInfo:
    is_cpu = bool(device.type & cl.device_type.CPU)
    is_gpu = bool(device.type & cl.device_type.GPU)
    platform = device.platform.name
    width, permute, stage_width = 1, False, 1
    if is_cpu and platform.startswith("Intel"):
        # Intel's compiler vectorises exact images across work-items, which is faster than explicit
        # vectors. It fails to do so in stages, which are then twelve times as slow as with explicit
        # vectors.
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
    """Return the number of floats in a vector of a CPU, and whether its compiler permutes them."""
    try:
        context = cl.Context([device])
        kernel = cl.Kernel(_built(context, kernel_source("vector_size.cl")), "vector_size")
        size = kernel.get_work_group_info(cl.kernel_work_group_info.COMPILE_WORK_GROUP_SIZE, device)
    except (cl.Error, DeviceError):  # the error is reported when a kernel is built for an image
        return 4, False
    lanes, permute, _ = size
    return (lanes, permute == 2) if lanes in (8, 16) else (4, False)


@functools.cache
def _open(index: int) -> Device:
    device = _raw_devices()[index]
    context = cl.Context([device])
    queue = cl.CommandQueue(context, properties=cl.command_queue_properties.PROFILING_ENABLE)
    info = _describe(index, device)
    return Device(info, context, queue, cl.CommandQueue(context))


def _opened_alike(info: DeviceInfo) -> Device:
    """Return the device of this process that matches a description, to unpickle a device."""
    alike = [each for each in list_devices() if each.label == info.label]
    if not alike:
        known = ", ".join(each.label for each in list_devices())
        raise DeviceError(
            f"the pickled device {info.label!r} is not on this machine, which has: {known}"
        )
    same = [each for each in alike if each.index == info.index] or alike
    return _open(same[0].index)


@dataclass(eq=False)
class Device:
    """Open device: its context, its queues and the kernels built so far.

    Kernels run in order on `queue`. Uploads run beside them on `uploads`. Threads may share a
    device; `profile` then counts the kernels of all threads.
    """

    info: DeviceInfo
    context: cl.Context
    queue: cl.CommandQueue
    uploads: cl.CommandQueue
    # By name and options. The kernel that was used last comes last.
    _kernels: dict[tuple, Kernel] = field(default_factory=dict, repr=False)
    _build_times_s: list[float] = field(default_factory=list, repr=False)
    _events: list[tuple[str, cl.Event]] | None = field(default=None, repr=False)
    # Held from when the arguments of a kernel are set until it is enqueued, because the kernel
    # stores them.
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)

    def __repr__(self) -> str:
        """Return the platform and the name."""
        return reprs.summary(self, repr(self.info.label))

    def __reduce__(self) -> tuple[Callable[[DeviceInfo], Device], tuple[DeviceInfo]]:
        """Pickle the description only. The process that unpickles it opens its own device."""
        return _opened_alike, (self.info,)

    def for_stages(self) -> Device:
        """Return the device with the width of factorized images; kernels and profile are shared."""
        if self.info.width == self.info.stage_width:
            return self
        return replace(self, info=replace(self.info, width=self.info.stage_width))

    @property
    def build_seconds(self) -> float:
        """Time that the driver has taken to build kernels, seconds.

        Drivers such as PoCL compile again when a kernel first runs. That time is not included.
        """
        return math.fsum(self._build_times_s)

    def kernel(self, name: str, **options: int) -> Kernel:
        """Return the kernel of `cl/<name>.cl`, built once per set of options.

        The device keeps the 32 kernels that were used last. Others are built again when they are
        needed, which takes only a lookup in the driver's cache on disk.

        Parameters
        ----------
        name : str
            Name of the kernel and of its file.
        **options : int
            Preprocessor definitions.

        Raises
        ------
        DeviceError
            If the driver's compiler refuses the kernel. The message contains the compiler's log.
        """
        _check_process()
        key = (name, *sorted(options.items()))
        with self._lock:
            kernel = self._kernels.pop(key, None) or self._build(name, options)
            self._kernels[key] = kernel
            while len(self._kernels) > _MOST_KERNELS:
                # Runs keep references to the kernels they use, and the driver to those enqueued.
                del self._kernels[next(iter(self._kernels))]
            return kernel

    def _build(self, name: str, options: dict[str, int]) -> Kernel:
        definitions = [f"-D{option}={value}" for option, value in sorted(options.items())]
        text = whole_source(f"{name}.cl")
        parameters = kernel_parameters(text, name, options)
        start = time.perf_counter()
        what = f"{self.info.label} could not build {name}.cl with {' '.join(definitions)}"
        try:
            program = _built(self.context, text, ["-cl-mad-enable", *definitions])
        except DeviceError as error:
            raise DeviceError(f"{what}: {error}") from error
        except cl.RuntimeError as error:
            log = indent(str(error), "  ", lambda line: True)
            raise DeviceError(f"{what}:\n{log}") from error
        # Program.all_kernels is avoided, because PyOpenCL never releases the kernels it returns.
        compiled = cl.Kernel(program, name)
        self._build_times_s.append(time.perf_counter() - start)
        return Kernel(name, parameters, compiled)

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

        Unless `local` is given, every work-item with several lanes is a work-group of its own,
        because PoCL compiles a kernel again for every local size. On a GPU, 64 work-items along the
        first axis form a work-group and share the data of a tile or a line. If 64 does not divide
        the axis, the largest common divisor is taken. Otherwise the driver chooses.

        Parameters
        ----------
        kernel : Kernel
            From `Device.kernel`.
        size : tuple of int
            Work-items along each axis.
        wait_for : sequence of Event, optional
            Events after which the kernel starts, in addition to those on the queue.
        local : tuple of int, optional
            Work-items of a work-group along each axis.
        **arguments : Buffer, int, float or array
            Arguments by the names of the kernel's parameters: a buffer for every pointer, numbers,
            which are converted to 32 bits, and 2 to 4 numbers for `float2` to `float4`.

        Raises
        ------
        TypeError
            If an argument is missing, unknown, or does not fit its parameter.
        """
        _check_process()
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
        """Return a number of work-items, rounded up to whole work-groups on a GPU."""
        return -(-items // _GROUP) * _GROUP if self.info.kind == "gpu" else items

    @contextlib.contextmanager
    def profile(self) -> Iterator[dict[str, KernelTimes]]:
        """Time every kernel run within the block. The yielded dict is filled at its end."""
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
        """Wait until the device has finished everything that was enqueued."""
        _check_process()
        self.uploads.finish()
        self.queue.finish()

    def buffer(self, bytes_: int) -> cl.Buffer:
        """Return an uninitialised buffer. Keep it until the device is done with it."""
        _check_process()
        flags, bytes_ = cl.mem_flags.READ_WRITE, max(int(bytes_), 4)
        if self.info.kind != "cpu":
            return cl.Buffer(self.context, flags, bytes_)
        # NumPy allocates large pages where the system has them. There are far fewer page faults and
        # TLB misses than in memory that a driver allocates.
        return self.share(aligned(np.empty, (bytes_,), np.uint8))

    def share(self, array: np.ndarray) -> cl.Buffer:
        """Return a buffer with the contents of an array: its own memory on a CPU, else a copy.

        Keep both, and do not change the array, until the device is done with them.
        """
        _check_process()
        how = cl.mem_flags.USE_HOST_PTR if self.info.kind == "cpu" else cl.mem_flags.COPY_HOST_PTR
        access = cl.mem_flags.READ_WRITE if array.flags.writeable else cl.mem_flags.READ_ONLY
        return cl.Buffer(self.context, access | how, hostbuf=array)

    def upload(self, array: np.ndarray) -> cl.Buffer:
        """Return a buffer with a copy of `array`, or an uninitialised buffer if it is empty."""
        _check_process()
        if not array.size:
            return self.buffer(0)
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.context, flags, hostbuf=np.ascontiguousarray(array))

    def read(self, buffer: cl.Buffer, into: np.ndarray) -> None:
        """Copy a buffer into an array, after everything that was enqueued before."""
        _check_process()
        cl.enqueue_copy(self.queue, into, buffer)

    def zeros(self, bytes_: int) -> cl.Buffer:
        """Return a buffer of zeros."""
        if self.info.kind == "cpu":
            return self.share(aligned(np.zeros, (max(int(bytes_), 4),), np.uint8))
        buffer = self.buffer(bytes_)
        cl.enqueue_fill_buffer(self.queue, buffer, np.zeros(1, np.uint32), 0, buffer.size)
        return buffer


def _built(context: cl.Context, text: str, options: Sequence[str] = ()) -> cl.Program:
    """Return a built program.

    Raises
    ------
    DeviceError
        If PoCL has too little space, for which LLVM would end the process.
    pyopencl.RuntimeError
        If the driver's compiler refuses the program.
    """
    if context.devices[0].platform.name == POCL and (why := _pocl_problem()):
        raise DeviceError(why)
    with warnings.catch_warnings():
        # Some compilers print a greeting. If a build fails, the error contains the log in any case.
        warnings.simplefilter("ignore", cl.CompilerWarning)
        return cl.Program(context, text).build(list(options))


def aligned(make: Callable[..., np.ndarray], shape: tuple[int, ...], kind: DTypeLike) -> np.ndarray:
    """Return an array made by np.empty or np.zeros that begins at the start of a page."""
    count = math.prod(shape) * np.dtype(kind).itemsize
    memory = make(count + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + count].view(kind).reshape(shape)


def _check_process() -> None:
    """Raise DeviceError in a process that was forked after its parent had used OpenCL.

    The threads of drivers exist only in the parent, and the forked process would wait for them for
    ever.
    """
    if _first_process() != os.getpid():
        raise DeviceError(
            "OpenCL cannot be used in a process that was forked after its parent had used it, "
            "because the threads of its drivers exist only in the parent. Start processes with "
            'multiprocessing.get_context("spawn"), or fork before OpenCL is used and before '
            "devices are listed"
        )


@functools.cache
def _first_process() -> int:
    """Return the id of the process that called this first, also in processes forked from it."""
    return os.getpid()


@functools.cache
def _prepare_caches() -> str:
    """Make PoCL and PyOpenCL use private folders; return why PoCL has none, or "" if it has one.

    Both load code from their caches. Without this, PoCL uses the folder that a variable names, and
    /tmp/pocl if there is no home directory, whoever can write there. It reads the variable when
    platforms are first listed.
    """
    try:
        for name in ("pytools", "pyopencl"):
            _check_space(made_private(user_caches() / name, "XDG_CACHE_HOME"))
    except OSError:
        # The variable PYOPENCL_NO_CACHE is read when PyOpenCL is imported, which is too early.
        cl._PYOPENCL_NO_CACHE = True
    given = os.environ.get(_POCL_VARIABLE)
    try:
        folder = made_private(Path(given), _POCL_VARIABLE) if given else private_folder("kernels")
    except OSError as error:
        os.environ[_POCL_VARIABLE] = os.devnull  # PoCL cannot write there, and has no device
        return f"PoCL cannot be used: {error}"
    os.environ[_POCL_VARIABLE] = str(folder.absolute())
    return ""


def _pocl_problem() -> str:
    """Return why PoCL cannot write its cache folder, which it needs to build; "" if it can."""
    if why := _prepare_caches():
        return why
    folder = os.environ[_POCL_VARIABLE]
    try:
        _check_space(Path(folder))
    except OSError as error:
        return (
            f"PoCL cannot write {_KERNEL_BYTES >> 20} MiB to its cache folder {folder!r} "
            f"({error.strerror}). Set the environment variable {_POCL_VARIABLE} to a folder that "
            "can be written"
        )
    return ""


def _check_space(folder: Path) -> None:
    """Raise OSError if there is no space for a kernel in a folder, or it cannot be written."""
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(_KERNEL_BYTES))
