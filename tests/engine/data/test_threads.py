"""Work in threads, with Ctrl-C at any point of the main thread."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future

import pytest

from clsas.engine.data.threads import cores, in_threads, uninterrupted, wait

# Ctrl-C at the n-th line that the main thread executes in Python's own locks and pools.
EVERYWHERE = """
import faulthandler, signal, sys, threading, time
from clsas.engine.data.threads import in_threads

faulthandler.dump_traceback_later(50, exit=True)
OURS = ("threading.py", "_base.py", "thread.py")

def interrupted_at(number):
    left = number
    def traced(frame, event, arg):
        nonlocal left
        if not frame.f_code.co_filename.endswith(OURS):
            return None
        if event == "line":
            left -= 1
            if left == 0:
                sys.settrace(None)
                signal.raise_signal(signal.SIGINT)
        return traced
    sys.settrace(traced)
    try:
        return list(in_threads(abs, range(-2, 2), 2))
    except KeyboardInterrupt:
        return None
    finally:
        sys.settrace(None)

signal.signal(signal.SIGINT, signal.default_int_handler)
number = 0
while (found := interrupted_at(number := number + 1)) is None:
    pass
assert found == [2, 1, 0, 1], found
assert threading.active_count() == 1, threading.enumerate()
print(number)
"""


@pytest.mark.exhaustive
def test_ctrl_c_never_leaves_a_lock_taken():
    done = subprocess.run(
        [sys.executable, "-c", EVERYWHERE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100, "hardly any line was interrupted"


@pytest.fixture
def heeded():
    """Let Ctrl-C interrupt, as at a terminal. Background jobs of a shell ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_comes_at_the_end_of_the_block(heeded):
    done = []

    @uninterrupted()
    def work():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        done.append("all")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["all"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_program_is_called_once(heeded):
    calls = []
    signal.signal(signal.SIGINT, lambda *_: calls.append("mine"))
    with uninterrupted():
        signal.raise_signal(signal.SIGINT)
        assert not calls
    assert calls == ["mine"]


def test_where_ctrl_c_is_ignored_it_stays_so(heeded):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with uninterrupted():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_other_threads_leave_signals_alone():
    done = []

    def work():
        with uninterrupted():
            done.append("all")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == ["all"]


def test_waiting_ends_in_time():
    start = time.monotonic()
    assert wait([Future()], 0.25) == set()
    assert time.monotonic() - start >= 0.25


def test_closing_early_leaves_the_rest():
    begun, before = [], set(threading.enumerate())
    results = in_threads(lambda item: begun.append(item) or time.sleep(0.02), range(100), 2)
    next(results)
    results.close()
    assert len(begun) < 100
    assert set(threading.enumerate()) <= before


def test_errors_come_out():
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda item: 1 / item, [1, 0, 1]))


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3}, raising=False)
    assert cores() == 2
    monkeypatch.delattr(os, "sched_getaffinity")
    assert cores() == os.cpu_count()


def test_workers_are_checked():
    with pytest.raises(ValueError, match="workers"):
        list(in_threads(abs, [1], 0))
