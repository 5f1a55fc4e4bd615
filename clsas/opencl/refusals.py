"""Why OpenCL cannot be used: there is no driver, PoCL has no cache, or the process was forked."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING

import pyopencl as cl

from clsas.core.extras import install_command

if TYPE_CHECKING:
    from clsas.opencl.device import DeviceInfo

_HOW_TO_GET_A_DEVICE = """\
No OpenCL device was found. Any one of these gives one:
  - a CPU driver from PyPI:  {command}
  - the vendor's driver of your GPU or CPU, which installs an .icd file in /etc/OpenCL/vendors;
    PyOpenCL's wheel looks there and in {folder}
    (copy or write an .icd file there when the driver lives in your Python environment:
    it is one line, the path of the driver's shared library).
  The environment variable OCL_ICD_VENDORS, where it is set, replaces these places."""


POCL = "Portable Computing Language"
"""Name of PoCL's platform."""
_KERNEL_BYTES = 1 << 16  # arbitrary: of a kernel on disk; a full disk has no room for it


class DeviceError(RuntimeError):
    """No OpenCL device fits, it refused to build a kernel, or the process was forked."""


def no_device() -> DeviceError:
    """Return the error that says why there is no device, and how to get one."""
    if any(platform.name == POCL for platform in _platforms()) and (why := _cache_problem()):
        return DeviceError(f"No OpenCL device was found: {why}")
    folder = Path(cl.__file__).parent / ".libs"
    return DeviceError(_HOW_TO_GET_A_DEVICE.format(folder=folder, command=install_command("pocl")))


def no_match(what: str, devices: Sequence[DeviceInfo]) -> DeviceError:
    """Return the error that says why none of some devices is what was asked for.

    PoCL has no device where it cannot write its cache.
    """
    of_pocl = any(info.platform == POCL for info in devices)
    why = "" if of_pocl or all(each.name != POCL for each in _platforms()) else _cache_problem()
    return DeviceError(f"No device matches {what}{why and f'. {why}'}")


def not_built(what: str, platform: str, error: cl.Error) -> DeviceError:
    """Return the error that says why a driver of a platform could not build something."""
    if platform == POCL and (why := _cache_problem()):
        return DeviceError(f"{what}: {why}")
    return DeviceError(f"{what}:\n{indent(str(error), '  ', lambda line: True)}")


def _platforms() -> list[cl.Platform]:
    try:
        return cl.get_platforms()
    except cl.LogicError:  # the loader found no driver at all
        return []


def check_process() -> None:
    """Raise DeviceError in a process that was forked after its parent had used OpenCL.

    Threads of drivers stay behind in the parent: whatever waits for them waits for ever.
    """
    if _first_process() != os.getpid():
        raise DeviceError(
            "OpenCL cannot be used in a process that was forked after its parent had used it: the "
            "threads of its drivers stay in the parent. Start processes by "
            'multiprocessing.get_context("spawn"), or fork before OpenCL is used, also before '
            "devices are listed"
        )


@functools.cache
def _first_process() -> int:
    """Return the process that called this first, in it and in those forked from it since."""
    return os.getpid()


def _cache_problem() -> str:
    """Return why PoCL cannot write its cache folder, without which it builds nothing, or ""."""
    folder = _cache_folder()
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_KERNEL_BYTES))
    except OSError as error:
        return (
            f"PoCL cannot write its cache folder {folder!r} ({error.strerror}). Set the "
            "environment variable POCL_CACHE_DIR to a folder that can be written"
        )
    return ""


def _cache_folder() -> str:
    """Return the folder in which PoCL keeps built kernels."""
    given = os.environ.get("POCL_CACHE_DIR")
    if given is not None:
        return given
    if caches := os.environ.get("XDG_CACHE_HOME"):
        return f"{caches}/pocl/kcache"
    home = os.environ.get("HOME")
    return "/tmp/pocl/kcache" if home is None else f"{home}/.cache/pocl/kcache"
