"""Ctrl-C at a command of clsas."""

import os
import signal
import subprocess
import sys
import time

# A shell's background jobs, and so what they start, ignore Ctrl-C.
HEEDING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from clsas.cli import main
main(prog_name="clsas")
"""


def interrupted(arguments, begins, folder=None, after_s=0.0):
    """Return the exit code and stderr of a command, interrupted after the line that `begins` so.

    The signal goes to the processes it started too, as from a terminal.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", HEEDING, *map(str, arguments)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        cwd=folder,
        text=True,
        start_new_session=True,
    )
    try:
        lines = [process.stderr.readline()]
        while not lines[-1].startswith(begins):
            assert lines[-1], f"it ended before {begins!r}: {lines}"
            lines.append(process.stderr.readline())
        time.sleep(after_s)
        os.killpg(process.pid, signal.SIGINT)
        _, rest = process.communicate(timeout=120)
        return process.returncode, "".join(lines) + rest
    finally:  # a hang fails the test and no more
        process.kill()
        process.stderr.close()
        process.wait()
