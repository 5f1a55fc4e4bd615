"""Devices that form a mosaic's patches side by side: every worker takes one."""

from __future__ import annotations

import contextlib
import os
import queue
import tempfile
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import (
    ENVIRONMENT_VARIABLE,
    Device,
    DeviceInfo,
    choose,
    list_devices,
    open_device,
)

_MOST_WORKERS = 1024  # on one machine: arbitrary, and more than any machine runs
_THREAD = threading.local()  # its `device` is that of the thread
_CLAIMING = threading.Lock()


def open_devices(request: Any) -> tuple[Device, ...]:
    """Return the devices that form patches side by side.

    Parameters
    ----------
    request : Device, str, int, sequence of them, or None
        See `clsas.mosaic`.

    Raises
    ------
    ValueError
        If the sequence is empty or names a device twice.
    DeviceError
        If there is no such device.
    """
    if isinstance(request, Sequence) and not isinstance(request, (str, bytes)):
        if not request:
            raise ArgumentError("device", "name at least one device", "an empty sequence")
        found = tuple(open_device(each) for each in request)
    elif request is not None:
        found = (open_device(request),)
    else:
        found = tuple(open_device(info.index) for info in default_devices())
    names = {device.info.index for device in found}
    if len(names) < len(found):
        named = ", ".join(device.info.label for device in found)
        raise ArgumentError("device", "name each device once", named)
    return found


def default_devices() -> list[DeviceInfo]:
    """Return all GPUs if there are several and the user chose none, else the chosen device."""
    first, _ = choose()
    alike = [info for info in list_devices() if info.kind == first.kind == "gpu"]
    return [first] if len(alike) < 2 or os.environ.get(ENVIRONMENT_VARIABLE) else alike


def device_threads(workers: int, devices: Sequence[Device]) -> ThreadPoolExecutor:
    """Return a pool of threads, each of which takes a device of its own."""
    free: queue.SimpleQueue[Device] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    return ThreadPoolExecutor(workers, initializer=lambda: setattr(_THREAD, "device", free.get()))


def thread_device() -> Device:
    """Return the device of this thread of `device_threads`."""
    return _THREAD.device


def process_device() -> Device:
    """Return the device of this worker process, which its threads share."""
    with _CLAIMING:
        return open_device(claim_device()[0].index)


@lru_cache(maxsize=1)
def claim_device() -> tuple[DeviceInfo, int | None]:
    """Claim a device for this process; return it and the descriptor of the file that is locked.

    Each worker process on this machine takes the next device. If there are more workers than
    devices, they share them evenly.
    """
    import fcntl

    devices = default_devices()
    for slot in range(_MOST_WORKERS):
        path = Path(tempfile.gettempdir()) / f"clsas-{os.getuid()}-worker-{slot}"
        with contextlib.suppress(OSError):  # it is another worker's or another user's
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(lock)
                raise
            return devices[slot % len(devices)], lock
    return devices[0], None
