"""Errors if OpenCL cannot be used: no driver, no private cache for PoCL, or a forked process."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pyopencl as cl

from clsas.engine.data.cache import made_private, private_folder, user_caches
from clsas.engine.data.extras import install_command

if TYPE_CHECKING:
    from clsas.engine.device.device import DeviceInfo

_HOW_TO_GET_A_DEVICE = """\
No OpenCL device was found. Any one of the following provides one:
  - a CPU driver from PyPI:  {command}
  - the vendor's driver of your GPU or CPU, which installs an .icd file in /etc/OpenCL/vendors;
    PyOpenCL's wheel looks there and in {folder}
    (copy or write an .icd file there if the driver is part of your Python environment:
    it is one line, the path of the driver's shared library).
  The environment variable OCL_ICD_VENDORS, if it is set, replaces these folders."""


POCL = "Portable Computing Language"
"""Name of PoCL's platform."""
_POCL_VARIABLE = "POCL_CACHE_DIR"
# Space that PoCL needs to build a kernel. Those of an image took up to 1.2 MiB at a time, most of
# which PoCL frees again. If less is left, LLVM ends the process.
_KERNEL_BYTES = 4 << 20


class DeviceError(RuntimeError):
    """Error if no OpenCL device matches, a kernel cannot be built, or the process was forked."""


def no_device() -> DeviceError:
    """Return the error for a machine without devices, which says how to get one."""
    if any(platform.name == POCL for platform in _platforms()) and (why := _pocl_problem()):
        return DeviceError(f"No OpenCL device was found: {why}")
    folder = Path(cl.__file__).parent / ".libs"
    return DeviceError(_HOW_TO_GET_A_DEVICE.format(folder=folder, command=install_command("pocl")))


def no_match(what: str, devices: Sequence[DeviceInfo]) -> DeviceError:
    """Return the error for a request that no device matches.

    If PoCL is installed but has no private folder that it can write to, it has no device, and the
    message says so.
    """
    of_pocl = any(info.platform == POCL for info in devices)
    why = "" if of_pocl or all(each.name != POCL for each in _platforms()) else _pocl_problem()
    return DeviceError(f"No device matches {what}{why and f'. {why}'}")


def check_cache(platform: str) -> None:
    """Raise DeviceError if a platform has no cache folder, or no space in it, to build a kernel."""
    if platform == POCL and (why := _pocl_problem()):
        raise DeviceError(why)


def _platforms() -> list[cl.Platform]:
    try:
        return cl.get_platforms()
    except cl.LogicError:  # the loader found no driver at all
        return []


def check_process() -> None:
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
def prepare_caches() -> str:
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
    if why := prepare_caches():
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
