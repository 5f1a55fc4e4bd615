"""Environments for other codes, and the processes in which the codes run."""

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

from clsas.engine.data.cache import private_folder

Ask = Callable[..., dict]

_BUILD = ("setuptools", "packaging", "wheel", "ninja", "numpy", "scipy")


class PeerError(Exception):
    """A code cannot be installed or run on this machine."""


def environment(name: str, *requirements: Sequence[str | Path]) -> Path:
    """Return the Python of an environment, which is created if necessary.

    Each entry of `requirements` contains the arguments of one call of pip.
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
    """Return the Python of an environment with torchbp, which is built if necessary.

    The build uses a copy of the checkout. Every state of the sources has its own environment.
    """
    if not (folder / "setup.py").exists() or not (folder / "torchbp").is_dir():
        raise PeerError(f"{folder} is not a checkout of torchbp: it lacks setup.py or torchbp/")
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

    If a number of cores is given, the program may use no more. Its affinity and the environment
    variables of OpenMP and PoCL are set accordingly.
    """
    environ, allowed = dict(os.environ), os.sched_getaffinity(0)
    if cores is not None:
        if cores > len(allowed):
            raise PeerError(f"{cores} cores were requested, but only {len(allowed)} are available")
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
            raise PeerError(
                f"{program.name} ended with exit code {process.wait()}; its messages are above"
            )
        return json.loads(line)

    try:
        yield ask
    except BaseException:
        process.kill()  # an image in progress may take minutes
        raise
    finally:
        process.communicate()
