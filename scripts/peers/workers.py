"""Environments that hold other codes, and the processes in which every code runs."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from clsas.core.cache import private_folder

Ask = Callable[..., dict]

_BUILD = ("setuptools", "packaging", "wheel", "ninja", "numpy", "scipy")


class PeerError(Exception):
    """Another code cannot be installed or run here."""


def environment(name: str, *requirements: Sequence[str | Path]) -> Path:
    """Return the Python of an environment of a name; make it if needed.

    Each of the requirements are the arguments of one call of pip, one after the other.
    """
    folder = private_folder("peers") / name
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        print(f"installing {name} in {folder}", file=sys.stderr)
        venv.create(folder, with_pip=True, clear=True)
        for each in requirements:
            done = subprocess.run(
                [python, "-m", "pip", "install", "--quiet", *each],
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                last = done.stderr.strip().splitlines()[-1:]
                raise PeerError(f"{name} cannot be installed: {''.join(last)}")
        (folder / "ready").touch()
    return python


def built(folder: Path, torch: str) -> Path:
    """Return the Python of an environment that holds a checkout of torchbp; build it if needed.

    A copy of the checkout is built. Another state of its sources has another environment.
    """
    if not (folder / "setup.py").exists() or not (folder / "torchbp").is_dir():
        raise PeerError(f"{folder} is no checkout of torchbp: it has no setup.py and torchbp/")
    digest = hashlib.sha256(torch.encode())
    for path in sorted(each for each in (folder / "torchbp").rglob("*") if each.is_file()):
        if path.suffix in {".py", ".cpp", ".h", ".cu", ".cuh"}:
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    with tempfile.TemporaryDirectory() as copy:
        source = shutil.copytree(
            folder, Path(copy) / "torchbp", ignore=shutil.ignore_patterns(".git", "build", "*.so")
        )
        return environment(
            f"torchbp-{digest.hexdigest()[:12]}",
            [torch, *_BUILD],
            ["--no-build-isolation", source],
        )


@contextmanager
def worker(
    python: Path | str, program: Path, scene_file: Path, cores: int | None = None
) -> Iterator[Ask]:
    """Yield a function that sends a request to the program of a code and returns its answer.

    With a number of cores the program has no more than so many, and is told so in the ways that
    OpenMP and PoCL listen to.
    """
    environ, allowed = dict(os.environ), os.sched_getaffinity(0)
    if cores is not None:
        if cores > len(allowed):
            raise PeerError(f"{cores} cores were asked for, and {len(allowed)} are there")
        environ |= {"OMP_NUM_THREADS": str(cores), "POCL_MAX_PTHREAD_COUNT": str(cores)}
        os.sched_setaffinity(0, sorted(allowed)[:cores])  # the program inherits it
    try:
        process = subprocess.Popen(
            [python, program, scene_file],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environ,
        )
    finally:
        os.sched_setaffinity(0, allowed)

    def ask(**request: object) -> dict:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            print(json.dumps(request), file=process.stdin, flush=True)
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise PeerError(f"{program.name} ended with {process.wait()}, its messages are above")
        return json.loads(line)

    try:
        yield ask
    except BaseException:
        process.kill()  # its image may take minutes
        raise
    finally:
        process.communicate()
