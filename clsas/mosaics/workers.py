"""Worker processes on this machine that only this user can reach: a Dask cluster behind TLS.

A Dask scheduler runs any code that a client sends, and other users of the machine can connect to
its port. Therefore every connection needs a certificate, which exists only in the memory of this
run's processes. Dask's HTTP pages are switched off. No module is imported from a folder to which
others can write.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from dask import config
from distributed import Client, Nanny, Scheduler, Security, SpecCluster, Worker
from distributed.comm.core import CommClosedError
from distributed.system import MEMORY_LIMIT

from clsas.engine.data.cache import private_folder
from clsas.engine.data.extras import needed
from clsas.engine.data.threads import uninterrupted

_SAFE_PATH = "PYTHONSAFEPATH"


class _NoPages:
    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Do nothing. Dask's own server listens even if the dashboard is off."""


class _Scheduler(_NoPages, Scheduler):
    pass


class _Worker(_NoPages, Worker):
    pass


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Start worker processes with one thread each, yield a client, and end them afterwards.

    Raises
    ------
    ImportError
        If `cryptography`, which makes the certificate, is not installed.
    ChildProcessError
        If a worker ends during its start.
    OSError
        If the cache folder cannot be written, or others can write to it.
    """
    # Scheduler and workers import modules from their folder, so it must be private.
    folder = private_folder("workers")
    opened = ExitStack()
    try:
        with uninterrupted():
            opened.enter_context(_environment_of_workers())
            with _deaf_to_ctrl_c():
                cluster = opened.enter_context(_cluster(workers, folder))
            client = opened.enter_context(Client(cluster))
        yield client
    finally:
        with uninterrupted():
            opened.close()


def _cluster(workers: int, folder: Path) -> SpecCluster:
    with needed("the certificate that keeps other users out of worker processes"):
        import cryptography  # noqa: F401 (Dask imports it, and reports its absence otherwise)
    security = Security.temporary()
    shared = {
        "host": "127.0.0.1",
        "protocol": "tls://",
        "security": security,
        "dashboard": False,
        "dashboard_address": None,
        "local_directory": str(folder),
    }
    worker = {
        **shared,
        "worker_class": _Worker,
        "nthreads": 1,
        "memory_limit": MEMORY_LIMIT // workers,
        "silence_logs": logging.CRITICAL,
    }
    try:
        return SpecCluster(
            scheduler={"cls": _Scheduler, "options": {**shared, "port": 0}},
            workers={index: {"cls": Nanny, "options": worker} for index in range(workers)},
            security=security,
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, CommClosedError) as error:
        raise ChildProcessError(
            f"a worker process ended while it started: {_cause(error)}"
        ) from error


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Start the processes of a cluster so that they ignore Ctrl-C.

    A terminal sends Ctrl-C to all processes. Only this process handles it, and ends the others.
    A process inherits its blocked signals from the thread that starts it. Here this is the thread
    of the cluster, which inherits them from the present thread.
    """
    # Otherwise starting the first process would start the tracker, which unblocks Ctrl-C.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Prevent the processes that are started from importing modules of the working directory.

    Workers start as `python -c`, which searches the working directory first, and others may be able
    to write to it. Afterwards the environment variables and `sys.path` are restored: Dask sets the
    variables of its workers, such as OMP_NUM_THREADS = 1, in this process too, and adds the folder
    of a scheduler to `sys.path`.
    """
    of_dask = config.get("distributed.nanny.pre-spawn-environ")
    names = (_SAFE_PATH, "PYTHONHASHSEED", "__DASK_PARENT_PID", *of_dask)
    before, folders = {name: os.environ.get(name) for name in names}, list(sys.path)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        sys.path[:] = folders
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _cause(error: BaseException) -> str:
    """Return the first cause of an exception, on one line."""
    killed = "it was killed or exited by itself (out of memory?)"
    if isinstance(error, CommClosedError):  # the connection broke before the process was missed
        return killed
    while error.__cause__ is not None:
        error = error.__cause__
    text = " ".join(str(error).split())
    # Dask reports nothing else about a process that was killed.
    if text == "Nanny failed to start worker process":
        return killed
    return f"{type(error).__name__}: {text}"
