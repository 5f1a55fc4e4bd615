"""Worker processes of this machine, which nobody else can use: a Dask cluster behind TLS.

A Dask scheduler runs whatever code a client sends it, and other users of the machine can connect
to its port. So every connection needs a certificate that exists only in the memory of this run's
processes, and the HTTP pages that Dask serves besides are not served.
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
        """Start none: Dask's own listens even where the dashboard is off."""


class _Scheduler(_NoPages, Scheduler):
    pass


class _Worker(_NoPages, Worker):
    pass


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Give a client of worker processes with one thread each; end them afterwards.

    Raises
    ------
    ImportError
        If `cryptography` is not installed, which makes the certificate.
    ChildProcessError
        If a worker ends while it starts.
    OSError
        If the cache folder cannot be written.
    """
    security = _certificate()
    # Workers import modules from their folder: it must be this user's, not one shared in /tmp.
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
    # Ctrl-C at a terminal is for this process, which then ends the others.
    heeded = signal.signal(signal.SIGINT, signal.SIG_IGN)
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
        signal.signal(signal.SIGINT, heeded)
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
    """Return the first of a chain of exceptions, on one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = " ".join(str(error).split())
    # Dask says no more of a process that died without a word.
    if text == "Nanny failed to start worker process":
        return "it was killed or exited by itself (out of memory?)"
    return f"{type(error).__name__}: {text}"
