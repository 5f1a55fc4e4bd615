"""Worker processes on this machine that only this user can reach: a Dask cluster behind TLS.

A Dask scheduler runs any code that a client sends, and other users of the machine can connect to
its port. Therefore every connection needs a certificate, which exists only in the memory of this
run's processes. Dask's HTTP pages are switched off.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from distributed import Client, Nanny, Scheduler, Security, SpecCluster, Worker
from distributed.system import MEMORY_LIMIT

from clsas.core.cache import cache_folder
from clsas.core.threads import uninterrupted


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
        If the cache folder cannot be written.
    """
    security = _certificate()
    # Workers import modules from their folder, so it must not be shared with others as /tmp is.
    folder = cache_folder() / "workers"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    shared = {
        "host": "127.0.0.1",
        "protocol": "tls://",
        "security": security,
        "dashboard": False,
        "dashboard_address": None,
    }
    worker = {
        **shared,
        "worker_class": _Worker,
        "nthreads": 1,
        "memory_limit": MEMORY_LIMIT // workers,
        "local_directory": str(folder),
        "silence_logs": logging.CRITICAL,
    }
    # A terminal sends Ctrl-C to all processes. Only this one heeds it, and ends the others.
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        cluster = SpecCluster(
            scheduler={"cls": _Scheduler, "options": {**shared, "port": 0}},
            workers={index: {"cls": Nanny, "options": worker} for index in range(workers)},
            security=security,
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        raise ChildProcessError(
            f"a worker process ended while it started: {_cause(error)}"
        ) from error
    finally:
        signal.signal(signal.SIGINT, previous)
    opened = ExitStack()
    try:
        with uninterrupted():
            opened.enter_context(cluster)
            client = opened.enter_context(Client(cluster))
        yield client
    finally:
        with uninterrupted():
            opened.close()


def _certificate() -> Security:
    try:
        return Security.temporary()
    except ImportError:
        raise ImportError(
            "worker processes need the package cryptography, which makes the certificate that "
            "keeps other users out: pip install 'clsas[mosaic]'"
        ) from None


def _cause(error: BaseException) -> str:
    """Return the first cause of an exception, on one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = " ".join(str(error).split())
    # This is all that Dask reports about a process that was killed.
    if text == "Nanny failed to start worker process":
        return "it was killed or exited by itself (out of memory?)"
    return f"{type(error).__name__}: {text}"
