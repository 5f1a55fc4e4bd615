"""Work in threads that Ctrl-C can interrupt at any time.

Python raises `KeyboardInterrupt` anywhere in the main thread, even between acquiring a lock and the
code that releases it. Threads that need the lock then wait for ever. Ctrl-C is therefore delayed
while the main thread uses objects that it shares with other threads.
"""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from clsas.engine.data import validate

_POLL_S = 0.1  # longest time for which waiting delays Ctrl-C

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block, which must be short."""
    handler = signal.getsignal(signal.SIGINT)
    # Only Python's handlers interrupt, and they interrupt only the main thread.
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    came: list[tuple] = []
    signal.signal(signal.SIGINT, lambda *signalled: came.append(signalled))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came:
            handler(*came[0])


def wait(futures: Collection[Future], timeout: float | None = None) -> set[Future]:
    """Wait until any future is done and return those that are; none after `timeout` seconds."""
    left = timeout
    while True:
        with uninterrupted():
            step = _POLL_S if left is None else min(left, _POLL_S)
            done = wait_for(futures, step, FIRST_COMPLETED).done
        if left is not None:
            left -= step
        if done or left == 0:
            return done


def cores() -> int:
    """Return the number of cores that this process may use, which can be fewer than there are."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int | None = None
) -> Iterator[Result]:
    """Yield the results of a function for every item, in order, computed by threads.

    Parameters
    ----------
    function : callable
        Called with one item. Ctrl-C, or closing the generator, waits for the calls that have begun.
    items : iterable
        Items, which are read a few ahead of the results, so that few results wait in memory.
    workers : int, optional
        Number of threads; by default `cores`.
    """
    if workers is not None:
        workers = validate.count("workers", workers)
    futures: deque[Future[Result]] = deque()
    workers, left = workers or cores(), iter(items)
    pool = ThreadPoolExecutor(workers)

    def submit(count: int) -> None:
        futures.extend(pool.submit(function, item) for item in islice(left, count))

    try:
        with uninterrupted():
            submit(2 * workers)
        while futures:
            wait([futures[0]])
            with uninterrupted():
                result = futures.popleft().result()
                submit(1)
            yield result
    finally:
        with uninterrupted():
            pool.shutdown(cancel_futures=True)
